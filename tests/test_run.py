"""The command line: what it refuses, in one line each, and what it leaves behind when it does."""

import contextlib
import json
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
import scipy.io
import torch
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from frictionzoo import __version__
from frictionzoo.config import check_overrides, compose_config
from frictionzoo.errors import CheckpointError, ConfigError, FrictionzooError, LogError
from frictionzoo.fit.loop import CHECKPOINT, _checked_checkpoint
from frictionzoo.job import Problem
from frictionzoo.logs.emps import Emps
from frictionzoo.run import _explain, _restore_overrides, refuse_no_choice

RUN = "hydra.run.dir=run"
RESULTS = ("result.json", "friction.safetensors", "identified.xml")
HEADER = "time,qpos,qvel,ctrl"
TIMES = 0.001 * np.arange(400)
BENCH = """<mujoco><option timestep="0.001" integrator="Euler"/><worldbody><body>
<joint name="knee" axis="0 1 0"/><geom size="0.1" pos="0 0 -0.1" mass="1"/></body></worldbody></mujoco>"""
SECOND = '<body pos="1 0 0"><joint name="hip"/><geom size="0.1"/></body></worldbody>'


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


@pytest.fixture
def complain(call: Callable, settings: dict[str, Any]) -> Callable[..., str]:
    """What a problem with these overrides, for which no program starts, is refused with; in the test's folder."""

    def complain(*overrides: str) -> str:
        changed = OmegaConf.merge(settings, OmegaConf.from_dotlist(list(overrides)))
        with pytest.raises(FrictionzooError) as refused:
            Problem.pose(OmegaConf.to_container(changed, resolve=True))
        return str(refused.value)

    return complain


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


def write_log(path: Path, header: str = HEADER, **signals: np.ndarray) -> None:
    columns = {"time": TIMES, "qpos": np.sin(TIMES), "qvel": np.cos(TIMES), "ctrl": np.sin(TIMES)} | signals
    np.savetxt(path, np.stack(list(columns.values()), axis=1), delimiter=",", header=header, comments="")


def with_value(index: int, value: float, array: np.ndarray = TIMES) -> np.ndarray:
    return np.where(np.arange(len(array)) == index, value, array)


@pytest.mark.parametrize(
    ("signals", "fragments"),
    [
        pytest.param({"time": 1.5 * TIMES}, ("0.0015 s per sample", "0.001 s as in knee_rod.xml"), id="other timestep"),
        pytest.param({"qpos": np.full(400, np.nan)}, ("cleaning leaves nothing", "data.clean"), id="nan"),
        pytest.param({"header": "time,qpos,qvel,other"}, ("data.columns.ctrl is missing",), id="other column"),
        pytest.param({"header": HEADER + ",load"}, ("4 cells", "expected 5 as in the header"), id="fewer cells"),
    ],
)
def test_a_recording_that_makes_no_sense_is_refused(
    complain: Callable, tmp_path: Path, signals: dict, fragments: tuple[str, ...]
) -> None:
    write_log(tmp_path / "a.csv", **signals)
    line = complain("data.train=[a.csv]")
    assert all(fragment in line for fragment in ("a.csv", *fragments))


def test_a_mistake_of_each_kind_is_one_line(refuse: Callable, tmp_path: Path, tiny: tuple[str, ...]) -> None:
    """The kinds, all of whose cases other tests look at in the function that refuses."""
    write_log(tmp_path / "a.csv", time=1.5 * TIMES)
    assert "a.csv[train]: 0.0015 s per sample" in refuse(*tiny, "data.train=[a.csv]")
    assert "expected at least 4001 for one segment" in refuse(*tiny, "segments.length=4000")
    assert "bench.xml: cannot be read" in refuse(*tiny, "bench.mjcf=bench.xml")
    assert "no such file" in refuse("data=emps", f"data.folder={tmp_path}")
    assert "_target_=os.system; expected a class of frictionzoo" in refuse(*tiny, "fit._target_=os.system")
    assert "segments.cuont: unknown option; did you mean count?" in refuse("segments.cuont=3")
    assert "~data: a job needs one data" in refuse("~data")
    assert "threads=0; expected 1 or more" in refuse("threads=0")


