"""Open-loop rollouts against the recording: how far a simulated drive drifts from the measured one."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from frictionzoo.errors import ConfigError
from frictionzoo.params import UNITS
from frictionzoo.segments import cut_rollouts
from frictionzoo.types import Dataset, Segments

Values = Mapping[str, Mapping[str, np.ndarray]]
Rollout = Callable[..., tuple]
"""`rollout(values, qpos, qvel, ctrl, load)`: predicted qpos and qvel, each (batch, time, nv)."""


@dataclass(frozen=True)
class Metrics:
    """Errors of open-loop rollouts that start at measured states.

    Diverged rollouts are counted and left out of the errors, which are NaN where all diverged.

    Attributes:
        position_mae: Mean over rollouts of each one's absolute position error, averaged over time and joints [unit].
        position_mae_std: Population standard deviation of that error over the rollouts, the paper's sigma_MAE [unit]; 0
            for a single rollout.
        position_rmse: Root mean square position error over all samples [unit].
        velocity_rmse: Root mean square velocity error over all samples [velocity_unit].
        unit: `rad` or `m`.
        velocity_unit: `rad/s` or `m/s`.
        horizon: Length of a rollout [s].
        rollouts: How many were simulated.
        diverged: How many of them left the finite numbers.
    """

    position_mae: float
    position_mae_std: float
    position_rmse: float
    velocity_rmse: float
    unit: str
    velocity_unit: str
    horizon: float
    rollouts: int
    diverged: int


@dataclass(frozen=True)
class Prediction:
    """Simulated states of some segments, after each step.

    Attributes:
        qpos: Position [rad or m].
        qvel: Velocity [rad/s or m/s].
    """

    qpos: Float[np.ndarray, "batch time nv"]
    qvel: Float[np.ndarray, "batch time nv"]

    @property
    def diverged(self) -> Bool[np.ndarray, "batch"]:
        """Which rollouts hold a sample that is not finite."""
        finite = np.isfinite(self.qpos) & np.isfinite(self.qvel)
        return np.logical_not(finite.all(axis=(1, 2)))


def predict(rollout: Rollout, values: Values, segments: Segments) -> Prediction:
    """Simulate each segment from its first measured state under its recorded commands.

    Args:
        rollout: Bench, friction law and engine.
        values: Values of the bench's and the law's parameters.
        segments: What was measured.
    """
    qpos, qvel = rollout(values, segments.qpos[:, 0], segments.qvel[:, 0], segments.ctrl, segments.load)
    return Prediction(np.asarray(qpos, dtype=np.float64), np.asarray(qvel, dtype=np.float64))


def measure(prediction: Prediction, segments: Segments, joint_type: str) -> Metrics:
    """Errors of simulated against measured states.

    Args:
        prediction: Simulated states of `segments`.
        segments: What was measured.
        joint_type: `hinge` or `slide`, for the units.
    """
    kept = ~prediction.diverged
    position = prediction.qpos[kept] - segments.qpos[kept, 1:]
    velocity = prediction.qvel[kept] - segments.qvel[kept, 1:]
    mae = np.abs(position).mean(axis=(1, 2))
    return Metrics(
        position_mae=float(mae.mean()) if kept.any() else np.nan,
        position_mae_std=float(mae.std()) if kept.any() else np.nan,
        position_rmse=_rms(position),
        velocity_rmse=_rms(velocity),
        unit=UNITS[joint_type]["position"],
        velocity_unit=UNITS[joint_type]["velocity"],
        horizon=round(segments.length * segments.timestep, 9),
        rollouts=segments.count,
        diverged=int(prediction.diverged.sum()),
    )


def _rms(error: Float[np.ndarray, "batch time nv"]) -> float:
    return float(np.sqrt(np.square(error).mean())) if error.size else np.nan


@dataclass(frozen=True)
class Judgement:
    """What one drive's rollouts say about it.

    Attributes:
        by_horizon: Metrics of each horizon, the main one first, for the parts `train` and `test`.
        trajectory: The paper's evaluation (a): one long test rollout.
        places: The paper's evaluation (b): test rollouts at random places.
        prediction: The simulated states of (a).
    """

    by_horizon: tuple[Mapping[str, Metrics], ...]
    trajectory: Metrics
    places: Metrics
    prediction: Prediction

    @property
    def train(self) -> Metrics:
        """Metrics of the training part at the main horizon."""
        return self.by_horizon[0]["train"]

    @property
    def test(self) -> Metrics:
        """Metrics of the test part at the main horizon."""
        return self.by_horizon[0]["test"]


class Evaluation:
    """The rollouts on which drives are compared; all drives meet the same ones.

    The windows are cut at once, so that logs too short for them are refused before a fit and not after it.

    Attributes:
        trajectory: The window of the paper's evaluation (a).
        window: Length of the moving mean over the error of (a) [s].

    Args:
        dataset: Recordings, train and test.
        joint_type: `hinge` or `slide`.
        horizons: Lengths of the rollouts [s], the main one first.
        rollouts: Largest number of rollouts at a horizon in a part; None takes all, with `consecutive` only.
        placement: Where they start, `random` or `consecutive`, as in `cut_rollouts`.
        trajectory: Length of the one rollout of (a) [s].
        window: Length of the moving mean over its error [s].
        places: How many rollouts at random places (b) has, of the main horizon.
        seed: Of the random places.

    Raises:
        ConfigError: An option is impossible.
        LogError: A log is shorter than a rollout.
    """

    def __init__(
        self,
        dataset: Dataset,
        joint_type: str,
        horizons: Sequence[float],
        rollouts: int | None,
        placement: str,
        trajectory: float,
        window: float,
        places: int,
        seed: int,
    ) -> None:
        if not horizons:
            raise ConfigError("evaluation.horizons is empty, expected at least one length in seconds")
        if not 0 < window <= trajectory:
            raise ConfigError(
                f"evaluation.window={window:g}; expected more than 0 s and at most the {trajectory:g} s shown"
            )
        parts = {"train": dataset.train, "test": dataset.test}
        self.joint_type = joint_type
        self.window = window
        self._by_horizon = [
            {part: cut_rollouts(logs, horizon, rollouts, placement, seed) for part, logs in parts.items()}
            for horizon in horizons
        ]
        self.trajectory: Segments = cut_rollouts(dataset.test, trajectory, 1, "random", seed)
        self._places = cut_rollouts(dataset.test, horizons[0], places, "random", seed)

    def judge(self, rollout: Rollout, values: Values) -> Judgement:
        """Simulate every window with one drive and measure its errors.

        Args:
            rollout: Bench, friction law and engine.
            values: Values of the bench's and the law's parameters.
        """

        def metrics(segments: Segments) -> Metrics:
            return measure(predict(rollout, values, segments), segments, self.joint_type)

        prediction = predict(rollout, values, self.trajectory)
        return Judgement(
            by_horizon=tuple(
                {part: metrics(segments) for part, segments in parts.items()} for parts in self._by_horizon
            ),
            trajectory=measure(prediction, self.trajectory, self.joint_type),
            places=metrics(self._places),
            prediction=prediction,
        )


def moving_mean_and_std(
    samples: Float[np.ndarray, "time"], width: int
) -> tuple[Float[np.ndarray, "windows"], Float[np.ndarray, "windows"]]:
    """Mean and standard deviation over each full window of a signal; `windows` is time - width + 1.

    Args:
        samples: The signal.
        width: Samples in a window, from 1 to the signal's length.
    """
    windows = np.lib.stride_tricks.sliding_window_view(samples, width)
    return windows.mean(axis=1), windows.std(axis=1)
