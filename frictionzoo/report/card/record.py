"""`card.json`: the machine-readable part of a card; `card.schema.json` in this folder describes it."""

import copy
import hashlib
import inspect
import json
import math
import shlex
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from omegaconf import OmegaConf

from frictionzoo.bench.read_bam import read_bam
from frictionzoo.core.anonymous import last_of, list_paths_of, without_paths
from frictionzoo.core.errors import ConfigError
from frictionzoo.report.card.portable import describe_bench
from frictionzoo.report.card.types import Card, LawRow, OriginRow, VisitedRow
from frictionzoo.report.text import to_markdown
from frictionzoo.result.fitted_drive import FittedDrive

CARD = "card.json"
MODEL = "model.safetensors"
PICTURE = "friction.png"
PAGE = "README.md"
CARD_VERSION: Final = 4
STATED = ("supply", "temperature", "payload")
_ROUNDED = 1e-6  # relative difference allowed between a float32 value of the run and the file
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
        "origin": _read_origin(drive, stated),
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


def _read_origin(drive: FittedDrive, options: Mapping[str, str]) -> OriginRow | None:
    """Return the origin of a drive whose values come from a BAM parameter file; None without such a file.

    `options` has `bam`, the file, and `source`, who published it and where; or neither.

    Raises:
        ConfigError: The run identified its values, its model or values differ from the file's, or the file is not a BAM
            parameter file.
    """
    if "bam" not in options:
        return None
    path = Path(options["bam"])
    published = read_bam(path)
    if (method := drive.result["fit"]["method"]) != "known":
        raise ConfigError(
            f"bam={path}: the run identified its values (fit={method}), expected the file's values; run it with "
            f"$(python -m frictionzoo.bench.read_bam {path})"
        )
    if drive.result["model"] != published.model:
        raise ConfigError(
            f"bam={path}: its model is {published.model}, the run's {drive.result['model']}; name the run's own file"
        )
    expected = {f"bench.{name}": value for name, value in published.bench.items()}
    expected |= {f"friction.{name}": value for name, value in published.friction.items()}
    for name, value in expected.items():
        # A delay or an offset that is fixed at 0 is not a parameter of the drive.
        run_values = drive.parameters[name].value.tolist() if name in drive.parameters else [0.0]
        if not all(math.isclose(run_value, value, rel_tol=_ROUNDED) for run_value in run_values):
            raise ConfigError(f"bam={path}: {name} is {value:g}, in the run {run_values[0]:g}; name the run's own file")
    return {
        "project": "BAM",
        "file": path.name,
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "drive": published.actuator,
        "law": published.bam,
        "source": options["source"],
        "remarks": list(published.remarks),
    }
