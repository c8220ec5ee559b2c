"""State of the jobs in a folder."""

import contextlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from frictionzoo.core.errors import RunError
from frictionzoo.core.jobs import find_runs, read_begun, read_failure, read_json, read_model
from frictionzoo.core.output import FAILURE, RESULT, RUNNING, is_lock
from frictionzoo.watch.course import Course, Point

AT_WORK = ("starting", "running")
QUIET = 10.0  # time without a file change after which the run's lock is checked [s]
ABANDONED = 60.0  # time without a file change after which a sweep without active jobs is over, compared or not [s]


@dataclass(frozen=True)
class Job:
    """State of a job.

    Attributes:
        name: Folder of the job, relative to the watched folder.
        model: Name of the model; empty if unknown.
        state: `starting`, `running`, `finished`, `failed`, or `stopped`: ended without a result or a reason.
        total: Largest number of iterations; None if the options do not set it.
        point: Progress of the fit; empty for a finished job.
        reason: Why it failed, or how to resume it.
        result: Content of its `result.json`; empty before it exists.
    """

    name: str
    model: str
    state: str
    total: int | None = None
    point: Point = field(default_factory=Point)
    reason: str = ""
    result: Any = field(default_factory=dict)


class Watched:
    """Watched folder, read repeatedly.

    Args:
        folder: Folder of a run or of a sweep, or a folder that contains runs.

    Raises:
        RunError: There is no such folder.
    """

    def __init__(self, folder: Path) -> None:
        if not folder.is_dir():
            raise RunError(f"{folder}: no such folder, expected that of a run or of a sweep; name one")
        self.folder = folder
        self._courses: dict[Path, Course] = {}
        self._begun: dict[Path, tuple[str, int | None]] = {}
        self._ended: dict[Path, Job] = {}

    def look(self) -> list[Job]:
        """Return the current state of all jobs, in order; an empty list if no run has begun."""
        try:
            return [self._see(run) for run in find_runs(self.folder)]
        except RunError:
            return []

    def is_over(self, jobs: Sequence[Job]) -> bool:
        """Return whether no job runs, and every sweep has compared its jobs or has been inactive for long."""
        if not jobs or any(job.state in AT_WORK for job in jobs):
            return False
        sweeps = [path.parent for path in self.folder.rglob("multirun.yaml")]
        return all(map(_has_ended, sweeps))

    def _see(self, run: Path) -> Job:
        if job := self._ended.get(run):
            if job.state != "finished" or (run / RESULT).exists():  # otherwise it runs again
                return job
            del self._ended[run]
        job = self._read(run)
        if job.state in ("finished", "failed"):
            self._ended[run] = job
        return job

    def _read(self, run: Path) -> Job:
        name = str(run.relative_to(self.folder)) if run != self.folder else run.resolve().name
        try:
            if (run / RESULT).exists():
                return _finished(name, read_json(run / RESULT))
            if (run / FAILURE).exists() and (failure := read_failure(run)):
                return Job(name, failure.model, "failed", reason=failure.reason, point=self._course(run).look())
        except (RunError, KeyError, TypeError) as error:
            return Job(name, "", "failed", reason=f"{RESULT} or {FAILURE} cannot be read: {error}")
        if run not in self._begun:
            total = read_begun(run, "config", "fit", "iterations")
            self._begun[run] = read_model(run), total if isinstance(total, int) else None
        model, total = self._begun[run]
        point, kept = self._course(run).look(), (run / "checkpoints" / "last.ckpt").exists()
        if _is_alive(run):
            return Job(name, model, "running" if point.iterations else "starting", total, point)
        return Job(
            name,
            model,
            "stopped",
            total,
            point,
            f"no result; go on with resume={run}" if kept else "no result; nothing is kept",
        )

    def _course(self, run: Path) -> Course:
        return self._courses.setdefault(run, Course(run))


def _finished(name: str, result: Mapping[str, Any]) -> Job:
    diverged = result["fit"]["stopped"] == "diverged"
    reason = f"the fit diverged; {RESULT} holds the best before that" if diverged else ""
    return Job(name, result["model"], "failed" if diverged else "finished", reason=reason, result=result)


def _is_alive(run: Path) -> bool:
    """Return whether a process works in the run's folder: its files change, or it holds the lock."""
    if _rests(run) < QUIET:
        return True
    if not is_lock(run / RUNNING):
        return False
    # Only after a quiet period: holding the lock keeps other processes from starting here for an instant.
    try:
        with FileLock(run / RUNNING, timeout=0):
            return False
    except Timeout:
        return True
    except OSError:  # a read-only folder
        return True


def _has_ended(sweep: Path) -> bool:
    """Return whether a sweep's comparison is newer than all its results, or the sweep is abandoned."""
    compared = sweep / "comparison" / "comparison.json"
    ended = compared.stat().st_mtime if compared.exists() else 0.0
    return all(path.stat().st_mtime <= ended for path in sweep.rglob(RESULT)) or _rests(sweep) > ABANDONED


def _rests(folder: Path) -> float:
    """Return the time since the last change in a folder, down to the contents of its subfolders [s]."""
    latest = 0.0
    for path in (folder, *folder.glob("*"), *folder.glob("*/*")):
        with contextlib.suppress(OSError):  # the file was removed
            latest = max(latest, path.stat().st_mtime)
    return time.time() - latest
