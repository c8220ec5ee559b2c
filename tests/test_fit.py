"""Objective, coordinates and methods on segments whose truth is known."""

import copy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from helpers.known_drive import KNOWN, PARAMETERS, TRUTH, bowl, identified, pose, run

from frictionzoo.core.errors import ConfigError, FitError
from frictionzoo.core.manifest import MANIFEST
from frictionzoo.fit import Adam, Auto, Fit, Grid, InverseDynamics, LevenbergMarquardt, Several, fit_reference
from frictionzoo.fit.chunk import search

pytestmark = pytest.mark.usefixtures("x64")


@pytest.mark.parametrize("name", ["mujoco_default", "residual_network"])
def test_gradient_equals_central_differences(name: str) -> None:
    """Of a law that is a constraint, and of one that adds a torque, with physical parameters and weights."""
    objective = pose(name).objective
    start, rng = objective.space.start, np.random.default_rng(1)
    # A network has corners in its ReLUs: the step is so small that next to none of them lies inside.
    step = 1e-5 if name != "residual_network" else 1e-8
    vector = start + jnp.asarray(rng.normal(scale=0.1, size=start.shape))
    directions = [rng.normal(size=start.shape) for _ in range(3)]
    for mode in ["reverse"] if name == "residual_network" else ["forward", "reverse"]:
        function = jax.jit(objective.value_and_grad(mode))
        gradient = function(vector, objective.data)[1]
        for direction in directions:
            ends = [function(vector + side * step * direction, objective.data)[0] for side in (1, -1)]
            # Central differences themselves err by step^2 and by rounding over step, both far below this.
            np.testing.assert_allclose(gradient @ direction, (ends[0] - ends[1]) / (2 * step), rtol=1e-6)


def test_space_names_values_and_bounds() -> None:
    space = pose("mujoco_default", "model.params.damping.identify=false").objective.space
    assert list(space.params) == ["bench.armature", "friction.frictionloss"]
    values = space.values(space.start)
    np.testing.assert_allclose(values["bench"]["armature"], 0.01)
    assert values["bench"]["kp"] == 20.0
    low = identified(space.values(space.low))
    param = space.params["friction.frictionloss"]
    assert low["frictionloss"] == pytest.approx(param.low)
    assert low["damping"] == pose("mujoco_default").model.params["damping"].init


@pytest.mark.parametrize("fit", ["adam", "auto", "grid", "lm"])
def test_a_space_with_nothing_to_identify_is_not_searched(make: Callable[..., Any], fit: str) -> None:
    with pytest.raises(ConfigError, match="no parameter is to be identified"):
        make("fit", f"fit={fit}").total(pose("mujoco_default", *KNOWN).objective)


def test_known_values_are_judged_and_not_moved(make: Callable[..., Any]) -> None:
    searched, fit = pose("mujoco_default").objective, make("fit", "fit=known")
    with pytest.raises(ConfigError, match=r"bench\.armature is to be identified"):
        fit.total(searched)
    objective = pose("mujoco_default", *KNOWN).objective
    progress, trace = search(fit, objective)
    assert (int(progress.iteration), int(progress.best_iteration)) == (1, 0)
    expected = float(searched.loss(searched.space.start, searched.data))
    assert float(trace.loss[0]) == float(progress.best_loss) == pytest.approx(expected, rel=1e-9)


def test_known_truth_has_no_loss_in_our_engine() -> None:
    """MuJoCo C made the recording: at its values the MJX rollouts must agree to rounding."""
    space = (problem := pose("mujoco_default")).objective.space
    vector = jnp.log(jnp.asarray([TRUTH["armature"], TRUTH["frictionloss"], TRUTH["damping"]]))
    assert list(space.params) == ["bench.armature", "friction.frictionloss", "friction.damping"]
    assert float(problem.objective.loss(vector, problem.objective.data)) < 1e-24


