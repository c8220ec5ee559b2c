"""What laws of friction that remember have in common: where they begin, and bristles that bend and slip."""

from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models.base import Values

_NEARLY_ZERO = 1e-2  # below it, the series is exact to 1e-10, and the quotient loses digits in float32


def settled_force(xp: Any, state: DriveState, limit: Any, rest_velocity: Any) -> Any:
    """Dry friction of a drive that has long been in this state [N m or N].

    At rest it holds whatever actuator and external torque ask for, up to the limit; in motion it is at the limit,
    against the motion. Between the two lies the rest velocity [rad/s or m/s], up to about which a measured joint may
    stand still.
    """
    asked = state.motor_torque + state.external_torque
    held = xp.minimum(xp.maximum(asked, -limit), limit)
    return settled(xp, state.qvel, rest_velocity, held, limit)


def settled(xp: Any, qvel: Any, rest_velocity: Any, held: Any, sliding: Any) -> Any:
    """What friction remembers of a drive that has long been at this velocity [rad/s or m/s]: held at rest, or sliding.

    What it is while sliding has the sign of the velocity; the rest velocity is that of `settled_force`.
    """
    share = qvel / rest_velocity
    slides = 1 - xp.exp(-xp.square(share))
    return (1 - slides) * held + slides * sliding * xp.tanh(share)


def remaining(xp: Any, rate: Any, timestep: float) -> tuple[Any, Any]:
    """How a bend z that follows z' = v - rate z ends a step in which v is constant: decay * z + reach * v.

    Both, decay [1] and reach [s], are exact for a constant rate of 0/s or more, so that no rate makes them unstable.
    """
    steps = rate * timestep
    small = steps < _NEARLY_ZERO
    divisor = xp.where(small, 1.0, steps)  # else the branch not taken would have a gradient that is not finite
    series = 1 - steps / 2 * (1 - steps / 3 * (1 - steps / 4))
    return xp.exp(-steps), timestep * xp.where(small, series, -xp.expm1(-divisor) / divisor)


def stribeck_bell(xp: Any, values: Values, velocity: Any) -> Any:
    """Share of what friction has at rest and loses over the Stribeck velocity [1]."""
    return xp.exp(-xp.square(velocity / values["stribeck_velocity"]))


def stribeck_force(xp: Any, values: Values, velocity: Any) -> Any:
    """Dry friction that falls with speed [N m or N], of static and kinetic torque and the Stribeck velocity."""
    excess = values["static_torque"] - values["kinetic_torque"]
    return values["kinetic_torque"] + excess * stribeck_bell(xp, values, velocity)


def slip(xp: Any, values: Values, state: DriveState, limit: Any) -> FrictionTerms:
    """What bristles come down to at constant velocity: dry friction at its limit [N m or N], and viscous friction."""
    dry = limit * xp.tanh(state.qvel / values["rest_velocity"])
    return FrictionTerms(torque=dry, damping=values["viscous_coefficient"])


def settled_bend(xp: Any, values: Values, state: DriveState, limit: Any) -> Any:
    """The bend of bristles of a joint at rest or in steady motion, of shape (..., nv, 1) [rad or m]."""
    return (settled_force(xp, state, limit, values["rest_velocity"]) / values["stiffness"])[..., None]


def bend(
    xp: Any, values: Values, state: DriveState, memory: Any, timestep: float, limit: Any, micro_damping: Any
) -> tuple[FrictionTerms, Any]:
    """Bristles that bend and yield at a limit [N m or N]: their torque at the end of a step, and the bend in the state.

    z' = v - s |v| z / limit, torque = s z + c z' + d v; of the stiffness s, the micro-damping c [N m s/rad or N s/m]
    and the viscous coefficient d, in a step of this length [s].
    """
    stiffness = values["stiffness"]
    rate = stiffness * xp.abs(state.qvel) / limit
    decay, reach = remaining(xp, rate, timestep)
    bent = decay * memory[..., 0] + reach * state.qvel
    # With z' = v - rate z at the end of the step: s z + c z' = (s - c rate) decay z + (s reach + c decay) v.
    torque = (stiffness - micro_damping * rate) * decay * bent
    damping = stiffness * reach + micro_damping * decay + values["viscous_coefficient"]
    return FrictionTerms(torque=torque, damping=damping), bent[..., None]
