"""Conversion of a file's columns to signals in SI units at common times."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Real

from frictionzoo.core.errors import ConfigError, LogError, closest
from frictionzoo.core.log import Columns
from frictionzoo.data.propose import BAM, propose
from frictionzoo.data.recording import HELD, SIGNALS, Recording, Table
from frictionzoo.data.units import ratio, to_si

NEEDED = ("time", "qpos", "ctrl")
LARGEST = 1e9  # largest plausible value of any signal; damaged numbers usually exceed it
LONGEST = 1e12  # s; thirty thousand years
STEPS = (5e-6, 100.0)  # s between samples; refuses 0.2 s read in days (below) and 1 ms read in us or ns (above)
Headers = dict[str, tuple[str, ...]]


def to_recording(
    table: Table,
    columns: Mapping[str, Any],
    units: Mapping[str, str],
    simulated: bool | None,
    listed: Collection[str] = (),
) -> Recording:
    """Convert a table to a recording with signals in SI units at the times of `qpos`, counted from 0.

    Signals with other times are resampled: commands and `enable` are held until the next sample, and their first value
    also holds before it; measurements are interpolated. Missing, repeated or disordered samples stay for cleaning.

    Args:
        table: Contents of a file.
        columns: Header, or list of headers, of each signal. If `time`, `qpos` or `ctrl` is missing here and in the
            table's times, all columns are inferred from unambiguous names.
        units: Unit of each signal; the default is the format's unit, otherwise SI.
        simulated: Whether a simulator made it; None: not stated.
        listed: Signals whose headers a user listed.

    Raises:
        ConfigError: A signal or unit is unknown, or headers are not a list of names.
        LogError: A column is missing, contains no numbers or differs in length from its time, a sample is absurdly
            large, a separate time column runs backwards, or the names are ambiguous.
    """
    _refuse_unread(table, columns)
    headers = _complete(table, _check(columns))
    clock = _Clock(table, headers["time"][0], units)
    signals = {
        signal: np.stack([clock.bring(signal, header) for header in headers[signal]], axis=1)
        for signal in SIGNALS
        if signal != "time" and signal in headers
    }
    for signal, values in {"time": clock.time[:, None], **signals}.items():
        largest = LONGEST if signal == "time" else LARGEST
        absurd = np.abs(values) > largest  # false for NaN, a missing sample
        if absurd.any():
            sample, column = np.argwhere(absurd)[0].tolist()
            raise LogError(
                f"{table.name}: {signal} ({headers[signal][column]}) is {values[sample, column]:.6g} in SI units at "
                f"sample {sample}, expected at most {largest:g}; take the sample out or set data.units.{signal}"
            )
    notes = tuple(dict.fromkeys((*table.notes, *clock.notes)))
    origins = {signal: Columns(headers[signal], signal in listed) for signal in signals}
    return Recording(table.name, clock.time, signals, table.fields, table.sha256, simulated, notes, origins)


def _refuse_unread(table: Table, columns: Mapping[str, Any]) -> None:
    """Raise LogError for an unusable column with a signal's name, which another column would replace."""
    for signal in SIGNALS:
        for header in (signal, BAM.get(signal, signal)):
            if header in table.refused and columns.get(signal) is None and signal not in table.columns:
                without = "" if signal in NEEDED else ", to [] to omit it"
                raise LogError(f"{table.refused[header]}; or set data.columns.{signal}{without}")


def pick(table: Table, header: str) -> Real[np.ndarray, "rows"]:
    """Return a column; LogError if it is missing or contains no numbers."""
    if header in table.refused:
        raise LogError(table.refused[header])
    if header not in table.columns:
        available = [name for name in (*table.columns, *table.refused) if name]
        raise LogError(f"{table.name}: no column {header}; {closest(header, available)}; rename it or set data.columns")
    return table.columns[header]


def _check(columns: Mapping[str, Any]) -> Headers:
    for key in set(columns) - set(SIGNALS):
        raise ConfigError(f"data.columns.{key}: unknown signal; {closest(str(key), SIGNALS)}")
    headers = {key: list_names(f"columns.{key}", given) for key, given in columns.items() if given is not None}
    if len(headers.get("time", ())) > 1:
        raise ConfigError(f"data.columns.time={list(headers['time'])}: expected one header")
    return {key: names for key, names in headers.items() if names}


def list_names(option: str, given: Any) -> tuple[str, ...]:
    """Return an option of `data`, a name or a list of names, as a tuple; ConfigError if it is neither."""
    names = given if isinstance(given, Sequence) and not isinstance(given, str) else [given]
    if not all(isinstance(name, str | int) for name in names):  # columns without a header are numbered
        raise ConfigError(f"data.{option}={given}: expected a list of names, as in [a, b]")
    return tuple(map(str, names))