def test_adam_recovers_a_known_drive(tmp_path: Path) -> None:
    problem = pose("mujoco_default")
    outcome = run(problem, Adam(600, 0.02, 0.9, "auto"), tmp_path)
    found = identified(outcome.values)
    for name, value in TRUTH.items():
        # Adam at a constant rate circles the optimum within about its step.
        assert found[name] == pytest.approx(value, rel=0.02), name
    assert problem.model.state_dict()["damping"].item() == found["damping"]
    assert outcome.stopped == "finished"
    assert outcome.loss == np.min(outcome.history["loss"]) == outcome.history["loss"][outcome.best_iteration]
    np.testing.assert_array_equal(outcome.history["friction.damping"][outcome.best_iteration], found["damping"])


def test_a_falling_rate_comes_to_rest(tmp_path: Path) -> None:
    """The step of an iteration is the rate, from all of it to none; at a constant rate the loss goes on jumping."""
    problem = pose("coulomb_smooth")
    traces = {
        schedule: run(problem, Adam(300, 0.05, 0.9, "auto", schedule), tmp_path / schedule).history
        for schedule in ("constant", "cosine")
    }
    steps = {key: np.abs(np.diff(np.log(h["bench.armature"][:, 0]))) for key, h in traces.items()}
    assert steps["cosine"][0] == pytest.approx(0.05, rel=1e-3) == steps["constant"][0]
    assert steps["cosine"][-1] < 1e-6
    jumps = {key: np.ptp(history["loss"][-10:]) / history["loss"][-1] for key, history in traces.items()}
    assert jumps["cosine"] < 1e-4 < jumps["constant"]
    assert traces["cosine"]["loss"][-1] == traces["cosine"]["loss"].min()


def test_adam_moves_physical_parameters_and_weights_together(tmp_path: Path) -> None:
    problem = pose("residual_network")
    weights = problem.model.get_parameter("layers.0.weight")
    before, space = weights.detach().clone(), problem.objective.space
    assert list(space.params) == ["bench.armature", "friction.frictionloss", "friction.damping"]
    assert all(name.startswith("friction.layers.") for name in space.weights)
    found = identified(run(problem, Adam(600, 0.02, 0.9, "auto"), tmp_path).values)
    # The recording has nothing that the physical law lacks, yet the network may stand for a part of it.
    for name, value in TRUTH.items():
        assert found[name] == pytest.approx(value, rel=0.05), name
    assert not torch.equal(before, weights)


def test_grid_finds_the_best_of_its_points(tmp_path: Path) -> None:
    problem = pose("mujoco_default", *(f"{name}.scale=1" for name in PARAMETERS))
    outcome = run(problem, Grid(3), tmp_path, chunk=10)
    assert outcome.iterations == len(outcome.history["loss"]) == 3**3
    combinations = np.column_stack([outcome.history[name][:, 0] for name in problem.objective.space.params])
    assert len(np.unique(combinations.round(12), axis=0)) == 3**3
    space = problem.objective.space
    np.testing.assert_allclose(combinations.min(0), [param.low for param in space.params.values()])
    np.testing.assert_allclose(combinations.max(0), [param.high for param in space.params.values()])
    loss = jax.jit(problem.objective.loss)
    losses = [float(loss(c, problem.objective.data)) for c in combinations]  # scales are 1 on this bench
    np.testing.assert_allclose(losses, outcome.history["loss"], rtol=1e-12)
    assert outcome.loss == outcome.history["loss"].min()


@pytest.mark.parametrize("fit", [Grid(3), LevenbergMarquardt()])
def test_a_network_is_refused(fit: Any) -> None:
    with pytest.raises(ConfigError, match=rf"fit={fit.name}: .*use fit=adam"):
        fit.total(pose("residual_network").objective)


def test_reference_is_the_optimum() -> None:
    objective = pose("baseline").objective
    vector = np.log([identified(fit_reference(objective))["armature"]])
    equations = objective.compile_normal_equations()(vector)
    assert np.abs(equations.gradient / equations.hessian.ravel()).max() < 1e-4  # what a step would still move


