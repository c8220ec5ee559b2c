"""Section `card` of `result.json`: a published drive, in a run folder without recordings and paths of a machine."""

import hashlib
import json
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from frictionzoo.core.errors import RunError
from frictionzoo.core.output import RESULT, TEMPLATE, to_json
from frictionzoo.core.records import Interval, NotNegative, Record, Sha256, Text

BENCH = "frictionzoo.bench.Bench"
"""Class of every card's bench, which needs no file except its template."""


class Visited(Record):
    """Range of one joint in the long held-out rollouts."""

    joint: Text
    """Name of the joint."""
    position: Interval
    """Lowest and highest measured position [rad or m]."""
    speed: NotNegative
    """Largest measured speed [rad/s or m/s]."""
    torque: NotNegative
    """Largest motor torque or force, from the actuator model [N m or N]."""


class Conditions(Record):
    """Conditions of the recordings."""

    supply: Text | None
    """Power supply, as stated by the card's author; null: not stated."""
    temperature: Text | None
    """Temperature, as stated by the card's author; null: not stated."""
    payload: Text | None
    """Payload, as stated by the card's author; null: not stated. Payloads from the recordings are in `data.logs`."""
    visited: Annotated[list[Visited], Meta(min_length=1)]
    """Range of each joint in the recordings."""
    fastest: NotNegative
    """Largest speed of any joint in the training recordings [rad/s or m/s]."""


class Published(Record):
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


class Card(Record):
    """A published drive."""

    name: Text
    """Title of the card."""
    licence: Annotated[str, Meta(pattern="^[a-z0-9][a-z0-9.+-]*$")]
    """Licence of the card, an identifier of model hubs."""
    conditions: Conditions
    origin: Published | None
    """Source of published values, which the run evaluated on its recordings; null: the run identified the values."""
    command: Text | None
    """Command of the run; null: made in Python, or not recorded."""
    files: dict[str, Sha256]
    """SHA-256 of each file of the card except README.md, by name; for result.json, of its content with `files` empty,
    as JSON with sorted keys."""


def open_card(folder: Path, result: Record) -> dict[str, Any]:
    """Verify a card's files, perhaps a stranger's, against its `result`; return settings with the template's path.

    Raises:
        RunError: A file is missing or was edited, the bench is of another kind, or the template refers to other files.
    """
    for name, expected in result["card"].files.items():
        if Path(name).name != name:
            raise RunError(f"{folder / RESULT}: it names the file {name}, expected names without folders")
        sha256 = hash_record(result) if name == RESULT else hashlib.sha256(_read(folder / name)).hexdigest()
        if sha256 != expected:
            raise RunError(f"{folder / name}: SHA-256 {sha256[:12]}, expected {expected[:12]}; get the card again")
    bench = result["settings"].get("bench")
    target = bench.get("_target_") if isinstance(bench, Mapping) else bench
    if target != BENCH:
        raise RunError(f"{folder / RESULT}: settings.bench: _target_={target}, expected {BENCH}; get the card again")
    path = folder / TEMPLATE
    try:
        name = find_reference(_read(path).decode())
    except UnicodeDecodeError:
        raise RunError(f"{path}: not UTF-8; expected the MJCF of a card; get the card again") from None
    if name:
        raise RunError(f"{path}: it refers to {name}, expected one file; this card cannot be loaded")
    return {**result["settings"], "bench": {**bench, "mjcf": str(path)}}


def hash_record(result: Record | Mapping[str, Any]) -> str:
    """Return the SHA-256 of a card's record without its hashes."""
    content = to_json(result)
    record = {**content, "card": {**content["card"], "files": {}}}
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def find_reference(mjcf: str) -> str | None:
    """Return a reference of an MJCF to a file or to code; None if there is none."""
    try:
        root = ET.fromstring(mjcf)
    except ET.ParseError:
        return None  # the bench reports the syntax error
    for element in root.iter():
        if element.tag in ("include", "extension", "plugin"):
            return f"<{element.tag}>"
        for name, value in element.attrib.items():
            if re.fullmatch(r"(file(right|left|up|down|front|back)?|plugin|content_type)", name):
                return value
    return None


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: no name that a file can have
        reason = error.strerror if isinstance(error, OSError) else error
        raise RunError(f"{path}: {reason}; expected the file of a card; get the card again") from None
