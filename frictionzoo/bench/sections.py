"""Changes of options in a bench's section, by their dotted names without the prefix `bench.`."""

import copy
from collections.abc import Mapping
from typing import Any


def put_options(section: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """Return a bench's section with changed options.

    Args:
        section: Section in the format of `describe(bench)` or conf/bench. A known parameter may be a number, in
            `params` or as an argument of the actuator.
        options: Values by dotted name, such as `{"actuator.params.kp.init": 15.0}`.
    """
    changed = copy.deepcopy(dict(section))
    for name, value in options.items():
        *path, last = name.split(".")
        place = _descend(changed, path[:-2] if path[-2:-1] == ["params"] else path)
        if path[-2:-1] == ["params"]:
            _put_parameter(place, path[-1], last, value)
        else:
            place[last] = value
    return changed


def _descend(place: dict[str, Any], path: list[str]) -> dict[str, Any]:
    for name in path:
        place[name] = dict(place.get(name) or {})
        place = place[name]
    return place


def _put_parameter(owner: dict[str, Any], name: str, what: str, value: Any) -> None:
    """Set one entry of a parameter's section; a plain value becomes the section's `init`."""
    params = owner["params"] = dict(owner.get("params") or {})
    given = owner.pop(name) if name in owner else params.get(name, {})
    known = {} if isinstance(given, Mapping) else {"init": given}
    params[name] = {**(given if isinstance(given, Mapping) else known), what: value}