def test_reference_is_kept_for_the_same_objective_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    objective = pose("baseline").objective
    first = identified(fit_reference(objective, tmp_path))
    monkeypatch.setattr("frictionzoo.fit.start.LevenbergMarquardt", None)  # it is not asked again
    assert identified(fit_reference(objective, tmp_path)) == first
    other = copy.copy(objective)
    other.data = objective.data._replace(weight=0.5 * objective.data.weight)
    with pytest.raises(TypeError):
        fit_reference(other, tmp_path)
    assert len({path.name for path in tmp_path.iterdir()} - {MANIFEST}) == 1


def test_reverse_mode_through_a_loop_is_refused() -> None:
    objective = pose("mujoco_default").objective
    engine = copy.copy(objective._rollout.engine)
    engine.reverse = False
    objective._rollout = replace(objective._rollout, engine=engine)
    with pytest.raises(ConfigError, match=r"fit\.derivative=reverse: engine=mjx .*; set fit\.derivative=forward"):
        objective.value_and_grad("reverse")


def test_chunks_change_no_bit(tmp_path: Path) -> None:
    problem = pose("coulomb_smooth")
    adam = Adam(20, 0.01, 0.9, "auto", "cosine")
    whole, ours = (run(problem, adam, tmp_path / str(size), chunk=size) for size in (100, 7))
    for name, history in whole.history.items():
        np.testing.assert_array_equal(ours.history[name], history)


def test_bounds_hold(tmp_path: Path) -> None:
    problem = pose("mujoco_default", "model.params.frictionloss.high=0.1", "model.params.frictionloss.init=0.05")
    outcome = run(bowl(problem), Adam(200, 0.02, 0.9, "auto"), tmp_path)
    assert outcome.history["friction.frictionloss"].max() <= 0.1 * (1 + 1e-12)
    assert identified(outcome.values)["frictionloss"] == pytest.approx(0.1, rel=1e-6)


def test_patience_stops(tmp_path: Path) -> None:
    outcome = run(bowl(pose("coulomb_smooth"), -3.0), Adam(1000, 0.05, 0.9, "auto"), tmp_path, patience=20, chunk=10)
    assert outcome.stopped == "patience"
    assert outcome.iterations < 1000
    assert outcome.iterations - 1 - outcome.best_iteration >= 20
    assert np.sum((outcome.vector + 3.0) ** 4) == pytest.approx(outcome.loss, rel=1e-9)  # of the best, not the last


def test_divergence_names_iteration_and_parameter(tmp_path: Path) -> None:
    # Weights have no bounds: after one step of this size the layers overflow.
    outcome = run(bowl(pose("residual_network")), Adam(5, 1e200, 0.9, "auto"), tmp_path)
    assert outcome.stopped == "diverged"
    assert outcome.message is not None
    assert outcome.message.startswith("fit diverged at iteration 1: ")
    assert "friction.layers." in outcome.message
    assert (outcome.iterations, outcome.best_iteration) == (1, 0)
    assert np.isfinite(outcome.loss)
    assert all(np.isfinite(value).all() for value in jax.tree.leaves(outcome.values))


def test_a_fit_that_never_starts_says_so(tmp_path: Path) -> None:
    problem = pose("coulomb_smooth")
    problem.objective.space.start = problem.objective.space.start * jnp.nan
    with pytest.raises(FitError, match="diverged at iteration 0"):
        run(bowl(problem), Adam(5, 0.01, 0.9, "auto"), tmp_path)


@pytest.mark.parametrize(
    ("kind", "option", "value"),
    [
        *((Adam, *row) for row in (("iterations", 0), ("learning_rate", 0.0), ("b2", 1.0), ("derivative", "both"))),
        (Adam, "schedule", "cosin"),
        *((LevenbergMarquardt, *row) for row in (("iterations", 0), ("tolerance", 0.0))),
        *((Several, *row) for row in (("tries", 0), ("tolerance", 2.0))),
        *((InverseDynamics, *row) for row in (("bandwidth", 0.0), ("cutoff", -1.0), ("slow", 2.0))),
        (Auto, "tries", 0),
    ],
)
def test_impossible_options_are_refused(kind: type[Fit], option: str, value: Any) -> None:
    with pytest.raises(ConfigError, match=rf"^fit\.{option}="):
        kind(**{option: value})
