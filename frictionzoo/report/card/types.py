"""Types of `card.json`, from which `make docs` generates `card.schema.json`."""

from typing import Annotated, Any, Literal, TypedDict

from frictionzoo.result.kinds import Interval, Joints, NotNegative, Sha256, Text


class LawRow(TypedDict):
    """A friction model."""

    name: Text
    """Name of the model, as in `model=`."""
    joints: Joints
    """Names of the joints with this model."""
    text: str
    """Description in Markdown: equation, symbols with units, limitations and source."""


class VisitedRow(TypedDict):
    """Range of one joint in the long held-out rollouts."""

    joint: Text
    """Name of the joint."""
    position: Interval
    """Lowest and highest measured position [rad or m]."""
    speed: NotNegative
    """Largest measured speed [rad/s or m/s]."""
    torque: NotNegative
    """Largest motor torque or force, from the actuator model [N m or N]."""


class ConditionsRow(TypedDict):
    """Conditions of the recordings."""

    supply: Text | None
    """Power supply, as stated by the card's author; null: not stated."""
    temperature: Text | None
    """Temperature, as stated by the card's author; null: not stated."""
    payload: Text | None
    """Payload, as stated by the card's author; null: not stated. Payloads from the recordings are in
    `result.data.logs`."""
    visited: Annotated[list[VisitedRow], ("minItems", 1)]
    """Range of each joint in the recordings."""
    fastest: NotNegative
    """Largest speed of any joint in the training recordings [rad/s or m/s]."""


class OriginRow(TypedDict):
    """A file of published values."""

    project: Literal["BAM"]
    """Project that defines the file format."""
    file: Text
    """Name of the file."""
    sha256: Sha256
    """SHA-256 of the file."""
    drive: Text
    """Name of the drive in the file."""
    law: Text
    """Name of the friction model in the file."""
    source: Text
    """Publisher and place of publication, as stated by the card's author."""
    remarks: list[Text]
    """Differences from the drive in the published project, one sentence each."""


class Card(TypedDict):
    """A published drive, for users without its run and recordings.

    It contains names of files, and no paths of the machine that made it.
    """

    schema_version: Literal[4]
    """Schema version, increased by every change that affects readers of the file."""
    name: Text
    """Title of the card."""
    licence: Annotated[str, ("pattern", "^[a-z0-9][a-z0-9.+-]*$")]
    """Licence of the card, an identifier of model hubs."""
    laws: Annotated[list[LawRow], ("minItems", 1)]
    """Friction models of the joints."""
    conditions: ConditionsRow
    origin: OriginRow | None
    """Source of published values, which the run evaluated on its recordings; null: the run identified the values."""
    command: Text | None
    """Command of the run; null: made in Python, or not recorded."""
    files: dict[str, Sha256]
    """SHA-256 of each other file of the card except README.md, by name."""
    result: dict[str, Any]
    """The run's `result.json`, with file names instead of paths, without the commands of its verdict, and with the test
    stand of `template.xml` as `settings.bench`."""
