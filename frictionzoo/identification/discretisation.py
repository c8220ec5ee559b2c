"""Discretisation error of a result, measured by simulating with half the timestep."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from frictionzoo.bench import Bench
from frictionzoo.core.described import remake
from frictionzoo.core.errors import ConfigError
from frictionzoo.fit import Objective, Space
from frictionzoo.simulation.drive import Drive


def is_wanted(asked: Any) -> bool:
    """Return whether the result is checked with half the timestep.

    Raises:
        ConfigError: `discretisation` is neither true nor false.
    """
    if not isinstance(asked, bool):
        raise ConfigError(f"discretisation={asked}: expected true or false")
    return asked


def halve_step(bench: Bench, softness: Sequence[float] | None = None) -> Bench:
    """Return the test stand with half the timestep and `solreffriction=softness`.

    Without `softness`, a friction constraint as stiff as the timestep allows stays so; others do not change.
    """
    constant, ratio = bench.solreffriction
    if bench.is_stiff:  # the timestep alone makes the constraint softer than the drive's friction
        constant /= 2
    softness = list(softness or (constant, ratio))
    return remake(bench, timestep=bench.timestep / 2, solreffriction=softness).observing(bench.observed)


def in_other_steps(objective: Objective, drive: Drive, bench: Bench) -> Objective:
    """Return the same objective on a test stand with another timestep."""
    sampling = bench.sampling(objective.interval)
    other = Drive.assemble(bench, drive.model, drive.engine.name, sampling)
    space = Space(bench, other.model, str(objective.space.start.dtype))
    return objective.for_drive(space, other.rollout).beginning(np.asarray(objective.data.begun))
