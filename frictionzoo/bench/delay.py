"""The delay of MuJoCo's actuators: attributes that say it."""

import math

from frictionzoo.bench.template import in_full

_ROUNDING = 1e-9  # share of a step


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


def is_filtered(delay: float, timestep: float) -> bool:
    """Return whether a delay is a filter in steps of this length [s]."""
    return _ROUNDING <= delay / timestep < 1 - _ROUNDING


def read_filter(constant: float, timestep: float) -> float:
    """Return the delay [s] of a filter with this time constant [s], the inverse of `write_delay`."""
    return timestep / math.expm1(timestep / constant)
