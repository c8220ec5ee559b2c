"""Draws from the posterior: against closed forms, numerical integration, and the intervals of a drive."""

import copy
import importlib.util
import pickle
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import frictionzoo as fz
from frictionzoo.core.errors import ConfigError, FitError, RunError
from frictionzoo.fit.blocks import Blocks
from frictionzoo.fit.inverse_dynamics import InverseDynamics
from frictionzoo.fit.lm import LevenbergMarquardt
from frictionzoo.fit.normal_equations import NormalEquations
from frictionzoo.fit.objective import Objective
from frictionzoo.fit.posterior import MOST_COORDINATES, Chains, Fitted, adjust, draw_posterior
from frictionzoo.fit.posterior import _refuse_disagreement as refuse_disagreement
from frictionzoo.fit.uncertainty import Covariance

pytest.importorskip("blackjax", reason="the extra posterior is not installed")


def fit_to(loss: Callable, start: list[float], low: float = -1e3, high: float = 1e3, fit: Any = None) -> Fitted:
    """What a fit of this loss, a function of a vector, leaves where it ended at `start`."""
    count = len(start)

    class Known(Objective):
        def __init__(self) -> None:
            labels = [f"friction.p{at}" for at in range(count)]
            bounds = {"low": np.full(count, low), "high": np.full(count, high)}
            self.space: Any = SimpleNamespace(labels=labels, start=jnp.asarray(start, jnp.float32), **bounds)
            self.data: Any = Blocks(*[None] * len(Blocks._fields))
            self.compile = lambda function, forward: jax.jit(function)

        def spread(self, tree: Any) -> Any:
            return tree

        def value_and_grad(self, derivative: str) -> Callable:
            return lambda vector, data: jax.value_and_grad(loss)(vector)

        def compile_scores(self) -> Callable:
            def evaluate(vector: Any) -> tuple[NormalEquations, np.ndarray]:
                at = jnp.asarray(vector, jnp.float32)
                own = (np.asarray(f(loss)(at), np.float64) / 2 for f in (jax.grad, jax.hessian))
                return NormalEquations(float(loss(at)), *own), np.zeros((2, count))

            return evaluate

    return Fitted(Known(), np.array(start), fit or LevenbergMarquardt())


def known(matrix: Any, centre: Any, freedom: float = 49.0) -> Covariance:
    """A distribution of all coordinates."""
    labels = tuple(f"friction.p{at}" for at in range(len(centre)))
    return Covariance(labels, np.array(centre, float), np.array(matrix, float), freedom)


HESSIAN = np.array([[3.0, 1.0, 0.0], [1.0, 2.0, 0.5], [0.0, 0.5, 50.0]])
MATRIX = np.array([[0.04, 0.01, 0.001], [0.01, 0.09, 0.002], [0.001, 0.002, 0.0004]])


def test_the_curvature_is_made_that_of_the_covariance() -> None:
    size, curvature = adjust(HESSIAN, MATRIX)
    np.testing.assert_allclose(curvature.T @ (size * HESSIAN) @ curvature, np.linalg.inv(MATRIX), rtol=1e-9, atol=1e-9)
    assert np.linalg.det(curvature) == pytest.approx(1)
    size, curvature = adjust(HESSIAN, np.linalg.inv(HESSIAN) / 7)  # all correlated alike: the magnitude is all there is
    assert size == pytest.approx(7)
    np.testing.assert_allclose(curvature, np.eye(3), atol=1e-9)


def test_the_posterior_of_a_parabola_is_the_covariance_s_student_t() -> None:
    best, centre = np.array([1.0, -2.0, 0.5]), [1.1, -2.0, 0.5]
    fitted = fit_to(lambda x: 5.0 + (x - best) @ jnp.asarray(HESSIAN, jnp.float32) @ (x - best), best.tolist())
    chains = draw_posterior(fitted, known(MATRIX, centre, 9.0), 2000, 0)
    assert chains.vectors.shape == (2000, 3) and max(chains.rhat.values()) < 1.02 and chains.divergences == 0
    deviation = np.sqrt(np.diag(MATRIX))
    found = (np.quantile(chains.vectors, [0.025, 0.5, 0.975], axis=0) - centre) / deviation
    expected = scipy.stats.t.ppf([0.025, 0.5, 0.975], 9)[:, None] + np.zeros(3)
    # The standard error of such a quantile, of a thousand independent draws, is 0.1.
    np.testing.assert_allclose(found, expected, atol=0.3)
    ranks = scipy.stats.spearmanr(chains.vectors).statistic
    expected = MATRIX / np.outer(deviation, deviation)
    np.testing.assert_allclose(2 * np.sin(np.pi / 6 * ranks), expected, atol=0.1)


