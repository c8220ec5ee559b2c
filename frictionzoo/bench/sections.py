"""Changes of options in a bench's section, by their dotted names without the prefix `bench.`."""

import copy
from collections.abc import Mapping
from typing import Any


def put_options(section: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """Return a section of a bench, as in `describe(bench)` or conf/bench, with other options by dotted name."""
    changed = copy.deepcopy(dict(section))
    for name, value in options.items():
        *path, key = name.split(".")
        owner = _descend(changed, path[:-2] if path[-2:-1] == ["params"] else path)
        if path[-2:-1] == ["params"]:
            _put_parameter(owner, path[-1], key, value)
        else:
            owner[key] = value
    return changed


def _descend(place: dict[str, Any], path: list[str]) -> dict[str, Any]:
    for name in path:
        place[name] = dict(place.get(name) or {})
        place = place[name]
    return place


def _put_parameter(owner: dict[str, Any], name: str, what: str, value: Any) -> None:
    """Set one entry of a parameter's section; a plain value becomes the section's `init`."""
    params = owner["params"] = dict(owner.get("params") or {})
    current = owner.pop(name) if name in owner else params.get(name, {})
    section = {} if isinstance(current, Mapping) else {"init": current}
    params[name] = {**(current if isinstance(current, Mapping) else section), what: value}
