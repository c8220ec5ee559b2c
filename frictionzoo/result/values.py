"""Parameter entries: one per joint, or per group of joints that share a value."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from frictionzoo.bench.base import Bench
from frictionzoo.core.params import Param
from frictionzoo.fit.uncertainty import Uncertainty
from frictionzoo.result.names import name_first
from frictionzoo.result.types import Result, Value

ALL = "all joints"


class ParameterArrays(NamedTuple):
    """One physical parameter of a run's result, by joint.

    Attributes:
        value: Values in `unit`; NaN: the joint's model has no such parameter.
        identified: Whether the fit estimated it; otherwise it was known.
        interval: Lower and upper ends of the 95 % intervals; NaN: no interval.
        identifiable: Whether the data determine it in all joints; None: not tested.
        by_joint: Entries of `result.json`, one per joint or per group of joints that share a value.
    """

    value: Float[np.ndarray, "nv"]
    unit: str
    identified: bool
    interval: Float[np.ndarray, "nv 2"]
    identifiable: bool | None
    by_joint: Sequence[Value]


def read_parameters(result: Result, nv: int) -> dict[str, ParameterArrays]:
    """Read the physical parameters of bench and friction model from a record, by full name (`bench.armature`)."""
    parameters = {}
    for row in result.parameters:
        value, interval = row.value, row.interval
        ends: Any = interval if interval is not None and isinstance(value, list) else [interval]
        ends = np.array([(np.nan, np.nan) if pair is None else pair for pair in ends], np.float64)
        arrays = np.broadcast_to(np.asarray(value, np.float64), nv), np.broadcast_to(ends, (nv, 2))
        details = row.identified, arrays[1], row.identifiable, row.by_joint
        parameters[f"{row.owner}.{row.name}"] = ParameterArrays(arrays[0], row.unit, *details)
    return parameters


def list_values(bench: Bench, param: Param, full: str, value: np.ndarray, uncertainty: Uncertainty) -> list[Value]:
    """List a parameter's entries in joint order; `full` is its full name, `value` covers the joints that have it."""
    nv = bench.nv
    value = param.spread(np.asarray(value, np.float64), nv)
    identified, low, high = (param.each(field, nv) for field in ("identify", "low", "high"))
    at_bound = identified & param.is_at_bound(value)
    intervals = uncertainty.intervals.get(full, np.full((nv, 2), np.nan))
    determined = uncertainty.determined.get(full)

    def describe(name: str, joints: Sequence[int]) -> Value:
        first = joints[0]
        return Value(
            name=name,
            joints=[bench.joints[joint] for joint in joints],
            value=float(value[first]),
            low=float(low[first]),
            high=float(high[first]),
            identified=bool(identified[first]),
            at_bound=bool(at_bound[first]),
            interval=intervals[first].tolist() if np.isfinite(intervals[first]).all() else None,
            identifiable=bool(determined[first]) if determined is not None and identified[first] else None,
        )

    return [describe(*group) for group in _group(bench, param, value).items()]


def _group(bench: Bench, param: Param, value: np.ndarray) -> dict[str, list[int]]:
    groups, members = bench.groups(param), param.members(bench.nv)
    if not param.is_identified:
        # Known values of a group may differ.
        values = {group: {value[i] for i in members if groups[i] == group} for group in groups}
        groups = [name if len(values[name]) == 1 else bench.joints[i] for i, name in enumerate(groups)]
        same = bench.nv > 1 and (value[members] == value[members[0]]).all()
        groups = [ALL] * bench.nv if same else groups
    joints: dict[str, list[int]] = {}
    for joint in members:
        joints.setdefault(groups[joint], []).append(joint)
    if ALL in joints and len(members) < bench.nv:
        joints = {name_first([bench.joints[joint] for joint in members]): members}
    return joints
