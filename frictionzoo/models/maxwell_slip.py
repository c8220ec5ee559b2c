"""Friction of several springs that slip one after the other."""

from collections.abc import Iterator
from typing import Any

from frictionzoo.core.errors import refuse_outside
from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Parameter, Params, Values, register_model
from frictionzoo.models.bristles import settled_force, slip, stribeck_force


@register_model("maxwell_slip")
class MaxwellSlip(FrictionModel):
    """Generalised Maxwell-slip model: parallel springs that slip one after another as the displacement grows.

    Use it for presliding with closed loops, as in rolling bearings.

    Cannot represent: friction that depends on direction, load or position; a distribution of the elements other than
    equal limits and evenly spaced yield points.

    An element of force F_i, i = 1 ... N, that sticks:  dF_i/dt = k_i v,  k_i = f_k / (i x)
    that slips, from |F_i| = g(v) / N on:               dF_i/dt = (sign(v) g(v) / N - F_i) / t
    g(v) = f_k + (f_s - f_k) exp(-(v / v_s)^2)
    torque = sum of F_i + d v

        v    joint velocity [rad/s or m/s]
        F_i  forces of the elements, the model's memory [N m or N]
        x    presliding [rad or m], displacement after which all elements slip at f_k: element i yields after i x / N
        f_s  static_torque [N m or N], at the onset of motion
        f_k  kinetic_torque [N m or N], well above v_s
        v_s  stribeck_velocity [rad/s or m/s], over which friction falls from f_s to f_k
        t    lag [s], time constant with which slipping elements follow a falling g(v)
        d    viscous_coefficient [N m s/rad or N s/m]
        v_0  rest_velocity [rad/s or m/s], below about which a joint counts as at rest when a rollout starts; known

    An element below its limit sticks: if g rises, its force follows as a spring, not with the lag. A rollout starts
    with forces that balance the load if the joint rests, and with slipping elements if it moves. Sticking elements are
    evaluated at the end of the step through MuJoCo's implicit damping, so the step is stable at any stiffness. At
    constant velocity the friction is g(v) sign(v) + d v.

    Source: F. Al-Bender, V. Lampaert, J. Swevers, "The generalized Maxwell-slip model: a novel model for friction
    simulation and compensation", IEEE Transactions on Automatic Control 50(11), 2005.

    Args:
        elements: Number of elements.

    Raises:
        ConfigError: There is no element; see also `FrictionModel`.
    """

    physical_parameters = {
        "presliding": Parameter("position", 1e-3, 1e-6, 0.1),
        "static_torque": Parameter("torque", 0.05, 1e-4, 2),
        # Not equal to static_torque at the start, where stribeck_velocity has no gradient.
        "kinetic_torque": Parameter("torque", 0.03, 1e-4, 2),
        "stribeck_velocity": Parameter("velocity", 0.075, 0.005, 0.5),
        "lag": Parameter("time", 1e-3, 1e-5, 0.1),
        "viscous_coefficient": Parameter("damping", 0.03, 1e-4, 10),
        "rest_velocity": Parameter("velocity", 0.01, 0.001, 0.1, identify=False),  # a property of the measurement
    }
    valleys = {"stribeck_velocity": (0.3, 3.0), "presliding": (0.1, 10.0)}
    dissipative = True
    sees = ("speed", "slow", "reversal")

    def __init__(self, nv: int, elements: int = 4, params: Params | None = None) -> None:
        super().__init__(nv, params)
        refuse_outside("model.elements", elements, 1, 1000)
        self.memory = elements

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Return the friction with all elements slipping."""
        return slip(xp, values, state, stribeck_force(xp, values, state.qvel))

    def settle(self, xp: Any, values: Values, state: DriveState) -> Any:
        """Return equal forces for all elements."""
        force = settled_force(xp, state, stribeck_force(xp, values, state.qvel), values["rest_velocity"])
        return xp.stack([force / self.memory] * self.memory, -1)

    def advance(
        self, xp: Any, values: Values, state: DriveState, memory: Any, timestep: float
    ) -> tuple[FrictionTerms, Any]:
        """Return the torque of slipping elements and of sticking ones at the end of the step, and all forces."""
        forces, torque, damping = [], 0.0, values["viscous_coefficient"]
        for force, following, added in self._elements(xp, values, state, memory, timestep):
            torque = torque + following
            damping = damping + added
            forces.append(force)
        return FrictionTerms(torque=torque, damping=damping), xp.stack(forces, -1)

    def advance_midway(
        self, xp: Any, values: Values, state: DriveState, memory: Any, timestep: float
    ) -> tuple[FrictionTerms, Any]:
        """Return the torque of all elements in the middle of the step, and all forces."""
        forces, added = [], 0.0
        for force, _, more in self._elements(xp, values, state, memory, timestep):
            added = added + more
            forces.append(force)
        # That damping brakes only the change of velocity, so the step is stable at any stiffness.
        terms = FrictionTerms(sum(forces) - added * state.qvel, damping=added + values["viscous_coefficient"])
        return terms, xp.stack(forces, -1)

    def _elements(
        self, xp: Any, values: Values, state: DriveState, memory: Any, timestep: float
    ) -> Iterator[tuple[Any, Any, Any]]:
        """Yield each element's force, and its torque at the end of the step as a torque and a damping."""
        limit = stribeck_force(xp, values, state.qvel) / self.memory
        follows = xp.exp(-timestep / values["lag"])
        softest = values["kinetic_torque"] / values["presliding"]
        for element in range(self.memory):
            stiffness = softest / (element + 1)
            force, _ = _move(xp, memory[..., element], stiffness * timestep * state.qvel, limit, follows)
            following, slips = _move(xp, force, stiffness * timestep * state.qvel, limit, follows)
            yield force, xp.where(slips, following, force), xp.where(slips, 0.0, stiffness * timestep)


def _move(xp: Any, force: Any, pull: Any, limit: Any, follows: Any) -> tuple[Any, Any]:
    """Return an element's force after its spring force changes by `pull` in a step, and whether it slips."""
    pulled = force + pull
    slips = (xp.abs(pulled) > limit) & (pulled * pull > 0)
    above = xp.maximum(xp.abs(force), limit) - limit
    return xp.where(slips, xp.sign(pulled) * (limit + above * follows), pulled), slips
