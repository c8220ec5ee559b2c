"""Delay attributes of MuJoCo's actuators."""

import math

import numpy as np
from jaxtyping import Float

from frictionzoo.bench.template import in_full

_ROUNDING = 1e-9  # share of a step
_SHORTEST = 0.1  # shortest filter under RK4, as a share of a step


def write_delay(delay: float, timestep: float) -> dict[str, str]:
    """Return the attributes of an actuator with a delay [s] in simulation steps of length `timestep` [s].

    MuJoCo interpolates linearly between steps: a held command acts with its mean over the step, as in
    `frictionzoo.simulation.rollout.applied`. MuJoCo's shortest delay is one step. A shorter delay becomes a first-order
    filter with the same lag for a ramp: in each step its activation covers 1 / (1 + delay / timestep) of the distance
    to the command.

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
    """Return the delays [s] that MuJoCo's RK4 needs to delay commands by `delay` [s] in steps of `timestep` [s].

    RK4 reads the delayed command at the start, middle and end of a step, with weights of 1/6, 2/3 and 1/6, and the last
    stored command instead of one not stored yet. From a delay of two steps on, the lag of a ramp is half a step shorter
    than the delay; the difference is smaller for shorter delays. Filters lag by their delay, but RK4 is unstable below
    a fifteenth of a step: a delay below a tenth of a step is rounded to a tenth or to 0.
    """
    steps = np.asarray(delay) / timestep
    filtered = np.where(steps < _SHORTEST, np.round(steps / _SHORTEST) * _SHORTEST, steps)
    short = np.interp(steps, [1.0, 13 / 12, 1.5], [1.0, 1.5, 2.0])
    return np.where(steps < 1, filtered, np.where(steps < 1.5, short, steps + 0.5)) * timestep


def is_filtered(delay: float, timestep: float) -> bool:
    """Return whether `write_delay` writes a delay [s] as a filter."""
    return _ROUNDING <= delay / timestep < 1 - _ROUNDING


def read_filter(constant: float, timestep: float) -> float:
    """Return the delay [s] of a filter with a time constant [s], the inverse of `write_delay`."""
    return timestep / math.expm1(timestep / constant)
