"""Cleaning: recordings become logs, uniform in time, without gaps and, on request, without spikes.

`Log.repairs` lists each change. Clean data stays bit-identical. The command delay stays: the fit estimates it.
"""

import contextlib
import math
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float

from frictionzoo.core.described import Described
from frictionzoo.core.errors import ConfigError, LogError, closest
from frictionzoo.core.log import JITTER, Log
from frictionzoo.data.recording import COMMANDS, HELD, SIGNALS, Recording, refuse_incomplete
from frictionzoo.data.signals import (
    FOLLOWED,
    SAME_PERIOD,
    check_filter,
    count_spikes,
    estimate_velocity,
    find_breaks,
    find_outliers,
    find_velocity_lag,
    find_wrap,
    repair_spikes,
    sample_signal,
    unwrap,
)
from frictionzoo.data.velocity import compare_velocities, find_dead_velocities, of_joints

CHOICES: dict[str, tuple[str, ...]] = {
    "resample": ("linear", "cubic"),
    "spikes": ("repair", "drop", "keep"),
    "velocity": ("measured", "estimated", "auto"),
}
RESAMPLED = {**dict.fromkeys(COMMANDS, "mean"), "enable": "held"}  # resampling of these signals
EXTRAS = tuple(signal for signal in SIGNALS if signal not in ("time", "qpos", "qvel", "ctrl"))
CUTOFF, HIGHEST = 20.0, 0.4  # default cut-off [Hz] of the velocity estimate, and its largest share of the sample rate
MOST_FINER = 1000.0  # largest upsampling factor; more would only add samples
FEWEST = 50  # fewest intervals that show whether times are rounded
SEVERAL = 5  # fewest occurrences of each rounded interval; a gap may occur once
ROUNDED = 0.55  # largest error of a rounded time, as a share of the rounding step
TIMES_ROUNDED = "times are rounded to"
"""Beginning of the repair sentence for rounded times."""
AUTO = "auto"
"""Value of an option whose number is found in the recording."""
NUMBER = re.compile(r"-?\d+(\.\d+)?(e-?\d+)?")


@dataclass(frozen=True)
class Cleaning(Described):
    """Options of the cleaning.

    Attributes:
        step: Sample interval of the logs [s]; None for the recording's interval (the median, if it varies by more than
            `JITTER`). All recordings of a fit need the same interval.
        resample: Interpolation of positions, velocities and extra signals: `linear`, or `cubic` splines. The enable
            signal is held. A command becomes the mean of the held command over each new interval, which neither delays
            nor advances it.
        gap: Longest interval, in medians, that does not split a recording. Longer runs of NaN split it too; shorter
            ones are interpolated.
        wrap: Period of wrapped positions, which are unwrapped [rad or m]; `auto` finds it, joint by joint; None for no
            change. Desired positions that jump by the same period are unwrapped along with the position.
        spikes: Treatment of isolated spikes of one or two samples. `repair` interpolates them in continuous signals and
            replaces outliers of commands by the previous value; `drop` leaves out recordings with a spike in the
            position; `keep` keeps them.
        velocity: `measured`; `estimated` from the position without phase lag; or `auto`: measured and compared with the
            position, but estimated for joints whose velocity is missing, constant, without motion, or so late or noisy
            that the estimate is more accurate.
        cutoff: Cut-off frequency of the velocity estimate [Hz]; None for 20 Hz, but at most 0.4 of the sample rate.
        order: Order of its filter, which runs forwards and backwards.
        velocity_lag: Lag of the measured velocity behind the position, to be removed [s]; `auto` measures it; None
            removes nothing.
        command_lag: Lag of the commands due to the recorder, to be removed [s]; None removes nothing. It is not the
            bench's `delay`, which delays a command's effect.
        shortest: Shortest piece to keep [s].

    Raises:
        ConfigError: A value is impossible.
    """

    step: float | None = None
    resample: str = "linear"
    gap: float = 5.0
    wrap: float | str | None = None
    spikes: str = "keep"
    velocity: str = "auto"
    cutoff: float | None = None
    order: int = 2
    velocity_lag: float | str | None = None
    command_lag: float | None = None
    shortest: float = 0.1

    def __post_init__(self) -> None:
        for option, choices in CHOICES.items():
            if getattr(self, option) not in choices:
                value = getattr(self, option)
                raise ConfigError(f"data.clean.{option}={value}: unknown; {closest(str(value), choices)}")
        check_filter("data.clean", CUTOFF if self.cutoff is None else self.cutoff, self.order)
        wrap = math.tau if self.wrap in (None, AUTO) else self.wrap
        for option, is_valid, expected in (
            ("step", self.step is None or self.step > 0, "a positive time in s, or null"),
            ("gap", self.gap >= 1.5, "at least 1.5 median intervals"),
            ("wrap", not isinstance(wrap, str) and wrap > 0, "a positive angle in rad, auto or null"),
            ("shortest", self.shortest >= 0, "a time in s from 0 on"),
            ("velocity_lag", self.velocity_lag == AUTO or _is_time(self.velocity_lag), "a time in s, auto or null"),
            ("command_lag", _is_time(self.command_lag), "a time in s, or null"),
        ):
            if not is_valid:
                raise ConfigError(f"data.clean.{option}={getattr(self, option)}: expected {expected}")


