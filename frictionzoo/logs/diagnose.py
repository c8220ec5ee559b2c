"""What is in a recording before anything is fitted: clock, encoder, lag between signals, excitation."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from frictionzoo.core.errors import LogError
from frictionzoo.core.log import JITTER
from frictionzoo.logs.recording import Recording
from frictionzoo.logs.velocity import estimate_velocity

GAP = 5.0  # median intervals; a longer one is a gap, not a few missing samples
SPIKE = 20.0  # a spike leaves both neighbours by this many times the usual second difference
FAR = 1.0  # times the range of the others that an outlier lies beyond it
RETURN = 0.5  # and its neighbours differ by less than this share of what it leaves them by
WIDEST = 2  # samples; a longer excursion may be a motion
OUTLIER = 0.2  # share of the median by which a supply does not change in earnest
QUANTISED = 0.9  # share of the steps between samples that are multiples of a quantum, if there is one
SLOWEST = 0.05  # share of the top speed under which a sample counts as slow
RESTING = 0.005  # and under which it counts as standing still
TOP = 0.001  # share of the samples on either side that may lie beyond what counts as the range
LONGEST_LAG = 0.1  # s, searched on either side
ALIKE = 0.9  # correlation from which on two signals are delayed copies of each other
ORDER = 2  # of the velocity estimate's filter; its cut-off is a tenth of the sample rate, at most 50 Hz
VOLTAGES = ("vin", "voltage", "supply", "supply_voltage", "input_voltage")  # what a header may call the supply


class Timing(NamedTuple):
    """A recording's clock.

    Attributes:
        samples: Number of samples.
        duration: From the first to the last [s].
        interval: Median interval between samples [s].
        jitter: Share of the intervals that deviate from the median by more than a log tolerates.
        worst: Largest such deviation outside gaps, as a share of the median.
        duplicates: Samples with the time of the one before.
        missing: Samples that would fill the intervals between one and a half medians and a gap.
        gaps: Intervals that are longer than a gap.
        resets: Times at which the clock runs backwards.
    """

    samples: int
    duration: float
    interval: float
    jitter: float
    worst: float
    duplicates: int
    missing: int
    gaps: int
    resets: int


@dataclass(frozen=True)
class Joint:
    """One joint of a recording; None stands for what cannot be told.

    Attributes:
        position: Lowest and highest position, outliers left out [rad or m].
        position_quantum: Step of the encoder [rad or m]; None where the values are not quantised.
        spikes: Isolated spikes of the position, of one sample or two.
        velocity: Lowest and highest velocity, estimated from the position, outliers left out [rad/s or m/s].
        velocity_quantum: Step of the measured velocity [rad/s or m/s].
        velocity_lag: Time by which the measured velocity lags the position's derivative [s].
        velocity_scale: Measured velocity over the position's derivative; 1 where their units agree.
        top_speed: Largest speed, outliers left out [rad/s or m/s].
        slow: Share of the samples under `SLOWEST` of the top speed.
        rest: Share of the samples under `RESTING` of the top speed.
    """

    position: tuple[float, float]
    position_quantum: float | None
    spikes: int
    velocity: tuple[float, float]
    velocity_quantum: float | None
    velocity_lag: float | None
    velocity_scale: float | None
    top_speed: float
    slow: float
    rest: float


@dataclass(frozen=True)
class Command:
    """One actuator's command in a recording.

    Attributes:
        range: Lowest and highest.
        saturated: Share of the samples at exactly the lowest or the highest.
    """

    range: tuple[float, float]
    saturated: float


@dataclass(frozen=True)
class Supply:
    """The measured supply against what the header says.

    Attributes:
        median: [V].
        range: Lowest and highest [V].
        outliers: Samples that differ from the median by more than a supply does in earnest.
        field: Header field that names a supply; None where there is none.
        stated: Its value [V].
    """

    median: float
    range: tuple[float, float]
    outliers: int
    field: str | None
    stated: float | None


@dataclass(frozen=True)
class Diagnosis:
    """What is in one recording.

    Attributes:
        name: The recording's.
        timing: Its clock.
        lost: Samples in which a signal is not finite.
        joints: Each joint.
        commands: Each actuator.
        supply: None where none was measured.
        enabled: Share of the samples with the drive on; None where that was not recorded.
    """

    name: str
    timing: Timing
    lost: int
    joints: tuple[Joint, ...]
    commands: tuple[Command, ...]
    supply: Supply | None
    enabled: float | None


def diagnose(recording: Recording) -> Diagnosis:
    """What is in a recording.

    Args:
        recording: As it comes; it may have jitter, gaps, NaN and spikes.

    Raises:
        LogError: It lacks a signal that every recording has, or holds next to nothing.
    """
    refuse_incomplete(recording)
    signals = recording.signals
    finite = np.all([np.isfinite(signals[name]).all(axis=1) for name in signals], axis=0)
    timing = measure_timing(recording.time)
    velocity = signals.get("qvel")
    joints = tuple(
        _diagnose_joint(recording, position, None if velocity is None else velocity[:, column])
        for column, position in enumerate(signals["qpos"].T)
    )
    enable = signals.get("enable")
    return Diagnosis(
        name=recording.name,
        timing=timing,
        lost=int((~finite).sum()),
        joints=joints,
        commands=tuple(_diagnose_command(recording.name, command) for command in signals["ctrl"].T),
        supply=_diagnose_supply(signals.get("supply"), recording.fields),
        enabled=None if enable is None else float((enable > 0.5).mean()),
    )


def refuse_incomplete(recording: Recording) -> None:
    """Refuse what no part of the program can use.

    Args:
        recording: As it comes.

    Raises:
        LogError: qpos or ctrl is missing, shapes disagree, a time is not finite, or there are too few samples.
    """
    name, samples = recording.name, len(recording.time)
    for signal in ("qpos", "ctrl"):
        if signal not in recording.signals:
            raise LogError(
                f"{name}: no {signal}, expected time, qpos and ctrl; name its column in data.columns.{signal}"
            )
    for signal, values in recording.signals.items():
        if values.ndim != 2 or len(values) != samples:
            raise LogError(f"{name}: {signal} has shape {values.shape}, expected ({samples}, columns) as time has")
    joints, speeds = (recording.signals.get(signal, recording.signals["qpos"]).shape[1] for signal in ("qpos", "qvel"))
    if speeds != joints:
        raise LogError(
            f"{name}: qvel has {speeds} columns and qpos {joints}, expected as many; name them in data.columns.qvel, "
            "or set it to [] to do without"
        )
    if not np.isfinite(recording.time).all():
        at = int(np.argmin(np.isfinite(recording.time)))
        raise LogError(f"{name}: time is NaN or infinite at sample {at}, expected seconds; cut or repair the file")
    if samples < 2 or not (np.diff(recording.time) > 0).any():
        raise LogError(f"{name}: {samples} samples at one time, expected at least 2 in a row; check data.columns.time")


def measure_timing(time: Float[np.ndarray, "time"]) -> Timing:
    """A recording's clock.

    Args:
        time: Sample times [s], at least two of which follow each other.
    """
    steps = np.diff(time)
    forward = steps[steps > 0]
    interval = float(np.median(forward))
    steady = forward[forward <= GAP * interval]
    deviation = np.abs(steady / interval - 1)
    return Timing(
        samples=len(time),
        duration=float(forward.sum()),
        interval=interval,
        jitter=float((deviation > JITTER).mean()),
        worst=float(deviation.max()),
        duplicates=int((steps == 0).sum()),
        missing=int((np.round(steady[steady > 1.5 * interval] / interval) - 1).sum()),
        gaps=len(forward) - len(steady),
        resets=int((steps < 0).sum()),
    )


def find_breaks(time: Float[np.ndarray, "time"], gap: float) -> Int[np.ndarray, "breaks"]:
    """Samples with which another stretch begins: after a gap, or where the clock runs backwards.

    Args:
        time: Sample times [s].
        gap: Longest interval within a stretch, in median intervals.
    """
    steps = np.diff(time)
    return np.flatnonzero((steps < 0) | (steps > gap * np.median(steps[steps > 0]))) + 1


def find_spikes(signal: Float[np.ndarray, "time"]) -> Int[np.ndarray, "spikes"]:
    """Samples that leave their neighbours on both sides the same way, while these are close to each other.

    The usual second difference and the signal's own step say what is usual, so a fast but smooth motion is no spike.

    Args:
        signal: Position, or another signal that cannot jump and come back.

    Returns:
        Every sample of every spike; a spike has one sample or two.
    """
    second = np.abs(np.diff(signal, 2))
    steps = np.abs(np.diff(signal))
    if not np.isfinite(second).any() or not (steps > 0).any():
        return np.zeros(0, int)
    usual = max(float(np.nanmedian(second)), float(steps[steps > 0].min()))
    found = [_find_spikes_of(signal, usual, width) for width in range(1, WIDEST + 1)]
    return np.unique(np.concatenate(found))


def _find_spikes_of(signal: Float[np.ndarray, "time"], usual: float, width: int) -> Int[np.ndarray, "spikes"]:
    before, after = signal[: -width - 1], signal[width + 1 :]
    leaves, returns = signal[1:-width] - before, signal[width:-1] - after
    size = np.where(leaves * returns > 0, np.minimum(np.abs(leaves), np.abs(returns)), 0.0)
    first = np.flatnonzero((size > SPIKE * usual) & (np.abs(before - after) < RETURN * size)) + 1
    return np.concatenate([first + i for i in range(width)])


def count_spikes(signal: Float[np.ndarray, "time"]) -> int:
    """Spikes of a signal, one for neighbouring samples.

    Args:
        signal: As `find_spikes` takes it.
    """
    found = find_spikes(signal)
    return len(found) and 1 + int((np.diff(found) > 1).sum())


def repair_spikes(signal: Float[np.ndarray, "time"]) -> Float[np.ndarray, "time"]:
    """The signal with a straight line in place of each spike.

    Args:
        signal: As `find_spikes` takes it.
    """
    repaired, found = signal.copy(), find_spikes(signal)
    others = np.delete(np.arange(len(signal)), found)
    repaired[found] = np.interp(found, others, signal[others])
    return repaired


def find_outliers(signal: Float[np.ndarray, "time"]) -> Bool[np.ndarray, "time"]:
    """Samples far beyond the range of the others, one or two in a row.

    Args:
        signal: Any, a held command too.
    """
    few = min(max(3, round(TOP * len(signal))), (len(signal) - 1) // 4)
    low, high = np.partition(signal, (few, len(signal) - 1 - few))[[few, -1 - few]]
    far = np.maximum(signal - high, low - signal) > FAR * (high - low)
    if not high > low:
        return np.zeros(len(signal), bool)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], far, [False]]).astype(int)))
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        far[first:last] = last - first <= WIDEST
    return far


def find_quantum(signal: Float[np.ndarray, "time"]) -> float | None:
    """Step of a quantised signal, None where it is not quantised.

    Args:
        signal: Samples; NaN are left out.
    """
    steps = np.abs(np.diff(signal))
    # What is left by arithmetic on the way from counts to radians is no step.
    steps = steps[np.isfinite(steps) & (steps > 1e-9 * np.nanmax(np.abs(signal), initial=1e-300))]
    if len(steps) < 2:
        return None
    small = steps[steps < 20 * steps.min()]
    quantum = float(np.median(small / np.round(small / steps.min())))
    ratio = steps / quantum
    few = ratio < 1000  # beyond, the rounding of the quantum itself decides
    whole = np.abs(ratio[few] - np.round(ratio[few])) < 0.1
    return quantum if whole.mean() >= QUANTISED else None


def find_lag(
    signal: Float[np.ndarray, "time"], reference: Float[np.ndarray, "time"], timestep: float
) -> tuple[float, float] | None:
    """Time by which a signal lags another, and its scale, by cross-correlation; None where they are not alike.

    Args:
        signal: Uniform samples.
        reference: What it may be a delayed copy of.
        timestep: Sample interval [s].

    Returns:
        Lag [s], to a fraction of a sample by a parabola through the peak; and signal over reference.
    """
    most = min(round(LONGEST_LAG / timestep), len(signal) // 4)
    if most < 1 or not (np.ptp(signal) > 0 and np.ptp(reference) > 0):
        return None
    inner = reference[most : len(reference) - most]
    windows = np.lib.stride_tricks.sliding_window_view(signal, len(inner))
    products, energy = windows @ inner, np.einsum("ij,ij->i", windows, windows)
    correlation = products / np.sqrt(np.maximum(energy, 1e-300) * max(float(inner @ inner), 1e-300))
    peak = int(np.argmax(correlation))
    if correlation[peak] < ALIKE or peak in (0, len(correlation) - 1):
        return None
    left, top, right = correlation[peak - 1 : peak + 2]
    fraction = 0.5 * (left - right) / (left - 2 * top + right) if left - 2 * top + right < 0 else 0.0
    return float(peak - most + fraction) * timestep, float(products[peak] / (inner @ inner))


def find_velocity_lag(
    time: Float[np.ndarray, "time"], position: Float[np.ndarray, "time"], velocity: Float[np.ndarray, "time"]
) -> tuple[float, float] | None:
    """Time by which a measured velocity lags the position's zero-phase derivative [s], and its scale against it.

    Args:
        time: Sample times [s]; jitter is taken out, the longest stretch without a gap counts.
        position: Measured position [rad or m].
        velocity: Measured velocity [rad/s or m/s].

    Returns:
        None where the recording is too short, or the two are no copies of each other.
    """
    grid, positions, velocities = regular_stretch(time, position, velocity)
    if len(grid) < 50:
        return None
    return find_lag(velocities, _derive(positions, float(grid[1] - grid[0])), float(grid[1] - grid[0]))


def regular_stretch(
    time: Float[np.ndarray, "time"], *signals: Float[np.ndarray, "time"]
) -> tuple[Float[np.ndarray, "grid"], ...]:
    """The longest stretch without a gap on a uniform grid of the median interval, the grid first.

    Args:
        time: Sample times [s].
        signals: Samples; those that are not finite are left out.
    """
    known = np.all([np.isfinite(signal) for signal in signals], axis=0)
    time, signals = time[known], tuple(signal[known] for signal in signals)
    if not (np.diff(time) > 0).any():
        return np.zeros(0), *(np.zeros(0) for _ in signals)
    new = np.concatenate([[True], np.diff(time) != 0])
    time, signals = time[new], tuple(signal[new] for signal in signals)
    edges = np.concatenate([[0], find_breaks(time, GAP), [len(time)]])
    longest = int(np.argmax(np.diff(edges)))
    cut = slice(edges[longest], edges[longest + 1])
    time = time[cut]
    grid = np.arange(time[0], time[-1], np.median(np.diff(time))) if len(time) > 1 else time
    return grid, *(np.interp(grid, time, signal[cut]) for signal in signals)


def _diagnose_joint(
    recording: Recording, position: Float[np.ndarray, "time"], measured: Float[np.ndarray, "time"] | None
) -> Joint:
    finite = position[np.isfinite(position)]
    if len(finite) < 2:
        raise LogError(f"{recording.name}: qpos holds {len(finite)} finite samples; check data.columns.qpos")
    smooth = repair_spikes(position)
    velocity = derive_velocity(recording.time, smooth)
    lag = None if measured is None else find_velocity_lag(recording.time, smooth, measured)
    low, high = _range(velocity)
    top = max(-low, high)
    return Joint(
        position=_range(finite),
        position_quantum=find_quantum(position),
        spikes=count_spikes(position),
        velocity=(low, high),
        velocity_quantum=None if measured is None else find_quantum(measured),
        velocity_lag=None if lag is None else lag[0],
        velocity_scale=None if lag is None else lag[1],
        top_speed=top,
        slow=float((np.abs(velocity) <= SLOWEST * top).mean()),
        rest=float((np.abs(velocity) <= RESTING * top).mean()),
    )


def _diagnose_command(name: str, command: Float[np.ndarray, "time"]) -> Command:
    finite = command[np.isfinite(command)]
    if not len(finite):
        raise LogError(f"{name}: ctrl holds no finite sample; check data.columns.ctrl")
    low, high = float(finite.min()), float(finite.max())
    return Command((low, high), float(((finite == low) | (finite == high)).mean()) if high > low else 0.0)


def _diagnose_supply(supply: Float[np.ndarray, "time columns"] | None, fields: Mapping[str, Any]) -> Supply | None:
    if supply is None or not np.isfinite(supply).any():
        return None
    field = next((name for name in VOLTAGES if isinstance(fields.get(name), int | float)), None)
    stated = None if field is None else float(fields[field])
    median, known = float(np.nanmedian(supply)), supply[np.isfinite(supply)]
    outliers = int((np.abs(known - median) > OUTLIER * abs(median)).sum())
    return Supply(median, (float(known.min()), float(known.max())), outliers, field, stated)


def _range(values: Float[np.ndarray, "samples"]) -> tuple[float, float]:
    low, high = np.quantile(values, [TOP, 1 - TOP])
    return float(low), float(high)


def derive_velocity(time: Float[np.ndarray, "time"], position: Float[np.ndarray, "time"]) -> Float[np.ndarray, "grid"]:
    """Velocity over the longest stretch without a gap, estimated from the position, on a uniform grid [rad/s or m/s].

    Args:
        time: Sample times [s].
        position: Measured position without spikes [rad or m].

    Returns:
        One zero for a recording that is too short.
    """
    grid, positions = regular_stretch(time, position)
    return _derive(positions, float(grid[1] - grid[0])) if len(grid) > 20 else np.zeros(1)


def _derive(position: Float[np.ndarray, "time"], timestep: float) -> Float[np.ndarray, "time"]:
    return estimate_velocity(position, timestep, min(0.1 / timestep, 50.0), ORDER, "")
