"""Diagnostics of a recording before a fit: clock, encoder, velocity lag, excitation."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from frictionzoo.core.errors import LogError
from frictionzoo.core.log import JITTER
from frictionzoo.data.recording import Recording
from frictionzoo.data.signals import (
    GAP,
    TOP,
    Signal,
    count_spikes,
    derive_velocity,
    find_quantum,
    find_velocity_lag,
    repair_spikes,
)

OUTLIER = 0.2  # largest plausible deviation of a supply voltage, as a share of its median
SLOWEST = 0.05  # share of the top speed below which a sample counts as slow
RESTING = 0.005  # share of the top speed below which a sample counts as standing still
VOLTAGES = ("vin", "voltage", "supply", "supply_voltage", "input_voltage")  # header fields with the supply voltage


class Timing(NamedTuple):
    """Clock of a recording.

    Attributes:
        duration: Sum of the positive intervals [s].
        interval: Median interval between samples [s].
        jitter: Share of the intervals, gaps excluded, that deviate from the median by more than `JITTER`.
        worst: Largest deviation of an interval from the median, gaps excluded, as a share of the median.
        duplicates: Samples that repeat the previous sample's time.
        missing: Samples missing in intervals longer than 1.5 medians and shorter than a gap.
        gaps: Intervals longer than `GAP` medians.
        resets: Backward jumps of the clock.
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
    """One joint of a recording; None for a value that the recording does not show.

    Attributes:
        position: Lowest and highest position, outliers excluded [rad or m].
        position_quantum: Step of the encoder [rad or m]; None if the values are not quantised.
        spikes: Number of isolated spikes of the position, each one or two samples long.
        velocity: Lowest and highest velocity, estimated from the position, outliers excluded [rad/s or m/s].
        velocity_quantum: Step of the measured velocity [rad/s or m/s].
        velocity_lag: Lag of the measured velocity behind the position's derivative [s].
        velocity_scale: Ratio of the measured velocity to the position's derivative; 1 if their units agree.
        top_speed: Largest speed, outliers excluded [rad/s or m/s].
        slow: Share of the samples at or below `SLOWEST` of the top speed.
        rest: Share of the samples at or below `RESTING` of the top speed.
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
    """Command of one actuator in a recording.

    Attributes:
        range: Lowest and highest command.
        saturated: Share of the samples at exactly one of these limits.
    """

    range: tuple[float, float]
    saturated: float


@dataclass(frozen=True)
class Supply:
    """Measured supply voltage, and the voltage that the header states.

    Attributes:
        median: Median voltage [V].
        range: Lowest and highest voltage [V].
        outliers: Number of samples that deviate from the median by more than `OUTLIER`.
        field: Header field with a supply voltage; None if there is none.
        stated: Value of that field [V].
    """

    median: float
    range: tuple[float, float]
    outliers: int
    field: str | None
    stated: float | None


@dataclass(frozen=True)
class Diagnosis:
    """Diagnostics of one recording.

    Attributes:
        name: Origin, for messages.
        lost: Number of samples in which a signal is not finite.
        supply: Supply voltage; None if not recorded.
        enabled: Share of the samples with the drive enabled; None if not recorded.
    """

    name: str
    timing: Timing
    lost: int
    joints: tuple[Joint, ...]
    commands: tuple[Command, ...]
    supply: Supply | None
    enabled: float | None


def diagnose(recording: Recording) -> Diagnosis:
    """Diagnose a recording before cleaning; it may have jitter, gaps, NaN and spikes.

    Raises:
        LogError: `refuse_incomplete` refuses the recording, or a joint or command has too few finite samples.
    """
    refuse_incomplete(recording)
    signals, enable = recording.signals, recording.signals.get("enable")
    finite = np.all([np.isfinite(values).all(axis=1) for values in signals.values()], axis=0)
    measured = signals["qvel"].T if "qvel" in signals else [None] * signals["qpos"].shape[1]
    return Diagnosis(
        name=recording.name,
        timing=measure_timing(recording.time),
        lost=int((~finite).sum()),
        joints=tuple(_diagnose_joint(recording, *pair) for pair in zip(signals["qpos"].T, measured, strict=True)),
        commands=tuple(_diagnose_command(recording.name, command) for command in signals["ctrl"].T),
        supply=_diagnose_supply(signals.get("supply"), recording.fields),
        enabled=None if enable is None else float((enable > 0.5).mean()),
    )


def refuse_incomplete(recording: Recording) -> None:
    """Refuse a recording that no part of the program can use.

    Raises:
        LogError: qpos or ctrl is missing, shapes disagree, a time is not finite, or fewer than two samples have
            increasing times.
    """
    name, samples = recording.name, len(recording.time)
    for signal in ("qpos", "ctrl"):
        if signal not in recording.signals:
            raise LogError(
                f"{name}: no {signal}, expected time, qpos and ctrl; name its column in data.columns.{signal}"
            )
    for signal, values in recording.signals.items():
        if values.ndim != 2 or len(values) != samples:
            raise LogError(f"{name}: {signal} has shape {values.shape}, expected ({samples}, columns) like time")
    joints, speeds = (recording.signals.get(signal, recording.signals["qpos"]).shape[1] for signal in ("qpos", "qvel"))
    if speeds != joints:
        raise LogError(
            f"{name}: qvel has {speeds} columns and qpos {joints}, expected as many; name them in data.columns.qvel, "
            "or set it to [] to omit it"
        )
    if not np.isfinite(recording.time).all():
        sample = int(np.argmin(np.isfinite(recording.time)))
        raise LogError(f"{name}: time is NaN or infinite at sample {sample}, expected seconds; cut or repair the file")
    if samples < 2 or not (np.diff(recording.time) > 0).any():
        raise LogError(f"{name}: {samples} samples at one time, expected at least 2 in a row; check data.columns.time")


def measure_timing(time: Signal) -> Timing:
    """Return a recording's clock from its sample times [s], with at least one positive interval."""
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


def _diagnose_joint(recording: Recording, position: Signal, measured: Signal | None) -> Joint:
    finite = position[np.isfinite(position)]
    if len(finite) < 2:
        raise LogError(f"{recording.name}: qpos holds {len(finite)} finite samples; check data.columns.qpos")
    smooth = repair_spikes(position)
    velocity = derive_velocity(recording.time, smooth)
    match = None if measured is None else find_velocity_lag(recording.time, smooth, measured)
    lag, scale = match or (None, None)
    low, high = _range(velocity)
    top = max(-low, high)
    return Joint(
        position=_range(finite),
        position_quantum=find_quantum(position),
        spikes=count_spikes(position),
        velocity=(low, high),
        velocity_quantum=None if measured is None else find_quantum(measured),
        velocity_lag=lag,
        velocity_scale=scale,
        top_speed=top,
        slow=float((np.abs(velocity) <= SLOWEST * top).mean()),
        rest=float((np.abs(velocity) <= RESTING * top).mean()),
    )


def _diagnose_command(name: str, command: Signal) -> Command:
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
    median, voltages = float(np.nanmedian(supply)), supply[np.isfinite(supply)]
    outliers = int((np.abs(voltages - median) > OUTLIER * abs(median)).sum())
    return Supply(median, (float(voltages.min()), float(voltages.max())), outliers, field, stated)


def _range(values: Float[np.ndarray, "samples"]) -> tuple[float, float]:
    low, high = np.quantile(values, [TOP, 1 - TOP])
    return float(low), float(high)
