"""The problem in simulation steps of half the length: what the step has done to a result."""

from collections.abc import Callable
from typing import Any

from frictionzoo.core.described import remake
from frictionzoo.core.errors import ConfigError
from frictionzoo.fit import Objective, Space
from frictionzoo.fit.base import Fit
from frictionzoo.identification.problem import Problem
from frictionzoo.simulate.drive import Drive


def is_wanted(asked: Any, joints: int) -> bool:
    """Whether half a step is looked at: it is compiled anew, for many joints long, so of itself for one alone.

    Raises:
        ConfigError: `discretisation` is neither true nor false nor null.
    """
    if asked is not None and not isinstance(asked, bool):
        raise ConfigError(f"discretisation={asked}: expected true, false, or null for drives of one joint")
    return joints == 1 if asked is None else asked


def finer(problem: Problem) -> Callable[[], Objective] | None:
    """Makes the objective of the drive in steps of half the length; None where that is not asked for.

    Nor is it of a fit that minimises something without a step.

    Raises:
        ConfigError: As `is_wanted`.
    """
    wanted = is_wanted(problem.settings["discretisation"], problem.bench.nv)
    by_rollouts = type(problem.fit).compile_scores is Fit.compile_scores
    return (lambda: halve(problem)) if wanted and by_rollouts else None


def halve(problem: Problem) -> Objective:
    """The objective in steps of half the length, of the same data."""
    bench = remake(problem.bench, timestep=problem.bench.timestep / 2).observing(problem.bench.observed)
    sampling = bench.sampling(problem.sampling.interval)
    drive = Drive.assemble(bench, problem.drive.model, problem.drive.engine.name, sampling)
    space = Space(bench, drive.model, problem.settings["dtype"])
    return problem.objective.for_drive(space, drive.rollout).beginning(problem.objective.states)
