"""What laws of friction that remember have in common: where they begin, and bristles that bend and slip."""

from typing import Any

from frictionzoo.core.state import DriveState
from frictionzoo.models.base import Values

_NEARLY_ZERO = 1e-2  # below it, the series is exact to 1e-10, and the quotient loses digits in float32


def settled_force(xp: Any, state: DriveState, limit: Any, rest_velocity: Any) -> Any:
    """Dry friction of a drive that has long been in this state [N m or N].

    At rest it holds whatever actuator and external torque ask for, up to the limit; in motion it is at the limit,
    against the motion. Between the two lies the rest velocity [rad/s or m/s], up to about which a measured joint may
    stand still.
    """
    share = state.qvel / rest_velocity
    slides = 1 - xp.exp(-xp.square(share))
    asked = state.motor_torque + state.external_torque
    held = xp.minimum(xp.maximum(asked, -limit), limit)
    return (1 - slides) * held + slides * limit * xp.tanh(share)


def remaining(xp: Any, rate: Any, timestep: float) -> tuple[Any, Any]:
    """How a bend z that follows z' = v - rate z ends a step in which v is constant: decay * z + reach * v.

    Both, decay [1] and reach [s], are exact for a constant rate of 0/s or more, so that no rate makes them unstable.
    """
    steps = rate * timestep
    small = steps < _NEARLY_ZERO
    divisor = xp.where(small, 1.0, steps)  # else the branch not taken would have a gradient that is not finite
    series = 1 - steps / 2 * (1 - steps / 3 * (1 - steps / 4))
    return xp.exp(-steps), timestep * xp.where(small, series, -xp.expm1(-divisor) / divisor)


def stribeck_force(xp: Any, values: Values, velocity: Any) -> Any:
    """Dry friction that falls with speed [N m or N], of static and kinetic torque and the Stribeck velocity."""
    excess = values["static_torque"] - values["kinetic_torque"]
    return values["kinetic_torque"] + excess * xp.exp(-xp.square(velocity / values["stribeck_velocity"]))
