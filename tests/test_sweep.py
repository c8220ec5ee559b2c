"""Sweeps: a failing job does not end the others, launchers agree, jobs share cores."""

import json
import math
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import psutil
import pytest
from conftest import LAUNCHERS, RUNS, changed, make_run
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from frictionzoo import __version__
from frictionzoo.bench.given import Given
from frictionzoo.cli.job import run_job as run_real_job
from frictionzoo.cli.sweep import SweepFolder, _complaint, conclude_sweep, run_in_sweep
from frictionzoo.core.config import CONF_DIR, prepare_hydra
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.jobs import read_record
from frictionzoo.core.manifest import MANIFEST, Manifest
from frictionzoo.core.output import to_json, write_atomically
from frictionzoo.core.threads import count_cores, limit_threads
from frictionzoo.result.types import Result
from frictionzoo.result.verdict import DO_NOT_USE

ROOT = Path(__file__).parent.parent
SWEEP = ("-m", "hydra.sweep.dir=sweep")
pytestmark = pytest.mark.usefixtures("in_haste")
DONE = changed(make_run(0, "baseline").result, metrics={"train": {"position_mae": 0.25, "diverged": 0}})


def complaints(err: str) -> list[str]:
    return [line for line in err.splitlines() if line.startswith("frictionzoo: ")]


def read_result(folder: Path) -> dict:
    """Everything in `result.json` that a repetition has to repeat: not times, nor the sweep's folder in commands."""
    result = json.loads((folder / "result.json").read_text())
    assert result.pop("timing")
    verdict = result["verdict"]
    named = f"{folder.parent.name}/{folder.name}"
    commands = [row["command"] for row in verdict["commands"]]
    assert any(named in command for command in commands) or verdict["grade"] == DO_NOT_USE
    return result | {"verdict": verdict | {"commands": [command.replace(named, "RUN") for command in commands]}}


def read_comparison(folder: Path) -> dict:
    """Everything in `comparison.json` that a repetition has to repeat."""
    comparison = json.loads((folder / "comparison" / "comparison.json").read_text())
    assert [run.pop("timing") for run in comparison["runs"]]
    return comparison


def test_a_failing_job_does_not_end_the_others(call, tiny, tmp_path, finished_run, monkeypatch):
    jobs = ["0_baseline", "1_neural_friction", "2_coulomb_smooth"]
    done = dict(zip(("baseline", "coulomb_smooth"), sorted(finished_run("sweep")[0].glob("?_*")), strict=True))

    def run_job(
        config: DictConfig, name: str, folder: Path, options: Sequence[str], given: Given
    ) -> tuple[Result, str | None]:
        """The job itself where it fails, and otherwise the results of one that was done before."""
        if name not in done:
            return run_real_job(config, name, folder, options=options, given=given)
        shutil.copytree(done[name], folder, dirs_exist_ok=True)
        return read_record(folder / "result.json", Result), None

    monkeypatch.setattr("frictionzoo.cli.job.run_job", run_job)
    # Most of a comparison's time.
    monkeypatch.setattr("frictionzoo.report.comparison_plots.write_figures", lambda *_: None)
    finished = call(*SWEEP, *tiny, "fit=lm", "fit.iterations=3", "model=baseline,neural_friction,coulomb_smooth")
    assert finished.status == 2 and SweepFolder.count == len(jobs)
    assert [(tmp_path / "sweep" / job / "result.json").exists() for job in jobs] == [True, False, True]
    failure = json.loads((tmp_path / "sweep" / jobs[1] / "failure.json").read_text())
    assert failure["model"] == "neural_friction"
    assert {"fit=lm", "model=neural_friction"} <= set(failure["overrides"])
    assert failure["reason"].startswith("fit=lm: ") and failure["reason"].endswith("use fit=adam")
    assert complaints(finished.err) == [f"frictionzoo: {tmp_path / 'sweep' / jobs[1]}: {failure['reason']}"]
    assert "Traceback" not in finished.err
    assert not [path for path in tmp_path.rglob("*") if path.name == ".running"]
    comparison = json.loads((tmp_path / "sweep" / "comparison" / "comparison.json").read_text())
    assert sorted(run["label"] for run in comparison["runs"]) == ["baseline", "coulomb_smooth"]
    assert comparison["failures"] == [{"run": jobs[1], "model": "neural_friction", "reason": failure["reason"]}]
    assert f"failed: {jobs[1]}: {failure['reason']}" in finished.out and "recommended: " in finished.out
    assert (tmp_path / "sweep" / "comparison" / "comparison.html").exists()


