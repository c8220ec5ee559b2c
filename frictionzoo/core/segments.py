"""Windows cut from logs: segments for a fit and longer rollouts for an evaluation."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from frictionzoo.core.errors import ConfigError, LogError, closest
from frictionzoo.core.log import Log
from frictionzoo.core.state import Signals

_log = logging.getLogger(__name__)

SAME_TIMESTEP = 1e-3  # largest relative difference between the timesteps of logs used together
_MOST = 0.9  # share of all samples that is in logs long enough for a window
_GAP, _GAP_SHARE = 1.0, 0.1  # default gap between training and test [s], and its largest share of a log


@dataclass(frozen=True)
class Segments:
    """Windows cut from logs: each starts at a measured state and is driven by the recorded commands.

    Sample i of `acting` acts between samples i and i + 1 of `qpos` and `qvel`, so there is one state more.

    Attributes:
        qpos: Measured position [rad or m].
        qvel: Measured velocity [rad/s or m/s].
        signals: Driving signals, each of shape (batch, samples, nv): `history` samples before the first state, then the
            samples from there on.
        timestep: Sample interval [s].
        load: Effect of each payload on the bench's MuJoCo model; None for no payloads.
        follows: Whether each begins where the previous one ends; None if none does.
        recording: Number of the log of each; None for a single log.
        begins: Time of each first state in its log [s]; None if not known.
    """

    qpos: Float[np.ndarray, "batch states nv"]
    qvel: Float[np.ndarray, "batch states nv"]
    signals: Signals
    timestep: float
    load: Float[np.ndarray, "batch load"] | None = None
    follows: Bool[np.ndarray, "batch"] | None = None
    recording: Int[np.ndarray, "batch"] | None = None
    begins: Float[np.ndarray, "batch"] | None = None

    @property
    def acting(self) -> Signals:
        """`signals` from the first state on."""
        return self.signals.map(lambda signal: signal[:, self.history :])

    @property
    def loads(self) -> Float[np.ndarray, "batch load"]:
        """`load`, with no columns if there is none."""
        return np.zeros((self.count, 0)) if self.load is None else self.load

    @property
    def count(self) -> int:
        """Number of segments."""
        return len(self.qpos)

    @property
    def length(self) -> int:
        """Sample intervals in each segment."""
        return self.qpos.shape[1] - 1

    @property
    def history(self) -> int:
        """Samples of `signals` before the first state."""
        return self.signals.ctrl.shape[1] - self.length

    @property
    def first(self) -> "Segments":
        """The first segment only."""
        load = None if self.load is None else self.load[:1]
        signals = self.signals.map(lambda signal: signal[:1])
        return Segments(self.qpos[:1], self.qvel[:1], signals, self.timestep, load)


class Sampling(NamedTuple):
    """Relation between the samples of recordings and simulation steps.

    Attributes:
        interval: Sample interval [s].
        substeps: Simulation steps in it.
        history: Command samples before a segment's first state that the largest delay can still bring into it.
        commands: Inputs of the actuator law that are commands too, with the same delay.
        second_order: Whether rollouts are of second order in the simulation step; MuJoCo's are of first order.
    """

    interval: float
    substeps: int
    history: int
    commands: tuple[str, ...] = ()
    second_order: bool = False


def cut_segments(logs: Sequence[Log], count: int | None = 20_000, length: int = 5, history: int = 0) -> Segments:
    """Cut windows for a fit from logs with equal columns and timestep.

    Each spans `length` sample intervals; there are at most `count` (None: all), spread evenly. They share no step: a
    sample on a border ends one and starts the next. `history` counts command samples before the first state; before a
    log begins, its first one is repeated.

    Raises:
        LogError: The logs do not match, or none is long enough for one segment.
        ConfigError: `count` or `length` is below 1.
    """
    _refuse_mixture(logs)
    _refuse_below_one("segments.length", length)
    available = [_consecutive(log, length) for log in logs]
    if not any(len(starts) for starts in available):
        longest = max(logs, key=lambda log: log.samples)
        raise LogError(
            f"{longest.name}: {longest.samples} samples, expected at least {length + 1} for one segment of {length} "
            "steps; record a longer log or set a smaller segments.length"
        )
    for log, starts in zip(logs, available, strict=True):
        if not len(starts):
            _log.warning("%s: %d samples, too short for %d steps; left out", log.name, log.samples, length)
    return _windows(logs, _spread(_places(available), count, "segments.count"), length, history)


def cut_rollouts(
    logs: Sequence[Log],
    horizon_s: float,
    count: int | None,
    placement: str,
    seed: int,
    history: int = 0,
    options: tuple[str, str] = ("evaluation.horizons", "evaluation.rollouts"),
) -> Segments:
    """Cut windows for an evaluation from logs with equal columns and timestep.

    Args:
        logs: Recordings; those shorter than the horizon give no rollout.
        horizon_s: Length of a rollout [s].
        count: Largest number of rollouts; None takes all, with `consecutive` only.
        placement: `random`: distinct starts drawn from `seed`, which may overlap; `consecutive`: a restart every
            horizon, spread evenly if there are more than `count`.
        seed: Seed of the random starts.
        history: As in `cut_segments`.
        options: Names of the options for `horizon_s` and `count`, for messages.

    Raises:
        LogError: The logs do not match, or all are shorter than the horizon.
        ConfigError: An option is impossible.
    """
    timestep = _refuse_mixture(logs)
    length = round(horizon_s / timestep)
    if length < 1:
        raise ConfigError(f"{options[0]}: {horizon_s:g} s, expected at least one step of {timestep:g} s")
    longest = max(logs, key=lambda log: log.samples)
    if longest.samples < length + 1:
        raise LogError(
            f"{longest.name}: {longest.samples} samples, expected at least {length + 1} for a rollout of "
            f"{horizon_s:g} s; use a longer log or a smaller {options[0]}"
        )
    if placement == "consecutive":
        places = _spread(_places([_consecutive(log, length) for log in logs]), count, options[1])
    elif placement == "random":
        places = _draw(_places([np.arange(max(log.samples - length, 0)) for log in logs]), count, seed, options[1])
    else:
        raise ConfigError(f"evaluation.placement={placement}: unknown; {closest(placement, ('random', 'consecutive'))}")
    return _windows(logs, places, length, history)


def longest_window(logs: Sequence[Log]) -> int:
    """Return the longest window, in sample intervals, that fits into logs with 90 % of all samples."""
    samples = np.sort([log.samples for log in logs])[::-1]
    covered = np.cumsum(samples)
    return int(samples[np.argmax(covered >= _MOST * covered[-1])]) - 1


def split_by_time(log: Log, test_share: float, gap: float | None) -> tuple[Log, Log]:
    """Split one log into its first block for training and its last, of `test_share`, for testing.

    An unused gap [s] keeps one from revealing the other; None for 1 s, but at most a tenth of the log.

    Raises:
        LogError: A part would have fewer than two samples.
        ConfigError: The share lies outside 0 to 1, or the gap is negative.
    """
    if not 0 <= test_share <= 1:
        raise ConfigError(f"data.split.test_share={test_share}: expected a share between 0 and 1")
    if gap is None:
        gap = min(_GAP, _GAP_SHARE * log.samples * log.timestep)
    if not gap >= 0:
        raise ConfigError(f"data.split.gap={gap}: expected 0 s or more")
    test = round(test_share * log.samples)
    train = log.samples - test - round(gap / log.timestep)
    for part, samples in (("train", train), ("test", test)):
        if samples < 2:
            raise LogError(
                f"{log.name}: the {part} part has {max(samples, 0)} of {log.samples} samples with data.split."
                f"test_share={test_share:g} and gap={gap:g} s, expected at least 2; change data.split"
            )
    return log.between(0, train, "train"), log.between(log.samples - test, log.samples, "test")


def _refuse_mixture(logs: Sequence[Log]) -> float:
    if not logs:
        raise LogError("no log was given, expected at least one")
    first = logs[0]
    for log in logs[1:]:
        if abs(log.timestep - first.timestep) > SAME_TIMESTEP * first.timestep:
            raise LogError(
                f"{log.name}: timestep {log.timestep:.6g} s, expected {first.timestep:.6g} s as in {first.name}; "
                "resample the logs to one timestep"
            )
        for signal in ("qpos", "ctrl"):
            columns, expected = getattr(log, signal).shape[1], getattr(first, signal).shape[1]
            if columns != expected:
                raise LogError(f"{log.name}: {columns} columns of {signal}, expected {expected} as in {first.name}")
    return first.timestep


def _refuse_below_one(option: str, value: int | None) -> None:
    if value is not None and value < 1:
        raise ConfigError(f"{option}={value}: expected 1 or more")


def _consecutive(log: Log, length: int) -> Int[np.ndarray, "segments"]:
    """Return the first samples of the consecutive windows of `length` steps in a log."""
    return np.arange((log.samples - 1) // length) * length


def _places(starts: Sequence[Int[np.ndarray, "..."]]) -> Int[np.ndarray, "segments 2"]:
    """Return log index and first sample of every window, from the first samples in each log."""
    return np.concatenate(
        [np.stack([np.full_like(first, number), first], axis=1) for number, first in enumerate(starts)]
    )


def _spread(places: Int[np.ndarray, "available 2"], count: int | None, option: str) -> Int[np.ndarray, "segments 2"]:
    _refuse_below_one(option, count)
    available = len(places)
    if count is None or count >= available:
        return places
    return places[np.arange(count) * available // count]


def _draw(
    places: Int[np.ndarray, "available 2"], count: int | None, seed: int, option: str
) -> Int[np.ndarray, "segments 2"]:
    """Draw at most `count` windows without repetition, in the order of drawing."""
    if count is None:
        raise ConfigError(f"{option}=null with evaluation.placement=random: expected a number of rollouts")
    _refuse_below_one(option, count)
    chosen = np.random.default_rng(seed).choice(len(places), size=min(count, len(places)), replace=False)
    return places[chosen]


def _windows(logs: Sequence[Log], places: Int[np.ndarray, "segments 2"], length: int, history: int) -> Segments:
    offset = np.cumsum([0] + [log.samples for log in logs[:-1]])
    start = offset[places[:, 0]]
    index = (start + places[:, 1])[:, None] + np.arange(length + 1)
    before = np.maximum(start[:, None], index[:, :1] + np.arange(-history, 0))
    driven = np.concatenate([before, index[:, :-1]], axis=1)
    qpos, qvel = (np.concatenate([getattr(log, name) for log in logs])[index] for name in ("qpos", "qvel"))
    recorded = [log.signals.named() for log in logs]
    signals = {name: np.concatenate([named[name] for named in recorded])[driven] for name in recorded[0]}
    load = np.stack([log.load for log in logs])[places[:, 0]]
    follows = np.append(False, (np.diff(places, axis=0) == [0, length]).all(axis=1))
    begins = np.concatenate([log.time for log in logs])[index[:, 0]]
    return Segments(qpos, qvel, Signals.from_named(signals), logs[0].timestep, load, follows, places[:, 0], begins)
