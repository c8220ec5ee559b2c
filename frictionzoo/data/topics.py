"""Topics with times of their own: in one table over the union of all times, or in several files of one recording."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Real

from frictionzoo.core.errors import LogError
from frictionzoo.data.propose import propose
from frictionzoo.data.recording import Table

SPARSE = 1 / 3  # least share of a topic's samples after which rows of other topics follow
OVERLAP = 0.02  # least share of the longest file's time that all files of a recording cover


def is_sparse(values: Real[np.ndarray, "rows"]) -> bool:
    """Return whether empty cells separate the samples of a column, as where other topics have rows of their own."""
    steps = np.diff(np.flatnonzero(np.isfinite(values)))
    return len(steps) > 0 and float((steps > 1).mean()) >= SPARSE


def separate(table: Table, columns: Mapping[str, Sequence[str]]) -> Table:
    """Give topics times of their own where a table's rows are the union of the times of several topics.

    A topic consists of the columns with the same empty cells. The time column becomes that of qpos, other topics get
    `HEADER/time`. `columns` has the headers of each signal; a table with no sparse column among them stays unchanged.
    """
    used = [header for headers in columns.values() for header in headers if header in table.columns]
    time, position = (next(iter(columns.get(signal, ())), "") for signal in ("time", "qpos"))
    clock = table.columns.get(time)
    if table.times or clock is None or position not in used or not any(is_sparse(table.columns[h]) for h in used):
        return table
    of_position = np.isfinite(table.columns[position])
    separated, times, names = dict(table.columns), dict[str, str](), {of_position.tobytes(): time}
    for header, values in table.columns.items():
        if header == time or len(values) != len(clock):
            continue
        present = np.isfinite(values)
        present = present if present.any() else of_position
        times[header] = names.setdefault(present.tobytes(), f"{header}/time")
        separated |= {header: values[present], times[header]: clock[present]}
    units = {name: table.units[time] for name in names.values() if time in table.units}
    return replace(table, columns=separated, times=times, units={**table.units, **units})


def join(tables: Mapping[str, Table], times: Sequence[str]) -> Table:
    """Join the files of one recording, each with its own times; columns become `KEY/HEADER`.

    `times` names the time columns, as `HEADER` or `KEY/HEADER`; otherwise they are found by name.

    Raises:
        LogError: A file has no time column, or the files do not cover the same time.
    """
    name = " + ".join(table.name for table in tables.values())
    columns, clocks = {}, dict[str, str]()
    for key, table in tables.items():
        columns |= {f"{key}/{header}": values for header, values in table.columns.items()}
        time = "" if table.times else _find_time(key, table, times)
        for header in table.columns:
            if header not in (time, *table.times.values()):
                clocks[f"{key}/{header}"] = f"{key}/{table.times.get(header, time)}"
    _refuse_apart(name, {clock: columns[clock] for clock in clocks.values()})
    return Table(
        name,
        columns,
        {field: value for table in tables.values() for field, value in table.fields.items()},
        hashlib.sha256(b"".join(bytes.fromhex(table.sha256) for table in tables.values())).hexdigest(),
        {f"{key}/{header}": error for key, table in tables.items() for header, error in table.refused.items()},
        clocks,
        {f"{key}/{header}": unit for key, table in tables.items() for header, unit in table.units.items()},
        notes=tuple(f"{key}: {note}" for key, table in tables.items() for note in table.notes),
        is_joined=True,
    )


def _find_time(key: str, table: Table, times: Sequence[str]) -> str:
    named = [time.removeprefix(f"{key}/") for time in times]
    time = next((header for header in (*named, *propose(table).columns.get("time", ())) if header in table.columns), "")
    if not time:
        available = ", ".join(list(table.columns)[:20]) or "none"
        expected = f"expected one; name it, as in data.columns.time={key}/HEADER"
        raise LogError(f"{table.name}: no time column among {available}, {expected}")
    return time


def _refuse_apart(name: str, clocks: Mapping[str, Real[np.ndarray, "_"]]) -> None:
    spans = {clock: (float(np.nanmin(times)), float(np.nanmax(times))) for clock, times in clocks.items() if len(times)}
    shared = min(last for _, last in spans.values()) - max(first for first, _ in spans.values())
    if shared < OVERLAP * max(last - first for first, last in spans.values()):
        listed = ", ".join(f"{clock} from {first:.9g} to {last:.9g}" for clock, (first, last) in spans.items())
        raise LogError(f"{name}: {listed}; expected times of one clock in one unit; convert them")
