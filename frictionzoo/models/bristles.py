"""Shared functions of models with memory: initial memory, and bristles that deflect and slip."""

from abc import abstractmethod
from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models.base import FrictionModel, Values

_NEARLY_ZERO = 1e-2  # below it the series is exact to 1e-10, while the quotient loses digits in float32


def settled_force(xp: Any, state: DriveState, limit: Any, rest_velocity: Any) -> Any:
    """Return the dry friction [N m or N] of a drive that has long been in this state.

    At rest it balances actuator and external torque, up to the limit; in motion it equals the limit and opposes the
    motion. The transition is at the rest velocity [rad/s or m/s]: below about this velocity a joint may stand still
    although its measured velocity is not 0.
    """
    load = state.motor_torque + state.external_torque
    holding = xp.minimum(xp.maximum(load, -limit), limit)
    return settled(xp, state.qvel, rest_velocity, holding, limit)


def settled(xp: Any, qvel: Any, rest_velocity: Any, held: Any, sliding: Any) -> Any:
    """Return the settled memory: `held` at rest, `sliding` with the velocity's sign in motion; see `settled_force`."""
    share = qvel / rest_velocity
    slides = 1 - xp.exp(-xp.square(share))
    return (1 - slides) * held + slides * sliding * xp.tanh(share)


def remaining(xp: Any, rate: Any, timestep: float) -> tuple[Any, Any]:
    """Return decay and reach of a step of z' = v - rate z with constant v: z ends at decay * z + reach * v.

    Decay [1] and reach [s] are exact for a constant rate of 0/s or more, so the step is stable at any rate.
    """
    steps = rate * timestep
    small = steps < _NEARLY_ZERO
    divisor = xp.where(small, 1.0, steps)  # keeps the gradient of the unused branch finite
    series = 1 - steps / 2 * (1 - steps / 3 * (1 - steps / 4))
    return xp.exp(-steps), timestep * xp.where(small, series, -xp.expm1(-divisor) / divisor)


def stribeck_bell(xp: Any, values: Values, velocity: Any) -> Any:
    """Return the remaining fraction [1] of the friction that decays over the Stribeck velocity, 1 at rest."""
    return xp.exp(-xp.square(velocity / values["stribeck_velocity"]))


def stribeck_force(xp: Any, values: Values, velocity: Any) -> Any:
    """Return dry friction [N m or N] that falls with speed from the static to the kinetic torque."""
    excess = values["static_torque"] - values["kinetic_torque"]
    return values["kinetic_torque"] + excess * stribeck_bell(xp, values, velocity)


def slip(xp: Any, values: Values, state: DriveState, limit: Any) -> FrictionTerms:
    """Return the friction of slipping bristles: dry friction at its limit [N m or N], and viscous friction."""
    dry = limit * xp.tanh(state.qvel / values["rest_velocity"])
    return FrictionTerms(torque=dry, damping=values["viscous_coefficient"])


class BristleModel(FrictionModel):
    """Bristles that deflect before they slip, at a limit that the subclass defines, and viscous friction.

    z' = v - s |v| z / limit, torque = s z + c z' + d v, with the memory z [rad or m], the `stiffness` s, the
    `viscous_coefficient` d, and the `micro_damping` c, 0 for a model without this parameter.
    """

    dissipative = True
    memory = 1

    @abstractmethod
    def limit(self, xp: Any, values: Values, state: DriveState) -> Any:
        """Return the dry friction of slipping bristles in this state [N m or N]; arguments as in `terms`."""

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Return the friction of slipping bristles."""
        return slip(xp, values, state, self.limit(xp, values, state))

    def settle(self, xp: Any, values: Values, state: DriveState) -> Any:
        """Return the deflection at rest or in steady motion [rad or m]."""
        force = settled_force(xp, state, self.limit(xp, values, state), values["rest_velocity"])
        return (force / values["stiffness"])[..., None]

    def advance(
        self, xp: Any, values: Values, state: DriveState, memory: Any, timestep: float
    ) -> tuple[FrictionTerms, Any]:
        """Return the bristle torque at the end of the step, and the deflection in this state."""
        stiffness, micro_damping = values["stiffness"], values.get("micro_damping", 0.0)
        limit, decay, reach, bent = self._bend(xp, values, state, memory, timestep)
        rate = stiffness * xp.abs(state.qvel) / limit
        # With z' = v - rate z at the end of the step: s z + c z' = (s - c rate) decay z + (s reach + c decay) v.
        torque = (stiffness - micro_damping * rate) * decay * bent
        damping = stiffness * reach + micro_damping * decay + values["viscous_coefficient"]
        return FrictionTerms(torque=torque, damping=damping), bent[..., None]

    def advance_midway(
        self, xp: Any, values: Values, state: DriveState, memory: Any, timestep: float
    ) -> tuple[FrictionTerms, Any]:
        """Return the bristle torque in the middle of the step, and the deflection there."""
        stiffness = values["stiffness"]
        limit, _, reach, bent = self._bend(xp, values, state, memory, timestep)
        # The part s reach of the damping brakes only the change of velocity, so the step is stable at any stiffness.
        damping = stiffness * reach + values["viscous_coefficient"]
        if "micro_damping" in values:
            # z' = (1 - s sign(v) z / limit) v
            damping = damping + values["micro_damping"] * (1 - stiffness * xp.sign(state.qvel) * bent / limit)
        return FrictionTerms(torque=stiffness * (bent - reach * state.qvel), damping=damping), bent[..., None]

    def _bend(self, xp: Any, values: Values, state: DriveState, memory: Any, timestep: float) -> tuple[Any, ...]:
        """Return the limit, decay and reach of a step (see `remaining`), and the deflection after it."""
        limit = self.limit(xp, values, state)
        decay, reach = remaining(xp, values["stiffness"] * xp.abs(state.qvel) / limit, timestep)
        return limit, decay, reach, decay * memory[..., 0] + reach * state.qvel
