"""A sweep of many jobs: one that fails leaves its reason and does not end the others."""

import json
import logging
import math
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from frictionzoo.output import write_atomically

_log = logging.getLogger(__name__)

FAILURE = "failure.json"
_RESULT = "result.json"
# Locked while a job runs, in whatever process; left behind, and no longer locked, by a job that was killed.
_RUNNING = ".running"


@dataclass(frozen=True)
class Failure:
    """A job of a sweep that brought no result to build on.

    Attributes:
        folder: The job's folder.
        model: The chosen model, as in conf/model.
        overrides: The job's options.
        reason: What went wrong, in one line.
    """

    folder: Path
    model: str
    overrides: tuple[str, ...]
    reason: str


class SweepFolder(Callback):
    """Hydra's callback by which the program learns its sweep's folder.

    Attributes:
        latest: The folder of the sweep that this process began last; None before the first.
    """

    latest: Path | None = None

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Remember the folder; have a Ray cluster of this machine listen on its loopback interface only."""
        SweepFolder.latest = Path(config.hydra.sweep.dir).absolute()
        # Read by Ray when it is imported; without it a node listens on all interfaces, whatever its address.
        if OmegaConf.select(config, "hydra.launcher.ray.init.address") == "local":
            os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"


def run_in_sweep(
    job: Callable[[], tuple[dict[str, Any], str | None]],
    folder: Path,
    model: str,
    overrides: Sequence[str],
    explain: Callable[[Exception], str | None],
) -> float:
    """Run one job of a sweep; whatever it raises becomes `failure.json` in its folder.

    Args:
        job: Returns what `result.json` holds, and a complaint if the fit diverged.
        folder: The job's folder; results of an earlier job in it are removed.
        model: The chosen model.
        overrides: The job's options.
        explain: One line for an error that a user can cause, None for an unexpected one.

    Returns:
        What a sweeper may minimise, see `objective_of`; infinite for a job that failed.

    Raises:
        OutputError: Not even `failure.json` can be written.
    """
    with FileLock(folder / _RUNNING):
        for name in (_RESULT, FAILURE):
            (folder / name).unlink(missing_ok=True)
        try:
            result, complaint = job()
        except Exception as error:
            foreseen = explain(error)
            result, complaint = None, foreseen or describe(error)
            content = {"model": model, "overrides": list(overrides), "reason": complaint}
            _log.error("%s: %s", folder.name, complaint, exc_info=None if foreseen else error)
            write_atomically(folder / FAILURE, f"{json.dumps(content, indent=2)}\n".encode())
        else:
            if complaint:
                _log.error("%s: %s", folder.name, complaint)
    (folder / _RUNNING).unlink()
    return math.inf if result is None or complaint else objective_of(result)


def objective_of(result: dict[str, Any]) -> float:
    """What a sweeper may minimise: the position error of open-loop rollouts of the training part [rad or m].

    Unlike the loss, it does not depend on how segments are cut or errors are weighted, so that jobs compare; and the
    test part stays unseen by what is chosen by it.

    Args:
        result: What `result.json` holds.

    Returns:
        The mean absolute error; infinite if a rollout diverged, because the mean leaves that one out.
    """
    train = result["metrics"]["train"]
    return math.inf if train["diverged"] else float(train["position_mae"])


def conclude_sweep(folder: Path) -> list[Failure]:
    """Look at what the jobs of a sweep left, in whatever processes and on whatever machines they ran.

    Waits for jobs that still run, as some do when their launcher gave up on another one.

    Args:
        folder: The sweep's folder.

    Returns:
        The jobs that failed, in their order: with a `failure.json`, with a fit that diverged, or with neither file
        because their process was killed.
    """
    names = (_RUNNING, FAILURE, _RESULT)
    folders = {path.parent for name in names for path in folder.rglob(name)}
    failures = [_judge(job) for job in sorted(folders, key=_natural)]
    return [failure for failure in failures if failure is not None]


def _judge(folder: Path) -> Failure | None:
    """The failure of the job in a folder, None if it did its work."""
    if (folder / _RUNNING).exists():
        with FileLock(folder / _RUNNING):
            pass
    if (folder / FAILURE).exists():
        saved = json.loads((folder / FAILURE).read_text())
        return Failure(folder, saved["model"], tuple(saved["overrides"]), saved["reason"])
    if not (folder / _RESULT).exists():
        model, overrides = _read_choices(folder)
        return Failure(folder, model, overrides, "no result: its process ended before it was done")
    result = json.loads((folder / _RESULT).read_text())
    if result["fit"]["stopped"] == "diverged":
        reason = f"fit diverged after {result['fit']['iterations']} iterations; {_RESULT} holds the best before that"
        return Failure(folder, result["model"], _read_choices(folder)[1], reason)
    return None


def _read_choices(folder: Path) -> tuple[str, tuple[str, ...]]:
    """Model and options of a job, from what Hydra wrote before it began."""
    saved = OmegaConf.load(folder / ".hydra" / "hydra.yaml")
    return OmegaConf.select(saved, "hydra.runtime.choices.model"), tuple(
        OmegaConf.select(saved, "hydra.overrides.task")
    )


def _natural(path: Path) -> list[str | int]:
    """Sorting key that puts job 10 after job 9."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", str(path))]


def describe(error: Exception) -> str:
    """One line for an unexpected error: its type and the first line of its message."""
    lines = str(error).strip().splitlines()
    return ": ".join([type(error).__name__, *lines[:1]])
