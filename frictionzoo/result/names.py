"""Names of parameters and joints for sentences, labels and tables, and access to values of a record."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from msgspec.structs import replace

from frictionzoo.result.types import ParameterRecord, ReferenceParameter, Value

NAMED = 4  # most names in a sentence; the rest is counted


def label_values(parameter: ReferenceParameter) -> dict[str, Value]:
    """Return the entries of a parameter by label: `bench.armature`, or `bench.armature/knee` with several entries."""
    full, rows = f"{parameter.owner}.{parameter.name}", parameter.by_joint
    return {full if len(rows) == 1 else f"{full}/{row.name}": row for row in rows}


def list_widths(parameters: Iterable[ReferenceParameter]) -> dict[str, float]:
    """Return half of each confidence interval as a share of its value, by label; without those of a value 0."""
    rows = (entry for parameter in parameters for entry in label_values(parameter).items())
    return {
        label: (row.interval[1] - row.interval[0]) / abs(2 * row.value)
        for label, row in rows
        if row.interval is not None and row.value
    }


def name_where(parameter: ReferenceParameter, **what: Any) -> str:
    """Return a parameter's full name, with the joints whose entries have these values unless all or none have."""
    full, rows = f"{parameter.owner}.{parameter.name}", parameter.by_joint
    names = [row.name for row in rows if all(row[key] == value for key, value in what.items())]
    return full if len(names) in (0, len(rows)) else f"{full} ({name_some(names)})"


def name_some(names: Sequence[str]) -> str:
    """Join names for a sentence; only the first `NAMED` are spelled out."""
    return ", ".join(names[:NAMED]) + (f" and {len(names) - NAMED} more" if len(names) > NAMED else "")


def name_unidentifiable(parameters: Sequence[ParameterRecord]) -> list[str]:
    """Return the parameters that are not identifiable, with their joints unless all are affected."""
    return [name_where(p, identifiable=False) for p in parameters if p.identifiable is False]


def say_bounds(parameter: ReferenceParameter) -> str:
    """Format the widest bounds over the joints that ended at a bound, or over all joints if none did."""
    rows = [row for row in parameter.by_joint if row.at_bound] or parameter.by_joint
    return f"[{min(row.low for row in rows):g}, {max(row.high for row in rows):g}]"


def merge_known(rows: Sequence[Value]) -> list[Value]:
    """Merge the entries of joints with the same known value, for a table."""
    merged: dict[Any, list[Value]] = {}
    for row in rows:
        merged.setdefault(row.name if row.identified else row.value, []).append(row)
    names = [name_first([row.name for row in entries]) for entries in merged.values()]
    joints = [[joint for row in entries for joint in row.joints] for entries in merged.values()]
    pairs = zip(merged.values(), names, joints, strict=True)
    return [replace(entries[0], name=name, joints=members) for entries, name, members in pairs]


def name_first(names: Sequence[str]) -> str:
    """Join names for a table; of three or more only the first is spelled out."""
    return ", ".join(names) if len(names) < 3 else f"{names[0]} and {len(names) - 1} more"


def read_values(parameter: ReferenceParameter) -> Float[np.ndarray, "nv"]:
    """Return the values of all joints; NaN: the joint's model has no such parameter."""
    value: Any = parameter.value
    return np.atleast_1d(np.array(value, np.float64))


def pick_value(parameter: ParameterRecord, joint: str) -> Value | None:
    """Return the entry of a parameter for a joint; None: the joint's model has no such parameter."""
    return next((row for row in parameter.by_joint if joint in row.joints), None)


def place_between_bounds(row: Value, values: Float[np.ndarray, "points"]) -> Float[np.ndarray, "points"]:
    """Return the relative position of values between an entry's bounds, 0 to 1; logarithmic for positive bounds."""
    low, high = row.low, row.high
    if low > 0:
        low, high, values = np.log(low), np.log(high), np.log(np.maximum(values, low))
    return np.clip((values - low) / (high - low), 0.0, 1.0)
