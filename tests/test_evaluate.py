"""Errors of rollouts against numbers computed by hand, divergence, and that all drives meet the same rollouts."""

import numpy as np
import pytest

from frictionzoo.core.errors import ConfigError, LogError
from frictionzoo.core.log import Dataset, Log
from frictionzoo.core.segments import Segments
from frictionzoo.core.state import Signals
from frictionzoo.result.evaluate import Evaluator, Prediction, measure, moving_mean_and_std, rollout_mae

TIMESTEP = 0.01


def make_segments(count, length, nv=1):
    rng = np.random.default_rng(0)
    qpos, qvel = rng.normal(size=(2, count, length + 1, nv))
    return Segments(qpos, qvel, Signals(rng.normal(size=(count, length, nv))), TIMESTEP)


def make_log(name, samples, seed):
    signals = np.random.default_rng(seed).normal(size=(3, samples, 1))
    return Log(name, np.arange(samples) * TIMESTEP, *signals, sha256=64 * "0", simulated=True)


def with_errors(segments, position, velocity):
    """Predictions that are off by these errors, which broadcast to (batch, time, nv)."""
    return Prediction(segments.qpos[:, 1:] + position, segments.qvel[:, 1:] + velocity)


def hold(values, qpos, qvel, signals, load):
    """A drive that stays where it is, plus an offset."""
    still = np.zeros((len(qpos), signals.ctrl.shape[1], qpos.shape[1]))
    return still + qpos[:, None] + values["bench"]["offset"], still


def evaluate(dataset, **changes):
    options = {
        **{"horizons": [0.2, 0.1], "rollouts": 5, "placement": "random", "trajectory": 0.5, "window": 0.05},
        **{"places": 7, "local": 0.1, "seed": 3},
    }
    return Evaluator(dataset, "hinge", **(options | changes))


@pytest.fixture
def dataset():
    return Dataset("noise", (make_log("a", 200, 1),), (make_log("b", 120, 2),))


def test_metrics_by_hand():
    segments = make_segments(2, 4)
    position = np.array([[1.0, -1.0, 3.0, -3.0], [0.0, 0.0, 0.0, 4.0]])[..., None]
    metrics = measure(with_errors(segments, position, 2.0), segments, "slide")
    # MAE of the rollouts 2 and 1; squares sum to 20 + 16 over 8 samples.
    assert metrics.position_mae == pytest.approx(1.5, rel=1e-12)
    assert metrics.position_mae_std == pytest.approx(0.5, rel=1e-12)
    assert metrics.position_rmse == pytest.approx(np.sqrt(36 / 8), rel=1e-12)
    assert metrics.velocity_rmse == pytest.approx(2.0, rel=1e-12)
    assert (metrics.unit, metrics.velocity_unit) == ("m", "m/s")
    assert (metrics.horizon, metrics.rollouts, metrics.diverged) == (0.04, 2, 0)


def test_metrics_average_joints():
    segments = make_segments(3, 4, nv=2)
    metrics = measure(with_errors(segments, np.array([1.0, 3.0]), 0.0), segments, "hinge")
    assert metrics.position_mae == pytest.approx(2.0, rel=1e-12)
    assert metrics.position_rmse == pytest.approx(np.sqrt(5.0), rel=1e-12)
    assert (metrics.unit, metrics.velocity_unit) == ("rad", "rad/s")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("signal", ["position", "velocity"])
def test_diverged_rollouts_are_counted_and_left_out(bad, signal):
    segments = make_segments(3, 4)
    errors = {"position": np.ones((3, 4, 1)), "velocity": np.ones((3, 4, 1))}
    errors["position"][1] = 100.0
    errors[signal][1, 2] = bad
    metrics = measure(with_errors(segments, **errors), segments, "hinge")
    assert metrics.diverged == 1
    assert metrics.rollouts == 3
    assert metrics.position_mae == pytest.approx(1.0, rel=1e-12)
    assert metrics.position_rmse == pytest.approx(1.0, rel=1e-12)


