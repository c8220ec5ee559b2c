"""Levenberg-Marquardt: its normal equations, what it finds, robust losses and refined initial states."""

import copy
import operator
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import spoil
from helpers.known_drive import TRUTH, bowl, identified, noisy, pose, record, run
from scipy.optimize._lsq.least_squares import IMPLEMENTED_LOSSES

from frictionzoo.core.errors import ConfigError, FitError
from frictionzoo.fit import LevenbergMarquardt
from frictionzoo.fit import blocks as blocks_module
from frictionzoo.fit.chunk import search
from frictionzoo.fit.loss import ROBUST, Loss, bend, soft_width
from frictionzoo.fit.normal_equations import NormalEquations, compress

pytestmark = pytest.mark.usefixtures("x64")

LM = LevenbergMarquardt(100, 1e-12)
ADAM = ("fit=adam", "fit.iterations=5", "fit.learning_rate=1e-3")


def assert_recovered(values: Any, tolerance: float) -> None:
    found = identified(values)
    for name, value in TRUTH.items():
        assert found[name] == pytest.approx(value, rel=tolerance), name


def test_a_known_drive_is_found_in_a_few_iterations(tmp_path: Path) -> None:
    problem = pose("mujoco_default")
    outcome = run(problem, LM, tmp_path)
    assert outcome.stopped == "converged"
    assert outcome.iterations <= 15
    assert_recovered(outcome.values, 1e-6)
    np.testing.assert_array_equal(outcome.loss, outcome.history["loss"].min())
    short = run(problem, LevenbergMarquardt(2, 1e-12), tmp_path / "short")
    assert (short.stopped, short.iterations) == ("finished", 2)


@pytest.mark.parametrize(
    "options", [{}, {"robust": "soft_l1", "robust_scale": 0.01}, {"refine": True}, {"encoder_step": 0.01}], ids=str
)
def test_the_derivatives_are_those_of_the_loss(options: dict[str, Any]) -> None:
    # A law without corners: on one, where sticking begins, the best start may lie, and the loss has no gradient there.
    objective = pose("coulomb_smooth", **options).objective
    vector = objective.space.start + 0.1
    evaluate, value_and_grad = objective.compile_normal_equations(), jax.jit(objective.value_and_grad("forward"))
    equations = evaluate(np.asarray(vector))
    loss, gradient = value_and_grad(vector, objective.data)
    np.testing.assert_allclose(equations.loss, loss, rtol=1e-12)
    # A refined start is the best one up to its search's last step, and the gradient assumes the best.
    np.testing.assert_allclose(2 * equations.gradient, gradient, rtol=1e-6 if options.get("refine") else 1e-10)
    # Where nothing is left over, J' J is the second derivative.
    data, values = objective.data, objective.space.values(vector)
    driven = data.qpos[0, :, 0], data.qvel[0, :, 0], data.signals.map(operator.itemgetter(0)), data.load[0]
    states = objective._rollout.compiled(values, *driven)
    qpos, qvel = (old.at[0, :, 1:].set(new) for old, new in zip((data.qpos, data.qvel), states, strict=True))
    objective.data, step = data._replace(qpos=qpos, qvel=qvel), 1e-5 * jnp.eye(len(vector))
    ends = [[value_and_grad(vector + side * unit, objective.data)[1] for unit in step] for side in (1, -1)]
    hessian = 2 * evaluate(np.asarray(vector)).hessian
    difference = (np.stack(ends[0]) - np.stack(ends[1])) / 2e-5
    np.testing.assert_allclose(hessian, difference, rtol=1e-5, atol=1e-5 * np.abs(hessian).max())


def test_a_fit_that_never_starts_says_so(tmp_path: Path) -> None:
    problem = pose("mujoco_default")
    spoil(problem.objective)
    with pytest.raises(FitError, match="diverged at iteration 0") as error:
        run(problem, LM, tmp_path)
    assert "learning_rate" not in str(error.value)


