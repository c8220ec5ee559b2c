"""Runs and sweeps as they are watched: what their files say while they run, and when they have ended."""

import json
import os
import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from filelock import FileLock

from frictionzoo.cli import watch
from frictionzoo.fit.loggers import Csv, RunLogger, TensorBoard
from frictionzoo.watch import follow
from frictionzoo.watch.course import Course, Point
from frictionzoo.watch.jobs import Watched
from frictionzoo.watch.terminal import draw, say, tell_changes

ROW = {"loss": 0.5, "grad_norm": 2.0, "bench.armature": 0.04, "friction.damping/knee": 0.1}


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is new in a test is new to its end, also on a machine that is busy."""
    monkeypatch.setattr("frictionzoo.watch.jobs.QUIET", 500.0)


@pytest.fixture
def run(finished_run: Callable, tmp_path: Path) -> Path:
    """The folder of a finished run to which anything may be done."""
    return copy(finished_run("mujoco_default")[0], tmp_path / "run")


@pytest.fixture
def sweep(finished_run: Callable, tmp_path: Path) -> Path:
    """The same of a sweep."""
    return copy(finished_run("sweep")[0], tmp_path / "sweep")


def copy(folder: Path, place: Path, *without: str) -> Path:
    """A copy whose files are new, but for those of these names."""
    shutil.copytree(folder, place, ignore=lambda *_: without)
    age(place, 0.0)
    return place


def age(folder: Path, seconds: float = 1000.0) -> None:
    """Have nothing changed in a folder for so long."""
    for path in (folder, *folder.rglob("*")):
        os.utime(path, (time.time() - seconds,) * 2)


@pytest.mark.parametrize("logger", [TensorBoard(), Csv()], ids=["tensorboard", "csv"])
def test_a_course_is_read_while_it_is_written(tmp_path: Path, logger: RunLogger) -> None:
    course = Course(tmp_path)
    assert course.look() == Point()
    record = logger.start(tmp_path, {"model": "mujoco_default"})
    assert course.look() == Point()
    for step in range(3):
        record.log_metrics({**ROW, "loss": 1.0 / (1 + step)}, step)
        record.save()
        point = course.look()
        assert point.iterations == step + 1 and point.loss == pytest.approx(1.0 / (1 + step))
        assert point.parameters == pytest.approx({"bench.armature": 0.04, "friction.damping/knee": 0.1})
    # What a run says of its end is no iteration; what goes on begins anew.
    record.log_metrics({"MAE/test_position": 1.0, "identified/bench.armature": 1.0}, 3)
    record.save()
    assert course.look() == point
    record = logger.start(tmp_path, {"model": "mujoco_default"})
    record.log_metrics(ROW, 0)
    record.save()
    assert course.look().iterations == 1


def test_a_finished_run_shows_what_it_found(run: Path) -> None:
    watched = Watched(run)
    (job,) = watched.look()
    result = json.loads((run / "result.json").read_text())
    assert watched.is_over([job]) and job.state == "finished"
    assert say(job).startswith(f"run: finished: {result['fit']['iterations']} iterations, loss ")
    assert result["verdict"]["grade"] in say(job)
    lines = "\n".join(draw([job], 100, 100))
    for parameter in result["parameters"]:
        name = f"  {parameter['owner']}.{parameter['name']} {parameter['value']:.4g} ("
        assert (name in lines) == parameter["identified"]


def test_a_run_without_a_result_runs_failed_or_was_stopped(run: Path) -> None:
    (run / "result.json").unlink()
    watched = Watched(run)
    (job,) = watched.look()  # its files are new
    saved = Course(run).look()
    assert (job.state, job.model, job.point) == ("running", "mujoco_default", saved)
    assert saved.iterations > 1 and f"iteration {saved.iterations} of 100" in say(job)
    age(run)
    (job,) = watched.look()
    assert job.state == "stopped" and f"resume={run}" in say(job) and watched.is_over([job])
    with FileLock(run / ".running"):
        age(run)
        assert [job.state for job in watched.look()] == ["running"]
    (run / "failure.json").write_text(json.dumps({"model": "lugre", "reason": "no good", "overrides": []}))
    (job,) = watched.look()
    assert say(job).endswith("no good") and job.state == "failed"


def test_a_sweep_is_over_once_it_has_compared_its_jobs(sweep: Path) -> None:
    watched = Watched(sweep)
    jobs = watched.look()
    assert [job.name for job in jobs] == ["0_baseline", "1_coulomb_smooth"] and watched.is_over(jobs)
    shutil.rmtree(sweep / "comparison")
    assert not watched.is_over(jobs)  # between two jobs
    age(sweep)
    assert watched.is_over(jobs)


def test_a_small_terminal_shows_what_runs(sweep: Path) -> None:
    (sweep / "0_baseline" / "result.json").unlink()
    jobs = Watched(sweep).look()
    whole = draw(jobs, 1000, 1000)
    assert whole[0] == "2 jobs: 1 finished, 1 running" and not any("…" in line for line in whole)
    small = draw(jobs, 40, 6)
    assert len(small) < 6 and max(map(len, small)) < 40
    assert small[1].startswith("0_baseline: running") and small[-1].startswith("and 1 more")


def test_it_waits_tells_changes_and_ends(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "empty").mkdir()
    steps = iter(
        [
            lambda: copy(run, tmp_path / "empty" / "run", "result.json"),
            lambda: None,
            lambda: shutil.copy(run / "result.json", tmp_path / "empty" / "run"),
        ]
    )
    monkeypatch.setattr(follow.time, "sleep", lambda _: next(steps)())
    watch.main([str(tmp_path / "empty")])
    nothing, running, finished = capsys.readouterr().out.splitlines()
    assert nothing == "no run in it yet"
    assert running.startswith("run: running: iteration ") and "| bench.armature 0." in running
    assert finished.startswith("run: finished: ")


def test_a_terminal_is_drawn_in_place(
    sweep: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    (sweep / "1_coulomb_smooth" / "result.json").rename(sweep / "kept.json")
    kept = sweep / "kept.json"
    monkeypatch.setattr(follow.time, "sleep", lambda _: kept.rename(sweep / "1_coulomb_smooth" / "result.json"))
    shutil.rmtree(sweep / "comparison")
    monkeypatch.setattr("frictionzoo.watch.jobs.ABANDONED", -1.0)
    watch.main([str(sweep)])
    first, second = capsys.readouterr().out.split("\x1b[J")
    *lines, up = first.split("\n")
    assert up == f"\x1b[{len(lines)}A\r" and max(map(len, lines)) < 60
    assert "running" in lines[0] and second.startswith("2 jobs: 2 finished\n")


@pytest.mark.usefixtures("interruptible")
def test_how_it_ends(run: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SystemExit) as ended:
        watch.main([str(run / "nowhere")])
    assert ended.value.code == 2 and capsys.readouterr().err.startswith(f"frictionzoo: {run}/nowhere: no such folder, ")
    (run / "result.json").unlink()
    watch.main(["--once", str(run)])
    assert capsys.readouterr().out.startswith("1 job: 1 running\nrun: running: ")

    def interrupt(_: float) -> None:
        os.kill(os.getpid(), 2)

    monkeypatch.setattr(follow.time, "sleep", interrupt)
    with pytest.raises(SystemExit) as ended:
        watch.main([str(run)])
    assert ended.value.code == 130
    assert capsys.readouterr().err == "frictionzoo: stopped by SIGINT; the watched jobs continue\n"
    age(run)
    with pytest.raises(SystemExit) as ended:
        watch.main([str(run)])
    assert ended.value.code == 2


def test_a_result_that_cannot_be_read_is_told(run: Path) -> None:
    (run / "result.json").write_text("{")
    (job,) = Watched(run).look()
    assert job.state == "failed" and "not JSON" in job.reason
    assert tell_changes([job], [job]) == []