def test_a_diverged_fit_has_failed_and_other_rollouts_are_no_mistake(finished_run: Callable, tmp_path: Path) -> None:
    folder = shutil.copytree(finished_run("sweep")[0], tmp_path / "sweep", ignore=lambda *_: ["comparison"])
    path = folder / "1_coulomb_smooth" / "result.json"
    result = json.loads(path.read_text())
    path.write_text(json.dumps(result | {"fit": result["fit"] | {"stopped": "diverged"}}))
    complaint = _complaint(path.parent)
    assert complaint is not None and complaint.startswith("fit diverged after 3 iterations; result.json holds the best")
    result["evaluation"]["sha256"], result["settings"]["evaluation"]["seed"] = 64 * "0", 1
    path.write_text(json.dumps(result))
    _, text, complaints = conclude_sweep(folder)
    assert text.startswith("no comparison: ") and "evaluation.seed=1, expected 0 as in" in text
    assert complaints == [] and not (folder / "comparison").exists()


@pytest.mark.parametrize("override", ["model=baseline,coulomb_smoth", "~segments.cuont"])
def test_what_does_not_compose_is_refused_before_any_job(call: Callable, tmp_path: Path, override: str) -> None:
    finished = call(*SWEEP, "seed=0,1", override)
    assert finished.status == 2
    assert finished.err == complaints(finished.err)[0] + "\n"
    assert not list(tmp_path.rglob("result.json")) and not list(tmp_path.rglob("failure.json"))


def test_a_plugin_that_is_not_installed_is_named(call: Callable) -> None:
    target = "hydra.launcher._target_=hydra_plugins.hydra_absent_launcher.launcher.Absent"
    finished = call(*SWEEP, "seed=0,1", target)
    assert finished.status == 2
    assert finished.err == complaints(finished.err)[0] + "\n"
    assert "pip install 'frictionzoo[absent]'" in finished.err


def list_files(folder: Path) -> list[str]:
    return [name for name in os.listdir(folder) if name != MANIFEST]


def fail() -> tuple[Result, None]:
    raise ZeroDivisionError("by zero\nand more")


def test_an_unexpected_error_is_recorded_and_its_traceback_logged(tmp_path, caplog):
    value = run_in_sweep(fail, tmp_path, "baseline", ["seed=3"])
    assert value == math.inf
    assert "Traceback" in caplog.text and "test_sweep.py" in caplog.text
    reason = "ZeroDivisionError: by zero"
    _, text, complaints = conclude_sweep(tmp_path)
    assert complaints == [f"{tmp_path}: {reason}"]
    assert text == f"no comparison: no run has a result to compare: {tmp_path.name}: {reason}"
    saved = json.loads((tmp_path / "failure.json").read_text())
    assert saved == {"model": "baseline", "overrides": ["seed=3"], "reason": reason}


def test_a_failure_does_not_outlive_a_successful_repetition(tmp_path: Path) -> None:
    def succeed() -> tuple[Result, None]:
        content = json.dumps(to_json(changed(DONE, model="baseline", fit={"stopped": "finished"})))
        write_atomically(tmp_path / "result.json", content.encode())
        return DONE, None

    assert run_in_sweep(fail, tmp_path, "baseline", []) == math.inf
    assert run_in_sweep(succeed, tmp_path, "baseline", []) == 0.25
    assert list_files(tmp_path) == ["result.json"]
    assert conclude_sweep(tmp_path)[2] == []
    assert run_in_sweep(fail, tmp_path, "baseline", []) == math.inf
    assert list_files(tmp_path) == ["failure.json"]


