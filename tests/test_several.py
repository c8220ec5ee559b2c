"""Several starts: laws within laws, and minima beside the one that a search comes to."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from helpers.known_drive import Problem, pose, record
from omegaconf import OmegaConf

from frictionzoo.core.config import compose_config
from frictionzoo.core.segments import Segments
from frictionzoo.fit import LevenbergMarquardt, Several
from frictionzoo.fit.chunk import search
from frictionzoo.fit.contained import Part
from frictionzoo.fit.motion import Recordings
from frictionzoo.fit.normal_equations import NormalEquations, bounded_step, descend
from frictionzoo.fit.several import _along, _is_near
from frictionzoo.fit.space import Box
from frictionzoo.models import model_names
from frictionzoo.models.registry import get_model

pytestmark = pytest.mark.usefixtures("x64")


LM, SEVERAL = LevenbergMarquardt(60, 1e-9), Several(60, 1e-9)
CONTAINING = [name for name in model_names() if get_model(name).contains]
SWINGS = ("data=twin", "data.samples=10000", "segments.length=100", "segments.count=60", "dtype=float64")


def noisy() -> Segments:
    """What no law explains to the last digit."""
    rng, clean = np.random.default_rng(1), record()
    qpos, qvel = clean.qpos.copy(), clean.qvel.copy()
    qpos[:, 1:] += 1e-4 * rng.normal(size=qpos[:, 1:].shape)
    qvel[:, 1:] += 1e-2 * rng.normal(size=qvel[:, 1:].shape)
    return Segments(qpos, qvel, clean.signals, clean.timestep)


def posed(law: str, *overrides: str) -> Problem:
    problem = pose(law, *overrides, segments=noisy())
    problem.objective.recordings = Recordings(SimpleNamespace(), problem.model, ())  # pyright: ignore[reportArgumentType]
    return problem


@pytest.mark.parametrize("law", CONTAINING)
def test_a_contained_law_has_coordinates_within(law: str) -> None:
    problem = posed(law)
    whole = Part.of(problem.model, problem.objective.space)
    parts = list(whole.contained())
    assert [part.law.name for part in parts] == list(get_model(law).contains)
    for part in parts:
        start, low, high = part.box
        assert len(start) < len(whole.box.start) and ((low <= start) & (start <= high)).all()
        assert {name for name in part.places} <= set(part.law.dimensions)
        np.testing.assert_allclose(part.own(part.whole(start)), start)
        values = problem.objective.space.values(jnp.asarray(part.whole(start)))["friction"]
        for name, rule in get_model(law).contains[part.law.name].items():
            if rule == 0.0:
                assert float(values[name][0]) == pytest.approx(
                    max(problem.model.params[name].each("low", 1)[0], 0.0), rel=1e-9
                )


def test_a_known_value_keeps_a_law_from_containing_another() -> None:
    problem = posed("stribeck", "model.params.stribeck_torque.identify=false")
    assert not list(Part.of(problem.model, problem.objective.space).contained())


def test_a_law_ends_no_higher_than_one_that_it_contains() -> None:
    contained = search(LM, posed("mujoco_default").objective)[0].best_loss
    assert search(SEVERAL, posed("harmonic_drive").objective)[0].best_loss < contained


def test_a_drive_of_two_inertias_ends_no_higher_than_one(pose_problem: Callable) -> None:
    def lowest(law: str, *astray: str) -> float:
        options = (*SWINGS, f"model={law}", "fit=several", *astray)
        problem = pose_problem(OmegaConf.to_container(compose_config(*options), resolve=True))
        return float(search(problem.fit, problem.objective)[0].best_loss)

    assert lowest("backlash", "model.params.rotor_inertia.init=1e-4") < lowest("mujoco_default")


def test_a_delay_is_looked_for_in_other_sample_intervals(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a loss that has a minimum in every interval, the lowest at the third."""
    objective = posed("mujoco_default", "bench.params.delay.identify=true", "bench.params.delay.init=0.001").objective
    recordings: Any = objective.recordings
    objective.recordings = recordings._replace(logs=(SimpleNamespace(timestep=0.005),))
    size, at = len(objective.space.start), objective.space.labels.index("bench.delay")
    start = np.asarray(objective.space.start)
    goal, tried = start + 0.5, []

    def evaluate(vector: np.ndarray) -> NormalEquations:
        tried.append(vector)
        residuals, slopes, later = vector - goal, np.eye(size), vector[at] * 2
        slopes[:, at] -= 0.1  # what else is found follows the delay
        residuals -= 0.1 * (later - 3) / 2
        residuals[at], slopes[at] = 0.2 * (later - 3), 0.4 * np.eye(size)[at]
        residuals, slopes = np.append(residuals, np.sin(np.pi * later)), np.vstack([slopes, np.zeros(size)])
        slopes[-1, at] = 2 * np.pi * np.cos(np.pi * later)
        return NormalEquations(float(residuals @ residuals), slopes.T @ residuals, slopes.T @ slopes)

    monkeypatch.setattr(objective, "compile_normal_equations", lambda: evaluate)
    found, _ = SEVERAL.init(objective)
    assert found[at] == pytest.approx(1.5, abs=1e-3) and evaluate(found).loss < 1e-6
    # A delay makes up for inertia: the initial armature is tried again with the delay found.
    armature = objective.space.labels.index("bench.armature")
    assert any(vector[armature] == start[armature] and vector[at] != start[at] for vector in tried)
    assert search(LM, objective)[0].best_loss > 0.1
    # From a start that is given, the delay alone is tried again.
    tried.clear()
    found, _ = Several(60, 1e-9, contained=False).init(objective.starting(goal))
    assert found[at] == pytest.approx(1.5, abs=1e-3) and evaluate(found).loss < 1e-6
    assert tried[0] == pytest.approx(goal) and not any(vector[armature] == start[armature] for vector in tried)