def _is_time(lag: Any) -> bool:
    return lag is None or (not isinstance(lag, str) and math.isfinite(lag))


def clean(recording: Recording, cleaning: Cleaning) -> list[Log]:
    """Clean a recording to logs, one for each stretch without a gap, in order; empty if nothing remains.

    Raises:
        LogError: A signal is missing, a repair is impossible, or the units of velocity and position differ.
        ConfigError: The cut-off is not below half the sample rate.
    """
    refuse_incomplete(recording)
    even = _even_out(recording)
    repeated = np.diff(even.time, prepend=-np.inf) == 0
    if repeated.any():
        even = even.keep(~repeated).say(f"samples with a repeated time dropped: {repeated.sum()}")
    whole = _drop_velocity(_unwrap(even, cleaning.wrap), cleaning)
    if cleaning.spikes == "drop" and any(map(count_spikes, whole.signals["qpos"].T)):
        return []
    gap = cleaning.gap
    sentence = f"split where time jumps by over {gap:g} intervals or goes back"
    parts = _split_at(whole, find_breaks(whole.time, gap), sentence)
    pieces = [piece for part in parts for piece in _split_at_nan(part, gap)]
    kept = [piece for piece in pieces if len(piece.time) > 1 and piece.time[-1] - piece.time[0] >= cleaning.shortest]
    if short := len(pieces) - len(kept):
        kept = [piece.say(f"pieces shorter than {cleaning.shortest:g} s left out: {short}") for piece in kept]
    if len(pieces) > 1:
        kept = [replace(piece, name=f"{recording.name}[{number}]") for number, piece in enumerate(kept, 1)]
    return [_finish(piece, cleaning) for piece in kept]


def summarise_repairs(logs: Sequence[Log]) -> list[str]:
    """Return a line for each kind of repair, the most frequent first; several joints of a log may have the same."""
    kinds = Counter(kind for log in logs for kind in dict.fromkeys(NUMBER.sub("#", text) for text in log.repairs))
    examples = {NUMBER.sub("#", sentence): sentence for log in reversed(logs) for sentence in reversed(log.repairs)}
    return [f"{count} of {len(logs)} logs: {examples[kind]}" for kind, count in kinds.most_common()]