def test_a_stopped_sweep_goes_on_with_what_is_missing(call, tiny, tmp_path, finished_run, monkeypatch):
    whole = finished_run("sweep")[0]
    shutil.copytree(whole, tmp_path / "sweep", ignore=lambda *_: ["comparison"])
    (tmp_path / "sweep" / "1_coulomb_smooth" / "result.json").unlink()
    done = []

    def run_job(
        config: DictConfig, name: str, folder: Path, options: Sequence[str], given: Given
    ) -> tuple[Result, None]:
        done.append(name)
        shutil.copy(whole / folder.name / "result.json", folder)
        return read_record(folder / "result.json", Result), None

    monkeypatch.setattr("frictionzoo.cli.job.run_job", run_job)
    monkeypatch.setattr("frictionzoo.report.comparison_plots.write_figures", lambda *_: None)
    finished = call(*RUNS["sweep"], *tiny, "hydra.sweep.dir=sweep", "resume=true")
    assert finished.status == 0, finished.err
    assert done == ["coulomb_smooth"] and "0_baseline: result exists" in finished.err
    assert read_comparison(tmp_path / "sweep") == read_comparison(whole)


@pytest.mark.parametrize(
    ("changes", "repeated"),
    [({}, False), ({"settings": {"seed": 1}}, True), ({"versions": {"frictionzoo": "0.0.0"}}, True), (None, True)],
)
def test_a_finished_job_is_not_repeated(tmp_path: Path, changes: dict | None, repeated: bool) -> None:
    result = changed(DONE, settings={"seed": 0, "bounds": [0.1, None]}, versions={"frictionzoo": __version__})
    whole = json.dumps(to_json(changed(result, **(changes or {}))))
    content = whole if changes is not None else whole[:-9]
    Manifest(tmp_path, "run").write("result.json", content.encode())
    settings = {"seed": 0, "bounds": [0.1, math.inf]}  # infinite is null in JSON
    value = run_in_sweep(fail, tmp_path, "baseline", [], settings)
    assert value == (math.inf if repeated else 0.25)
    assert list_files(tmp_path) == ["failure.json" if repeated else "result.json"]


def test_a_sweeper_is_told_infinity_where_a_rollout_diverged(tmp_path: Path) -> None:
    result = changed(DONE, metrics={"train": {"diverged": 1}})
    assert run_in_sweep(lambda: (result, None), tmp_path, "baseline", []) == math.inf
    assert run_in_sweep(lambda: (DONE, "fit diverged"), tmp_path, "baseline", []) == math.inf
    assert os.listdir(tmp_path) == []  # no failure.json: there is a result


def test_failures_come_in_the_order_of_jobs(tmp_path: Path) -> None:
    for number in (10, 9, 1):
        folder = tmp_path / f"{number}_baseline"
        folder.mkdir()
        run_in_sweep(fail, folder, "baseline", [])
    complaints = conclude_sweep(tmp_path)[2]
    assert [line.partition(": ")[0] for line in complaints] == [f"{tmp_path}/{i}_baseline" for i in (1, 9, 10)]


def holder_of(path: Path, process: psutil.Process) -> psutil.Process | None:
    """The process among these and their children that has a file open."""
    for child in process.children(recursive=True):
        try:
            if str(path) in {file.path for file in child.open_files()}:
                return child
        except psutil.Error:  # it ended meanwhile
            continue
    return None


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["joblib", "submitit_local"])
def test_a_killed_job_is_listed(start: Callable, tiny: tuple[str, ...], tmp_path: Path, launcher: str) -> None:
    sweep = start(*SWEEP, *tiny, f"hydra/launcher={launcher}", "model=coulomb_smooth", "fit.iterations=1000000,3")
    endless = tmp_path / "sweep" / "0_coulomb_smooth"
    while not (endless / "checkpoints").exists():  # the fit has begun
        assert sweep.poll() is None
        time.sleep(0.1)
    victim = holder_of(endless / ".running", psutil.Process(sweep.pid))
    assert victim is not None
    victim.kill()
    _, err = sweep.communicate()
    assert sweep.returncode == 2
    assert f"frictionzoo: {endless}: no result: its process ended before it was done" in complaints(err)
    assert "the sweep ended early" in complaints(err)[-1]
    assert "Traceback" not in err
    if launcher == "submitit_local":  # its other jobs go on, and the sweep waits for them
        assert (tmp_path / "sweep" / "1_coulomb_smooth" / "result.json").exists()
        assert len(complaints(err)) == 2


