"""Sweeps: a job that fails records its reason and does not stop the others."""

import contextlib
import json
import logging
import math
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from filelock import FileLock
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from frictionzoo import __version__
from frictionzoo.cli.explain import explain
from frictionzoo.cli.mistakes import mistakes_in_one_line
from frictionzoo.core.errors import OutputError, RunError
from frictionzoo.core.jobs import find_runs, read_failure, read_json, read_record
from frictionzoo.core.manifest import FileState, Manifest, saying
from frictionzoo.core.output import FAILURE, RESULT, RUN_FILES, RUNNING, is_lock, occupy, to_json, write_json
from frictionzoo.core.telling import tell
from frictionzoo.result.comparison.types import Comparison
from frictionzoo.result.types import Result

_log = logging.getLogger(__name__)
# Hydra creates the callback, so data passes to this program only through a context variable.
_begun: ContextVar[list[Path]] = ContextVar("begun")
_SWEEP_RECORD = "multirun.yaml"  # Hydra's


class SweepFolder(Callback):
    """Hydra callback that reports the sweep's folder to the program.

    Attributes:
        count: Number of jobs of the sweep that this process began; 0 in the processes of a launcher.
    """

    count: int = 0

    @staticmethod
    @contextlib.contextmanager
    def noted() -> Iterator[list[Path]]:
        """Yield a list to which a sweep adds its folder when it begins; it stays empty for a single job."""
        token = _begun.set([])
        try:
            yield _begun.get()
        finally:
            _begun.reset(token)

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Record the sweep's folder; restrict a local Ray cluster to the loopback interface."""
        folder = Path(config.hydra.sweep.dir).absolute()
        with mistakes_in_one_line():  # Hydra would only warn
            manifest = Manifest(folder, "sweep")
            manifest.refuse([_SWEEP_RECORD])
            with saying(folder):
                manifest.record({_SWEEP_RECORD: FileState.of(OmegaConf.to_yaml(config).encode())})
        _begun.get([]).append(folder)
        SweepFolder.count = _count_jobs(config)
        tell(f"sweep of {SweepFolder.count} jobs", lambda: _describe_jobs(folder))
        # Ray reads this on import; without it, a node listens on all interfaces, whatever its address.
        if OmegaConf.select(config, "hydra.launcher.ray.init.address") == "local":
            os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"


def _count_jobs(config: DictConfig) -> int:
    """Return the number of jobs in a grid, or that a search proposes."""
    parser = OverridesParser.create(GlobalHydra.instance().config_loader())
    overrides = parser.parse_overrides([*config.hydra.overrides.task])
    grid = (len([*each.sweep_string_iterator()]) for each in overrides if each.is_discrete_sweep())
    return OmegaConf.select(config, "hydra.sweeper.n_trials") or math.prod(grid)


def _describe_jobs(folder: Path) -> str:
    """Return how many jobs of a sweep have ended, and the folders of those that run."""
    ended = sum(1 for name in (RESULT, FAILURE) for _ in folder.glob(f"*/{name}"))
    return ", ".join([f"{ended} done", *sorted(f"{path.parent.name} runs" for path in folder.glob(f"*/{RUNNING}"))])


def run_in_sweep(
    job: Callable[[], tuple[Result, str | None]],
    folder: Path,
    model: str,
    overrides: Sequence[str],
    finished: Mapping[str, Any] | None = None,
    inside: Collection[str] = (),
) -> float:
    """Run one job of a sweep, and write an error that it raises to `failure.json` in its folder, if possible.

    If another process works in the folder, wait for its end. Then remove the results of an earlier job.

    Args:
        job: Returns the content of `result.json`, and a message if the fit diverged.
        folder: The job's folder.
        model: Name of the model.
        overrides: The job's options.
        finished: The job's settings, if an existing `result.json` with equal settings is to be kept; else None.
        inside: Subfolders that the job's logger writes.

    Returns:
        The objective for a sweeper, see `objective_of`; infinite for a failed job.

    Raises:
        OutputError: The job's folder contains conflicting files of other origin.
    """
    with occupy(folder, wait=True, names=RUN_FILES, inside=inside) as manifest:
        if finished is not None and (result := _read_finished(folder, finished)):
            _log.info("%s: result exists", folder.name)
            return math.inf if result.fit.stopped == "diverged" else objective_of(result)
        for name in (RESULT, FAILURE):
            manifest.remove(name)
        try:
            result, complaint = job()
        except Exception as error:
            foreseen = explain(error)
            result, complaint = None, foreseen or describe(error)
            content = {"model": model, "overrides": list(overrides), "reason": complaint}
            _log.error("%s: %s", folder.name, complaint, exc_info=None if foreseen else error)
            # On a full disk only the log reports it: Hydra would print an error from here in extra lines.
            with contextlib.suppress(OutputError):
                write_json(folder / FAILURE, content)
        else:
            if complaint:
                _log.error("%s: %s", folder.name, complaint)
    return math.inf if result is None or complaint else objective_of(result)


def _read_finished(folder: Path, settings: Mapping[str, Any]) -> Result | None:
    """Return the content of a job's `result.json` if this version made it with these settings, else None."""
    try:
        result = read_record(folder / RESULT, Result)
    except RunError:
        return None
    same = result.settings == json.loads(json.dumps(to_json(settings)))
    return result if same and result.versions.frictionzoo == __version__ else None


def objective_of(result: Result) -> float:
    """Return the objective for a sweeper: the mean position error of open-loop training rollouts [rad or m].

    It uses no test data, and does not depend on segments and weights as the loss does, so jobs are comparable. It is
    infinite if a rollout diverged, because the mean ignores diverged rollouts.
    """
    train = result.metrics.train
    return math.inf if train.diverged or train.position_mae is None else float(train.position_mae)


def conclude_sweep(folder: Path) -> tuple[Comparison | None, str, list[str]]:
    """Compare the jobs of a sweep from their files, wherever they ran, and write the comparison to `comparison/`.

    Wait for jobs that still run, as some do after their launcher gave up on another one.

    Returns:
        Content of `comparison.json`, or None if nothing can be compared; the text for the user; and one line for each
        failed job: with a `failure.json`, with a diverged fit, or without a file because its process was killed.

    Raises:
        OutputError: The comparison cannot be written.
    """
    for path in filter(is_lock, folder.rglob(RUNNING)):
        with FileLock(path):
            pass
    # Imported late: neither --help nor a mistake waits for it.
    from frictionzoo.api.comparison_files import write_comparison
    from frictionzoo.report.terminal import summarise_comparison

    complaints: list[str] = []
    try:
        complaints += [f"{run}: {reason}" for run in find_runs(folder) if (reason := _complaint(run))]
        comparison = write_comparison([folder], folder / "comparison")
    except RunError as error:
        return None, f"no comparison: {error}", complaints
    return comparison, summarise_comparison(comparison, folder / "comparison"), complaints


def _complaint(folder: Path) -> str | None:
    """Return why the job in a folder failed; None if it did not."""
    if failure := read_failure(folder):
        return failure.reason
    fit = read_json(folder / RESULT).get("fit", {})
    if fit.get("stopped") == "diverged":
        return f"fit diverged after {fit['iterations']} iterations; {RESULT} holds the best values before that"
    return None


def describe(error: Exception) -> str:
    """Return an error's type and the first line of its message."""
    lines = str(error).strip().splitlines()
    return ": ".join([type(error).__name__, *lines[:1]])
