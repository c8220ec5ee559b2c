"""The command line: what it refuses, in one line each, and what it leaves behind when it does."""

import contextlib
import os
import pickle
import resource
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import torch
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from frictionzoo import __version__
from frictionzoo.cli.explain import explain
from frictionzoo.cli.overrides import refuse_no_choice
from frictionzoo.cli.resume import nothing_of_a_refused_run, recorded
from frictionzoo.core.config import check_overrides, compose_config
from frictionzoo.core.errors import CheckpointError, ConfigError, FrictionzooError, OutputError
from frictionzoo.core.manifest import MANIFEST
from frictionzoo.core.output import occupy
from frictionzoo.fit.loop import CHECKPOINT, _checked_checkpoint

RUN = "hydra.run.dir=run"
RESULTS = ("result.json", "friction.safetensors", "identified.xml")
NO_GPU = pytest.mark.skipif("cuda" in {device.platform for device in jax.devices()}, reason="JAX has a GPU")
TIMES = 0.001 * np.arange(400)


@pytest.fixture
def refuse(call: Callable, tmp_path: Path) -> Callable[..., str]:
    """The one line with which a command is refused; it has left no result."""

    def refuse(*overrides: str) -> str:
        finished = call(*overrides, RUN)
        assert finished.status == 2
        assert finished.out == ""
        line = error_line(finished.err)
        assert finished.err == line + "\n"
        assert not (tmp_path / "run" / "checkpoints").exists()
        assert not left_behind(tmp_path / "run")
        return line

    return refuse


@pytest.fixture(scope="module")
def settings(compose: Callable, tiny: tuple[str, ...]) -> dict[str, Any]:
    """What `tiny` composes to, as a problem takes it."""
    return OmegaConf.to_container(compose(*tiny), resolve=True)


def error_line(err: str) -> str:
    """The last line of a standard error on which the program says once what is wrong."""
    lines = err.splitlines()
    assert [line.startswith("frictionzoo: ") for line in lines].count(True) == 1
    assert lines[-1].startswith("frictionzoo: ")
    assert "Traceback" not in err
    return lines[-1]


def left_behind(folder: Path) -> list[str]:
    """Results, and files that were begun and not finished."""
    return [path.name for path in folder.rglob("*") if path.name in RESULTS or path.suffix in (".part", ".png")]


def write_log(path: Path, time: np.ndarray = TIMES) -> None:
    columns = np.stack([time, np.sin(TIMES), np.cos(TIMES), np.sin(TIMES)], axis=1)
    np.savetxt(path, columns, delimiter=",", header="time,qpos,qvel,ctrl", comments="")


def test_a_mistake_of_each_kind_is_one_line(refuse: Callable, tmp_path: Path, tiny: tuple[str, ...]) -> None:
    """Here and in tests of the modules that refuse, the other cases are looked at without a program."""
    write_log(tmp_path / "a.csv", time=1.5 * TIMES)
    assert "a.csv[train]: 0.0015 s per sample" in refuse(*tiny, "data.train=[a.csv]", "bench.timestep=0.001")
    assert "expected at least 4001 for one segment" in refuse(*tiny, "segments.length=4000")
    assert "bench.xml: cannot be read" in refuse(*tiny, "bench.mjcf=bench.xml")
    assert "no such file" in refuse("data=emps", f"data.folder={tmp_path}")
    assert "_target_=os.system; expected a class of frictionzoo" in refuse(*tiny, "fit._target_=os.system")
    assert "segments.cuont: unknown option; did you mean count?" in refuse("segments.cuont=3")
    assert "~data: a job needs one data" in refuse("~data")
    assert "threads=0; expected 1 or more" in refuse("threads=0")


