"""Tables of text in aligned columns."""

from collections.abc import Mapping, Sequence
from typing import Any

Rows = Sequence[Sequence[str]]
COLUMNS = {"qpos": "position", "qvel": "velocity", "ctrl": "command", "torque": "torque"}


def align(rows: Rows) -> str:
    """Align a table: columns padded to their longest entry, numbers right-aligned, text left-aligned."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    flush = [str.rjust if all(map(_is_number, column[1:])) else str.ljust for column in zip(*rows, strict=True)]
    lines = ("  ".join(pad(cell, width) for pad, cell, width in zip(flush, row, widths, strict=True)) for row in rows)
    return "\n".join(line.rstrip() for line in lines)


def list_columns(columns: Mapping[str, Any]) -> Rows:
    """Return a table of the column assigned to each joint, from `columns` of `result.json` or `inspect.json`."""
    signals = sorted(columns["by"], key=[*COLUMNS, *columns["by"]].index)
    rows = [("joint <-", *(str(COLUMNS.get(signal, signal)) for signal in signals))]
    return [*rows, *((row["joint"], *(row["columns"][signal] for signal in signals)) for row in columns["joints"])]


def _is_number(cell: str) -> bool:
    return not cell or cell == "none" or cell[0] in "+-.0123456789"
