"""Distillation: a run whose training segments are a fitted drive's rollouts, and its comparison with that drive."""

import sys
from collections.abc import Mapping
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from frictionzoo.api.comparison_files import write_comparison
from frictionzoo.api.identified import Identified
from frictionzoo.cli.job import run_job
from frictionzoo.cli.mistakes import NOT_IDENTIFIED
from frictionzoo.cli.overrides import refuse_no_choice
from frictionzoo.core import config as conf
from frictionzoo.core.errors import ConfigError, FitError, closest
from frictionzoo.core.output import RUN_FILES, claim, refuse_existing
from frictionzoo.core.telling import say
from frictionzoo.report.terminal import summarise, summarise_comparison

_GROUPS = ("model", "fit", "logger")  # configuration files that a student may choose
_SHARED = ("bench", "data", "scale", "evaluation", "resume", "experiment")  # always the teacher's
_EXACT = {"robust": "none", "refine": False, "continuity": 0.0, "impulse": False, "slow": 0.0}


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
    if student.not_identified:
        sys.exit(NOT_IDENTIFIED)


def compose_student(teacher: Identified, options: Mapping[str, str]) -> DictConfig:
    """Return the student's configuration: the teacher's settings, with the files and options that the user chose.

    A simulated drive has neither noise nor outliers, so robust losses and short segments are not needed: segments are
    as long as the evaluation rollouts, and hold no more states in total than the teacher's.

    Raises:
        ConfigError: An option is missing, unknown, invalid or shared with the teacher.
    """
    if "model" not in options:
        raise ConfigError(f"model is missing; give model=NAME, {closest('', conf.list_choices('model'))}")
    for option in options:
        if option.partition(".")[0] in _SHARED:
            raise ConfigError(f"{option}: teacher and student share it; leave it out")
    settings = conf.keep_caches_at_home(teacher.result.settings)
    # Other loggers start programs, which the user has to request.
    is_csv = "loggers.Csv" in str(settings.get("logger"))
    chosen = {"fit": "auto", "logger": "csv" if is_csv else "tensorboard"}
    chosen |= {group: options[group] for group in _GROUPS if group in options}
    choices = [f"{group}={name}" for group, name in chosen.items()]
    refuse_no_choice(choices)
    count, length = (settings["segments"][key] for key in ("count", "length"))
    longer = max(length, round(settings["evaluation"]["horizons"][0] / teacher.segments.timestep))
    count = None if count is None else max(1, count * length // longer)
    exact = {"loss": {**settings["loss"], **_EXACT}, "segments": {"count": count, "length": longer}}
    # The teacher was simulated with the same step: no discretisation error.
    plain = conf.create_literal({**settings, **exact, "discretisation": False, "resume": None})
    composed = conf.compose_config(*choices)
    for group in chosen:
        OmegaConf.update(plain, group, OmegaConf.to_container(composed[group], resolve=False), merge=False)
    config = conf.override(plain, {option: value for option, value in options.items() if option not in chosen})
    config["teacher"] = str(Path(teacher.place).resolve())
    return config
