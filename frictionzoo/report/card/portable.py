"""Bench and model sections that a card can be rebuilt from without other files, and checks before the rebuild."""

import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from frictionzoo.bench import Bench
from frictionzoo.core.described import describe
from frictionzoo.core.errors import RunError
from frictionzoo.core.output import to_json
from frictionzoo.core.params import Param
from frictionzoo.models import FrictionModel
from frictionzoo.result.read_back import build_drive

TEMPLATE = "template.xml"
_BENCH = "frictionzoo.bench.Bench"


def describe_bench(bench: Bench, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the section that builds this bench from `TEMPLATE`; a robot does not need its own file any more.

    Link inertias, gravity and time step come from the template. `settings` is the section that built the bench.
    """
    description = describe(bench.actuator)
    options = {name: value for name, value in description.items() if name not in {"params", *bench.actuator.dimensions}}
    of_actuator = {name: _section(bench.params[name]) for name in bench.actuator.params if name in bench.params}
    of_bench = {name: _section(param) for name, param in bench.params.items() if name not in of_actuator}
    kept = {name: settings[name] for name in ("solreffriction", "second_order", "payload", "tie") if name in settings}
    actuator = {**options, "params": of_actuator}
    return to_json(
        {"_target_": _BENCH, "mjcf": TEMPLATE, "joint": list(bench.joints), **kept}
        | {"actuator": actuator, "params": of_bench}
    )


def _section(param: Param) -> dict[str, Any]:
    return {name: getattr(param, name) for name in ("init", "low", "high", "scale", "identify", "tie")}


def write_template(bench: Bench) -> str:
    """Return the MJCF of `TEMPLATE`.

    Raises:
        RunError: It refers to other files, which a card cannot contain.
    """
    text = bench.template()
    if name := _find_reference(text):
        raise RunError(f"{bench.source}: it refers to the file {name}, expected a test stand in one file; remove it")
    return text


def place_settings(folder: Path, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return a card's settings with the path of its template.

    Raises:
        RunError: The settings have no bench.
    """
    bench = settings.get("bench")
    if not isinstance(bench, Mapping):
        raise RunError(f"{folder}: settings.bench={bench}, expected a section; get the card again")
    return {**settings, "bench": {**bench, "mjcf": str(folder / TEMPLATE)}}


def build_parts(folder: Path, settings: Mapping[str, Any]) -> tuple[Bench, FrictionModel]:
    """Build the bench and the model of a card, with settings from `place_settings`.

    Raises:
        RunError: The bench is of another kind, or the template is missing, not UTF-8, or refers to other files.
        FrictionzooError: The settings are invalid.
    """
    target = settings["bench"].get("_target_")
    if target != _BENCH:
        raise RunError(f"{folder}: _target_={target}, expected {_BENCH}; this card cannot be loaded")
    path = folder / TEMPLATE
    try:
        name = _find_reference(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise RunError(f"{path}: {error.strerror}; expected the file of a card; get the card again") from None
    except ValueError:
        raise RunError(f"{path}: not UTF-8; expected the MJCF of a card; get the card again") from None
    if name:
        raise RunError(f"{path}: it refers to {name}, expected one file; this card cannot be loaded")
    return build_drive(folder, settings)


def _find_reference(text: str) -> str | None:
    """Return a reference of an MJCF to a file or to code; None if there is none."""
    try:
        root = ET.fromstring(text)
    except ET.ParseError:
        return None  # the bench reports the syntax error
    for element in root.iter():
        if element.tag in ("include", "extension", "plugin"):
            return f"<{element.tag}>"
        for name, value in element.attrib.items():
            if re.fullmatch(r"(file(right|left|up|down|front|back)?|plugin|content_type)", name):
                return value
    return None
