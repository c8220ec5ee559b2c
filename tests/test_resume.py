"""A run that is killed and resumed ends with the same bits as one that is not."""

import errno
import gc
import json
import os
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import RUNS
from omegaconf import OmegaConf
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from frictionzoo.cli.job import _identify
from frictionzoo.cli.resume import restore_overrides
from frictionzoo.core.errors import CheckpointError, ConfigError, RunError
from frictionzoo.core.manifest import MANIFEST, Manifest
from frictionzoo.core.output import occupy
from frictionzoo.fit import loop, run_fit
from frictionzoo.fit.loggers import Csv
from frictionzoo.fit.loop import FitFiles
from frictionzoo.identification import Problem, recipe
from frictionzoo.report import run_plots


def iterations_saved(folder: Path) -> int:
    """Iterations in the folder's checkpoint; 0 without one. A checkpoint is there whole or not at all."""
    path = folder / "checkpoints" / "last.ckpt"
    return int(torch.load(path, weights_only=True)["frictionzoo"]["progress"][0]) if path.exists() else 0


def steps_on_tensorboard(folder: Path) -> list[int]:
    events = EventAccumulator(str(folder / "tensorboard"), size_guidance={"scalars": 0})
    events.Reload()
    return [scalar.step for scalar in events.Scalars("loss")]


def assert_same(run: Path, other: Path) -> None:
    """Same weights byte for byte, same parameters, same fit and history."""
    assert (run / "friction.safetensors").read_bytes() == (other / "friction.safetensors").read_bytes()
    assert (run / "identified.xml").read_bytes() == (other / "identified.xml").read_bytes()
    first, second = (json.loads((folder / "result.json").read_text()) for folder in (run, other))
    for section in ("parameters", "fit", "metrics", "by_horizon", "paper"):
        assert first[section] == second[section]
    first, second = (
        torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)["frictionzoo"] for folder in (run, other)
    )
    for section in ("progress", "history"):
        assert len(first[section]) == len(second[section])
        assert all(torch.equal(one, two) for one, two in zip(first[section], second[section], strict=True))