def addresses_of(process: psutil.Process) -> set[str]:
    """Where a process and its children listen."""
    found = set()
    for each in [process, *process.children(recursive=True)]:
        try:
            found |= {c.laddr.ip for c in each.net_connections("tcp") if c.status == psutil.CONN_LISTEN}
        except psutil.Error:
            continue
    return found


@pytest.mark.slow
def test_launchers_agree(start: Callable, finished_run: Callable, tiny: tuple[str, ...], tmp_path: Path) -> None:
    options, in_one_process = (*RUNS["sweep"], *tiny), finished_run("sweep")[0]
    for launcher in LAUNCHERS:
        sweep = start(*options, f"hydra/launcher={launcher}", f"hydra.sweep.dir={launcher}")
        processes, children, addresses = psutil.Process(sweep.pid), [], set()
        while sweep.poll() is None:
            addresses |= addresses_of(processes)
            children = processes.children(recursive=True) or children
            time.sleep(0.5)
        _, err = sweep.communicate()
        assert sweep.returncode == 0, err
        assert not complaints(err) and "Warning" not in err
        assert addresses <= {"127.0.0.1", "::1", "::ffff:127.0.0.1"}
        assert bool(addresses) == (launcher == "ray")
        assert not psutil.wait_procs(children, timeout=30)[1]

        for job in ("0_baseline", "1_coulomb_smooth"):
            assert read_result(tmp_path / launcher / job) == read_result(in_one_process / job), launcher
        assert read_comparison(tmp_path / launcher) == read_comparison(in_one_process), launcher


def test_jobs_at_a_time_times_threads_is_cores() -> None:
    prepare_hydra()
    launchers = {}
    with initialize_config_dir(str(CONF_DIR), version_base="1.3"):
        for path in (CONF_DIR / "hydra" / "launcher").glob("*.yaml"):
            overrides = [f"hydra/launcher={path.stem}", "hydra.sweep.dir=sweep"]
            launchers[path.stem] = compose("config", overrides=overrides, return_hydra_config=True)
    assert set(launchers) == {"joblib", "ray", "submitit_local", "submitit_slurm"}
    for threads, each in [(None, 1), (1, 1), (count_cores(), count_cores())]:
        resolved = {}
        for name, config in launchers.items():
            OmegaConf.update(config, "threads", threads)
            resolved[name] = OmegaConf.to_container(config.hydra.launcher, resolve=True)
        assert resolved["joblib"]["n_jobs"] * each == count_cores()
        assert resolved["ray"]["ray"]["remote"]["num_cpus"] == each
        assert resolved["ray"]["ray"]["init"]["num_cpus"] == count_cores()
        assert resolved["submitit_local"]["cpus_per_task"] == resolved["submitit_slurm"]["cpus_per_task"] == each


COUNT = """
from pathlib import Path
from frictionzoo.core.manifest import MANIFEST, Manifest
from frictionzoo.core.output import write_atomically
from frictionzoo.core.threads import limit_threads
limit_threads({threads})
import jax, torch
jax.devices()
names = [task.joinpath("comm").read_text() for task in Path("/proc/self/task").iterdir()]
print(sum("XLAEigen" in name for name in names), torch.get_num_threads())
"""


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="there is no list of threads")
def test_threads_are_limited() -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", COUNT.format(threads=1)]
    finished = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert finished.stdout.split() == ["1", "1"]


def test_a_limit_of_threads_comes_before_jax_or_is_told_to_be_late(monkeypatch, caplog):
    variables = ("PJRT_NPROC", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    for name in variables:
        monkeypatch.setenv(name, "1")
    limit_threads(3)  # JAX is loaded
    limit_threads(None)
    assert "threads=3 has no effect" in caplog.text and {os.environ[name] for name in variables} == {"1"}
    monkeypatch.delitem(sys.modules, "jax")
    limit_threads(3)
    assert {os.environ[name] for name in variables} == {"3"}
    for threads in (0, -1):
        with pytest.raises(ConfigError, match=f"threads={threads}; expected 1 or more"):
            limit_threads(threads)