@pytest.mark.parametrize(
    ("overrides", "fragments"),
    [
        (["data.train=[b.csv]"], ("b.csv: no such file", "data.train")),
        (["data.train=[empty]"], ("empty: no file in this folder",)),
        (["data.train=[garbage]"], ("garbage: suffix none of no known format", "data.format")),
        (["data.train=[garbage]", "data.format=csv"], ("garbage: byte", "not UTF-8", "CSV file")),
        (["data.train=[]"], ("no recording", "data.train=[a.csv]")),
        (["data.train=[a.csv]", "data.test=[a.csv]"], ("in data.train and in data.test",)),
        (["data.split.test_share=0.0"], ("the test part has 0 of 400 samples", "change data.split")),
        (["data.split.test_share=1.0"], ("the train part has 0 of 400 samples", "change data.split")),
        (["data.split.gap=9.0"], ("the train part has 0 of 400 samples", "gap=9 s")),
        (["segments.length=4000"], ("samples, expected at least 4001 for one segment", "segments.length")),
        (["evaluation.horizons=[9.0]"], ("expected at least 9001 for a rollout of 9 s", "evaluation.horizons")),
        (["data.columns.ctrl=[ctrl,ctrl]"], ("ctrl has 2 columns, expected 1", "bench.joint")),
    ],
)
def test_a_recording_that_does_not_serve_is_refused(
    complain: Callable, tmp_path: Path, overrides: list[str], fragments: tuple[str, ...]
) -> None:
    write_log(tmp_path / "a.csv")
    (tmp_path / "garbage").write_bytes(bytes(range(256)))
    (tmp_path / "empty").mkdir()
    line = complain("data.train=[a.csv]", "evaluation.horizons=[0.01]", *overrides)
    assert all(fragment in line for fragment in fragments)


@pytest.mark.parametrize(
    ("variables", "fragments"),
    [
        pytest.param(None, ("no such file", "FRICTIONZOO_DATA"), id="missing"),
        pytest.param("folder", ("cannot be read (Is a directory)",), id="folder"),
        pytest.param(b"\x00garbage\xff" * 40, ("not a readable MATLAB file",), id="garbage"),
        pytest.param({"t": TIMES, "qm": TIMES}, ("no variable vir", "it holds t, qm"), id="other variables"),
        pytest.param({"t": TIMES, "qm": with_value(3, np.nan), "vir": TIMES}, ("NaN", "sample 3"), id="nan"),
        pytest.param({"t": TIMES[::-1], "qm": TIMES, "vir": TIMES}, ("runs backwards",), id="backwards"),
        pytest.param({"t": TIMES[:9], "qm": TIMES[:9], "vir": TIMES[:9]}, ("9 samples",), id="too short"),
    ],
)
def test_a_matlab_file_that_does_not_serve_is_refused(
    tmp_path: Path, variables: object, fragments: tuple[str, ...]
) -> None:
    path = tmp_path / "emps" / "DATA_EMPS.mat"
    path.parent.mkdir()
    if variables == "folder":
        path.mkdir()
    elif isinstance(variables, bytes):
        path.write_bytes(variables)
    elif isinstance(variables, dict):
        scipy.io.savemat(path, variables)
    with pytest.raises(LogError) as refused:
        Emps("emps", str(tmp_path), "DATA_EMPS.mat", "DATA_EMPS.mat", 100.0, 4).load()
    assert all(fragment in str(refused.value) for fragment in ("DATA_EMPS.mat", *fragments))


@pytest.mark.parametrize(
    ("override", "fragments"),
    [
        ("data=twinn", ("no such data", "did you mean twin?")),
        ("fit=adan", ("no such fit", "did you mean adam?")),
        ("bench=nee", ("no such bench", "did you mean knee?")),
        ("sed=3", ("sed: unknown option", "did you mean seed?")),
        ("model.params.static_torque.inti=1", ("unknown option", "did you mean init?")),
        ("segments.count", ("segments.count", "missing EQUAL")),
    ],
)
def test_what_does_not_compose_is_told_with_the_closest_name(
    monkeypatch: pytest.MonkeyPatch, override: str, fragments: tuple[str, ...]
) -> None:
    monkeypatch.setattr(sys, "argv", ["frictionzoo", override])
    with pytest.raises(HydraException) as refused:
        compose_config(override)
    line = _explain(refused.value)
    assert line is not None and all(fragment in line for fragment in fragments)


def test_a_value_that_does_not_resolve_is_one_line(settings: dict[str, Any]) -> None:
    config = OmegaConf.create(settings | {"seed": "${speed}"})
    with pytest.raises(OmegaConfBaseException) as refused:
        check_overrides(config, config)
    line = _explain(refused.value)
    assert line is not None and "Interpolation key 'speed' not found" in line and "\n" not in line


@pytest.mark.parametrize(
    ("argument", "names"), [("model=null", "mujoco_default"), ("~data", "twin"), ("fit=[lm]", "lm")]
)
def test_a_job_needs_one_of_each_group(argument: str, names: str) -> None:
    with pytest.raises(ConfigError, match=rf"needs one .*{names}"):
        refuse_no_choice(["seed=1", argument])
    refuse_no_choice(["model=lugre", "experiment=null", "~experiment", "seed=null", "--help"])


