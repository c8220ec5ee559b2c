"""Discretisation error of a result, measured by simulating with half the timestep."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from frictionzoo.bench import Bench
from frictionzoo.core.described import remake
from frictionzoo.core.errors import ConfigError
from frictionzoo.fit import Objective, Space
from frictionzoo.fit.base import Fit
from frictionzoo.simulate.drive import Drive

if TYPE_CHECKING:
    from frictionzoo.identification.problem import Problem


def is_wanted(asked: Any) -> bool:
    """Return whether the result is checked with half the timestep.

    Raises:
        ConfigError: `discretisation` is neither true nor false.
    """
    if not isinstance(asked, bool):
        raise ConfigError(f"discretisation={asked}: expected true or false")
    return asked


def finer(problem: "Problem") -> Callable[[Float[np.ndarray, "coordinates"]], Objective] | None:
    """Return a function that makes the objective near a vector with half the timestep.

    None if `discretisation` is false, or if the fit minimises an objective without rollouts.

    Raises:
        ConfigError: See `is_wanted`.
    """
    by_rollouts = type(problem.fit).compile_scores is Fit.compile_scores
    if not (is_wanted(problem.settings["discretisation"]) and by_rollouts):
        return None
    objective, pilot, half = problem.objective, problem.pilot, halve_step(problem.bench)

    def approach(vector: Float[np.ndarray, "coordinates"]) -> Objective:
        if pilot is None:
            return objective.approaching(in_other_steps(objective, problem.drive, half), vector)
        half_wide = remake(pilot.bench, timestep=half.timestep, solreffriction=list(half.solreffriction))
        return objective.approaching(pilot.simulate(half_wide), vector)

    return approach


def halve_step(bench: Bench, softness: Sequence[float] | None = None) -> Bench:
    """Return the test stand with half the timestep.

    Args:
        bench: The test stand with the full timestep.
        softness: `solreffriction` of the friction constraint; None: as stiff as the timestep allows if `bench` has
            that, else unchanged.
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
    return objective.for_drive(space, other.rollout).beginning(objective.states)
