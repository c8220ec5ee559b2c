"""Simulation steps in a sample interval of a recording."""

from frictionzoo.core.errors import BenchError

MOST_STEPS = 10_000
"""Most simulation steps per sample, and samples of the longest delay of commands."""


def count_substeps(interval: float, timestep: float) -> int:
    """Return the number of simulation steps [s] in a sample interval [s]."""
    return max(1, round(interval / timestep))


def is_whole(interval: float, timestep: float) -> bool:
    """Return whether an interval [s] is within 1 % of a whole number of simulation steps [s]."""
    return abs(interval / (count_substeps(interval, timestep) * timestep) - 1) <= 0.01


def refuse_interval(interval: float, timestep: float, whose: str, source: str) -> None:
    """Refuse a sample interval [s] of a recording that is not a whole number of steps [s] of the model in `source`.

    Raises:
        BenchError: It is not a whole number of steps, or has too many steps.
    """
    if (substeps := count_substeps(interval, timestep)) > MOST_STEPS:
        raise BenchError(
            f"{whose}: {interval:.6g} s per sample are {substeps} simulation steps of {timestep:.6g} s, expected at "
            f"most {MOST_STEPS}; set a longer bench.timestep"
        )
    if not is_whole(interval, timestep):
        raise BenchError(
            f"{whose}: {interval:.6g} s per sample, expected {timestep:.6g} s as in {source}, or a whole number of "
            "them; set bench.timestep to the log's interval or a part of it, or resample the log"
        )
