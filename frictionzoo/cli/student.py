"""Distillation: fit another friction model (the student) to a run's drive (the teacher), and compare both."""

import sys
from collections.abc import Mapping
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from frictionzoo.api.comparison_files import write_comparison
from frictionzoo.api.identified import Identified
from frictionzoo.cli.job import run_job
from frictionzoo.cli.mistakes import NOT_IDENTIFIED
from frictionzoo.cli.overrides import refuse_no_choice
from frictionzoo.core.config import (
    check_overrides,
    compose_config,
    create_literal,
    keep_caches_at_home,
    list_choices,
    read_value,
)
from frictionzoo.core.errors import ConfigError, FitError, closest
from frictionzoo.core.output import RUN_FILES, claim, refuse_existing
from frictionzoo.core.telling import say
from frictionzoo.report.terminal import summarise, summarise_comparison

_GROUPS = ("model", "fit", "logger")  # configuration files that a student may choose
_SHARED = ("bench", "data", "scale", "evaluation", "resume", "experiment")  # always the teacher's


def distill(folder: Path, options: Mapping[str, str]) -> None:
    """Fit a model to a drive's rollouts under the training commands, and compare both on the test recordings.

    The student's folder is a run folder, with a comparison in `comparison/`. The options are `model`, `output` (a
    folder), and fit options of a run.

    Raises:
        FrictionzooError: The run or its recordings cannot be read, an option is invalid, or the teacher diverges. No
            files remain.
        SystemExit: The fit did not identify the drive.
    """
    teacher = Identified.load(folder)
    config = compose_student(teacher, {key: value for key, value in options.items() if key != "output"})
    name = options["model"]
    place = Path(options.get("output", folder / "distilled" / name))
    refuse_existing(place)
    with claim(place, "run", RUN_FILES, undone=True):
        student, complaint = run_job(config, name, place, teacher, [f"{key}={value}" for key, value in options.items()])
        compared = write_comparison([Path(teacher.place), place], place / "comparison")
    say("\n\n".join([summarise(student, place), summarise_comparison(compared, place / "comparison")]))
    if complaint:
        raise FitError(complaint)
    if student["not_identified"]:
        sys.exit(NOT_IDENTIFIED)


def compose_student(teacher: Identified, options: Mapping[str, str]) -> DictConfig:
    """Return the student's configuration: the teacher's with the `model` and other options of a run in `options`.

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

    A simulated drive has neither noise nor outliers, so robust losses and short segments are not needed: segments are
    as long as the evaluation rollouts, and hold no more states in total than the teacher's.
    """
    settings = keep_caches_at_home(teacher.result["settings"])
    composed = compose_config(*(f"{group}={name}" for group, name in choices.items()))
    sections = {group: OmegaConf.to_container(composed[group], resolve=False) for group in choices}
    count, length = (settings["segments"][key] for key in ("count", "length"))
    longer = max(length, round(settings["evaluation"]["horizons"][0] / teacher.segments.timestep))
    loss = {"robust": "none", "refine": False, "continuity": 0.0, "impulse": False, "slow": 0.0}
    replaced = {
        "loss": {**settings["loss"], **loss},
        "discretisation": False,  # the teacher was simulated with the same step
        "segments": {"count": None if count is None else max(1, count * length // longer), "length": longer},
        "resume": None,
    }
    config = create_literal({**settings, **replaced})
    for group in sections.keys() - replaced.keys():
        OmegaConf.update(config, group, sections[group], merge=False)
    return config


def _choose_logger(teacher: Identified) -> str:
    """Keep the teacher's logger if it writes plain files; others start programs, which the user has to request."""
    section = teacher.result["settings"].get("logger")
    target = section.get("_target_") if isinstance(section, Mapping) else None
    return "csv" if target == "frictionzoo.fit.loggers.Csv" else "tensorboard"
