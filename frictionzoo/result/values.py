"""Parameter entries: one per joint, or per group of joints that share a value."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from frictionzoo.bench.base import Bench
from frictionzoo.core.params import Param
from frictionzoo.fit.uncertainty import Uncertainty
from frictionzoo.result.names import name_first
from frictionzoo.result.types import Result, ValueRow

ALL = "all joints"


class Parameter(NamedTuple):
    """One physical parameter of a run's result.

    Attributes:
        value: Value of each joint, in `unit`; NaN: its model has no such parameter.
        unit: Unit of the value.
        identified: Whether the fit estimated it; otherwise it was known.
        interval: Lower and upper end of each joint's 95 % interval; NaN: no interval.
        identifiable: Whether the data determine it in all joints; None: not tested.
        by_joint: Entries of `result.json`, one per joint or per group of joints that share a value, with `name`,
            `joints`, `identified`, `at_bound` and `identifiable`.
    """

    value: Float[np.ndarray, "nv"]
    unit: str
    identified: bool
    interval: Float[np.ndarray, "nv 2"]
    identifiable: bool | None
    by_joint: Sequence[ValueRow]


def read_parameters(result: Result, nv: int) -> dict[str, Parameter]:
    """Read the physical parameters of bench and friction model from a record, by full name (`bench.armature`)."""
    found = {}
    for row in result["parameters"]:
        value, interval = row["value"], row["interval"]
        ends: Any = interval if interval is not None and isinstance(value, list) else [interval]
        ends = np.array([(np.nan, np.nan) if pair is None else pair for pair in ends], np.float64)
        arrays = np.broadcast_to(np.asarray(value, np.float64), nv), np.broadcast_to(ends, (nv, 2))
        known = row["identified"], arrays[1], row["identifiable"], row["by_joint"]
        found[f"{row['owner']}.{row['name']}"] = Parameter(arrays[0], row["unit"], *known)
    return found


def list_values(bench: Bench, param: Param, full: str, value: np.ndarray, uncertainty: Uncertainty) -> list[ValueRow]:
    """List the entries of a parameter in the order of the joints.

    Args:
        bench: Bench with the joints and the groups that share the value.
        param: The parameter.
        full: Full name, such as `bench.armature`.
        value: Value of each joint that has the parameter.
        uncertainty: Intervals and identifiability.
    """
    nv = bench.nv
    value = param.spread(np.asarray(value, np.float64), nv)
    free, low, high = (param.each(what, nv) for what in ("identify", "low", "high"))
    reached = free & param.is_at_bound(value)
    ends = uncertainty.intervals.get(full, np.full((nv, 2), np.nan))
    determined = uncertainty.determined.get(full)

    def describe(name: str, joints: Sequence[int]) -> ValueRow:
        first = joints[0]
        return {
            "name": name,
            "joints": [bench.joints[joint] for joint in joints],
            "value": float(value[first]),
            "low": float(low[first]),
            "high": float(high[first]),
            "identified": bool(free[first]),
            "at_bound": bool(reached[first]),
            "interval": ends[first].tolist() if np.isfinite(ends[first]).all() else None,
            "identifiable": bool(determined[first]) if determined is not None and free[first] else None,
        }

    return [describe(*group) for group in _group(bench, param, value).items()]


def _group(bench: Bench, param: Param, value: np.ndarray) -> dict[str, list[int]]:
    """Return the joints of each group by its name, ordered by the first joint."""
    groups, members = bench.groups(param), param.members(bench.nv)
    if not param.is_identified:
        # Known values of a group may differ.
        alike = {group: {value[i] for i in members if groups[i] == group} for group in groups}
        groups = [of if len(alike[of]) == 1 else bench.joints[i] for i, of in enumerate(groups)]
        same = bench.nv > 1 and (value[members] == value[members[0]]).all()
        groups = [ALL] * bench.nv if same else groups
    found: dict[str, list[int]] = {}
    for joint in members:
        found.setdefault(groups[joint], []).append(joint)
    if ALL in found and len(members) < bench.nv:
        found = {name_first([bench.joints[joint] for joint in members]): members}
    return found
