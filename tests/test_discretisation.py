"""Intervals that hold what the simulation's step does."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.known_drive import pose
from omegaconf import OmegaConf

from frictionzoo.core.config import compose_config
from frictionzoo.core.described import remake
from frictionzoo.core.errors import ConfigError
from frictionzoo.fit import LevenbergMarquardt, estimate_uncertainty
from frictionzoo.fit.chunk import search
from frictionzoo.identification import Parts, Problem
from frictionzoo.identification.pilot import halve_step, in_other_steps
from frictionzoo.identification.solve import finer, is_wanted
from frictionzoo.simulation.drive import Drive

pytestmark = pytest.mark.usefixtures("x64")

TRUTH = {"bench.armature": 0.07, "friction.viscous_coefficient": 0.4}


def test_an_interval_reaches_to_steps_of_no_length() -> None:
    """Twice as far as half a step moves the value."""
    objective = pose("mujoco_default").objective
    vector = np.asarray(objective.space.start, np.float64)
    equations, _ = objective.compile_scores()(vector)
    moved = np.array([0.01, -0.02, 0.03])
    halved = equations._replace(gradient=equations.gradient - equations.hessian @ moved)
    other: Any = SimpleNamespace(compile_normal_equations=lambda: lambda vector: halved)
    other.beginning = lambda states: other
    before, after = (estimate_uncertainty(objective, vector, None, f).covariance for f in (None, lambda vector: other))
    assert before is not None and after is not None
    undone = -np.linalg.solve(equations.hessian, equations.gradient)
    half = [2.0 * np.sqrt(np.diag(of.matrix)) for of in (before, after)]
    np.testing.assert_allclose(after.centre - vector, (undone + 2 * moved) / 2, rtol=1e-9)
    np.testing.assert_allclose(half[1] - half[0], (np.abs(undone + 2 * moved) - np.abs(undone)) / 2, rtol=0.02)


@pytest.mark.parametrize("asked", [1, "yes", 0.0])
def test_what_is_neither_true_nor_false_is_refused(asked: Any) -> None:
    with pytest.raises(ConfigError, match="expected true or false"):
        is_wanted(asked)


@pytest.mark.parametrize(
    ("softness", "stated", "expected"),
    [([0.004, 1.0], None, [0.002, 1.0]), ([0.02, 1.0], None, [0.02, 1.0]), ([0.004, 1.0], [0.004, 1.0], [0.004, 1.0])],
)
def test_friction_as_stiff_as_a_step_allows_is_stiffer_in_half_of_it(softness, stated, expected):
    bench = remake(pose("mujoco_default").objective.space.bench, timestep=0.002, solreffriction=softness)
    halved = halve_step(bench, stated)
    assert (halved.timestep, halved.solreffriction) == (0.001, expected)


def test_slopes_of_long_steps_lead_to_where_short_ones_end() -> None:
    """From the least of the long steps, one of Gauss and Newton goes where it goes with the short ones' own slopes."""
    problem = pose("mujoco_default")
    objective, bench = problem.objective, problem.objective.space.bench
    drive = Drive.assemble(bench, problem.model, "specialised", bench.sampling(objective.interval))
    finer = in_other_steps(objective, drive, halve_step(bench))
    vector = np.asarray(search(LevenbergMarquardt(60, 1e-9), objective)[0].best)

    def move(of: Any) -> np.ndarray:
        equations = of.compile_normal_equations()(vector)
        return -np.linalg.solve(equations.hessian, equations.gradient)

    own, near = move(finer), move(objective.approaching(finer, vector))
    assert np.abs(own).max() > 100 * np.abs(move(objective)).max()
    assert np.abs(near - own).max() < 0.1 * np.abs(own).max(), (own, near)


@pytest.mark.slow
def test_a_drive_that_was_recorded_in_short_steps_is_within() -> None:
    """The twin moves in steps of 0.25 ms and is fitted in steps of 1 ms."""
    options = ("data=twin_clean", "data.samples=8000", "model=coulomb_stribeck", "fit=lm", "dtype=float64")
    options += (
        *("loss.refine=true", "loss.velocity=1e-5", "segments.length=20", "device=cpu", "evaluation.trajectory=1.0"),
    )
    settings: Any = OmegaConf.to_container(compose_config(*options, "data.cache_dir=null"), resolve=True)
    parts = Parts.from_settings(settings)
    with parts.computing():
        problem = Problem.pose(parts)
        vector = np.asarray(search(problem.fit, problem.objective)[0].best)
        steps = finer(problem)
        assert steps is not None
        before, after = (estimate_uncertainty(problem.objective, vector, None, f).intervals for f in (None, steps))
    for name, truth in TRUTH.items():
        (low, high), (reached, end) = before[name][0], after[name][0]
        assert not low < truth < high, (name, low, high)
        assert reached < truth < end, (name, reached, end)