@pytest.mark.parametrize(
    ("override", "fragments"),
    [
        ("segments.length=0", ("segments.length=0", "1 or more")),
        ("fit.iterations=0", ("fit.iterations=0", "at least 1")),
        ("evaluation.placement=rnadom", ("evaluation.placement=rnadom", "did you mean random?")),
        ("evaluation.window=0.0", ("evaluation.window=0", "more than 0 s")),
        ("loss.position=-1.0", ("loss.position=-1", "at least 0")),
        ("model.params.static_torque.init=9", ("static_torque: init=9 lies outside", "start inside")),
        ("model.params.static_torque.scale=ln", ("static_torque", "scale is log or a number")),
        ("dtype=float16", ("dtype=float16", "float32 or float64")),
        ("device=gpu", ("device=gpu", "auto, cpu or cuda")),
        ("fit._target_=os.system", ("_target_=os.system", "a class of frictionzoo")),
        ("bench.actuator._target_=subprocess.Popen", ("_target_=subprocess.Popen", "a class of frictionzoo")),
    ],
)
def test_an_option_that_makes_no_sense_is_refused(
    complain: Callable, override: str, fragments: tuple[str, ...]
) -> None:
    line = complain(override)
    assert all(fragment in line for fragment in fragments)


@pytest.mark.skipif("cuda" in {device.platform for device in jax.devices()}, reason="JAX has a GPU")
def test_a_gpu_that_is_not_there_is_refused(complain: Callable) -> None:
    assert "device=cuda: JAX finds none, expected a GPU" in complain("device=cuda")


@pytest.mark.parametrize(
    ("mjcf", "override", "fragments"),
    [
        pytest.param("<mujoco>", "", ("not XML",), id="not XML"),
        pytest.param(BENCH.replace("geom size", "geom sise"), "", ("MuJoCo does not compile it", "sise"), id="refused"),
        pytest.param(BENCH, "bench.joint=knie", ("no joint knie", "did you mean knee?", "bench.joint"), id="no joint"),
        pytest.param(
            BENCH.replace("</worldbody>", SECOND), "bench.joint=null", ("knee, hip", "one named joint"), id="several"
        ),
        pytest.param(
            BENCH.replace("</worldbody>", SECOND), "", ("2 degrees of freedom", "1 identified joints"), id="one of two"
        ),
        pytest.param(BENCH.replace("Euler", "RK4"), "", ("integrator RK4", "Euler or implicitfast"), id="RK4"),
        pytest.param(
            BENCH.replace("<worldbody>", '<include file="rod.xml"/><worldbody>'), "", ("<include>",), id="include"
        ),
        pytest.param(
            BENCH.replace("</mujoco>", '<actuator><motor joint="knee"/></actuator></mujoco>'),
            "",
            ("joint knee has an actuator", "bench.actuator"),
            id="actuator",
        ),
        pytest.param(BENCH.replace("0.001", "0.002"), "", ("0.001 s per sample", "0.002 s as in"), id="timestep"),
    ],
)
def test_a_bench_that_does_not_serve_is_refused(
    complain: Callable, tmp_path: Path, mjcf: str, override: str, fragments: tuple[str, ...]
) -> None:
    (tmp_path / "bench.xml").write_text(mjcf)
    line = complain("bench.mjcf=bench.xml", *filter(None, [override]))
    assert all(fragment in line for fragment in ("bench.xml", *fragments))


UNBOUNDED = ("fit.learning_rate=1e3", "model.params.viscous_coefficient.high=1e300", "fit.iterations=4")


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


def test_a_fit_that_starts_outside_the_finite_numbers_is_refused(
    call: Callable, tmp_path: Path, tiny: tuple[str, ...]
) -> None:
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
        pytest.param(6_000, "last.ckpt", id="checkpoint"),  # above Hydra's own files, below a checkpoint
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


@pytest.fixture(scope="module")
def bomb() -> type:
    """A class whose pickle makes a file when it is loaded."""

    class Bomb:
        def __init__(self, path: Path) -> None:
            self.path = path

        def __reduce__(self) -> tuple:
            return os.mkdir, (str(self.path),)

    return Bomb


def identity(**changes: str) -> dict:
    return {"frictionzoo": {"identity": {"frictionzoo": "0.0.0", **changes}, "progress": [], "history": []}}


