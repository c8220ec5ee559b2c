"""A run that is killed and resumed ends with the same bits as one that is not."""

import json
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

JOBS = {
    "coulomb_smooth": ("model=coulomb_smooth", "fit.iterations=60", "segments.length=5"),
    "neural_friction": (
        *("model=neural_friction", "model.hidden=[4,4]", "fit.derivative=reverse"),
        *("fit.iterations=60", "segments.length=3", "dtype=float32"),
    ),
}
PATIENCE = 600.0  # s after which a process that has not come to the awaited moment is a failure


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Folder of a run of this name that nobody interrupted, made once."""
    folder = tmp_path_factory.mktemp("whole")

    def whole(call: Callable, tiny: tuple[str, ...], name: str, *more: str) -> Path:
        run = folder / str(abs(hash((name, *more))))
        if not run.exists():
            assert call(*tiny, *JOBS[name], *more, f"hydra.run.dir={run}").status == 0
        return run

    return whole


def iterations_saved(folder: Path) -> int:
    """Iterations in the folder's checkpoint; 0 without one. A checkpoint is there whole or not at all."""
    path = folder / "checkpoints" / "last.ckpt"
    return int(torch.load(path, weights_only=True)["frictionzoo"]["progress"][0]) if path.exists() else 0


def steps_on_tensorboard(folder: Path) -> list[int]:
    events = EventAccumulator(str(folder / "tensorboard"), size_guidance={"scalars": 0})
    events.Reload()
    return [scalar.step for scalar in events.Scalars("loss")]


def has_begun(folder: Path) -> bool:
    overrides = folder / ".hydra" / "overrides.yaml"
    return overrides.exists() and overrides.stat().st_size > 0  # Hydra makes the file first and fills it then


def is_halfway(folder: Path) -> bool:
    return iterations_saved(folder) >= 20


def is_fitted(folder: Path) -> bool:
    return iterations_saved(folder) == 60


def kill_when(process: Any, folder: Path, moment: Callable[[Path], bool]) -> None:
    """SIGKILL, which no process can answer, as soon as the folder shows that the moment has come."""
    deadline = time.monotonic() + PATIENCE
    while not moment(folder):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL


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


@pytest.mark.parametrize(
    ("name", "moment"),
    [
        pytest.param("coulomb_smooth", has_begun, marks=pytest.mark.slow),
        ("coulomb_smooth", is_halfway),
        pytest.param("coulomb_smooth", is_fitted, marks=pytest.mark.slow),
        pytest.param("neural_friction", is_halfway, marks=pytest.mark.slow),
    ],
    ids=["before the first checkpoint", "in the fit", "after the fit", "network"],
)
def test_killed_and_resumed_is_as_if_nothing_had_happened(
    start: Callable,
    call: Callable,
    whole: Callable,
    tiny: tuple[str, ...],
    tmp_path: Path,
    name: str,
    moment: Callable[[Path], bool],
) -> None:
    expected = whole(call, tiny, name)
    folder = tmp_path / "killed"
    kill_when(start(*tiny, *JOBS[name], "hydra.run.dir=killed"), folder, moment)
    assert not (folder / "result.json").exists()
    resumed = start("resume=killed")
    out, err = resumed.communicate()
    assert resumed.returncode == 0, err
    assert str(folder) in out
    assert ("resuming from" in err) == (moment is not has_begun)
    assert_same(folder, expected)
    assert steps_on_tensorboard(folder) == list(range(60))


def test_a_finished_run_resumed_is_the_same_run(
    call: Callable, whole: Callable, tiny: tuple[str, ...], tmp_path: Path
) -> None:
    expected = whole(call, tiny, "coulomb_smooth")
    folder = shutil.copytree(expected, tmp_path / "copy")
    assert call(f"resume={folder}").status == 0
    assert_same(folder, expected)


def test_a_run_that_lost_patience_is_resumed_to_the_same_end(
    call: Callable, whole: Callable, tiny: tuple[str, ...], tmp_path: Path
) -> None:
    # So large a step throws the values about, and no iteration beats an early one for three in a row.
    impatient = ("loop.patience=3", "fit.learning_rate=1.0")
    expected = whole(call, tiny, "coulomb_smooth", *impatient)
    assert json.loads((expected / "result.json").read_text())["fit"]["stopped"] == "patience"
    folder = shutil.copytree(expected, tmp_path / "copy")
    assert call(f"resume={folder}").status == 0
    assert_same(folder, expected)


@pytest.mark.parametrize(
    ("override", "what"),
    [
        ("fit.learning_rate=0.02", "fit"),
        ("seed=1", "seed"),
        ("segments.count=19", "segments"),
        ("loop.chunk=3", "chunk"),
        ("model=coulomb_stribeck", "model"),
    ],
)
def test_a_checkpoint_of_another_run_is_refused(
    call: Callable, whole: Callable, tiny: tuple[str, ...], override: str, what: str
) -> None:
    folder = whole(call, tiny, "coulomb_smooth")
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    finished = call(f"resume={folder}", override)
    assert finished.status == 2
    (line,) = [line for line in finished.err.splitlines() if line.startswith("frictionzoo: ")]
    assert f"last.ckpt: {what} " in line and "start a new one" in line
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
