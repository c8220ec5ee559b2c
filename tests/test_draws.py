"""Drives that are drawn from the joint distribution of what was identified."""

import copy
import dataclasses
import inspect
import re
from collections.abc import Callable
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
import scipy.stats
from conftest import changed, check_each, trace_nothing
from hypothesis import given, settings

import frictionzoo as fz
from frictionzoo.core.errors import ConfigError, RunError
from frictionzoo.core.segments import Segments
from frictionzoo.core.state import Signals
from frictionzoo.fit.uncertainty import Covariance
from frictionzoo.result import draws
from frictionzoo.result.draws import predict_band

MANY = 20_000


def test_draws_are_as_wide_and_as_correlated_as_they_say() -> None:
    matrix = np.array([[4.0, 1.0, 2.0], [1.0, 1.0, 0.5], [2.0, 0.5, 1.0]])
    matrix[2] = matrix[:, 2] = 0.5 * matrix[0]  # of rank 2
    matrix[2, 2] = 1.0
    found = Covariance(("a", "b", "c"), np.array([3.0, 0.0, -1.0]), matrix, 6.0).draw(MANY, np.random.default_rng(0))
    ends = np.quantile(found, [0.025, 0.975], axis=0)
    half = scipy.stats.t.ppf(0.975, 6) * np.sqrt(np.diag(matrix))
    # The standard error of such a quantile is 2 % of half an interval.
    np.testing.assert_allclose((ends - [3.0, 0.0, -1.0]) / half, [[-1] * 3, [1] * 3], atol=0.08)
    scale = np.sqrt(np.diag(matrix))
    np.testing.assert_allclose(np.corrcoef(found.T), matrix / np.outer(scale, scale), atol=0.03)
    np.testing.assert_allclose(found[:, 2] + 1.0, 0.5 * (found[:, 0] - 3.0), atol=1e-9)


def test_samples_of_a_run_have_its_intervals(finished_run: Callable[[str], Any]) -> None:
    drive = fz.load(finished_run("mujoco_default")[0])
    row = drive.result["covariance"]
    assert row is not None
    sure = {name: p for name, p in drive.parameters.items() if p.identifiable}
    found = drive.sample(MANY)
    assert found.keys() == sure.keys() and len(sure) > 1
    coordinates = {}
    for name, parameter in sure.items():
        assert found[name].shape == (MANY, 1)
        at = row["labels"].index(name)
        assert row["scale"][at] == "log"
        coordinates[at] = np.log(found[name][:, 0])
        (low, high), drawn = np.log(parameter.interval[0]), np.quantile(coordinates[at], [0.025, 0.975])
        np.testing.assert_allclose((drawn - low) / (high - low), [0, 1], atol=0.04)
        assert row["centre"][at] == pytest.approx((low + high) / 2, rel=1e-9)
    matrix, own = np.array(row["matrix"]), list(coordinates)
    scale = np.sqrt(np.diag(matrix))
    expected = (matrix / np.outer(scale, scale))[np.ix_(own, own)]
    # Of ranks, since a few draws of Student's t lie far out and at a bound.
    ranks = scipy.stats.spearmanr(np.array([*coordinates.values()]).T).statistic
    np.testing.assert_allclose(2 * np.sin(np.pi / 6 * ranks), expected[0, 1] if len(own) == 2 else expected, atol=0.05)
    for name, values in drive.sample(3, seed=1).items():
        np.testing.assert_array_equal(values, drive.sample(3, seed=1)[name])
        assert (values != found[name][:3]).any()


def test_nothing_is_drawn_without_intervals(finished_run: Callable[[str], Any]) -> None:
    drive = fz.load(finished_run("mujoco_default")[0])
    with pytest.raises(ConfigError, match="count=0: expected 1 or more"):
        drive.sample(0)
    drive = copy.copy(drive)
    object.__setattr__(drive, "result", changed(drive.result, covariance=None, no_intervals="nothing was identified"))
    with pytest.raises(RunError, match="nothing was identified, expected intervals to draw from"):
        drive.sample(10)


