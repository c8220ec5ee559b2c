"""One job of the command line: from a configuration to the files of an identified drive."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from frictionzoo import __version__
from frictionzoo.api.identified import Identified
from frictionzoo.bench.given import Given
from frictionzoo.core.build import build
from frictionzoo.core.config import list_options, resolve
from frictionzoo.core.output import RUN_FILES
from frictionzoo.core.telling import tell
from frictionzoo.data.cache import digest
from frictionzoo.fit.loggers import RunLogger
from frictionzoo.fit.loop import FitFiles
from frictionzoo.identification import Parts, Problem, solve
from frictionzoo.identification.commands import Origin
from frictionzoo.report.terminal import summarise_in_markdown
from frictionzoo.result.record import describe_data, pick_metrics
from frictionzoo.result.types import Result


def run_job(
    config: DictConfig,
    name: str,
    folder: Path,
    teacher: Identified | None = None,
    options: Sequence[str] = (),
    given: Given | None = None,
) -> tuple[Result, str | None]:
    """Identify a drive with the friction model `name`, and write the run's files.

    Rollouts of a `teacher` replace the measured training segments. `options`, as `KEY=VALUE`, enter the commands that
    the run suggests. `given` has the bench and recordings if they have been read already.

    Returns:
        Content of `result.json`, and a one-line message if the fit diverged.

    Raises:
        FrictionzooError: The input is at fault.
    """
    settings = resolve(config)
    logger = build(settings["logger"], RunLogger)
    parts = Parts.from_settings(settings, given, folder)
    tell("compiling, verifying the simulation in MuJoCo C")
    with parts.computing() as device:
        problem = Problem.pose(parts)
        if teacher:
            problem = problem.following(teacher)
        record = FitFiles(folder, logger, _identify(name, problem), _list_hyperparameters(name, problem))
        origin = Origin.of_run(options, folder, teacher.place if teacher else None)
        drive = Identified.of(solve(problem, name, device, record=record, origin=origin))
    tell(f"writing {folder}")
    result = drive.save(folder)
    figures = [folder / name for name in RUN_FILES if name.startswith("figures/") and (folder / name).exists()]
    logger.finish(result.fit.iterations, pick_metrics(result), figures, summarise_in_markdown(result, folder))
    return result, drive.complaint


def _identify(name: str, problem: Problem) -> dict[str, str]:
    """Return the properties that a checkpoint must share with this run."""
    settings, segments = problem.settings, problem.segments
    sections = {key: settings[key] for key in ("bench", "model", "fit", "segments", "loss", "seed", "dtype")}
    return {
        "frictionzoo": __version__,
        "model": name,
        "data": describe_data(problem.dataset).sha256,
        "engine": problem.drive.engine.name,
        **{section: json.dumps(value, sort_keys=True) for section, value in sections.items() if section != "model"},
        "model settings": json.dumps(sections["model"], sort_keys=True),
        "chunk": str(settings["loop"]["chunk"]),
        # Measured states after cleaning, and payloads.
        "training samples": digest(
            {n: getattr(segments, n) for n in ("qpos", "qvel", "loads")} | segments.signals.named()
        ),
    }


def _list_hyperparameters(name: str, problem: Problem) -> dict[str, Any]:
    """Return the choices of files and the options that can change the result, by their names in conf/."""
    chosen = {"model": name, "data": problem.dataset.name, "fit": problem.fit.name}
    options = dict(list_options(problem.settings))
    indifferent = ("resume", "compilation_cache", "loop.progress", "logger.")
    # A choice implies bounds and scales, which would hide it among the few differences that TensorBoard shows.
    implied = ("_target_", ".default", ".low", ".high", ".scale")
    return chosen | {k: v for k, v in options.items() if not k.startswith(indifferent) and not k.endswith(implied)}
