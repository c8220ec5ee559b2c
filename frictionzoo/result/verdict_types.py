"""Types of the verdict in `result.json`."""

from typing import Literal, TypedDict

from frictionzoo.result.kinds import Text

Grade = Literal["nothing speaks against it", "use it with care", "do not use it"]


class FindingRow(TypedDict):
    """A problem of the result."""

    kind: Literal[
        "identification",
        "recordings",
        "torque",
        "gain",
        "joints",
        "reference",
        "train",
        "fit",
        "bounds",
        "identifiability",
        "stability",
        "residual",
    ]
    """Subject of the check."""
    severe: bool
    """Whether the problem makes the result useless."""
    text: Text
    """Description of the problem."""
    mend: Text | None
    """Remedy; null: none, or `text` has it."""
    law: Text | None
    """Friction model of the package with the missing term; null: the problem is not a missing term, or no model has
    it."""


class CommandRow(TypedDict):
    """A command to copy."""

    kind: Literal["repair", "inspect", "law", "recording", "export"]
    """Purpose: fix a finding, inspect the recordings, try another friction model, design the next recording, or export
    the drive."""
    command: Text
    """Shell command."""


class VerdictRow(TypedDict):
    """Problems of a result, and next steps."""

    grade: Grade
    """Overall grade."""
    findings: list[FindingRow]
    """Problems, causes first and then severe ones; empty: no problem found."""
    commands: list[CommandRow]
    """Commands to copy, in this order. A result that must not be used gets no recording and no export; a result with a
    repair gets no recording."""
