"""Command line: `python -m frictionzoo.run model=coulomb_stribeck` identifies a drive."""

import contextlib
import logging
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from frictionzoo.cli.explain import missing_plugin
from frictionzoo.cli.mistakes import NOT_IDENTIFIED, fail, mistakes_in_one_line, outlive_readers, stoppable
from frictionzoo.cli.overrides import choices_of, given_to_hydra, quote_values, refuse_no_choice
from frictionzoo.cli.resume import (
    SavedRequest,
    nothing_of_a_refused_run,
    record_job,
    recorded,
    restore_overrides,
    restore_settings,
    say_how_a_run_goes_on,
    say_how_a_sweep_goes_on,
    write_record,
)
from frictionzoo.cli.sweep import SweepFolder, conclude_sweep, describe, objective_of, run_in_sweep
from frictionzoo.core.build import build
from frictionzoo.core.config import CONF_DIR, check_overrides, compose_config, prepare_hydra, resolve
from frictionzoo.core.output import LOGGERS, RUN_FILES, occupy
from frictionzoo.core.telling import name_job, say, tell
from frictionzoo.core.threads import limit_threads, threads_each
from frictionzoo.data.source import Source
from frictionzoo.result.types import Result


@hydra.main(version_base="1.3", config_path=str(CONF_DIR), config_name="config")
def _job(config: DictConfig) -> float:
    """Run one job for Hydra; return the objective for a sweeper."""
    hydra_config = HydraConfig.get()
    model, folder = hydra_config.runtime.choices["model"], Path(hydra_config.runtime.output_dir)
    record, inside = record_job(config), {hydra_config.runtime.choices["logger"]} & LOGGERS
    # An interrupted run has the same record.
    resumed, config.resume = config.resume, None

    def begin() -> tuple[Result, str | None]:
        write_record(record)
        return _identify(config, folder)

    if hydra_config.mode == RunMode.MULTIRUN:
        options, number = hydra_config.overrides.task, int(hydra_config.job.num) + 1
        _show_job(number, model)
        finished = resolve(config) if resumed else None
        # Processes of a launcher have no other handler.
        outlive_readers()
        with stoppable():
            return run_in_sweep(begin, folder, model, options, finished, inside)
    is_named = resumed is not None or any("hydra.run.dir=" in option for option in hydra_config.overrides.hydra)
    # Errors end here, because Hydra adds a line to an error that passes through it.
    with (
        mistakes_in_one_line(lambda: say_how_a_run_goes_on(folder)),
        nothing_of_a_refused_run([] if is_named else [folder, *folder.parents[:2]]),
        occupy(folder, wait=False, names=RUN_FILES, inside=inside),
        # A resumed run keeps its first record, because the new command may be a mistake.
        contextlib.nullcontext() if resumed else recorded(record),
    ):
        result, complaint = _identify(config, folder, goes_on=resumed is not None)
    if complaint:
        fail(complaint)
    if result.not_identified:
        sys.exit(NOT_IDENTIFIED)
    return objective_of(result)


def _show_job(number: int, model: str) -> None:
    """Show the progress of a sweep's job; in a launcher's process show none, because the sweep shows its own."""
    name_job(f"job {number} of {SweepFolder.count}, {model}" if SweepFolder.count else None)
    logger = logging.getLogger("frictionzoo")
    if not SweepFolder.count and logger.level == logging.INFO and sys.stderr.isatty():
        logger.setLevel(logging.WARNING)


def _identify(config: DictConfig, folder: Path, goes_on: bool = False) -> tuple[Result, str | None]:
    hydra_config = HydraConfig.get()
    choices, options = hydra_config.runtime.choices, hydra_config.overrides.task
    plain = compose_config(*choices_of(choices))
    check_overrides(config, plain)
    if goes_on:
        config, options = restore_settings(folder, config, plain, options)
    alone = hydra_config.mode == RunMode.RUN or choices["hydra/launcher"] == "basic"
    limit_threads(config.threads if alone else threads_each(config.threads))
    settings = resolve(config)
    if not goes_on:
        SavedRequest(choices, options, settings).save(folder)
    model = choices["model"]
    tell(f"reading bench and recordings ({model} on {settings['data'].get('name', 'data')})")
    build(settings["data"], Source).find()
    # Imported late: --help and mistakes do not wait, and torch and JAX see the thread limit.
    from frictionzoo.bench.given import Given

    given = Given.read(settings)
    tell("loading torch and JAX")
    from frictionzoo.cli.job import run_job
    from frictionzoo.report.terminal import summarise

    with _quiet_writers():
        result, complaint = run_job(config, model, folder, options=options, given=given)
    if hydra_config.mode == RunMode.RUN or SweepFolder.count:
        say(summarise(result, folder))
    return result, complaint


@contextlib.contextmanager
def _quiet_writers() -> Iterator[None]:
    """Print nothing about a thread that a full disk ended: TensorBoard raises its error at the next write."""
    hook = threading.excepthook
    threading.excepthook = lambda thread: None if isinstance(thread.exc_value, OSError) else hook(thread)
    try:
        yield
    finally:
        threading.excepthook = hook


def main(arguments: Sequence[str] | None = None) -> None:
    """Run `python -m frictionzoo.run`; `arguments` default to `sys.argv`.

    A user's mistake gives one line on standard error and status 2; a sweep prints one line for each failed job after
    the last one. A fit that did not identify the drive gives status 3, Ctrl-C one line and status 130, SIGTERM 143.
    """
    prepare_hydra()
    with mistakes_in_one_line():
        overrides = restore_overrides(quote_values(sys.argv[1:] if arguments is None else arguments))
        refuse_no_choice(overrides)
    with SweepFolder.noted() as begun, mistakes_in_one_line(lambda: say_how_a_sweep_goes_on(*begun), overrides):
        with given_to_hydra(overrides):
            complaint = _run_jobs(begun)
        for folder in begun:
            _conclude(folder, complaint)


def _run_jobs(begun: Sequence[Path]) -> str | None:
    """Run all jobs; return a one-line message if a sweep ended early."""
    try:
        _job()
    except Exception as error:
        refused = isinstance(error, HydraException | OmegaConfBaseException) or missing_plugin(error)
        if refused or not begun:
            raise
        return f"the sweep ended early ({describe(error)}); jobs that had not begun are not listed"
    return None


def _conclude(sweep: Path, complaint: str | None) -> None:
    """Compare the jobs of a sweep, print its failures, and exit with its status."""
    name_job("")
    tell("comparing the jobs")
    comparison, text, complaints = conclude_sweep(sweep)
    say(text)
    if complaint:
        complaints.append(complaint)
    if complaints:
        fail(*complaints)
    if comparison and comparison.recommendation and comparison.recommendation.not_identified:
        sys.exit(NOT_IDENTIFIED)