@pytest.mark.slow
@pytest.mark.usefixtures("in_haste")
@pytest.mark.parametrize(
    ("name", "place", "saved"),
    [
        pytest.param("coulomb_smooth", (loop.FitModule, "training_step"), 0, id="before the first checkpoint"),
        pytest.param("coulomb_smooth", (run_plots, "write_figures"), 3, id="after the fit"),
        pytest.param("neural_friction", (loop._Saver, "on_train_epoch_end"), 2, id="network, in the fit"),
    ],
)
def test_ended_elsewhere_and_resumed_is_as_if_nothing_had_happened(
    call: Callable, finished_run: Callable, tiny: tuple[str, ...], tmp_path: Path, name: str, place: tuple, saved: int
) -> None:
    function = getattr(*place)

    def end(*arguments: Any) -> None:
        if iterations_saved(tmp_path / "ended") == saved:
            raise OSError(errno.EIO, "the power went")
        function(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(*place, end)
        assert call(*RUNS[name], *tiny, "hydra.run.dir=ended").status == 2
    assert iterations_saved(tmp_path / "ended") == saved and not (tmp_path / "ended" / "result.json").exists()
    resumed = call("resume=ended")
    assert resumed.status == 0, resumed.err
    assert ("resuming from" in resumed.err) == (saved > 0)
    assert_same(tmp_path / "ended", finished_run(name)[0])
    assert steps_on_tensorboard(tmp_path / "ended") == [0, 1, 2]


def read_files(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != MANIFEST}


@pytest.mark.usefixtures("unrendered")
def test_a_finished_run_is_resumed_to_itself_and_by_its_own_command_alone(call, finished_run, tmp_path, tiny):
    expected, _ = finished_run("coulomb_smooth")
    folder = shutil.copytree(expected, tmp_path / "copy")
    before = read_files(folder)
    anew = (*RUNS["coulomb_smooth"], *tiny, f"hydra.run.dir={folder}", "fit.learning_rate=0.02")
    for arguments, complaint in {
        (f"resume={folder}", "fit.learning_rate=0.02"): "last.ckpt: fit ",
        (f"resume={folder}", "seed=-3"): "seed=-3; expected",
        anew: "last.ckpt: fit ",
    }.items():
        finished = call(*arguments)
        assert finished.status == 2
        (line,) = [line for line in finished.err.splitlines() if line.startswith("frictionzoo: ")]
        assert complaint in line
        assert read_files(folder) == before
    with occupy(folder, wait=False):
        refused = call(f"resume={folder}")
    assert refused.status == 2
    assert refused.err.startswith(f"frictionzoo: {folder}: another process works in it")
    assert refused.err.count("\n") == 1
    assert call(f"resume={folder}").status == 0
    assert_same(folder, expected)


def test_a_folder_is_one_process_s_and_what_a_killed_one_began_is_removed(tmp_path: Path) -> None:
    killed = Manifest(tmp_path, "run")
    killed.write("checkpoints/last.ckpt", b"first")
    part, foreign = tmp_path / f".last.ckpt.{killed.token}.part", tmp_path / "checkpoints" / ".last.ckpt.99.part"
    part.write_bytes(b"sec")
    foreign.touch()
    with occupy(tmp_path, wait=False):
        assert not part.exists() and foreign.exists()
        with pytest.raises(RunError, match="another process works in it, expected a free folder; wait"):
            occupy(tmp_path, wait=False).__enter__()
    assert sorted(os.listdir(tmp_path)) == [MANIFEST, "checkpoints"]


def raise_in_a_collection(number: int) -> None:
    """A signal whose exception Python drops; it has to come again."""
    gc.callbacks.append(lambda phase, _: (gc.callbacks.pop(), signal.raise_signal(number)))
    gc.collect()
    time.sleep(10)


def fill_the_disk(_: int) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


RUN = ("hydra.run.dir=run", "run keeps its options; go on with resume=")
SWEEP = ("hydra.sweep.dir=run", "run keeps 0 finished jobs; go on with the same command and hydra.sweep.dir=")


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize(
    ("end", "number", "status", "place", "keeps"),
    [
        pytest.param(signal.raise_signal, signal.SIGTERM, 143, *RUN, id="SIGTERM"),
        pytest.param(signal.raise_signal, signal.SIGINT, 130, *SWEEP, id="Ctrl-C in a sweep"),
        pytest.param(raise_in_a_collection, signal.SIGINT, 130, *RUN, id="Ctrl-C in a collection"),
        pytest.param(fill_the_disk, 0, 2, *RUN, id="disk"),
    ],
)
def test_what_ends_a_job_is_one_line_that_says_how_to_go_on(
    call: Callable,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    end: Callable[[int], None],
    number: int,
    status: int,
    place: str,
    keeps: str,
) -> None:
    monkeypatch.setattr("frictionzoo.cli.job.run_job", lambda *_, **__: end(number))
    handlers = [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)]
    ended = call(place, *(["-m"] if "sweep" in place else []))
    assert ended.status == status
    assert ended.err.count("\n") == 1 and f"{tmp_path}/{keeps}{tmp_path}/run" in ended.err
    assert handlers == [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)]
    assert not list(tmp_path.rglob(".running"))


@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        (["resume=true"], "resume=true"),
        (["-m", "resume=true"], "resume=true"),
        (["-m", "resume=true", "hydra.sweep.dir=nowhere"], "hydra.sweep.dir=nowhere"),
        (["-m", "resume=sweep"], "resume=sweep"),
        (["resume=sweep"], "hydra.sweep.dir=sweep resume=true"),
    ],
)
def test_a_resumed_sweep_has_to_be_one(tmp_path, monkeypatch, arguments, option):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sweep" / "0_baseline" / ".hydra").mkdir(parents=True)
    with pytest.raises(ConfigError, match=option):
        restore_overrides(arguments)
    whole = ["-m", "hydra.sweep.dir=sweep", "resume=true"]
    assert restore_overrides(whole) == whole