def test_compressed_residuals_have_the_same_loss_gradient_and_curvature() -> None:
    rng = np.random.default_rng(0)
    jacobian, residuals = rng.normal(size=(50, 4)) * [1.0, 1e3, 1e-4, 1.0], rng.normal(size=50)
    equations = NormalEquations(residuals @ residuals, jacobian.T @ residuals, jacobian.T @ jacobian)
    short, slopes = compress(equations, 1.0)
    assert short.shape == (5,) and slopes.shape == (5, 4)
    assert short @ short == pytest.approx(equations.loss, rel=1e-12)
    np.testing.assert_allclose(slopes.T @ short, equations.gradient, rtol=1e-8)
    np.testing.assert_allclose(slopes.T @ slopes, equations.hessian, rtol=1e-8, atol=1e-12)


def test_what_cannot_be_identified_does_not_break_it() -> None:
    jacobian = np.array([[1.0, 1.0, 0.0], [2.0, 2.0, 0.0]])
    residuals = np.array([1.0, 3.0])
    equations = NormalEquations(residuals @ residuals, jacobian.T @ residuals, jacobian.T @ jacobian)
    short, slopes = compress(equations, 1.0)
    np.testing.assert_allclose(slopes.T @ short, equations.gradient, atol=1e-12)
    assert np.isfinite(short).all()
    rounding = -np.array([[1e9, 3e9], [2e9, 1e10]])
    assert all(np.isfinite(part).all() for part in compress(NormalEquations(1.0, np.ones(2), rounding), 1.0))


def test_chunks_change_no_bit(tmp_path: Path) -> None:
    problem = pose("coulomb_smooth")
    whole, *others = (run(problem, LM, tmp_path / str(size), chunk=size) for size in (100, 1, 3))
    for ours in others:
        assert ours.iterations == whole.iterations > 3
        assert identified(ours.values) == identified(whole.values)
        for name, history in whole.history.items():
            np.testing.assert_array_equal(ours.history[name], history)


@pytest.mark.parametrize("missed", [0.0, 0.05, 0.2, 0.9, 1.0, 1.1, -1.05, 3.0])
def test_an_error_within_an_encoder_step_bends_its_square(missed: float) -> None:
    """Half an error's square has the slope's square, times `bend`, as its second derivative."""
    loss = Loss(encoder_step=2.0)
    slope = jax.grad(loss.unexplained)(missed)
    curvature = jax.grad(jax.grad(lambda error: loss.unexplained(error) ** 2 / 2))(missed)
    width = jnp.asarray(soft_width(2.0))
    assert bend(loss.unexplained(jnp.asarray(missed)), width) == pytest.approx(float(curvature / slope**2), rel=1e-5)
    assert bend(jnp.asarray(missed), jnp.asarray(0.0)) == 1


def test_positions_rounded_to_an_encoder_s_steps_are_fitted_in_a_few_iterations() -> None:
    """With J' J for the second derivative each step would go too far, in the initial states and in the parameters."""
    objective = pose("coulomb_smooth", refine=True, encoder_step=0.01, velocity=1e-6).objective
    objective.data = objective.data._replace(qpos=jnp.round(objective.data.qpos / 0.01) * 0.01)
    progress, _ = search(LevenbergMarquardt(60, 1e-6), objective)
    assert progress.converged and progress.iteration <= 9  # 12 with J' J
    # From the states that were found there, the same vector has the same loss.
    found = objective.beginning(progress.method.begun).compile_normal_equations()(np.asarray(progress.best))
    assert found.loss == pytest.approx(progress.best_loss, rel=1e-6)


