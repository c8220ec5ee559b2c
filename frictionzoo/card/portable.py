"""A test stand and a law as sections that make them again from a card alone, and what of such sections may be built."""

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
    """The section that makes this bench from `TEMPLATE`, a robot's too, whose own file is not needed any more.

    Link inertias, gravity and time step are those of the template.

    Args:
        bench: The test stand.
        settings: The section that made it.
    """
    own = describe(bench.actuator)
    given = {name: value for name, value in own.items() if name not in {"params", *bench.actuator.dimensions}}
    of_actuator = {name: _section(bench.params[name]) for name in bench.actuator.params if name in bench.params}
    of_bench = {name: _section(param) for name, param in bench.params.items() if name not in of_actuator}
    kept = {name: settings[name] for name in ("solreffriction", "second_order", "payload", "tie") if name in settings}
    actuator = {**given, "params": of_actuator}
    return to_json(
        {"_target_": _BENCH, "mjcf": TEMPLATE, "joint": list(bench.joints), **kept}
        | {"actuator": actuator, "params": of_bench}
    )


def _section(param: Param) -> dict[str, Any]:
    return {name: getattr(param, name) for name in ("init", "low", "high", "scale", "identify", "tie")}


def write_template(bench: Bench) -> str:
    """The MJCF of `TEMPLATE`.

    Raises:
        RunError: It refers to files, which a card has not.
    """
    text = bench.template()
    if name := _find_reference(text):
        raise RunError(f"{bench.source}: it refers to the file {name}, expected a test stand in one file; leave it out")
    return text


def place_settings(folder: Path, settings: Mapping[str, Any]) -> dict[str, Any]:
    """A card's settings with the template where it lies.

    Raises:
        RunError: They have no bench.
    """
    bench = settings.get("bench")
    if not isinstance(bench, Mapping):
        raise RunError(f"{folder}: settings.bench={bench}, expected a section; get the card anew")
    return {**settings, "bench": {**bench, "mjcf": str(folder / TEMPLATE)}}


def build_parts(folder: Path, settings: Mapping[str, Any]) -> tuple[Bench, FrictionModel]:
    """The bench and the law of a card.

    Args:
        folder: The card's.
        settings: As `place_settings` has them.

    Raises:
        RunError: The bench is of another kind, or the template is not there or refers to files.
        FrictionzooError: The settings make no sense.
    """
    target = settings["bench"].get("_target_")
    if target != _BENCH:
        raise RunError(f"{folder}: _target_={target}, expected {_BENCH}; it is no card to be loaded")
    path = folder / TEMPLATE
    try:
        name = _find_reference(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise RunError(f"{path}: {error.strerror}; expected the file of a card; get the card anew") from None
    except ValueError:
        raise RunError(f"{path}: not UTF-8; expected the MJCF of a card; get the card anew") from None
    if name:
        raise RunError(f"{path}: it refers to {name}, expected one file; it is no card to be loaded")
    return build_drive(folder, settings)


def _find_reference(text: str) -> str | None:
    """What an MJCF refers to outside itself: a file, or code to be loaded."""
    try:
        root = ET.fromstring(text)
    except ET.ParseError:
        return None  # the bench says what is wrong with it
    for element in root.iter():
        if element.tag in ("include", "extension", "plugin"):
            return f"<{element.tag}>"
        for name, value in element.attrib.items():
            if re.fullmatch(r"(file(right|left|up|down|front|back)?|plugin|content_type)", name):
                return value
    return None