@pytest.mark.parametrize(("late", "leads_back"), [(0.95, True), (1.02, False), (0.75, False)])
def test_a_delay_leads_back_from_near_in_the_same_interval(late: float, leads_back: bool) -> None:
    assert _is_near([0.97 * 0.02], 1, 0.02)(np.array([0.0, late * 0.02])) == leads_back


def test_a_search_may_begin_at_a_bound_beside_which_rollouts_diverge() -> None:
    """The solver begins a hair inside its bounds."""

    def evaluate(vector: np.ndarray) -> NormalEquations:
        away = vector - 1.0
        loss = float(away @ away) if vector[0] == 0 else np.inf
        return NormalEquations(loss, away, np.eye(1))

    found, loss, _ = descend(evaluate, Box(np.zeros(1), np.zeros(1), np.full(1, 2.0)), 20, 1e-6)
    assert (found, loss) == (0.0, 1.0)


@pytest.mark.parametrize(
    ("stiffness", "limits", "vectors"),
    [
        (100, {}, 30),
        (100, {"patience": [(8, 0.2)]}, 9),
        (10, {"patience": [(8, 0.2)]}, 30),
        (100, {"goal": 0.1}, 4),
        (10, {"goal": 0.1}, 30),
        (100, {"goal": 0.8}, 30),
    ],
)
def test_a_search_with_rivals_ends_when_it_is_slow(stiffness: float, limits: dict[str, Any], vectors: int) -> None:
    """A step is the distance to the minimum over `stiffness`."""
    tried = []

    def evaluate(vector: np.ndarray) -> NormalEquations:
        tried.append(vector)
        return NormalEquations(float(vector @ vector), vector, stiffness * np.eye(1))

    descend(evaluate, Box(np.ones(1), -np.ones(1), np.ones(1)), 30, 1e-9, **limits)
    assert len(tried) == vectors


@pytest.mark.parametrize("rounding", [0.0, 1e-18, -1e-18, 1e-300])
def test_coordinates_without_effect_do_not_move_with_a_delay(rounding: float) -> None:
    """A robot's joint that sticks leaves rounding instead of curvature, on the diagonal and beside it."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        jacobian = rng.normal(size=(30, 6)) * 10.0 ** rng.uniform(-2, 2, 6)
        jacobian[:, 2] = 0.0
        hessian = jacobian.T @ jacobian
        expected = -np.linalg.lstsq(np.delete(jacobian, [0, 2], 1), jacobian[:, 0], rcond=None)[0]
        hessian[2, 2], hessian[2, 4], hessian[4, 2] = rounding, 1e-17, 1e-17
        direction = _along(hessian, 0)
        np.testing.assert_allclose(np.delete(direction, [0, 2]), expected, rtol=1e-5)
        assert direction[0] == 1.0 and np.isfinite(direction).all()
        assert rounding > 0 or direction[2] == 0.0


@pytest.mark.parametrize("rounding", [0.0, 1e-26, -1e-18, 1e-300])
def test_coordinates_without_effect_take_no_step(rounding: float) -> None:
    """Of a coordinate that moves nothing, gradient and curvature are rounding, and their ratio anything."""
    rng = np.random.default_rng(4)
    for _ in range(20):
        jacobian = rng.normal(size=(30, 6))
        jacobian[:, 2] = 0.0
        gradient, hessian = jacobian.T @ rng.normal(size=30), jacobian.T @ jacobian
        hessian[2, 2], gradient[2] = rounding, 1e-17 * rng.normal()
        step = bounded_step(gradient, hessian, np.full(6, -10.0), np.full(6, 10.0))
        expected = -np.linalg.solve(np.delete(np.delete(hessian, 2, 0), 2, 1), np.delete(gradient, 2))
        np.testing.assert_allclose(np.delete(step, 2), expected, rtol=1e-6)
        assert step[2] == 0.0
    assert (bounded_step(np.zeros(2), np.zeros((2, 2)), -np.ones(2), np.ones(2)) == 0).all()