@pytest.mark.parametrize(
    ("override", "fragments"),
    [
        ("data=twinn", ("no such data", "did you mean twin?")),
        ("sed=3", ("sed: unknown option", "did you mean seed?")),
        ("foo=1", ("foo: unknown option; expected one of bench,",)),  # which is near none
        ("segments.count", ("segments.count", "missing EQUAL")),
    ],
)
def test_what_does_not_compose_is_told_with_the_closest_name(override: str, fragments: tuple[str, ...]) -> None:
    with pytest.raises(HydraException) as refused:
        compose_config(override)
    line = explain(refused.value, [override])
    assert line is not None and all(fragment in line for fragment in fragments)


def test_a_value_that_does_not_resolve_is_one_line(settings: dict[str, Any]) -> None:
    config = OmegaConf.create(settings | {"seed": "${speed}"})
    with pytest.raises(OmegaConfBaseException) as refused:
        check_overrides(config, config)
    line = explain(refused.value)
    assert line is not None and "Interpolation key 'speed' not found" in line and "\n" not in line


@pytest.mark.parametrize(
    ("argument", "names"), [("model=null", "mujoco_default"), ("~data", "twin"), ("fit=[lm]", "lm")]
)
def test_a_job_needs_one_of_each_group(argument: str, names: str) -> None:
    with pytest.raises(ConfigError, match=rf"needs one .*{names}"):
        refuse_no_choice(["seed=1", argument])
    refuse_no_choice(["model=lugre", "experiment=emps", "~experiment", "seed=null", "--help"])


@pytest.mark.parametrize(
    ("override", "fragments"),
    [
        ("data={train: [garbage], format: csv}", ("garbage: byte", "not UTF-8", "CSV file")),
        ("data={train: [a.csv], test: [a.csv]}", ("in data.train and in data.test",)),
        ("evaluation.window=0.0", ("evaluation.window=0", "more than 0 s")),
        ("device=gpu", ("device=gpu", "auto, cpu or cuda")),
        pytest.param("device=cuda", ("device=cuda: JAX finds none, expected a GPU",), marks=NO_GPU),
    ],
)
def test_a_problem_that_makes_no_sense_is_refused(call, pose_problem, settings, tmp_path, override, fragments):
    """Where it is posed; `call` has gone to the test's folder."""
    write_log(tmp_path / "a.csv")
    (tmp_path / "garbage").write_bytes(bytes(range(256)))
    changed = OmegaConf.merge(settings, OmegaConf.from_dotlist([override]))
    with pytest.raises(FrictionzooError) as refused:
        pose_problem(OmegaConf.to_container(changed))
    assert all(fragment in str(refused.value) for fragment in fragments)


UNBOUNDED = ("fit.learning_rate=1e3", "model.params.viscous_coefficient.high=1e300", "fit.iterations=4")


@pytest.mark.usefixtures("unrendered")
def test_a_fit_that_diverges_keeps_the_best_and_says_where(call: Callable, tmp_path: Path, tiny: tuple) -> None:
    finished = call(*tiny, *UNBOUNDED, RUN)
    assert finished.status == 2
    line = error_line(finished.err)
    assert "fit diverged at iteration 1" in line and "friction.viscous_coefficient" in line
    result = torch.load(tmp_path / "run" / "checkpoints" / "last.ckpt", weights_only=True)["frictionzoo"]
    assert all(torch.isfinite(rows).all() for rows in result["history"])
    assert '"stopped": "diverged"' in (tmp_path / "run" / "result.json").read_text()
    assert set(RESULTS) <= set(left_behind(tmp_path / "run"))
    assert "friction.viscous_coefficient" in finished.out


def test_a_fit_that_starts_outside_the_finite_numbers_is_refused(call, tmp_path, tiny):
    finished = call(*tiny, *UNBOUNDED, "model.params.viscous_coefficient.init=1e299", RUN)
    assert finished.status == 2
    line = error_line(finished.err)
    assert "fit diverged at iteration 0" in line and "friction.viscous_coefficient" in line
    assert not left_behind(tmp_path / "run")


