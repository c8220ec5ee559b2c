"""Summary of a data set in plain text."""

import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

from frictionzoo.core.telling import align, escape_all, list_columns

WIDTH = 110  # characters per line, at most, and without a terminal
MARKS = {"good": "ok", "note": "note", "caution": "caution", "bad": "problem"}

Row = tuple[str, str, str, str, str]


def summarise(survey: Mapping[str, Any], folder: Path) -> str:
    """Summarise a data set: quantities over the recordings, findings, and the folder of `inspect.json` and its page."""
    survey = escape_all(survey)
    data, count = survey["data"], survey["data"]["recordings"]
    length = f"{data['samples']} samples, {data['duration']:.4g} s"
    options = [finding["option"] for finding in survey["findings"] if finding["option"]]
    tables = [align(list_columns(columns)) for columns in survey["columns"]]
    blocks = [
        f"{data['name']}: {count} recording{'s' * (count != 1)}, {length}",
        *(tables if len(survey["joints"]) > 1 else []),
        align([("over all recordings", "lowest", "median", "highest", "unit"), *list_quantities(survey)]),
        "\n".join(_tell(survey["findings"])),
        *([f"suggested options: {' '.join(dict.fromkeys(options))}"] if options else []),
        f"files: {folder}",
    ]
    return "\n\n".join(blocks)


def list_quantities(survey: Mapping[str, Any]) -> Iterator[Row]:
    """Yield rows of the table of quantities: name, lowest, median and highest over the recordings, unit."""
    timing, units = survey["timing"], survey["units"]
    small_unit = " or ".join(f"m{unit}" for unit in units["position"].split(" or "))
    yield from _row("sample interval", timing["interval"], "ms", 1e3)
    yield from _row("intervals off by more than 5 %", timing["jitter"], "%", 100.0)
    for joint in survey["joints"]:
        suffix = f" {joint['name']}" if len(survey["joints"]) > 1 else ""
        yield _bounds(f"position{suffix}", joint["position"], units["position"])
        yield _bounds(f"velocity{suffix}", joint["velocity"], units["velocity"])
        yield from _row(f"position quantum{suffix}", joint["position_quantum"], small_unit, 1e3)
        yield from _row(f"velocity lag{suffix}", joint["velocity_lag"], "ms", 1e3)
        yield from _row(f"at rest{suffix}", joint["rest"], "%", 100.0)
        if delay := joint["delay"]:
            values = {"low": delay["low"], "median": delay["seconds"], "high": delay["high"]}
            yield from _row(f"command delay{suffix}, quartiles", values, "ms", 1e3)
    for command in survey["commands"]:
        suffix = f" {command['name']}" if len(survey["commands"]) > 1 else ""
        yield _bounds(f"command{suffix}", command["range"], "")
        yield from _row(f"command at a limit{suffix}", command["saturated"], "%", 100.0)
    if survey["supply"]:
        yield from _row("supply, measured", survey["supply"]["measured"], "V", 1.0)


def _row(name: str, spread: Mapping[str, float] | None, unit: str, factor: float) -> Iterator[Row]:
    if spread is not None:
        low, median, high = (f"{factor * spread[key]:.4g}" for key in ("low", "median", "high"))
        yield name, low, median, high, unit


def _bounds(name: str, bounds: Sequence[float], unit: str) -> Row:
    return name, f"{bounds[0]:.4g}", "", f"{bounds[1]:.4g}", unit


def _tell(findings: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    order, width = list(MARKS)[::-1], min(WIDTH, shutil.get_terminal_size((WIDTH, 24)).columns)
    for finding in sorted(findings, key=lambda finding: order.index(finding["state"])):
        text = f"{finding['title']}: {finding['text']}"
        yield fill(text, width, initial_indent=f"{MARKS[finding['state']]:<9}", subsequent_indent=" " * 9)
