"""A choice of a recipe, and what it may choose of."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from frictionzoo.core.params import AUTO

OPTIONAL = {
    "delay": "the data show a delay",
    "position_offset": "the data show an encoder offset",
    "torque_offset": "the data show a constant torque",
}
"""Parameters of a bench that are identified where recordings show them, and what they stand for."""
RIVALS = "torque_offset", "position_offset"
"""Those among them that shift a balance with gravity alike, so that one of them is identified at most."""


class Choice(NamedTuple):
    """What was chosen for an option that was left open, and why."""

    option: str
    value: Any
    reason: str

    def __str__(self) -> str:
        value = "null" if self.value is None else self.value
        return f"{self.option}={str(value).lower() if isinstance(value, bool) else value}: {self.reason}"


def imply(loss: Mapping[str, Any]) -> Iterator[Choice]:
    """What the options of a loss that are given leave no choice for.

    Args:
        loss: All of them; an open one is `auto`.
    """
    given = {name: value for name, value in loss.items() if value != AUTO}
    if given.get("impulse"):
        yield Choice("loss.position", 0.0, "loss.impulse uses measured velocities only")
        yield Choice("loss.refine", False, "loss.impulse uses measured velocities only")
    if given.get("robust", "none") != "none":
        yield Choice("loss.refine", False, "a robust loss starts at measured states")
    if 0 in (given.get("position"), given.get("velocity")):
        yield Choice("loss.refine", False, "multiple shooting needs weights above 0 for position and velocity")
    if given.get("continuity"):
        yield Choice("loss.refine", True, "loss.continuity needs estimated initial states")
        yield Choice("segments.count", None, "loss.continuity needs consecutive segments")


def is_open(params: Mapping[str, Any], name: str) -> bool:
    """Whether the section of a bench's parameters leaves open if this one is identified."""
    return isinstance(params.get(name), Mapping) and params[name].get("identify") == AUTO
