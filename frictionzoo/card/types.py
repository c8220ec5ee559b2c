"""What `card.json` holds, as types, of which `make docs` makes `card.schema.json`, as of those of `result.json`."""

from typing import Annotated, Any, Literal, TypedDict

from frictionzoo.result.kinds import Interval, Joints, NotNegative, Sha256, Text


class LawRow(TypedDict):
    """A friction law."""

    name: Text
    """Its name in the zoo."""
    joints: Joints
    """Names of the joints that have it."""
    text: str
    """Its equation, every symbol with its unit, what it cannot represent, and its source, in Markdown."""


class VisitedRow(TypedDict):
    """Where the long held-out rollouts took a joint."""

    joint: Text
    """Its name."""
    position: Interval
    """Lowest and highest measured position [rad or m]."""
    speed: NotNegative
    """Largest measured speed [rad/s or m/s]."""
    torque: NotNegative
    """Largest torque or force of its motor [N m or N], by the actuator law."""


class ConditionsRow(TypedDict):
    """Under which conditions the drive is as it is here."""

    supply: Text | None
    """What powered it, in the words of who made the card; null: not stated."""
    temperature: Text | None
    """How warm it was; null: not stated."""
    payload: Text | None
    """What it carried; null: not stated. What recordings say of it is in `result.data.logs`."""
    visited: Annotated[list[VisitedRow], ("minItems", 1)]
    """What the recordings say, joint by joint."""
    fastest: NotNegative
    """Largest speed of any joint in the training recordings [rad/s or m/s]."""


class OriginRow(TypedDict):
    """A file that somebody else published the values in."""

    project: Literal["BAM"]
    """Whose parameter file it is."""
    file: Text
    """Its name."""
    sha256: Sha256
    """Its hash."""
    drive: Text
    """The drive, as it calls it."""
    law: Text
    """The friction law, as it calls it."""
    source: Text
    """Who published it and where, in the words of who made the card."""
    remarks: list[Text]
    """What the drive does there and not here, a sentence each."""


class Card(TypedDict):
    """A drive for others, who have neither its run nor its recordings.

    It names files and no folder: no path of the machine on which it was made is in it.
    """

    schema_version: Literal[3]
    """Raised by every change that a reader of this file could notice."""
    name: Text
    """Title of the card."""
    licence: Annotated[str, ("pattern", "^[a-z0-9][a-z0-9.+-]*$")]
    """Under which the card may be used, an identifier as model hubs have it."""
    laws: Annotated[list[LawRow], ("minItems", 1)]
    """The friction law, or those of several joints."""
    conditions: ConditionsRow
    origin: OriginRow | None
    """Of published values, which the run judged on its recordings; null: the run identified them."""
    command: Text | None
    """That made the run; null: it was made in Python, or the run does not say."""
    files: dict[str, Sha256]
    """Hash of each of the card's other files but README.md, by name."""
    result: dict[str, Any]
    """The run's `result.json`, with names in place of paths, without commands to go on with, and with `settings.bench`
    as the test stand of `template.xml`."""
