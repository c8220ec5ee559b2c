"""Cards, which publish a drive: `python -m frictionzoo.card RUN licence=...` writes, `frictionzoo.load` reads one."""

import copy
import hashlib
import inspect
import math
import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from frictionzoo.bench import Bench
from frictionzoo.bench.read_bam import read_bam
from frictionzoo.core.anonymous import find_paths, last_of, list_paths_of, without_paths
from frictionzoo.core.described import describe
from frictionzoo.core.errors import ConfigError, RunError, closest
from frictionzoo.core.jobs import read_begun
from frictionzoo.core.output import RESULT, TEMPLATE, take_place, to_json, write_atomically, write_json
from frictionzoo.core.params import Param
from frictionzoo.core.templates import open_template, write_yaml
from frictionzoo.report.run_plots import find_units, save_portraits
from frictionzoo.report.terminal import tabulate_errors, tabulate_values
from frictionzoo.report.text import escape_markdown, format_number, to_markdown
from frictionzoo.result.card import BENCH, Card, Conditions, Published, Visited, find_reference, hash_record
from frictionzoo.result.curves import FILE as CURVES
from frictionzoo.result.curves import write_curves
from frictionzoo.result.fitted_drive import FittedDrive
from frictionzoo.result.read_back import LAW
from frictionzoo.result.types import Result

PICTURE = "friction.png"
PAGE = "README.md"
STATED = ("supply", "temperature", "payload")
OPTIONS = ("licence", "output", "name", *STATED, "bam", "source")
FOLDER = "card"  # default output, in the run's folder
MODELS = ("identified.xml", "identified.urdf", "bench.xml")  # model files of a run
FILES = {
    RESULT: "the run's record: values, intervals, errors and conditions, for programs",
    LAW: "values of the friction model, in full precision",
    CURVES: "friction curve of the model",
    "identified.xml": "the test stand or robot with the drive, for MuJoCo",
    "identified.urdf": "the robot with the drive",
    "bench.xml": "the simulated part of the robot, for MuJoCo",
    TEMPLATE: "the test stand without the drive, for `fz.load`",
    PICTURE: "the figure above",
}
"""Files of a card, except its page."""
_ROUNDED = 1e-6  # relative difference allowed between a float32 value of the run and the published file


def write_card(folder: Path, options: Mapping[str, str]) -> tuple[Path, list[str]]:
    """Write the card of a run: a run folder without recordings and paths of this machine, with a page and a picture.

    `options` are `licence`, and optionally `output` (a folder), `name`, `supply`, `temperature` and `payload`; for
    values that someone else published, also `bam`, the parameter file, and `source`, who published it and where.

    Returns:
        Folder of the card, and a warning for each path of this machine in its model files, which are copied unchanged.

    Raises:
        ConfigError: An option is missing, unknown or invalid, or the run's values differ from the BAM file.
        RunError: The folder does not contain a finished run, or its bench refers to files.
        OutputError: The card's folder contains a foreign file with a card file's name, or cannot be written.
    """
    _refuse_invalid(options)
    place = Path(options.get("output", folder / FOLDER))
    with take_place(place, "card", [PAGE, *FILES, RESULT]) as fresh:
        drive = FittedDrive.load(folder)
        result = describe_card(drive, folder, options)
        assert result.card is not None
        for name in (LAW, *MODELS):
            if (folder / name).exists():
                write_atomically(fresh / name, (folder / name).read_bytes())
        write_curves(fresh, drive.curves.without_recordings())
        write_atomically(fresh / TEMPLATE, write_template(drive.bench).encode())
        save_portraits(fresh / PICTURE, result.card.name, drive.result, drive.curves)
        hashes = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(fresh.iterdir())}
        result.card.files = {RESULT: hash_record(result), **hashes}
        write_atomically(fresh / PAGE, _render_page(result, drive).encode())
        write_json(fresh / RESULT, to_json(result))
    return place, [
        f"{path}: contains the path {text} of the robot file; remove it from that file before you publish"
        for path in (place / name for name in MODELS if (place / name).exists())
        for text in find_paths(path.read_bytes())
    ]


def _refuse_invalid(options: Mapping[str, str]) -> None:
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
    if ("bam" in options) != ("source" in options):
        present, missing = ("bam", "source") if "bam" in options else ("source", "bam")
        hint = "bam=FILE with the published values and source=TEXT, who published them and where"
        raise ConfigError(f"{present}={options[present]}: {missing} is missing; give {hint}")


