"""Evaluation: errors of open-loop rollouts against the recordings."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from frictionzoo.core.errors import ConfigError
from frictionzoo.core.log import Dataset
from frictionzoo.core.segments import Segments, cut_rollouts
from frictionzoo.core.units import UNITS
from frictionzoo.result.torque import AS_THE_FIT
from frictionzoo.result.types import JointErrors, Metrics

_SMALL = 50  # most rollouts of a set that is simulated together with other sets
KEPT = 100  # most rollouts whose errors are kept for each sample, evenly spread
Values = Mapping[str, Mapping[str, np.ndarray]]
Rollout = Callable[..., tuple]
"""`rollout(values, qpos, qvel, ctrl, load)`: predicted qpos and qvel, each (batch, time, nv)."""


@dataclass(frozen=True)
class Prediction:
    """Simulated states of segments after each step: qpos [rad or m] and qvel [rad/s or m/s]."""

    qpos: Float[np.ndarray, "batch time nv"]
    qvel: Float[np.ndarray, "batch time nv"]

    @property
    def first(self) -> "Prediction":
        """Prediction of the first segment."""
        return Prediction(self.qpos[:1], self.qvel[:1])

    @property
    def diverged(self) -> Bool[np.ndarray, "batch"]:
        """Rollouts with a sample that is not finite."""
        finite = np.isfinite(self.qpos) & np.isfinite(self.qvel)
        return np.logical_not(finite.all(axis=(1, 2)))


def predict(rollout: Rollout, values: Values, segments: Segments) -> Prediction:
    """Simulate each segment from its first measured state under its recorded commands."""
    qpos, qvel = rollout(values, segments.qpos[:, 0], segments.qvel[:, 0], segments.signals, segments.load)
    return Prediction(np.asarray(qpos, dtype=np.float64), np.asarray(qvel, dtype=np.float64))


def _predict_all(rollout: Rollout, values: Values, cut: Sequence[Segments]) -> list[Prediction]:
    """Simulate several sets of segments; small sets form one batch, because each shape is compiled separately."""
    small = [each for each in cut if each.count <= _SMALL]
    if not small:
        return [predict(rollout, values, each) for each in cut]
    longest, begin, predictions = max(each.length for each in small), 0, list[Prediction]()

    def start(each: Segments) -> tuple[Any, ...]:
        beyond = (0, 0), (0, longest - each.length), (0, 0)
        return each.qpos[:, 0], each.qvel[:, 0], each.signals.map(lambda signal: np.pad(signal, beyond, "edge"))

    starts = jax.tree.map(lambda *parts: np.concatenate(parts), *map(start, small))
    qpos, qvel = rollout(values, *starts, np.concatenate([each.loads for each in small]))
    for each in cut:
        if each.count > _SMALL:
            predictions.append(predict(rollout, values, each))
            continue
        rows, begin = slice(begin, begin + each.count), begin + each.count
        predictions.append(Prediction(*(np.asarray(part[rows, : each.length], np.float64) for part in (qpos, qvel))))
    return predictions


def measure(prediction: Prediction, segments: Segments, joint_type: str) -> Metrics:
    """Return the errors of simulated against measured states (NaN: all diverged) of `hinge` or `slide` joints."""
    units: Any = UNITS[joint_type]
    kept = ~prediction.diverged
    mae = rollout_mae(prediction, segments)[kept]
    return Metrics(
        position_mae=float(mae.mean()) if kept.any() else np.nan,
        position_mae_std=float(mae.std()) if kept.any() else np.nan,
        position_rmse=rms(prediction.qpos[kept] - segments.qpos[kept, 1:]),
        velocity_rmse=rms(prediction.qvel[kept] - segments.qvel[kept, 1:]),
        unit=units["position"],
        velocity_unit=units["velocity"],
        horizon=round(segments.length * segments.timestep, 9),
        rollouts=segments.count,
        diverged=int(prediction.diverged.sum()),
    )


def _measure_joints(prediction: Prediction, segments: Segments) -> tuple[JointErrors, ...]:
    kept = ~prediction.diverged
    pairs = (prediction.qpos, segments.qpos), (prediction.qvel, segments.qvel)
    errors = (np.moveaxis(simulated[kept] - measured[kept, 1:], 2, 0) for simulated, measured in pairs)
    return tuple(
        JointErrors(float(np.abs(q).mean()) if q.size else np.nan, rms(q), rms(v)) for q, v in zip(*errors, strict=True)
    )


def rollout_mae(prediction: Prediction, segments: Segments) -> Float[np.ndarray, "batch"]:
    """Return the position MAE of each rollout over time and joints [rad or m]; NaN: diverged."""
    error = np.abs(prediction.qpos - segments.qpos[:, 1:])
    return np.where(prediction.diverged, np.nan, error.mean(axis=(1, 2)))


def rms(error: Float[np.ndarray, "..."]) -> float:
    """Return the root mean square; NaN if there is no value."""
    return float(np.sqrt(np.square(error).mean())) if error.size else np.nan


@dataclass(frozen=True)
class Judgement:
    """Errors of one drive in all rollouts of the evaluation, in positions [rad or m].

    Attributes:
        by_horizon: Metrics of each horizon, main horizon first, for the parts `train` and `test`.
        by_joint: Errors of each joint at the main horizon, by part.
        rollout_mae: Position MAE of each rollout of the main horizon, by part.
        trajectory: Metrics of the paper's evaluation (a): one long test rollout.
        places: Metrics of the paper's evaluation (b): test rollouts from random starts.
        prediction: Simulated states of the long test rollouts, evaluation (a) first.
        local_mae: Position MAE of each short rollout over the whole test part.
        train_errors: Simulated minus measured position in at most `KEPT` finite training rollouts, main horizon.
    """

    by_horizon: tuple[Mapping[str, Metrics], ...]
    by_joint: Mapping[str, tuple[JointErrors, ...]]
    rollout_mae: Mapping[str, Float[np.ndarray, "rollouts"]]
    trajectory: Metrics
    places: Metrics
    prediction: Prediction
    local_mae: Float[np.ndarray, "windows"]
    train_errors: Float[np.ndarray, "kept time nv"]

    @property
    def train(self) -> Metrics:
        """Training metrics at the main horizon."""
        return self.by_horizon[0]["train"]

    @property
    def test(self) -> Metrics:
        """Test metrics at the main horizon."""
        return self.by_horizon[0]["test"]


class Evaluator:
    """Rollouts for the comparison of drives, the same for all drives.

    The windows are cut at construction, which refuses too short logs before a fit.

    Attributes:
        trajectories: Long windows of the test part; the first is the paper's evaluation (a).
        local: Consecutive short windows over the whole test part.

    Args:
        dataset: Recordings, train and test.
        joint_type: `hinge` or `slide`.
        horizons: Lengths of the rollouts [s], main horizon first.
        rollouts: Largest number of rollouts of a horizon in a part; None: all, with `consecutive` only.
        placement: Placement of their starts, `random` or `consecutive`, as in `cut_rollouts`.
        trajectory: Length of the long rollouts [s]; the first is (a).
        window: Length of the moving mean over the error of (a) [s].
        places: Number of long rollouts, and of rollouts of the main horizon from random starts (b).
        local: Length of the short rollouts [s].
        seed: Seed of the random starts.
        torque: Comparison of recorded torque, `bandwidth` [Hz] and `held`; None for either: as in the fit.
        history: Samples of the command before each rollout that may still act in it.

    Raises:
        ConfigError: An option has an invalid value.
        LogError: A log is shorter than a rollout.
    """

    def __init__(
        self,
        dataset: Dataset,
        joint_type: str,
        horizons: Sequence[float] = (1.0,),
        rollouts: int | None = 10,
        placement: str = "random",
        trajectory: float = 3.0,
        window: float = 0.1,
        places: int = 10,
        local: float = 0.1,
        seed: int = 0,
        torque: Mapping[str, Any] = AS_THE_FIT,
        history: int = 0,
    ) -> None:
        if not horizons:
            raise ConfigError("evaluation.horizons is empty, expected at least one length in seconds")
        if not 0 < window <= trajectory:
            most = f"at most evaluation.trajectory, {trajectory:g} s"
            raise ConfigError(f"evaluation.window={window:g}; expected more than 0 s and {most}")
        parts = {"train": dataset.train, "test": dataset.test}
        self.joint_type, self.window, self.torque = joint_type, window, torque
        self._by_horizon = [
            {part: cut_rollouts(logs, horizon, rollouts, placement, seed, history) for part, logs in parts.items()}
            for horizon in horizons
        ]

        def cut(option: str, seconds: float, count: int | None, placement: str = "random") -> Segments:
            options = f"evaluation.{option}", "evaluation.places"
            return cut_rollouts(dataset.test, seconds, count, placement, seed, history, options)

        self.trajectories: Segments = cut("trajectory", trajectory, places)
        self._places = cut("horizons", horizons[0], places)
        self.local: Segments = cut("local", local, None, "consecutive")

    @property
    def _cut(self) -> list[Segments]:
        return [segments for parts in self._by_horizon for segments in parts.values()]

    @property
    def _windows(self) -> list[Segments]:
        return [self.trajectories, self._places, self.local, *self._cut]

    @property
    def count(self) -> int:
        """Number of rollouts."""
        return sum(segments.count for segments in self._windows)

    @property
    def sha256(self) -> str:
        """Hash of states, commands, inputs and payloads of all windows; equal for drives with the same rollouts."""
        digest = hashlib.sha256()
        for segments in (*self._cut, self.trajectories, self._places, self.local):
            loads = (segments.loads,) if segments.loads.size else ()
            acting = segments.acting  # without signals that only friction models read: they differ between models
            driven = np.concatenate([acting.ctrl, *acting.inputs.values()], axis=2)
            for signal in (segments.qpos, segments.qvel, driven, *loads):
                digest.update(str(signal.shape).encode() + np.ascontiguousarray(signal, np.float64).tobytes())
        return digest.hexdigest()

    def judge(self, rollout: Rollout, values: Values) -> Judgement:
        """Simulate every window with one drive and measure its errors."""
        long, places, local, *others = _predict_all(rollout, values, self._windows)
        pairs, unit = zip(others, self._cut, strict=True), self.joint_type
        predicted = [{part: next(pairs) for part in parts} for parts in self._by_horizon]
        training, measured = predicted[0]["train"]
        errors = (training.qpos - measured.qpos[:, 1:])[~training.diverged]
        kept = np.unique(np.linspace(0, max(len(errors) - 1, 0), KEPT).astype(int))[: len(errors)]
        return Judgement(
            by_horizon=tuple({part: measure(*pair, unit) for part, pair in parts.items()} for parts in predicted),
            by_joint={part: _measure_joints(*pair) for part, pair in predicted[0].items()},
            rollout_mae={part: rollout_mae(*pair) for part, pair in predicted[0].items()},
            trajectory=measure(long.first, self.trajectories.first, unit),
            places=measure(places, self._places, unit),
            prediction=long,
            local_mae=rollout_mae(local, self.local),
            train_errors=errors[kept],
        )


def moving_mean_and_std(
    samples: Float[np.ndarray, "time"], width: int
) -> tuple[Float[np.ndarray, "windows"], Float[np.ndarray, "windows"]]:
    """Return mean and standard deviation of a signal over each full window of `width` samples."""
    windows = np.lib.stride_tricks.sliding_window_view(samples, width)
    return windows.mean(axis=1), windows.std(axis=1)