def test_blocks_change_nothing_but_rounding(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = pose("mujoco_default").objective
    monkeypatch.setattr(blocks_module, "BLOCK_STATES", 35)  # 7 of the 60 segments: the last block is not full
    monkeypatch.setattr(blocks_module, "ON_ACCELERATOR", 1)
    blocks = pose("mujoco_default").objective
    assert blocks.data.weight.shape == (9, 7) and float(blocks.data.weight.sum()) == 60
    vector = np.asarray(whole.space.start)
    found = (objective.compile_normal_equations()(vector)[:3] for objective in (whole, blocks))
    for one, two in zip(*found, strict=True):
        np.testing.assert_allclose(two, one, rtol=1e-12)
    losses = [float(part.loss(whole.space.start, part.data)) for part in (whole, blocks)]
    assert losses[0] == pytest.approx(losses[1], rel=1e-12)


def test_bounds_hold(tmp_path: Path) -> None:
    problem = pose("mujoco_default", "model.params.frictionloss.high=0.1", "model.params.frictionloss.init=0.05")
    outcome = run(problem, LM, tmp_path)
    assert outcome.history["friction.frictionloss"].max() <= 0.1 * (1 + 1e-12)
    assert identified(outcome.values)["frictionloss"] == pytest.approx(0.1, rel=1e-3)


def test_outliers_do_not_rule_a_robust_fit(tmp_path: Path) -> None:
    segments = copy.deepcopy(record())
    segments.qvel[::6, 3:] += 2.0
    for robust, low, high in (("none", 0.2, np.inf), ("huber", 0.0, 0.02)):
        problem = pose("mujoco_default", segments=segments, robust=robust, robust_scale=1e-3)
        found = identified(run(problem, LM, tmp_path / robust).values)
        assert low < max(abs(found[name] / value - 1) for name, value in TRUTH.items()) < high


def test_robust_losses_are_those_of_scipy() -> None:
    z = np.array([0.0, 0.3, 1.0, 1.7, 40.0])
    assert set(ROBUST) == {"none", *IMPLEMENTED_LOSSES} - {"linear", "arctan"}
    for name, function in ROBUST.items():
        expected, slope = z, np.ones(5)
        if name != "none":
            IMPLEMENTED_LOSSES[name](z, rho := np.empty((3, 5)), False)
            expected, slope = rho[:2]
        np.testing.assert_allclose(function(z), expected, rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(jax.vmap(jax.grad(function))(z), slope, rtol=1e-12)


def test_refined_starts_take_the_bias_of_noisy_ones_away(tmp_path: Path) -> None:
    measured = noisy(record(), 1e-6, 3e-3)
    weights = {"position": 1e12, "velocity": 1 / 9e-6}  # of the noise's variances
    plain, refined = (
        identified(
            run(pose("mujoco_default", segments=measured, refine=refine, **weights), LM, tmp_path / str(refine)).values
        )
        for refine in (False, True)
    )
    errors = {name: (abs(plain[name] / value - 1), abs(refined[name] / value - 1)) for name, value in TRUTH.items()}
    assert sum(after for _, after in errors.values()) < 0.5 * sum(before for before, _ in errors.values())


@pytest.mark.parametrize(
    ("option", "options"),
    [
        ("loss.robust", {"robust": "huberr"}),
        ("loss.encoder_step", {"encoder_step": -1.0}),
        ("loss.robust_scale", {"robust": "huber", "robust_scale": 0.0}),
        ("loss.robust", {"robust": "huber", "refine": True}),
        ("loss.refine", {"refine": True, "velocity": 0.0}),
        ("loss.continuity", {"refine": True, "continuity": -1.0}),
        ("loss.continuity", {"continuity": 1.0}),
        ("loss.continuity", {"refine": True, "continuity": 1.0}),  # no segment begins where another ends
        ("loss.impulse", {"refine": True, "position": 0.0, "impulse": True}),
        ("loss.impulse", {"impulse": True}),
        ("loss.slow", {"slow": 0.1}),
        ("loss.slow", {"position": 0.0, "impulse": True, "slow": 1.5}),
    ],
)
def test_impossible_losses_are_refused(option: str, options: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=option):
        pose("mujoco_default", **options)


def test_auto_takes_the_method_that_suits_the_law(make: Callable[..., Any], tmp_path: Path) -> None:
    few, many = pose("mujoco_default"), bowl(pose("residual_network"))
    auto = make("fit", "fit=auto", "fit.tries=50", "fit.tolerance=1e-12", "fit.iterations=5", "fit.learning_rate=1e-3")
    assert auto.choose(few.objective).name == "lm" and auto.choose(many.objective).name == "adam"
    assert_recovered(run(few, auto, tmp_path / "few").values, 1e-6)
    found, adam = (run(many, fit, tmp_path / fit.name) for fit in (auto, make("fit", *ADAM)))
    np.testing.assert_array_equal(found.vector, adam.vector)
