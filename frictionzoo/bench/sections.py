"""Section of a bench: its parameters, and changes of options by dotted names without the prefix `bench.`."""

import copy
from collections.abc import Mapping
from typing import Any

PARAMS = {"armature": "inertia", "delay": "time", "position_offset": "position", "torque_offset": "torque"}
"""Dimension of each parameter of a bench."""
DEFAULTS: dict[str, dict[str, Any]] = {
    "armature": {"init": 0.01, "low": 1e-5, "high": 1.0, "scale": "log", "identify": True},
    "delay": {"init": 0.0, "low": 0.0, "high": 0.1, "scale": 0.01, "identify": False},
    "position_offset": {"init": 0.0, "low": -0.2, "high": 0.2, "scale": 0.1, "identify": False},
    "torque_offset": {"init": 0.0, "low": -20.0, "high": 20.0, "scale": 1.0, "identify": False},
}
"""Default sections of a bench's parameters: armature of a servo joint [kg m^2], no delay [s], no encoder offset
[rad or m], no constant torque [N m or N]."""


def put_options(section: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """Return a section of a bench, as in `describe(bench)` or conf/bench, with other options by dotted name."""
    changed = copy.deepcopy(dict(section))
    for name, value in options.items():
        *path, key = name.split(".")
        if path[-2:-1] == ["params"]:
            _put_parameter(_descend(changed, path[:-2]), path[-1], key, value)
        else:
            _descend(changed, path)[key] = value
    return changed


def _descend(place: dict[str, Any], path: list[str]) -> dict[str, Any]:
    for name in path:
        place[name] = dict(place.get(name) or {})
        place = place[name]
    return place


def _put_parameter(owner: dict[str, Any], name: str, what: str, value: Any) -> None:
    """Set one entry of a parameter's section; a plain value becomes the section's `init`."""
    params = _descend(owner, ["params"])
    current = owner.pop(name) if name in owner else params.get(name, {})
    params[name] = {**(current if isinstance(current, Mapping) else {"init": current}), what: value}
