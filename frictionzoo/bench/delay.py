"""The delay of MuJoCo's actuators: what of an identified delay they can hold, and the attributes that say it."""

import math

from frictionzoo.bench.template import in_full

_ROUNDING = 1e-9  # share of a step


def round_delay(delay: float, timestep: float) -> float:
    """Return the delay nearest to this one that MuJoCo's actuators have in steps of this length [s].

    MuJoCo stores a command at the end of its step, so that the next step is the first in which a delayed one acts: a
    delay is zero, or one step or more. From one step on, fractions of a step are interpolated, and none is rounded.

    Source: MuJoCo documentation, XML reference, `actuator/general/delay`.
    """
    steps = delay / timestep
    return delay if steps >= 1 - _ROUNDING else timestep * round(steps)


def write_delay(delay: float, timestep: float) -> dict[str, str]:
    """Return the attributes by which an actuator delays its commands, none where the nearest delay is zero.

    Between two steps MuJoCo interpolates linearly: for a command that is held, that is its mean over the step, as in
    `frictionzoo.simulate.rollout.applied`.
    """
    rounded = round_delay(delay, timestep)
    if not rounded:
        return {}
    samples = math.ceil(rounded / timestep - _ROUNDING) + 2
    return {"delay": in_full(rounded), "nsample": str(samples), "interp": "linear"}
