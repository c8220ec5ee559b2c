"""What `result.json` holds of its verdict, as types."""

from typing import Annotated, Literal, TypedDict

from frictionzoo.result.kinds import Text

Grade = Literal["nothing speaks against it", "use it with care", "do not use it"]


class FindingRow(TypedDict):
    """Something that speaks against the result."""

    kind: Literal[
        "identification",
        "recordings",
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


class VerdictRow(TypedDict):
    """What speaks against a result, and what to do next."""

    grade: Grade
    """In plain words."""
    findings: list[FindingRow]
    """The worst first; empty: nothing speaks against it."""
    commands: Annotated[list[Text], ("maxItems", 3)]
    """To copy: the law to try on the same data with the same options, the recording to make, the export. Of a run from
    Python, calls with the names bench, logs and drive, which stands for the result."""