@pytest.fixture
def pose(call, pose_problem, compose, tiny):
    plain = OmegaConf.to_container(compose(*tiny, "model=coulomb_smooth"), resolve=True)

    def pose(*overrides: str) -> Problem:
        return pose_problem(OmegaConf.to_container(OmegaConf.merge(plain, OmegaConf.from_dotlist(list(overrides)))))

    return pose


def test_a_run_that_lost_patience_is_resumed_to_the_same_end(pose: Callable, tmp_path: Path) -> None:
    # So large a step throws the values about, and no iteration beats an early one for three in a row.
    problem = pose("loop.patience=3", "fit.learning_rate=1.0", "fit.iterations=60")
    solved, loop = (problem.fit, problem.objective, problem.drive.model), problem.settings["loop"]
    first, again = (run_fit(*solved, FitFiles(tmp_path, Csv()), **loop) for _ in range(2))
    assert first.stopped == again.stopped == "patience"
    assert (first.iterations, first.best_iteration, first.loss) == (again.iterations, again.best_iteration, again.loss)
    np.testing.assert_equal((again.vector, again.history), (first.vector, first.history))


@pytest.mark.parametrize(
    ("overrides", "changed"),
    [
        (
            ("fit.learning_rate=0.02", "seed=1", "loss.velocity=0.5", "dtype=float32", "loop.chunk=3"),
            {"fit", "seed", "loss", "dtype", "chunk"},
        ),
        (
            ("bench.params.armature.init=0.02", "model.params.viscous_coefficient.init=0.02"),
            {"bench", "model settings"},
        ),
        (("segments.count=19",), {"segments", "training samples"}),
        (("data.split.test_share=0.3",), {"training samples"}),
        (("loop.patience=9", "evaluation.rollouts=2"), set()),
    ],
)
def test_what_makes_it_another_run(pose, finished_run, overrides, changed):
    folder, _ = finished_run("coulomb_smooth")
    begun = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)["frictionzoo"]["identity"]
    now = _identify("coulomb_smooth", pose("fit.iterations=3", *overrides))
    assert {what for what, value in now.items() if begun[what] != value} == changed
    assert now.keys() == begun.keys()
    assert now["data"] == json.loads((folder / "result.json").read_text())["data"]["sha256"]
    for what in [*changed, "model", "data", "engine"]:
        with pytest.raises(CheckpointError, match=rf"last\.ckpt: {what} "):
            loop._checked_checkpoint(folder, begun | {what: "another"})
    assert loop._checked_checkpoint(folder, begun) == folder / "checkpoints" / "last.ckpt"


@pytest.mark.slow
@pytest.mark.usefixtures("in_haste")
def test_automatic_settings_are_found_once(call, tiny, tmp_path, monkeypatch):
    """A run that ended in its fit goes on with the settings that were found, and ends as one that did not."""
    stated = ("bench.timestep=1e-3", "bench.solreffriction=[0.002,1.0]", "bench.params.position_offset.identify=false")
    options = (*tiny, "model=mujoco_default", "recipe=auto", "fit=lm", *stated)
    assert call(*options, "hydra.run.dir=whole").status in (0, 3)

    def stop(*arguments: Any) -> None:
        raise OSError(errno.EIO, "the power went")

    with monkeypatch.context() as patched:
        patched.setattr(loop.FitModule, "training_step", stop)
        stopped = call(*options, "hydra.run.dir=run")
    assert stopped.status == 2 and (tmp_path / "run" / recipe.SETTLED).exists(), stopped.err
    with monkeypatch.context() as patched:
        patched.setattr(recipe.Stages, "run", stop)
        resumed = call("resume=run")
    assert resumed.status in (0, 3) and "automatic settings read from" in resumed.err
    assert_same(tmp_path / "run", tmp_path / "whole")
    first, second = (json.loads((tmp_path / name / "result.json").read_text()) for name in ("run", "whole"))
    assert first["recipe"] == second["recipe"] and len(first["recipe"]) > 5
