"""Attributes for the delay of MuJoCo's actuators."""

import math

import numpy as np
from jaxtyping import Float

from frictionzoo.bench.template import in_full

_ROUNDING = 1e-9  # share of a step
_SHORTEST = 0.1  # of a step, filter under RK4


def write_delay(delay: float, timestep: float) -> dict[str, str]:
    """Return the attributes by which an actuator delays its commands in steps of this length [s].

    Between two steps MuJoCo interpolates linearly: a held command acts with its mean over the step, as in
    `frictionzoo.simulate.rollout.applied`. MuJoCo stores a command at the end of its step, so its shortest delay is one
    step. A shorter delay is written as a first-order filter that lags a steady change by the same time: in each step
    its activation goes 1 / (1 + delay / timestep) of the way to the command.

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

    RK4 reads the late command at a step's begin, middle and end, with weights of 1/6, 2/3 and 1/6. It takes the last
    stored command where it needs a later one. From a delay of two steps on, a steady change is late by half a step less
    than the delay; the difference is smaller for shorter delays. Filters lag by their delay, but RK4 is unstable for
    less than a fifteenth of a step: below a tenth, the delay is rounded to a tenth or to none.
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