def _finish(piece: Recording, cleaning: Cleaning) -> Log:
    piece = _fill_nan(piece)
    piece = _repair_spikes(piece) if cleaning.spikes == "repair" else piece
    lag = cleaning.velocity_lag
    if lag is not None and cleaning.velocity != "estimated" and "qvel" in piece.signals:
        lag = _find_lag(piece) if isinstance(lag, str) else float(lag)
        piece = _shift(piece, "velocity_lag", ["qvel"], lag, cleaning.resample)
    if cleaning.command_lag is not None:
        commands = [signal for signal in COMMANDS if signal in piece.signals]
        piece = _shift(piece, "command_lag", commands, float(cleaning.command_lag), "held")
    piece = _choose_velocity(_resample(piece, cleaning), cleaning)
    if piece.time[0] != 0:
        start = piece.time[0]
        piece = replace(piece, time=piece.time - start).say(f"time counted from its first sample, at {start:.6g} s")
    qpos, qvel, ctrl = (piece.signals[name] for name in ("qpos", "qvel", "ctrl"))
    return Log(
        *(piece.name, piece.time, qpos, qvel, ctrl, piece.sha256, piece.simulated),
        extras={extra: piece.signals[extra] for extra in EXTRAS if extra in piece.signals},
        velocity_estimated=len(piece.without_velocity) == piece.signals["qpos"].shape[1],
        without_velocity=piece.without_velocity,
        repairs=piece.notes,
        metadata=piece.fields,
        columns=piece.columns,
        units=piece.units,
    )


def _even_out(piece: Recording) -> Recording:
    """Undo rounding of even times: two interval lengths, each time at most `ROUNDED` rounding steps off."""
    steps = np.diff(piece.time)
    interval = float(piece.time[-1] - piece.time[0]) / max(len(steps), 1)
    if len(steps) < FEWEST or not interval > 0:
        return piece
    intervals, counts = np.unique(np.round(steps / interval, 4), return_counts=True)
    if len(intervals) != 2 or counts.min() < SEVERAL or not intervals[1] - intervals[0] > JITTER:
        return piece
    step, samples = interval * float(intervals[1] - intervals[0]), np.arange(len(piece.time))
    slope, start = np.polyfit(samples, piece.time, 1)
    if np.abs(piece.time - start - slope * samples).max() > ROUNDED * step:
        return piece
    sentence = f"{TIMES_ROUNDED} {step:.4g} s: replaced by uniform times, {slope:.6g} s apart"
    return replace(piece, time=start + slope * samples).say(sentence)


def _unwrap(piece: Recording, wrap: float | str | None) -> Recording:
    """Unwrap positions, and desired positions that jump by the same period."""
    qpos, ctrl = piece.signals["qpos"].copy(), piece.signals["ctrl"].copy()
    turns, periods = 0, set[float]()
    for joint, wrapped in enumerate(piece.signals["qpos"].T):
        period = find_wrap(wrapped) if isinstance(wrap, str) else wrap
        if period is None:
            continue
        qpos[:, joint] = unwrap(wrapped, period)
        turns += int(np.count_nonzero(np.diff(np.round((qpos[:, joint] - wrapped) / period))))
        periods.add(period)
        jumps = find_wrap(ctrl[:, joint]) if ctrl.shape == qpos.shape else None
        if jumps is not None and abs(jumps / period - 1) < SAME_PERIOD:
            command = unwrap(ctrl[:, joint], period)
            apart = np.nanmedian(qpos[:, joint] - command)
            ctrl[:, joint] = command + period * np.round(apart / period)
    if not turns and (wrap is None or isinstance(wrap, str)):
        return piece
    found = f", period {' and '.join(f'{period:.6g}' for period in sorted(periods))}" if isinstance(wrap, str) else ""
    signals = {**piece.signals, "qpos": qpos, "ctrl": ctrl}
    return replace(piece, signals=signals).say(f"turns of the position unwrapped: {turns}{found}")


def _drop_velocity(piece: Recording, cleaning: Cleaning) -> Recording:
    """Drop velocities to estimate: 0 for some joints, no qvel for all; LogError with `velocity=measured`."""
    qpos, qvel = piece.signals["qpos"], piece.signals.get("qvel")
    if qvel is None or cleaning.velocity == "estimated":
        signals = {signal: values for signal, values in piece.signals.items() if signal != "qvel"}
        return replace(piece, signals=signals, without_velocity=tuple(range(qpos.shape[1])))
    dead = find_dead_velocities(piece.time, qpos, qvel, cleaning.gap)
    if dead and cleaning.velocity == "measured":
        fault = next(iter(dead.values()))
        raise LogError(
            f"{piece.name}: {fault}, expected a measured velocity; name its column in data.columns.qvel, or set "
            "data.clean.velocity=auto to estimate it"
        )
    qvel = np.where(np.isin(np.arange(qvel.shape[1]), list(dead)), 0.0, qvel)
    signals = {**piece.signals, "qvel": qvel}
    if len(dead) == qvel.shape[1]:
        del signals["qvel"]
    dropped = replace(piece, signals=signals, without_velocity=tuple(dead))
    return dropped.say("; ".join(dead.values())) if dead else piece