def _complete(table: Table, headers: Headers) -> Headers:
    """Add missing required headers from the table's times, or from unambiguous names."""
    if "time" not in headers and headers.get("qpos", ("",))[0] in table.times:
        headers = {**headers, "time": (table.times[headers["qpos"][0]],)}
    missing = [signal for signal in NEEDED if signal not in headers]
    if not missing:
        return headers
    proposal = propose(table)
    if proposal.certain:
        return {**proposal.columns, **headers}
    suggestion = " ".join(proposal.overrides())
    available = ", ".join(list(table.columns)[:20]) or "none"
    unusable = f"; no numbers in {', '.join(list(table.refused)[:20])}" if table.refused else ""
    notes = f" ({', '.join(table.notes)})" if table.notes else ""
    example = ", as in data.columns.time=0 data.columns.qpos=[1]" if all(map(str.isdecimal, table.columns)) else ""
    raise LogError(
        f"{table.name}: data.columns.{missing[0]} is missing{example}; "
        + (f"perhaps {suggestion}; " if suggestion else "")
        + f"its columns are {available}{notes}{unusable}"
    )


class _Clock:
    """Times of `qpos`, and the resampling of other signals to these times."""

    def __init__(self, table: Table, header: str, units: Mapping[str, str]) -> None:
        self.table, self.header, self.units = table, header, units
        self.notes: list[str] = []
        ticks = pick(table, header)
        self.start = next(iter(ticks[np.isfinite(ticks)]), 0.0)
        self.time = self._seconds(header)
        _check_clock(table.name, header, ticks, self.time)

    def bring(self, signal: str, header: str) -> Float[np.ndarray, "time"]:
        """Convert a signal to SI units at the times of `qpos`."""
        values = to_si(pick(self.table, header), self._ratio(signal, header))
        clock = self.table.times.get(header, self.header)
        times = self._seconds(clock)
        name = self.table.name
        if len(values) != len(times):
            raise LogError(f"{name}: {header} has {len(values)} samples and {clock} {len(times)}, expected as many")
        if clock == self.header or np.array_equal(times, self.time):
            return values
        if not len(times):
            raise LogError(f"{name}: {header} has no samples; record it, or name another column")
        backward = np.flatnonzero(np.diff(times) < 0)
        if len(backward):
            raise LogError(
                f"{name}: {clock} runs backwards at sample {backward[0] + 1} ({times[backward[0]]:.6g} s, then "
                f"{times[backward[0] + 1]:.6g} s); expected increasing times of {header}, to interpolate it at the "
                "times of qpos; cut the recording there, or write its messages in order"
            )
        held = signal in HELD
        self.notes.append(
            f"{signal} {'held' if held else 'interpolated linearly'} from {len(times)} samples to the "
            f"{len(self.time)} times of qpos"
        )
        if held:  # last value at or before each time; before the first sample, the first value
            return values[np.maximum(np.searchsorted(times, self.time, side="right") - 1, 0)]
        return np.interp(self.time, times, values)

    def _seconds(self, header: str) -> Float[np.ndarray, "rows"]:
        """Return a time column in seconds since the first sample of `qpos`; subtract whole numbers exactly."""
        ticks = pick(self.table, header)
        with np.errstate(over="ignore"):  # `to_recording` refuses absurd times
            since = ticks - self.start
        return to_si(since, self._ratio("time", header))

    def _ratio(self, signal: str, header: str) -> tuple[float, float]:
        unit = self.units.get(signal) or self.table.units.get(header)
        return ratio(signal, str(unit)) if unit else (1.0, 1.0)


def _check_clock(name: str, header: str, ticks: Real[np.ndarray, "time"], time: Float[np.ndarray, "time"]) -> None:
    """Raise LogError for a date written as one whole number (20240131235959) or a time in another unit."""
    finite = np.isfinite(ticks)
    if finite.sum() < 2:
        return
    ticks, time = ticks[finite], time[finite]
    day, clock = np.divmod(ticks, 10**6) if (ticks > 10**13).all() else (ticks, np.zeros(1))
    digits = (
        *((day // 10**4, 1900, 2099), (day // 100 % 100, 1, 12), (day % 100, 1, 31)),
        *((clock // 10**4, 0, 23), (clock // 100 % 100, 0, 59), (clock % 100, 0, 59)),
    )
    if all(((low <= value) & (value <= high)).all() for value, low, high in digits):
        raise LogError(
            f"{name}: {header} is a date ({int(ticks[0])}), expected a time that counts; write it in seconds"
        )
    steps = np.diff(time)
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else STEPS[0]
    if not STEPS[0] <= step <= STEPS[1]:
        raise LogError(
            f"{name}: {header} advances by {step:.3g} s from sample to sample, expected {STEPS[0]:g} to "
            f"{STEPS[1]:g} s; set data.units.time, such as ns, or 86400 where it counts days"
        )