def test_a_skewed_posterior_is_the_loss_s_own_and_keeps_to_the_bounds() -> None:
    """One coordinate that saturates upwards, as a smooth sign's slope does, beside one that stays where it is."""
    low, high, freedom = -3.0, 4.0, 20.0
    variance = 1.5**2

    def loss(x: Any) -> Any:
        return 1.0 + (jnp.exp(-x[0]) - 1.0) ** 2

    chains = draw_posterior(fit_to(loss, [0.0, 0.7], low, high), known([[variance]], [0.0], freedom), 4000, 0)
    drawn = chains.vectors[:, 0]
    np.testing.assert_allclose(chains.vectors[:, 1], 0.7)
    assert low < drawn.min() and drawn.max() < high
    grid = np.linspace(low, high, 20_001)
    density = (1 + (np.exp(-grid) - 1) ** 2 / variance / freedom) ** (-(freedom + 1) / 2)  # F'' / 2 is 1 at 0
    cumulated = np.cumsum(density) / density.sum()
    shares = [0.025, 0.25, 0.5, 0.75, 0.975]
    expected = np.interp(shares, cumulated, grid)
    np.testing.assert_allclose(np.quantile(drawn, shares), expected, atol=0.15)
    assert expected[0] > -1.6 and expected[-1] > 3.8, "a Gaussian's would be +-2.9"


def test_what_cannot_be_sampled_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def loss(x: Any) -> Any:
        return 1 + x @ x

    unit = known(np.eye(2), [0, 0])
    with pytest.raises(FitError, match=r"^the fit ended 7\.1 standard deviations"):
        draw_posterior(fit_to(loss, [5.0, 5.0]), unit, 10, 0)
    with pytest.raises(FitError, match="covariance of 2 coordinates"):
        draw_posterior(fit_to(loss, [0.0, 0.0]), known(np.ones((2, 2)), [0, 0]), 10, 0)
    with pytest.raises(FitError, match="no minimum"):
        draw_posterior(fit_to(lambda x: 1 - x @ x, [0.0, 0.0]), unit, 10, 0)
    many = MOST_COORDINATES + 1
    with pytest.raises(ConfigError, match=r"^21 numbers were identified"):
        draw_posterior(fit_to(loss, [0.0] * many), known(np.eye(many), np.zeros(many)), 10, 0)
    with pytest.raises(ConfigError, match=r"^fit=inverse_dynamics"):
        draw_posterior(fit_to(loss, [0.0, 0.0], fit=InverseDynamics()), unit, 10, 0)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match="blackjax"):
        draw_posterior(fit_to(loss, [0.0, 0.0]), unit, 10, 0)


def test_chains_that_do_not_agree_are_refused_and_a_divergence_is_told(caplog: pytest.LogCaptureFixture) -> None:
    for rhat, effective in ((1.2, 900.0), (np.nan, 900.0), (1.0, 40.0), (1.0, np.nan)):
        chains = Chains(np.zeros((1, 2)), {"a": 1.0, "b": rhat}, {"a": 900.0, "b": effective}, 3)
        with pytest.raises(FitError, match=r"^posterior of 1000 draws: .*\(b\)"):
            refuse_disagreement(chains, 1000)
    refuse_disagreement(Chains(np.zeros((1, 1)), {"a": 1.0}, {"a": 900.0}, 3), 1000)
    assert "3 divergences" in caplog.text


def test_draws_of_a_drive_have_its_intervals(recording: Path) -> None:
    bench = fz.Bench("knee_rod.xml", actuator=fz.PositionPD(kp=20, kd=1))
    evaluation = {"horizons": [0.1], "rollouts": 1, "places": 1, "trajectory": 0.1, "window": 0.02}
    how: Any = {"recipe": "given", "segments": {"length": 20, "count": 40}, "evaluation": evaluation}
    how |= {"test": 0.2, "method": "lm", "dtype": "float64", "discretisation": False, "loop": {"progress": False}}
    fit = fz.identify(bench, "mujoco_default", fz.read(recording), **how)
    found, fast = fit.posterior(1000), fit.sample(20_000)
    assert found.keys() == fast.keys() and len(found) > 1 and found.divergences == 0
    for name, draws in found.items():
        assert draws.shape == (1000, 1)
        share = np.log(draws).std() / np.log(fast[name]).std()
        assert share == pytest.approx(1, abs=0.15)
        moved = (np.log(draws).mean() - np.log(fast[name]).mean()) / np.log(fast[name]).std()
        assert moved == pytest.approx(0, abs=0.25)
    qpos, _ = fit.rollout(values=fit.with_values({name: draws[0] for name, draws in found.items()}))
    assert np.isfinite(qpos).all()
    with pytest.raises(ConfigError, match="count=0: expected 1 or more"):
        fit.posterior(0)
    for alone in (copy.deepcopy(fit.fitted), pickle.loads(pickle.dumps(fit.fitted))):
        assert alone is None


def test_a_run_that_was_read_back_has_none(finished_run: Callable[[str], Any]) -> None:
    with pytest.raises(RunError, match=r"no training data"):
        fz.load(finished_run("mujoco_default")[0]).posterior()
    with pytest.raises(RunError, match="a network's weights can replace its physical parameters"):
        fz.load(finished_run("neural_friction")[0]).posterior()