def test_a_band_holds_what_training_rollouts_were_off_by(finished_run: Callable[[str], Any]) -> None:
    drive = fz.load(finished_run("mujoco_default")[0])
    simulated, kept = drive.rollout()[0], drive.curves.train_errors
    assert len(kept) == drive.metrics["train"].rollouts == 1
    with pytest.raises(RunError, match="1 training rollouts of the evaluation stayed finite, expected 2 at least"):
        drive.band()
    errors = np.random.default_rng(0).normal(size=(50, kept.shape[1], 1))
    drive = dataclasses.replace(drive, curves=dataclasses.replace(drive.curves, train_errors=errors))
    low, high = drive.band(count=20)
    assert low.shape == high.shape == (len(simulated), kept.shape[1], 1)
    # Without draws, the band is the quantiles of the errors around the fitted drive, wider by Student's.
    wider = scipy.stats.t.ppf(0.975, 49) / scipy.stats.norm.ppf(0.975) * np.sqrt(1 + 1 / 50)
    alone = dataclasses.replace(drive, result=changed(drive.result, covariance=None)).band()
    expected = np.quantile(wider * errors, 0.025, axis=0)[None] + 0 * low
    np.testing.assert_allclose(simulated[:, : kept.shape[1]] - alone.high, expected, rtol=1e-9)
    assert (high - low).mean() > (alone.high - alone.low).mean()


def test_a_band_holds_as_much_as_it_says() -> None:
    """Of a drive whose value is drawn as it is uncertain, and whose errors are drawn as those of the training are."""
    rng, length = np.random.default_rng(0), 50
    curves = trace_nothing(Segments(*np.zeros((2, 1, 2, 1)), Signals(np.zeros((1, 1, 1))), 0.01))
    curves = dataclasses.replace(curves, train_errors=rng.normal(size=(100, length, 1)))
    values, truth = rng.normal(size=(100, 1)), rng.normal(size=400)
    time = np.linspace(0, 2, length)[:, None]
    low, high = predict_band("here", lambda drawn: (drawn["a.b"] * time)[None], {"a.b": values}, curves)
    measured = truth[:, None] * time[:, 0] - rng.normal(size=(400, length))
    inside = (low[0, :, 0] <= measured) & (measured <= high[0, :, 0])
    assert inside.mean() == pytest.approx(0.95, abs=0.02)  # quantiles of a hundred draws


put_values = inspect.unwrap(draws.put_values)  # as users have it: tests check types at run time
PARAMS = {
    "bench": fz.Bench("knee_rod.xml", actuator=fz.PositionPD(kp=20, kd=1.0)).params,
    "friction": fz.law("stribeck").params,
}
FULL = [f"{owner}.{name}" for owner, params in PARAMS.items() for name in params]
VALUES = {owner: {name: np.array([1.0]) for name in params} for owner, params in PARAMS.items()}


@settings(derandomize=True)
@given(name=st.text() | st.sampled_from(FULL).map(lambda full: full[:-1]) | st.sampled_from(["armature", "bench", "."]))
def test_a_value_of_no_parameter_is_refused_with_the_closest(name: str) -> None:
    with pytest.raises(ConfigError, match=r"(?s)no such parameter of the drive; .*bench\.armature"):
        put_values(VALUES, {name: np.array([0.1])}, PARAMS, 1)
    near = re.escape("bench.armatur: no such parameter of the drive; did you mean bench.armature?")
    with pytest.raises(ConfigError, match=near):
        put_values(VALUES, {"bench.armatur": 0.1}, PARAMS, 1)


@pytest.mark.parametrize("value", [np.ones(2), np.ones((1, 1)), np.ones(0), np.nan, [np.inf], "1", None, [True], -1.0])
def test_a_value_that_a_parameter_cannot_have_is_refused_by_its_name(value: Any) -> None:
    check_each(check_refused, [(full, value) for full in FULL])


def check_refused(full: str, value: Any) -> None:
    owner, _, name = full.partition(".")
    if isinstance(value, float) and value == -1.0 and PARAMS[owner][name].each("low", 1)[0] < 0:
        assert put_values(VALUES, {full: value}, PARAMS, 1)[owner][name] == -1.0
        return
    with pytest.raises(ConfigError, match=f"^{re.escape(full)}: "):
        put_values(VALUES, {full: value}, PARAMS, 1)


@pytest.mark.parametrize("value", [2, 2.0, np.float32(2), [2.0], np.array([2])])
def test_a_value_is_put_in_place_of_another(value: Any) -> None:
    found = put_values(VALUES, {"friction.damping": value}, PARAMS, 1)
    assert found["friction"]["damping"] == [2.0] and VALUES["friction"]["damping"] == [1.0]
    assert found["bench"] == VALUES["bench"]