@contextlib.contextmanager
def no_file_above(size: int) -> Iterator[None]:
    """Lets no file of this process grow beyond a size [byte]: the errors of a full disk, without the disk."""
    # JAX would fill its cache of compiled functions with halves.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1e9)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize(
    ("size", "place"),
    [
        pytest.param(0, "hydra.run.dir", id="run folder"),
        pytest.param(7_000, "last.ckpt", id="checkpoint"),  # above Hydra's own files, below a checkpoint
        pytest.param(20_000, "figure3_parameters.png", id="results"),  # above a checkpoint, below a figure
    ],
)
def test_a_full_disk_is_one_line(call: Callable, tmp_path: Path, tiny: tuple[str, ...], size: int, place: str) -> None:
    with no_file_above(size):
        finished = call(*tiny, "fit.iterations=2", RUN)
    assert finished.status == 2
    line = error_line(finished.err)
    assert "File too large" in line and place in line and "free space" in line
    assert not left_behind(tmp_path / "run")


class Bomb:
    """Its pickle makes a folder when it is loaded."""

    def __reduce__(self) -> tuple:
        return os.mkdir, ("executed",)


def identity(**changes: str) -> dict:
    return {"frictionzoo": {"identity": {"frictionzoo": "0.0.0", **changes}, "progress": [], "history": []}}


HARMFUL = identity(frictionzoo=__version__) | {"code": Bomb()}


@pytest.mark.parametrize(
    ("content", "fragment"),
    [
        pytest.param(b"garbage", "cannot be read", id="garbage"),
        pytest.param({"state_dict": {}}, "cannot be read", id="of another program"),
        pytest.param(identity(), "frictionzoo 0.0.0, expected", id="of another version"),
        pytest.param(HARMFUL, "cannot be read", id="with code"),
        pytest.param(pickle.dumps(HARMFUL), "cannot be read", id="with code, pickled"),
    ],
)
def test_a_checkpoint_that_is_none_is_refused_and_not_run(tmp_path, monkeypatch, content, fragment):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "checkpoints" / CHECKPOINT
    path.parent.mkdir()
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        torch.save(content, path)
    with pytest.raises(CheckpointError, match=rf"last\.ckpt: {fragment}.*; .*start a new"):
        _checked_checkpoint(tmp_path, {"frictionzoo": __version__})
    assert not (tmp_path / "executed").exists()


LIGHT = """
import atexit, sys
heavy = {"torch", "jax", "mujoco", "lightning", "scipy", "matplotlib"}
atexit.register(lambda: print("imported", *sorted(heavy & set(sys.modules)), flush=True))
from frictionzoo.cli.commands import main
main()
"""


def test_typing_errors_do_not_wait_for_heavy_imports(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent)}
    command = [sys.executable, "-c", LIGHT, "model=coulomb_stribek"]
    finished = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert finished.returncode == 2 and finished.stdout == "imported\n"
    assert finished.stderr == error_line(finished.stderr) + "\n" and "mean coulomb_stribeck?" in finished.stderr
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize(
    ("more", "error", "left"),
    [
        (None, ConfigError, False),
        (None, OutputError, True),  # the run goes on with its record
        (None, KeyboardInterrupt, True),
        (".hydra/mine.txt", ConfigError, False),
    ],
)
def test_a_refused_run_leaves_no_folder_and_takes_nothing_along(tmp_path, more, error, left):
    folder, made = tmp_path / "outputs" / "today" / "run", [tmp_path / "outputs" / "today"]
    record = {folder / ".hydra" / f"{name}.yaml": b"a: 1" for name in ("config", "hydra", "overrides")}
    folder.mkdir(parents=True)
    if more:
        (folder / more).parent.mkdir()
        (folder / more).write_text("mine")
    with pytest.raises(error), nothing_of_a_refused_run([folder, *made]), occupy(folder, wait=False), recorded(record):
        raise error
    assert [path.exists() for path in record] == len(record) * [left]
    others = {path for path in tmp_path.rglob("*") if path.is_file() and path.name != MANIFEST} - {*record}
    assert others == ({folder / more} if more else set())
    assert folder.exists() == bool(left or more)
    assert (tmp_path / "outputs").exists()  # it was there before
