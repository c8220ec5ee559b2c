"""Distillation: fit another friction model (the student) to a run's drive (the teacher), and measure the loss."""

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from frictionzoo.cli.job import run_job
from frictionzoo.cli.overrides import refuse_no_choice
from frictionzoo.comparison.runs import Run, read_runs
from frictionzoo.comparison.statistics import difference, resample
from frictionzoo.core.config import (
    check_overrides,
    compose_config,
    create_literal,
    keep_caches_at_home,
    list_choices,
    read_value,
)
from frictionzoo.core.errors import ConfigError, OutputError, closest
from frictionzoo.core.output import RUN_FILES, claim, to_json, write_atomically
from frictionzoo.core.params import UNITS
from frictionzoo.distill.page import write_page
from frictionzoo.export.nearest import evaluate_law
from frictionzoo.models import FrictionModel
from frictionzoo.models.base import sliding_torque
from frictionzoo.result.identified import Identified
from frictionzoo.result.types import Result

NOTE = "distillation.json"
_GROUPS = ("model", "fit", "logger")  # configuration files that a student may choose
_SHARED = ("bench", "data", "scale", "evaluation", "resume", "experiment")  # always the teacher's


@dataclass(frozen=True)
class Distillation:
    """Outcome of a distillation.

    Attributes:
        folder: Folder of the student.
        teacher: Content of the teacher's `result.json`.
        student: Content of the student's `result.json`.
        note: Content of `distillation.json`: the teacher's folder, differences between the two, and notes.
        complaint: One line if the fit diverged, else None.
    """

    folder: Path
    teacher: Result
    student: Result
    note: Mapping[str, Any]
    complaint: str | None


def distill(folder: Path, options: Mapping[str, str]) -> Distillation:
    """Fit a model to a drive's rollouts under the training commands, and evaluate both on the test recordings.

    The student's folder has the files of a run and `distillation.json`; its page also shows the teacher.

    Args:
        folder: Folder of the teacher's run.
        options: `model`, a name; `output`, a folder; and fit options of a run, all as text.

    Raises:
        FrictionzooError: The run or its recordings cannot be read, an option is invalid, or the teacher diverges.
            No files remain.
    """
    teacher = Identified.load(folder)
    config = compose_student(teacher, {key: value for key, value in options.items() if key != "output"})
    name = options["model"]
    place = Path(options.get("output", folder / "distilled" / name))
    if os.path.lexists(place):
        raise OutputError(f"{place}: it exists already, expected a new folder; remove it or set output to another")
    with claim(place, "run", RUN_FILES, undone=True):
        student, complaint = run_job(config, name, place, teacher, [f"{key}={value}" for key, value in options.items()])
        found, runs = Identified.load(place), read_runs([Path(teacher.place), place])[0]
        note = to_json(_compare(teacher, found, runs))
        write_atomically(place / NOTE, (json.dumps(note, indent=2, allow_nan=False) + "\n").encode())
        write_page(place / "report.html", found, runs[0], note)
    return Distillation(place, teacher.result, student, note, complaint)


def compose_student(teacher: Identified, options: Mapping[str, str]) -> DictConfig:
    """Return the student's configuration: the teacher's with another model and fit.

    Args:
        teacher: The drive to follow.
        options: `model`, and options of a run.

    Raises:
        ConfigError: An option is missing, unknown, invalid or shared with the teacher.
    """
    if "model" not in options:
        raise ConfigError(f"model is missing; give model=NAME, {closest('', list_choices('model'))}")
    for option in options:
        if option.partition(".")[0] in _SHARED:
            raise ConfigError(f"{option}: teacher and student share it; leave it out")
    chosen = {group: options[group] for group in _GROUPS if group in options}
    refuse_no_choice([f"{group}={name}" for group, name in chosen.items()])
    plain = _replace_choices(teacher, {"fit": "auto", "logger": _choose_logger(teacher)} | chosen)
    values = (read_value(f"{option}={value}") for option, value in options.items() if option not in chosen)
    config = OmegaConf.merge(plain, *values)
    assert isinstance(config, DictConfig)
    check_overrides(config, plain)
    config["teacher"] = str(Path(teacher.place).resolve())
    return config


def _replace_choices(teacher: Identified, choices: Mapping[str, str]) -> DictConfig:
    """Return the teacher's settings with some sections replaced by files of conf/; others, such as `scale`, stay.

    A simulated drive has neither noise nor outliers. Robust losses and short segments are not needed: segments are as
    long as the evaluation rollouts, and hold no more states in total than the teacher's.
    """
    settings = keep_caches_at_home(teacher.result["settings"])
    composed = compose_config(*(f"{group}={name}" for group, name in choices.items()))
    sections = {group: OmegaConf.to_container(composed[group], resolve=False) for group in choices}
    count, length = (settings["segments"][key] for key in ("count", "length"))
    longer = max(length, round(settings["evaluation"]["horizons"][0] / teacher.segments.timestep))
    own = {
        "loss": {
            **settings["loss"],
            "robust": "none",
            "refine": False,
            "continuity": 0.0,
            "impulse": False,
            "slow": 0.0,
        },
        "discretisation": False,  # the teacher was simulated with the same step
        "segments": {"count": None if count is None else max(1, count * length // longer), "length": longer},
        "resume": None,
    }
    config = create_literal({**settings, **own})
    for group in sections.keys() - own.keys():
        OmegaConf.update(config, group, sections[group], merge=False)
    return config


def _choose_logger(teacher: Identified) -> str:
    """Keep the teacher's logger if it writes plain files; others start programs, which the user has to request."""
    section = teacher.result["settings"].get("logger")
    target = section.get("_target_") if isinstance(section, Mapping) else None
    return "csv" if target == "frictionzoo.fit.loggers.Csv" else "tensorboard"


def _compare(teacher: Identified, student: Identified, runs: Sequence[Run]) -> dict[str, Any]:
    """Return the content of `distillation.json`: the teacher's folder, and the differences between both runs."""
    qpos, own = (run.curves.qpos for run in runs)
    taught, errors = (run.curves.test_mae for run in runs)
    kept = np.isfinite(qpos).all(axis=(1, 2)) & np.isfinite(own).all(axis=(1, 2))
    states, units = teacher.samples, UNITS[teacher.bench.joint_type]
    own_inputs = {name: getattr(student.samples, name) for name in student.model.inputs}
    laws = (teacher.model, states), (student.model, states._replace(**own_inputs))
    torques = [sliding_torque(np, evaluate_law(*law), states.qvel) for law in laws]
    rollouts, recorded = f"{kept.sum()} of {teacher.over}", f"{len(states.qvel)} recorded states of these"
    differences = (
        ("qpos", units["position"], rollouts, _rms((own - qpos)[kept]) if kept.any() else None),
        ("friction torque", units["torque"], recorded, _rms(torques[1] - torques[0])),
    )
    return {
        "teacher": str(Path(teacher.place).resolve()),
        "differences": [dict(zip(("quantity", "unit", "over", "rms"), d, strict=True)) for d in differences],
        "error": asdict(difference(errors, taught, resample(len(errors)))),
        "notes": _note(teacher.model, student.model),
    }


def _rms(difference: np.ndarray) -> float:
    return float(np.sqrt(np.square(difference).mean()))


def _note(teacher: FrictionModel, student: FrictionModel) -> list[str]:
    # Count all numbers of a model, including known ones.
    before, after = (sum(values.numel() for values in law.parameters()) for law in (teacher, student))
    if after <= before:
        return []
    return [f"{student.name} is not the simpler law: it has {after} parameters, {teacher.name} {before}."]
