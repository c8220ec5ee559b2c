"""Writing of a run's drive as a card: page, `card.json`, values, model files and a picture."""

import hashlib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import cast

import numpy as np
import safetensors.torch
import torch

from frictionzoo import __version__
from frictionzoo.core.anonymous import find_paths
from frictionzoo.core.errors import ConfigError, RunError, closest
from frictionzoo.core.output import take_place, to_json, write_atomically, write_json
from frictionzoo.core.templates import open_template, write_yaml
from frictionzoo.report.card.portable import TEMPLATE, write_template
from frictionzoo.report.card.record import CARD, MODEL, PAGE, PICTURE, STATED, build_card, read_schema, title_of
from frictionzoo.report.card.types import Card
from frictionzoo.report.run_plots import find_units, save_portraits
from frictionzoo.report.terminal import tabulate_errors, tabulate_values
from frictionzoo.report.text import escape_markdown, format_number
from frictionzoo.result.fitted_drive import FittedDrive
from frictionzoo.result.record import refuse_invalid
from frictionzoo.result.types import Result

OPTIONS = ("licence", "output", "name", *STATED, "bam", "source")
FOLDER = "card"  # default output, in the run's folder
_MODELS = ("identified.xml", "identified.urdf", "bench.xml")  # model files of a run
FILES = {
    CARD: "this page for programs",
    MODEL: "values of the friction model and the test stand, in full precision",
    "identified.xml": "the test stand or robot with the drive, for MuJoCo",
    "identified.urdf": "the robot with the drive",
    "bench.xml": "the simulated part of the robot, for MuJoCo",
    TEMPLATE: "the test stand without the drive, for `fz.load`",
    PICTURE: "the figure above",
}
"""Files of a card, except its page."""


def write_card(folder: Path, options: Mapping[str, str]) -> tuple[Path, list[str]]:
    """Write the card of a run.

    `options` are `licence`, and optionally `output` (a folder), `name`, `supply`, `temperature` and `payload`; for
    values that someone else published, also `bam`, the parameter file, and `source`, who published it and where.

    Returns:
        Folder of the card, and a warning for each path of this machine in its model files, which are copied unchanged.

    Raises:
        ConfigError: An option is missing, unknown or invalid, or the run's values differ from the BAM file.
        RunError: The folder does not contain a finished run with friction curves, or its bench refers to files.
        OutputError: The card's folder contains a foreign file with a card file's name, or a run, or cannot be written.
    """
    _refuse_impossible(options)
    place = Path(options.get("output", folder / FOLDER))
    with take_place(place, "card", [PAGE, *FILES, CARD]) as fresh:
        drive = FittedDrive.load(folder)
        if not drive.curves.portraits:
            raise RunError(f"{folder}: no friction curve, expected one; a newer frictionzoo writes it: identify again")
        _write_files(drive, fresh, options)
    return place, [
        f"{path}: contains the path {text} of the robot file; remove it from that file before you publish"
        for path in (place / name for name in _MODELS if (place / name).exists())
        for text in find_paths(path.read_bytes())
    ]


def _refuse_impossible(options: Mapping[str, str]) -> None:
    for option, value in options.items():
        if option not in OPTIONS:
            raise ConfigError(f"{option}: unknown option; {closest(option, OPTIONS)}")
        if not value.isprintable() or not value.strip():
            raise ConfigError(f"{option}={value!r}: expected one line of text")
    if "licence" not in options:
        raise ConfigError("licence is missing; state the licence of the card, such as licence=cc-by-4.0")
    if not re.fullmatch(r"[a-z0-9][a-z0-9.+-]*", options["licence"]):
        raise ConfigError(
            f"licence={options['licence']}: expected a lower-case identifier of model hubs, such as "
            "cc-by-4.0 or apache-2.0"
        )
    for present, missing, hint in (("bam", "source", "who published it and where"), ("source", "bam", "the file")):
        if present in options and missing not in options:
            raise ConfigError(f"{present}={options[present]}: {missing} is missing; say {hint}, {missing}=...")


def _write_files(drive: FittedDrive, folder: Path, options: Mapping[str, str]) -> None:
    assert drive.folder  # the drive was loaded from it
    tensors = {f"bench.{name}": torch.from_numpy(np.array(value)) for name, value in drive.values["bench"].items()}
    tensors |= {f"friction.{name}": value.contiguous() for name, value in drive.state.items()}
    header = {"frictionzoo": f"{drive.model.name}, version {__version__}"}
    write_atomically(folder / MODEL, safetensors.torch.save(tensors, header))
    write_atomically(folder / TEMPLATE, write_template(drive.bench).encode())
    for name in _MODELS:
        if (drive.folder / name).exists():
            write_atomically(folder / name, (drive.folder / name).read_bytes())
    save_portraits(folder / PICTURE, title_of(drive, options), drive.result, drive.curves)
    hashes = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())}
    card = to_json(build_card(drive, options, hashes))
    refuse_invalid(folder / CARD, card, read_schema())
    write_atomically(folder / PAGE, render_page(card).encode())
    write_json(folder / CARD, card)


def render_page(card: Card) -> str:
    """Render the card's page in Markdown, with the metadata header for model hubs."""
    result = cast(Result, card["result"])
    tables = {"values": tabulate_values(result), "errors": tabulate_errors(result), "units": find_units(result)}
    content = {"card": card, "result": result, "picture": PICTURE, "files": FILES, **tables}
    filters = {
        "number": format_number,
        "plain": escape_markdown,
        "name": _write_name,
        "quoted": write_yaml,
        "fence": _write_fence,
    }
    return open_template("report/card/card.md.jinja", filters).render(content)


def _write_name(text: str) -> str:
    """Format a name as inline code, also valid in tables; as plain text if code cannot contain it."""
    is_code = text.isprintable() and text == text.strip() and not set(text) & set("`|")
    return f"`{text}`" if is_code and text else escape_markdown(text)


def _write_fence(text: str) -> str:
    """Return the fence of a code block: more backticks than the text contains in a row."""
    return "`" * max(3, 1 + max(map(len, re.findall("`+", text)), default=0))
