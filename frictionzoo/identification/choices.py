"""A choice of the automatic settings, and the optional parameters that they may identify."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from frictionzoo.core.params import AUTO

OPTIONAL = {
    "delay": "the data show a delay",
    "position_offset": "the data show an encoder offset",
    "torque_offset": "the data show a constant torque",
}
"""Bench parameters that are identified only if the recordings show them, with that reason."""
RIVALS = "torque_offset", "position_offset"
"""Optional parameters that shift a balance with gravity alike: at most one of them is identified."""


class Choice(NamedTuple):
    """The value chosen for an open option, and the reason."""

    option: str
    value: Any
    reason: str

    def __str__(self) -> str:
        value = "null" if self.value is None else self.value
        return f"{self.option}={str(value).lower() if isinstance(value, bool) else value}: {self.reason}"


def imply(loss: Mapping[str, Any]) -> Iterator[Choice]:
    """Yield the choices that the options of a loss determine; an open option is `auto`."""
    options = {name: value for name, value in loss.items() if value != AUTO}
    if options.get("impulse"):
        yield Choice("loss.position", 0.0, "loss.impulse uses measured velocities only")
        yield Choice("loss.refine", False, "loss.impulse uses measured velocities only")
    if options.get("robust", "none") != "none":
        yield Choice("loss.refine", False, "a robust loss starts at measured states")
    if 0 in (options.get("position"), options.get("velocity")):
        yield Choice("loss.refine", False, "multiple shooting needs weights above 0 for position and velocity")
    if options.get("continuity"):
        yield Choice("loss.refine", True, "loss.continuity needs estimated initial states")
        yield Choice("segments.count", None, "loss.continuity needs consecutive segments")


def is_open(params: Mapping[str, Any], name: str) -> bool:
    """Return whether a bench's parameter section leaves open if this parameter is identified."""
    return isinstance(params.get(name), Mapping) and params[name].get("identify") == AUTO
