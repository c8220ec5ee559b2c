"""A choice of a recipe, and what it may choose of."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from frictionzoo.core.params import AUTO

OPTIONAL = {
    "delay": "commands act late",
    "position_offset": "the encoder's zero is another",
    "torque_offset": "a constant torque acts besides the actuator's",
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
        yield Choice("loss.position", 0.0, "impulses are between measured velocities")
        yield Choice("loss.refine", False, "impulses are between measured velocities")
    if given.get("robust", "none") != "none":
        yield Choice("loss.refine", False, "a robust loss begins at measured states")
    if 0 in (given.get("position"), given.get("velocity")):
        yield Choice("loss.refine", False, "initial states are estimated by position and velocity, or not at all")
    if given.get("continuity"):
        yield Choice("loss.refine", True, "segments hold together where initial states are estimated along")
        yield Choice("segments.count", None, "segments hold together that follow one another")


def is_open(params: Mapping[str, Any], name: str) -> bool:
    """Whether the section of a bench's parameters leaves open if this one is identified."""
    return isinstance(params.get(name), Mapping) and params[name].get("identify") == AUTO
