"""How parameters and joints are named in sentences, labels and tables, and how values are read from a record."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from frictionzoo.result.types import ParameterRow, ReferenceRow, ValueRow

NAMED = 4  # joints that a sentence names; the others are counted


def label_values(parameter: ParameterRow | ReferenceRow) -> dict[str, ValueRow]:
    """The entries of a parameter by their labels: `bench.armature`, of several entries `bench.armature/knee`."""
    full, rows = f"{parameter['owner']}.{parameter['name']}", parameter["by_joint"]
    return {full if len(rows) == 1 else f"{full}/{row['name']}": row for row in rows}


def name_where(parameter: ParameterRow | ReferenceRow, **what: Any) -> str:
    """The full name of a parameter and, in brackets, the joints whose entries have these values, if not all have."""
    full, rows = f"{parameter['owner']}.{parameter['name']}", parameter["by_joint"]
    names = [row["name"] for row in rows if all(row[key] == value for key, value in what.items())]
    return full if len(names) in (0, len(rows)) else f"{full} ({name_some(names)})"


def name_some(names: Sequence[str]) -> str:
    """Names in a sentence, the first of many."""
    return ", ".join(names[:NAMED]) + (f" and {len(names) - NAMED} more" if len(names) > NAMED else "")


def name_unidentifiable(parameters: Sequence[ParameterRow]) -> list[str]:
    """Names of the parameters that the data do not determine, of several joints with these."""
    return [name_where(p, identifiable=False) for p in parameters if p["identifiable"] is False]


def reached_bounds(parameter: ParameterRow | ReferenceRow) -> tuple[float, float]:
    """The bounds of a parameter, of several joints the widest of those that ended at theirs."""
    rows = [row for row in parameter["by_joint"] if row["at_bound"]] or parameter["by_joint"]
    return min(row["low"] for row in rows), max(row["high"] for row in rows)


def say_bounds(parameter: ParameterRow | ReferenceRow) -> str:
    """The same in words."""
    low, high = reached_bounds(parameter)
    return f"[{low:g}, {high:g}]"


def merge_known(rows: Sequence[ValueRow]) -> list[ValueRow]:
    """Entries of a parameter for a table: joints whose values are known and the same are one."""
    merged: dict[Any, list[ValueRow]] = {}
    for row in rows:
        merged.setdefault(row["name"] if row["identified"] else row["value"], []).append(row)
    return [
        {
            **own[0],
            "name": name_first([row["name"] for row in own]),
            "joints": [j for row in own for j in row["joints"]],
        }
        for own in merged.values()
    ]


def name_first(names: Sequence[str]) -> str:
    """Names in a table, the first of many."""
    return ", ".join(names) if len(names) < 3 else f"{names[0]} and {len(names) - 1} more"


def read_values(parameter: ParameterRow | ReferenceRow) -> Float[np.ndarray, "nv"]:
    """The values of all joints; NaN where a joint's law has no such parameter."""
    value: Any = parameter["value"]
    return np.atleast_1d(np.array(value, np.float64))


def pick_value(parameter: ParameterRow, joint: str) -> ValueRow | None:
    """The entry of a parameter that holds for a joint; None where the joint's law has no such parameter."""
    return next((row for row in parameter["by_joint"] if joint in row["joints"]), None)


def place_between_bounds(row: ValueRow, values: Float[np.ndarray, "points"]) -> Float[np.ndarray, "points"]:
    """Where values lie between the bounds of an entry, from 0 to 1; in decades where the bounds are positive."""
    low, high = row["low"], row["high"]
    if low > 0:
        low, high, values = np.log(low), np.log(high), np.log(np.maximum(values, low))
    return np.clip((values - low) / (high - low), 0.0, 1.0)
