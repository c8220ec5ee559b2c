"""What `result.json` holds of its verdict, as types."""

from typing import Literal, TypedDict

from frictionzoo.result.kinds import Text

Grade = Literal["nothing speaks against it", "use it with care", "do not use it"]


class FindingRow(TypedDict):
    """Something that speaks against the result."""

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
    """What was looked at."""
    severe: bool
    """The result is of no use as long as this is so."""
    text: Text
    """What was found."""
    mend: Text | None
    """What mends it; null: `text` says so."""
    law: Text | None
    """The law of the zoo that has what this one lacks; null: it is no matter of the law, or there is none."""


class CommandRow(TypedDict):
    """A command to copy."""

    kind: Literal["repair", "inspect", "law", "recording", "export"]
    """What it does: mend what a finding says, look at the recordings, try another law, design the next recording, or
    export the drive."""
    command: Text
    """For a shell; of a run from Python, a call with the names bench, logs and drive, which stands for the result."""


class VerdictRow(TypedDict):
    """What speaks against a result, and what to do next."""

    grade: Grade
    """In plain words."""
    findings: list[FindingRow]
    """The worst first; empty: nothing speaks against it."""
    commands: list[CommandRow]
    """To copy, in this order. A result that is not to be used suggests neither a recording nor an export; neither does
    a result with a repair suggest a recording."""