@pytest.mark.parametrize(
    ("content", "fragment"),
    [
        pytest.param(b"garbage", "cannot be read", id="garbage"),
        pytest.param(b"", "cannot be read", id="empty"),
        pytest.param({"state_dict": {}}, "cannot be read", id="of another program"),
        pytest.param({"frictionzoo": {"identity": 3}}, "cannot be read", id="without identity"),
        pytest.param(identity(), "frictionzoo 0.0.0, expected", id="of another version"),
    ],
)
def test_a_checkpoint_that_is_none_is_refused(tmp_path: Path, content: bytes | dict, fragment: str) -> None:
    path = tmp_path / "checkpoints" / CHECKPOINT
    path.parent.mkdir()
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        torch.save(content, path)
    with pytest.raises(CheckpointError, match=rf"last\.ckpt: {fragment}.*; .*start a new"):
        _checked_checkpoint(tmp_path, {"frictionzoo": __version__})


@pytest.mark.parametrize("save", [torch.save, lambda content, path: path.write_bytes(pickle.dumps(content))])
def test_a_checkpoint_with_code_is_refused_and_not_run(tmp_path: Path, bomb: type, save: Callable) -> None:
    path = tmp_path / "checkpoints" / CHECKPOINT
    path.parent.mkdir()
    save(identity(frictionzoo=__version__) | {"code": bomb(tmp_path / "executed")}, path)
    with pytest.raises(CheckpointError, match=r"last\.ckpt: cannot be read"):
        _checked_checkpoint(tmp_path, {"frictionzoo": __version__})
    assert not (tmp_path / "executed").exists()


@pytest.fixture
def foreign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file with the overrides of a run folder from elsewhere."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "foreign" / ".hydra").mkdir(parents=True)
    return tmp_path / "foreign" / ".hydra" / "overrides.yaml"


@pytest.mark.parametrize(
    ("overrides", "fragment"),
    [
        ("- --multirun", "--multirun; expected an override"),
        ("- --config-dir=evil", "--config-dir=evil; expected an override"),
        ("a: 3", "expected a list of overrides"),
        ("- [3]", "expected a list of overrides"),
        ("!!python/object/apply:os.mkdir [executed]", "expected a run folder"),
        ("- !!python/object/apply:os.mkdir [executed]", "expected a run folder"),
        ("[", "expected a run folder"),
        (None, "resume=foreign: no foreign/.hydra/overrides.yaml that can be read, expected a run folder"),
    ],
)
def test_a_run_folder_with_code_is_refused_and_not_run(foreign: Path, overrides: str | None, fragment: str) -> None:
    if overrides is not None:
        foreign.write_text(overrides)
    with pytest.raises(ConfigError) as refused:
        _restore_overrides(["resume=foreign"])
    assert fragment in str(refused.value)
    assert not Path("executed").exists()


def test_a_class_that_a_run_folder_names_is_refused(refuse: Callable, foreign: Path, tiny: tuple[str, ...]) -> None:
    foreign.write_text(json.dumps([*tiny, "bench.actuator._target_=builtins.exec"]))
    assert "_target_=builtins.exec; expected a class of frictionzoo" in refuse("resume=foreign")


def test_settings_of_hydra_are_not_taken_over_from_a_run_folder(foreign: Path) -> None:
    of_hydra = [
        "++hydra.callbacks.bad._target_=os.mkdir",
        "hydra/launcher=bad",
        "+hydra.x=3",
        "~resume",
        "resume=other",
    ]
    foreign.write_text(json.dumps([*of_hydra, "seed=-3", "model=lugre"]))
    today = ["seed=4", "resume=foreign"]
    assert _restore_overrides(today) == ["seed=-3", "model=lugre", *today, "hydra.output_subdir=null"]
    for none in (["seed=4"], ["resume=foreign", "resume=null"], ["resume="]):
        assert _restore_overrides(none) == none


LIGHT = """
import atexit, sys
heavy = {"torch", "jax", "mujoco", "lightning", "scipy", "matplotlib"}
atexit.register(lambda: print("imported", *sorted(heavy & set(sys.modules)), flush=True))
from frictionzoo.run import main
main()
"""


@pytest.mark.parametrize(
    ("argument", "line"),
    [
        ("--help", None),
        ("model=coulomb_stribek", "model=coulomb_stribek: no such model; did you mean coulomb_stribeck?"),
        ("seed=x", "seed=x; expected a whole number from 0 on"),
    ],
)
def test_help_and_typing_errors_do_not_wait_for_heavy_imports(tmp_path: Path, argument: str, line: str | None) -> None:
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent)}
    command = [sys.executable, "-c", LIGHT, argument]
    finished = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert finished.returncode == (2 if line else 0)
    assert finished.stdout.splitlines()[-1] == "imported"
    if line:
        assert finished.stdout == "imported\n"
        assert finished.stderr == error_line(finished.stderr) + "\n" and line in finished.stderr