def _split_at(piece: Recording, breaks: Sequence[int] | np.ndarray, sentence: str) -> list[Recording]:
    if not len(breaks):
        return [piece]
    edges = [0, *breaks, len(piece.time)]
    return [piece.keep(slice(first, last)).say(sentence) for first, last in pairwise(edges)]


def _split_at_nan(piece: Recording, gap: float) -> list[Recording]:
    """Cut out runs of NaN that are longer than a gap or touch an end; these cannot be interpolated."""
    missing = ~np.all([np.isfinite(values).all(axis=1) for values in piece.signals.values()], axis=0)
    for first, last in np.flatnonzero(np.diff(missing, prepend=False, append=False)).reshape(-1, 2):
        touches_end = first == 0 or last == len(missing)
        # n missing samples make an interval of n + 1 steps.
        missing[first:last] = touches_end or last - first + 1 > gap
    if not missing.any():
        return [piece]
    breaks = np.flatnonzero(np.diff(missing)) + 1
    parts = _split_at(piece, breaks, f"cut where a signal is NaN for over {gap:g} intervals or at an end")
    return [part for part, start in zip(parts, (0, *breaks), strict=True) if not missing[start]]


def _fill_nan(piece: Recording) -> Recording:
    filled, sentences = dict(piece.signals), []
    for name, values in piece.signals.items():
        bad = ~np.isfinite(values)
        if bad.any():
            method = "held" if name in HELD else "linear"
            pairs = zip(~bad.T, values.T, strict=True)
            columns = [sample_signal(column[valid], piece.time[valid], piece.time, method) for valid, column in pairs]
            filled[name] = np.where(bad, np.stack(columns, axis=1), values)
            sentences.append(f"NaN samples of {name} interpolated: {bad.any(axis=1).sum()}")
    return replace(piece, signals=filled).say(*sentences) if sentences else piece


def _repair_spikes(piece: Recording) -> Recording:
    repaired, sentences = dict(piece.signals), []
    for name, values in piece.signals.items():
        if name in COMMANDS:
            outliers = _each(find_outliers, values)
            previous = np.maximum.accumulate(np.where(outliers, 0, np.arange(len(values))[:, None]), axis=0)
            if outliers.any():
                repaired[name] = np.take_along_axis(values, previous, axis=0)
                sentences.append(f"outliers of {name} replaced by the previous value: {outliers.any(axis=1).sum()}")
        count = 0 if name in HELD else sum(map(count_spikes, values.T))
        if count:
            repaired[name] = _each(repair_spikes, values)
            sentences.append(f"spikes of {name} interpolated: {count}")
    return replace(piece, signals=repaired).say(*sentences) if sentences else piece


def _shift(piece: Recording, option: str, signals: Sequence[str], lag: float, method: str) -> Recording:
    """Shift signals earlier by the lag [s] from an option, and cut the end that has no samples."""
    later = piece.time + lag
    kept = (later >= piece.time[0]) & (later <= piece.time[-1])
    if kept.sum() < 2:
        raise LogError(f"{piece.name}: shorter than data.clean.{option}={lag:g} s; set a smaller one")
    cut, at = piece.keep(kept), later[kept]
    shifted = {signal: _each(sample_signal, piece.signals[signal], piece.time, at, method) for signal in signals}
    between = "" if method == "held" else f", {method} between samples"
    sentence = f"{', '.join(signals)} shifted {lag:.4g} s earlier{between}"
    return replace(cut, signals={**cut.signals, **shifted}).say(sentence)


def _find_lag(piece: Recording) -> float:
    qpos, qvel = piece.signals["qpos"], piece.signals["qvel"]
    estimates = [find_velocity_lag(piece.time, repair_spikes(q), v) for q, v in zip(qpos.T, qvel.T, strict=True)]
    lags = [lag[0] for lag in estimates if lag is not None]
    if not lags:
        raise LogError(
            f"{piece.name}: qvel does not match a delayed derivative of the position, expected for "
            "data.clean.velocity_lag=auto; give the lag in s or set data.clean.velocity=estimated"
        )
    return float(np.median(lags))