def test_nothing_left_is_nan():
    segments = make_segments(2, 4)
    metrics = measure(with_errors(segments, np.nan, 0.0), segments, "hinge")
    assert metrics.diverged == 2
    for error in ("position_mae", "position_mae_std", "position_rmse", "velocity_rmse"):
        assert np.isnan(getattr(metrics, error)), error
    prediction = with_errors(segments, np.array([1.0, np.inf])[:, None, None], 0.0)
    np.testing.assert_allclose(rollout_mae(prediction, segments), [1.0, np.nan], rtol=1e-12)


def test_judgement_covers_parts_horizons_and_paper(dataset):
    judgement = evaluate(dataset).judge(hold, {"bench": {"offset": np.zeros(1)}})
    assert [parts["test"].horizon for parts in judgement.by_horizon] == [0.2, 0.1]
    assert judgement.train is judgement.by_horizon[0]["train"]
    assert judgement.test is judgement.by_horizon[0]["test"]
    assert (judgement.train.rollouts, judgement.test.rollouts) == (5, 5)
    assert (judgement.trajectory.horizon, judgement.trajectory.rollouts) == (0.5, 1)
    assert judgement.trajectory.position_mae_std == 0
    assert (judgement.places.horizon, judgement.places.rollouts) == (0.2, 7)
    assert judgement.prediction.qpos.shape == (7, 50, 1)
    assert judgement.rollout_mae["test"].mean() == pytest.approx(judgement.test.position_mae, rel=1e-12)
    assert judgement.rollout_mae["train"].std() == pytest.approx(judgement.train.position_mae_std, rel=1e-12)
    assert judgement.local_mae.shape == (11,)  # 119 steps hold eleven windows of 10


def test_the_hash_tells_rollouts_apart(dataset):
    first, again = evaluate(dataset).sha256, evaluate(dataset).sha256
    others = [evaluate(dataset, **change).sha256 for change in ({"seed": 4}, {"local": 0.2}, {"trajectory": 0.4})]
    assert first == again and len({first, *others}) == 4


def test_judgement_of_a_drive_that_holds(dataset):
    evaluation = evaluate(dataset, placement="consecutive", rollouts=None)
    judgement = evaluation.judge(hold, {"bench": {"offset": np.zeros(1)}})
    log = dataset.test[0]
    starts = np.arange(5) * 20  # 119 steps hold five windows of 20
    expected = np.mean([np.abs(log.qpos[s + 1 : s + 21] - log.qpos[s]).mean() for s in starts])
    assert judgement.test.rollouts == 5
    assert judgement.test.position_mae == pytest.approx(expected, rel=1e-12)


def test_drives_meet_the_same_rollouts(dataset):
    evaluation = evaluate(dataset)
    near, again, far = (evaluation.judge(hold, {"bench": {"offset": np.full(1, x)}}) for x in (0.0, 0.0, 1e3))
    assert near.by_horizon == again.by_horizon
    # An offset far above the signal shifts the mean error of the same windows by itself, less the signed errors' mean.
    start, signal = evaluation.trajectories.first.qpos[:, :1], evaluation.trajectories.first.qpos[:, 1:]
    assert far.trajectory.position_mae == pytest.approx(1e3 + (start - signal).mean(), rel=1e-12)


def test_test_metrics_do_not_see_training_logs(dataset):
    changed = Dataset("noise", (make_log("c", 200, 9),), dataset.test)
    values = {"bench": {"offset": np.zeros(1)}}
    first, second = (evaluate(data).judge(hold, values) for data in (dataset, changed))
    assert first.test == second.test
    assert first.train != second.train


@pytest.mark.parametrize("option", [{"trajectory": 1.2}, {"horizons": [1.2]}])
def test_too_short_a_log_is_refused_before_any_rollout(dataset, option):
    with pytest.raises(LogError, match=r"120 samples, expected at least 121"):
        evaluate(dataset, **option)
    with pytest.raises(ConfigError, match=r"evaluation\.horizons is empty"):
        evaluate(dataset, horizons=[])


def test_moving_mean_and_std():
    mean, std = moving_mean_and_std(np.array([0.0, 2.0, 4.0, 4.0]), 2)
    np.testing.assert_allclose(mean, [1, 3, 4], rtol=1e-12)
    np.testing.assert_allclose(std, [1, 1, 0], rtol=1e-12)