def describe_card(drive: FittedDrive, folder: Path, stated: Mapping[str, str]) -> Result:
    """Return the record of a card: the run's, without paths and with the section `card`, still without hashes.

    Raises:
        ConfigError: The values differ from the file that `stated["bam"]` names.
    """
    result = copy.deepcopy(drive.result)
    options = read_begun(folder, "overrides")
    command = None if options is None else shlex.join(["frictionzoo", *map(str, options)])
    paths = {*list_paths_of(result, command), str(folder.absolute()), str(folder.resolve())}
    result.verdict.commands = []  # they refer to the run's folder
    result.settings["bench"] = describe_bench(drive.bench, result.settings["bench"])
    for log in result.data.logs:
        log.name = last_of(log.name)
    result.card = Card(
        name=stated.get("name", f"{result.data.name}, {result.model}"),
        licence=stated["licence"],
        conditions=Conditions(
            **{name: stated.get(name) for name in STATED},
            visited=_list_visited(drive),
            fastest=float(np.abs(drive.curves.velocity).max()),
        ),
        origin=_read_origin(drive, stated),
        command=command,
        files={},
    )
    return msgspec.convert(without_paths(to_json(result), paths, drive.bench.joints), Result)


def describe_bench(bench: Bench, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the section that builds this bench from `TEMPLATE`; a robot does not need its own file any more.

    Link inertias, gravity and time step come from the template. `settings` is the section that built the bench.
    """
    actuator = describe(bench.actuator)
    options = {name: value for name, value in actuator.items() if name not in {"params", *bench.actuator.dimensions}}
    of_actuator = {name: _section(bench.params[name]) for name in bench.actuator.params if name in bench.params}
    of_bench = {name: _section(param) for name, param in bench.params.items() if name not in of_actuator}
    kept = {name: settings[name] for name in ("solreffriction", "second_order", "payload", "tie") if name in settings}
    section = {"_target_": BENCH, "mjcf": TEMPLATE, "joint": list(bench.joints), **kept}
    return to_json({**section, "actuator": {**options, "params": of_actuator}, "params": of_bench})


def _section(param: Param) -> dict[str, Any]:
    return {name: getattr(param, name) for name in ("init", "low", "high", "scale", "identify", "tie")}


def write_template(bench: Bench) -> str:
    """Return the MJCF of `TEMPLATE`.

    Raises:
        RunError: It refers to other files, which a card cannot contain.
    """
    text = bench.template()
    if name := find_reference(text):
        raise RunError(f"{bench.source}: it refers to the file {name}, expected a test stand in one file; remove it")
    return text


def _list_visited(drive: FittedDrive) -> list[Visited]:
    segments = drive.recorded
    position, speed = np.concatenate(segments.qpos), np.abs(np.concatenate(segments.qvel))
    torque = np.abs(drive.samples.motor_torque)
    return [
        Visited(
            joint=joint,
            position=[float(position[:, index].min()), float(position[:, index].max())],
            speed=float(speed[:, index].max()),
            torque=float(torque[:, index].max()),
        )
        for index, joint in enumerate(drive.bench.joints)
    ]


def _read_origin(drive: FittedDrive, options: Mapping[str, str]) -> Published | None:
    """Return the origin of a drive whose values come from the BAM parameter file `bam`; None without such a file.

    Raises:
        ConfigError: The run identified its values, its model or values differ from the file's, or the file is not a BAM
            parameter file.
    """
    if "bam" not in options:
        return None
    path = Path(options["bam"])
    published = read_bam(path)
    if (method := drive.result.fit.method) != "known":
        raise ConfigError(
            f"bam={path}: the run identified its values (fit={method}), expected the file's values; run it with "
            f"$(python -m frictionzoo.bench.read_bam {path})"
        )
    if drive.result.model != published.model:
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
    return Published(
        project="BAM",
        file=path.name,
        sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
        drive=published.actuator,
        law=published.bam,
        source=options["source"],
        remarks=list(published.remarks),
    )


def _render_page(result: Result, drive: FittedDrive) -> str:
    """Render the card's page in Markdown, with the metadata header for model hubs."""
    joints: dict[str, list[str]] = {}
    texts: dict[str, str] = {}
    for index, joint in enumerate(drive.bench.joints):
        law = drive.model.of_joint(index)[0]
        joints.setdefault(law.name, []).append(joint)
        texts[law.name] = to_markdown(inspect.getdoc(type(law)) or "")
    laws: Sequence[Mapping[str, Any]] = [
        {"name": name, "joints": joints[name], "text": text} for name, text in texts.items()
    ]
    tables = {"values": tabulate_values(result), "errors": tabulate_errors(result), "units": find_units(result)}
    filters = {
        "number": format_number,
        "plain": escape_markdown,
        "name": _write_name,
        "quoted": write_yaml,
        "fence": _write_fence,
    }
    page = open_template("report/card.md.jinja", filters)
    return page.render(card=result.card, result=result, laws=laws, picture=PICTURE, files=FILES, **tables)


def _write_name(text: str) -> str:
    """Format a name as inline code, also valid in tables; as plain text if code cannot contain it."""
    is_code = text.isprintable() and text == text.strip() and not set(text) & set("`|")
    return f"`{text}`" if is_code and text else escape_markdown(text)


def _write_fence(text: str) -> str:
    """Return the fence of a code block: more backticks than the text contains in a row."""
    return "`" * max(3, 1 + max(map(len, re.findall("`+", text)), default=0))
