"""A test stand and a law as sections that make them again from a card alone, and what of such sections may be built."""

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from frictionzoo.bench import Actuator, Bench
from frictionzoo.core.build import build
from frictionzoo.core.described import describe
from frictionzoo.core.errors import RunError
from frictionzoo.core.output import to_json
from frictionzoo.core.params import Param
from frictionzoo.core.registry import KINDS, find_registered
from frictionzoo.models import FrictionModel

TEMPLATE = "template.xml"
_BENCH = "frictionzoo.bench.Bench"
_KINDS = (KINDS["actuators"], KINDS["models"])


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
    kept = {name: settings[name] for name in ("solreffriction", "payload", "tie") if name in settings}
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
    """The bench and the law of a card; of what its sections name, only laws that are registered are built.

    Args:
        folder: The card's.
        settings: As `place_settings` has them.

    Raises:
        RunError: The sections name something else, or the template refers to files.
        FrictionzooError: They make no sense.
    """
    try:
        bench, model = settings["bench"], settings["model"]
        if bench["_target_"] != _BENCH:
            raise RunError(f"{folder}: _target_={bench['_target_']}, expected {_BENCH}; it is no card to be loaded")
        parts = {name: part for name, part in bench.items() if name != "_target_"}
        for target in [*_list_targets(parts), *_list_targets(model)]:
            _refuse_stranger(folder, target)
        text = (folder / TEMPLATE).read_text(encoding="utf-8")
        if name := _find_reference(text):
            raise RunError(f"{folder / TEMPLATE}: it refers to {name}, expected one file; it is no card to be loaded")
        made = build(bench)
        law = build(model, nv=made.nv)
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        reason = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        raise RunError(
            f"{folder}: no test stand or law can be made of its settings ({reason}); expected a card that this program "
            "wrote"
        ) from None
    law.bind(made.joints)
    return made.observing(law.inputs), law


def _list_targets(section: Any) -> Iterator[str]:
    if isinstance(section, Mapping):
        if "_target_" in section:
            yield str(section["_target_"])
        section = list(section.values())
    if isinstance(section, list):
        for part in section:
            yield from _list_targets(part)


def _refuse_stranger(folder: Path, target: str) -> None:
    """Before anything is imported for it."""
    module, _, name = target.rpartition(".")
    for found in (found for kind in _KINDS for found in kind.list_all()):
        own, _, cls = found.target.rpartition(".")
        if name == cls and module in (own, found.module, "frictionzoo.bench"):
            return
    registered = find_registered(target)
    if not (isinstance(registered, type) and issubclass(registered, Actuator | FrictionModel)):
        raise RunError(
            f"{folder}: {target} is no friction or actuator law that is installed here; expected one of python -m "
            "frictionzoo.list models actuators"
        )


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
