"""The delay of MuJoCo's actuators: attributes that say it."""

import math

import numpy as np
from jaxtyping import Float

from frictionzoo.bench.template import in_full

_ROUNDING = 1e-9  # share of a step
_SHORTEST = 0.1  # of a step, filter under RK4


def write_delay(delay: float, timestep: float) -> dict[str, str]:
    """Return the attributes by which an actuator delays its commands in steps of this length [s].

    Between two steps MuJoCo interpolates linearly: for a command that is held, that is its mean over the step, as in
    `frictionzoo.simulate.rollout.applied`. It stores a command at the end of its step, so that such a delay is one step
    or more. A shorter one is a first-order filter whose activation lags a steady change by as much: in each step it
    goes 1 / (1 + delay / timestep) of the way to the command.

    Source: MuJoCo documentation, XML reference, `actuator/general/delay`; "Computation", "Actuation model".
    """
    steps = delay / timestep
    if steps >= 1 - _ROUNDING:
        samples = math.ceil(steps - _ROUNDING) + 2
        return {"delay": in_full(delay), "nsample": str(samples), "interp": "linear"}
    if steps < _ROUNDING:
        return {}
    return {"dyntype": "filterexact", "dynprm": in_full(timestep / math.log1p(1 / steps)), "actearly": "true"}


def stretch(delay: Float[np.ndarray, "..."], timestep: float) -> Float[np.ndarray, "..."]:
    """Return the delays [s] to write for MuJoCo's RK4, so that commands act this late in steps of this length [s].

    RK4 looks at a late command at a step's begin, middle and end, with weights of 1/6, 2/3 and 1/6, and takes the last
    one that is stored where a later one is needed. A steady change is late by half a step less than the delay says, and
    by less than that where the delay is shorter than two steps. Filters are as late as they say, but RK4 is unstable
    for those of less than a fifteenth of a step: below a tenth, the delay is rounded to that or to none.
    """
    steps = np.asarray(delay) / timestep
    filtered = np.where(steps < _SHORTEST, np.round(steps / _SHORTEST) * _SHORTEST, steps)
    short = np.interp(steps, [1.0, 13 / 12, 1.5], [1.0, 1.5, 2.0])
    return np.where(steps < 1, filtered, np.where(steps < 1.5, short, steps + 0.5)) * timestep


def is_filtered(delay: float, timestep: float) -> bool:
    """Return whether a delay is a filter in steps of this length [s]."""
    return _ROUNDING <= delay / timestep < 1 - _ROUNDING


def read_filter(constant: float, timestep: float) -> float:
    """Return the delay [s] of a filter with this time constant [s], the inverse of `write_delay`."""
    return timestep / math.expm1(timestep / constant)
