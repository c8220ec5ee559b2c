"""`card.json`: the machine-readable part of a card; `card.schema.json` in this folder describes it."""

import copy
import inspect
import json
import shlex
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from omegaconf import OmegaConf

from frictionzoo.core.anonymous import last_of, list_paths_of, without_paths
from frictionzoo.report.card.origin import read_origin
from frictionzoo.report.card.portable import describe_bench
from frictionzoo.report.card.types import Card, LawRow, VisitedRow
from frictionzoo.report.text import to_markdown
from frictionzoo.result.fitted_drive import FittedDrive

CARD = "card.json"
MODEL = "model.safetensors"
PICTURE = "friction.png"
PAGE = "README.md"
CARD_VERSION: Final = 4
STATED = ("supply", "temperature", "payload")
_OVERRIDES = Path(".hydra", "overrides.yaml")


def read_schema() -> dict[str, Any]:
    """Return the JSON schema of `card.json`, which documents every field."""
    return json.loads(
        resources.files("frictionzoo.report.card").joinpath("card.schema.json").read_text(encoding="utf-8")
    )


def build_card(drive: FittedDrive, stated: Mapping[str, str], files: Mapping[str, str]) -> Card:
    """Return the content of `card.json` for a drive loaded from a run's folder.

    `stated` has `licence`, and optionally `name`, `supply`, `temperature`, `payload`, `bam` and `source`; `files` has
    SHA-256 hashes by file name.

    Raises:
        ConfigError: The values differ from the file that `bam` names.
    """
    result = drive.result
    card = {
        "schema_version": CARD_VERSION,
        "name": title_of(drive, stated),
        "licence": stated["licence"],
        "laws": _list_laws(drive),
        "conditions": {
            **{name: stated.get(name) for name in STATED},
            "visited": _list_visited(drive),
            "fastest": float(np.abs(drive.curves.velocity).max()),
        },
        "origin": read_origin(drive, stated),
        "command": _read_command(drive.folder),
        "files": dict(files),
        "result": _make_portable(drive),
    }
    folders = [str(drive.folder.absolute()), str(drive.folder.resolve())] if drive.folder else []
    paths = {*list_paths_of(cast(dict[str, Any], result), card["command"]), *folders}
    return cast(Card, without_paths(card, paths, drive.bench.joints))


def title_of(drive: FittedDrive, stated: Mapping[str, str]) -> str:
    """Return the card's title: the option `name`, or else data set and model."""
    return stated.get("name", f"{drive.result['data']['name']}, {drive.result['model']}")


def _list_laws(drive: FittedDrive) -> list[LawRow]:
    rows: dict[str, LawRow] = {}
    for index, joint in enumerate(drive.bench.joints):
        law = drive.model.of_joint(index)[0]
        text = to_markdown(inspect.getdoc(type(law)) or "")
        rows.setdefault(law.name, {"name": law.name, "joints": [], "text": text})["joints"].append(joint)
    return list(rows.values())


def _list_visited(drive: FittedDrive) -> list[VisitedRow]:
    samples, segments = drive.samples, drive.recorded
    rows: list[VisitedRow] = []
    for index, joint in enumerate(drive.bench.joints):
        position, speed = segments.qpos[..., index], np.abs(segments.qvel[..., index])
        torque = np.abs(samples.motor_torque[:, index])
        ends = [float(position.min()), float(position.max())]
        rows.append({"joint": joint, "position": ends, "speed": float(speed.max()), "torque": float(torque.max())})
    return rows


def _read_command(folder: Path | None) -> str | None:
    if folder is None or not (folder / _OVERRIDES).exists():
        return None
    options = [str(option) for option in OmegaConf.to_container(OmegaConf.load(folder / _OVERRIDES)) or []]
    return shlex.join(["frictionzoo", *options])


def _make_portable(drive: FittedDrive) -> dict[str, Any]:
    result: dict[str, Any] = copy.deepcopy(cast(dict[str, Any], drive.result))
    result["verdict"]["commands"] = []  # they refer to the run's folder
    result["settings"]["bench"] = describe_bench(drive.bench, result["settings"]["bench"])
    for log in result["data"]["logs"]:
        log["name"] = last_of(log["name"])
    return result