def _resample(piece: Recording, cleaning: Cleaning) -> Recording:
    """Resample to a uniform grid of `step`, or of the median interval if the clock varies too much."""
    steps = np.diff(piece.time)
    interval = float(np.median(steps))
    uniform = bool((np.abs(steps / interval - 1) <= JITTER).all())
    mean = float(piece.time[-1] - piece.time[0]) / len(steps)
    if uniform and (cleaning.step is None or abs(cleaning.step / mean - 1) <= FOLLOWED):
        return piece
    step = interval if cleaning.step is None else cleaning.step
    if step < interval / MOST_FINER:
        raise ConfigError(
            f"data.clean.step={step:g}: expected at least {interval / MOST_FINER:g} s, because {piece.name} has a "
            f"sample every {interval:g} s"
        )
    samples = int((piece.time[-1] - piece.time[0]) / step + FOLLOWED) + 1
    if samples < 2:
        raise LogError(f"{piece.name}: shorter than data.clean.step={step:g} s; set a smaller one, or omit it")
    grid = piece.time[0] + step * np.arange(samples)
    signals = {
        name: _each(sample_signal, values, piece.time, grid, RESAMPLED.get(name, cleaning.resample))
        for name, values in piece.signals.items()
    }
    missing = int((np.round(steps[steps > 1.5 * interval] / interval) - 1).sum())
    rates = f"from about {1 / interval:.4g} to {1 / step:.4g} samples/s"
    commands = ", ".join(name for name in COMMANDS if name in signals)
    sentence = f"resampled {rates}, {cleaning.resample}; {commands}: mean of the held command"
    if missing:
        sentence += f"; missing samples interpolated: {missing}"
    return replace(piece, time=grid, signals=signals).say(sentence)


def _each(change: Callable[..., np.ndarray], values: Float[np.ndarray, "time columns"], *more: Any) -> np.ndarray:
    return np.stack([change(column, *more) for column in values.T], axis=1)


def _choose_velocity(piece: Recording, cleaning: Cleaning) -> Recording:
    """Estimate velocities that are missing or inaccurate; compare the others with the position."""
    if cleaning.velocity == "measured" and "qvel" not in piece.signals:
        raise LogError(
            f"{piece.name}: no qvel; name its column in data.columns.qvel or set data.clean.velocity=estimated"
        )
    timestep = float(piece.time[-1] - piece.time[0]) / (len(piece.time) - 1)
    cutoff = min(CUTOFF, HIGHEST / timestep) if cleaning.cutoff is None else cleaning.cutoff
    order, qpos = cleaning.order, piece.signals["qpos"]

    def estimate() -> np.ndarray:
        return _each(estimate_velocity, qpos, timestep, cutoff, order, piece.name, "data.clean.cutoff")

    estimates = None
    if "qvel" in piece.signals and cleaning.velocity == "auto":
        with contextlib.suppress(LogError, ConfigError):  # a recording without an estimate keeps the measured velocity
            estimates = estimate()
        joints = sorted({*range(qpos.shape[1])} - {*piece.without_velocity})
        sentences, worse = compare_velocities(piece.name, piece.time, qpos, piece.signals["qvel"], joints, estimates)
        piece = replace(piece, without_velocity=tuple(sorted({*piece.without_velocity, *worse}))).say(*sentences)
    if not piece.without_velocity:
        return piece
    to_estimate = list(piece.without_velocity)
    qvel = piece.signals.get("qvel", np.empty_like(qpos)).copy()
    qvel[:, to_estimate] = (estimate() if estimates is None else estimates)[:, to_estimate]
    method = f"zero-phase Butterworth low-pass of order {order} at {cutoff:g} Hz, central differences"
    return replace(piece, signals={**piece.signals, "qvel": qvel}).say(
        f"qvel{of_joints(to_estimate, qpos)} estimated from qpos: {method}"
    )
