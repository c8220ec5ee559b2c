"""The command line: what it refuses, in one line each, and what it leaves behind when it does."""

import contextlib
import os
import pickle
import resource
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import numpy as np
import pytest
import scipy.io
import torch

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
    refuse: Callable, tmp_path: Path, signals: dict, fragments: tuple[str, ...]
) -> None:
    write_log(tmp_path / "a.csv", **signals)
    line = refuse("data=files", "data.train=[a.csv]", "data.split.gap=0.05", "evaluation.horizons=[0.01]")
    assert all(fragment in line for fragment in ("a.csv", *fragments))


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
    refuse: Callable, tmp_path: Path, overrides: list[str], fragments: tuple[str, ...]
) -> None:
    write_log(tmp_path / "a.csv")
    (tmp_path / "garbage").write_bytes(bytes(range(256)))
    (tmp_path / "empty").mkdir()
    line = refuse("data=files", "data.train=[a.csv]", "data.split.gap=0.05", "evaluation.horizons=[0.01]", *overrides)
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
    refuse: Callable, tmp_path: Path, variables: object, fragments: tuple[str, ...]
) -> None:
    path = tmp_path / "emps" / "DATA_EMPS.mat"
    path.parent.mkdir()
    if variables == "folder":
        path.mkdir()
    elif isinstance(variables, bytes):
        path.write_bytes(variables)
    elif isinstance(variables, dict):
        scipy.io.savemat(path, variables)
    line = refuse("data=emps", f"data.folder={tmp_path}")
    assert all(fragment in line for fragment in ("DATA_EMPS.mat", *fragments))


@pytest.mark.parametrize(
    ("override", "fragments"),
    [
        ("model=coulomb_stribek", ("no such model", "did you mean coulomb_stribeck?")),
        ("data=twinn", ("no such data", "did you mean twin?")),
        ("fit=adan", ("no such fit", "did you mean adam?")),
        ("bench=nee", ("no such bench", "did you mean knee?")),
        ("model=null", ("needs one model", "mujoco_default")),
        ("~data", ("needs one data", "twin")),
        ("sed=3", ("sed: unknown option", "did you mean seed?")),
        ("segments.cuont=3", ("segments.cuont: unknown option", "did you mean count?")),
        ("model.params.static_torque.inti=1", ("unknown option", "did you mean init?")),
        ("+segments.stride=3", ("segments.stride: unknown option", "count, length")),
        ("~segments.count", ("segments.count: missing", "20000")),
        ("segments=3", ("segments=3", "a section with count, length")),
        ("segments.count=many", ("segments.count=many", "a whole number such as 20000")),
        ("segments.count=2.5", ("segments.count=2.5", "a whole number")),
        ("segments.length=null", ("segments.length=null", "a whole number such as 5")),
        ("segments.length=0", ("segments.length=0", "1 or more")),
        ("fit.learning_rate=fast", ("fit.learning_rate=fast", "a number such as 0.01")),
        ("fit.iterations=0", ("fit.iterations=0", "at least 1")),
        ("loop.patience=x", ("loop.patience=x", "a whole number")),
        ("evaluation.horizons=1", ("evaluation.horizons=1", "a list such as [1.0]")),
        ("evaluation.horizons=[long]", ("evaluation.horizons=['long']", "a list such as [1.0]")),
        ("evaluation.placement=rnadom", ("evaluation.placement=rnadom", "did you mean random?")),
        ("evaluation.window=0.0", ("evaluation.window=0", "more than 0 s")),
        ("loss.position=-1.0", ("loss.position=-1", "at least 0")),
        ("model.params.static_torque.init=x", ("static_torque.init=x", "a number such as 0.05")),
        ("model.params.static_torque.init=9", ("static_torque: init=9 lies outside", "start inside")),
        ("model.params.static_torque.scale=ln", ("static_torque", "scale is log or a number")),
        ("seed=null", ("seed=null", "a whole number from 0 on")),
        ("seed=-1", ("seed=-1", "a whole number from 0 on")),
        ("seed=${speed}", ("Interpolation key 'speed' not found",)),
        ("dtype=float16", ("dtype=float16", "float32 or float64")),
        ("device=gpu", ("device=gpu", "auto, cpu or cuda")),
        ("fit._target_=os.system", ("_target_=os.system", "a class of frictionzoo")),
        ("bench.actuator._target_=subprocess.Popen", ("_target_=subprocess.Popen", "a class of frictionzoo")),
        ("resume=nowhere", ("resume=nowhere", "expected a run folder")),
        ("resume=.", ("resume=.", "expected a run folder")),
        ("segments.count", ("segments.count", "missing EQUAL")),
    ],
)
def test_an_option_that_makes_no_sense_is_refused(
    refuse: Callable, tiny: tuple[str, ...], override: str, fragments: tuple[str, ...]
) -> None:
    line = refuse(*tiny, override)
    assert all(fragment in line for fragment in fragments)


@pytest.mark.skipif("cuda" in {device.platform for device in jax.devices()}, reason="JAX has a GPU")
def test_a_gpu_that_is_not_there_is_refused(refuse: Callable, tiny: tuple[str, ...]) -> None:
    assert "device=cuda: JAX finds none" in refuse(*tiny, "device=cuda")


@pytest.mark.parametrize(
    ("mjcf", "override", "fragments"),
    [
        pytest.param(None, "", ("bench.xml: cannot be read",), id="missing"),
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
    refuse: Callable, tmp_path: Path, tiny: tuple[str, ...], mjcf: str | None, override: str, fragments: tuple[str, ...]
) -> None:
    if mjcf is not None:
        (tmp_path / "bench.xml").write_text(mjcf)
    line = refuse(*tiny, "bench.mjcf=bench.xml", *filter(None, [override]))
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


@pytest.fixture
def begun(call: Callable, tmp_path: Path, tiny: tuple[str, ...]) -> Path:
    """A run folder that a mistake ended before its first iteration, without a checkpoint."""
    assert call(*tiny, "fit.iterations=2", "loop.chunk=0", RUN).status == 2
    (tmp_path / "run" / "checkpoints").mkdir()
    return tmp_path / "run"


def identity(**changes: str) -> dict:
    return {"frictionzoo": {"identity": {"frictionzoo": "0.0.0", **changes}, "progress": [], "history": []}}


@pytest.mark.parametrize(
    ("content", "fragments"),
    [
        pytest.param(b"garbage", ("cannot be read",), id="garbage"),
        pytest.param(b"", ("cannot be read",), id="empty"),
        pytest.param({"state_dict": {}}, ("cannot be read",), id="of another program"),
        pytest.param({"frictionzoo": {"identity": 3}}, ("cannot be read",), id="without identity"),
        pytest.param(identity(), ("frictionzoo 0.0.0, expected",), id="of another version"),
    ],
)
def test_a_checkpoint_that_is_none_is_refused(
    call: Callable, begun: Path, content: bytes | dict, fragments: tuple[str, ...]
) -> None:
    path = begun / "checkpoints" / "last.ckpt"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        torch.save(content, path)
    finished = call("resume=run", "loop.chunk=2")
    assert finished.status == 2
    assert all(fragment in error_line(finished.err) for fragment in ("last.ckpt", "start", *fragments))
    assert not left_behind(begun)


@pytest.mark.parametrize("form", ["torch", "pickle"])
def test_a_checkpoint_with_code_is_refused_and_not_run(
    call: Callable, begun: Path, tmp_path: Path, bomb: type, form: str
) -> None:
    path = begun / "checkpoints" / "last.ckpt"
    content = identity() | {"code": bomb(tmp_path / "executed")}
    if form == "torch":
        torch.save(content, path)
    else:
        path.write_bytes(pickle.dumps(content))
    finished = call("resume=run", "loop.chunk=2")
    assert finished.status == 2
    assert "last.ckpt: cannot be read" in error_line(finished.err)
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize(
    ("overrides", "fragments"),
    [
        ("- fit._target_=os.system", ("_target_=os.system", "a class of frictionzoo")),
        ("- bench.actuator._target_=builtins.exec", ("_target_=builtins.exec", "a class of frictionzoo")),
        ("- --multirun", ("--multirun", "expected an override")),
        ("- --config-dir=evil", ("--config-dir=evil", "expected an override")),
        ("a: 3", ("expected a list of overrides",)),
        ("- [3]", ("expected a list of overrides",)),
        ("!!python/object/apply:os.mkdir [executed]", ("expected a run folder",)),
        ("- !!python/object/apply:os.mkdir [executed]", ("expected a run folder",)),
        ("[", ("expected a run folder",)),
    ],
)
def test_a_run_folder_with_code_is_refused_and_not_run(
    refuse: Callable, tmp_path: Path, overrides: str, fragments: tuple[str, ...]
) -> None:
    saved = tmp_path / "foreign" / ".hydra" / "overrides.yaml"
    saved.parent.mkdir(parents=True)
    saved.write_text(overrides)
    line = refuse("resume=foreign")
    assert all(fragment in line for fragment in fragments)
    assert not (tmp_path / "executed").exists()


def test_settings_of_hydra_are_not_taken_over_from_a_run_folder(refuse: Callable, tmp_path: Path) -> None:
    saved = tmp_path / "foreign" / ".hydra" / "overrides.yaml"
    saved.parent.mkdir(parents=True)
    saved.write_text("['++hydra.callbacks.bad._target_=os.mkdir', 'hydra/launcher=bad', '+hydra.x=3', 'seed=-3']")
    assert "seed=-3" in refuse("resume=foreign")


def test_a_mistaken_resume_leaves_the_record_of_how_the_run_began(begun: Path, call: Callable) -> None:
    before = {path: path.read_bytes() for path in (begun / ".hydra").iterdir()}
    assert "seed=-3" in error_line(call("resume=run", "seed=-3").err)
    assert {path: path.read_bytes() for path in (begun / ".hydra").iterdir()} == before


def test_a_mistake_in_a_process_of_its_own(start: Callable, tmp_path: Path, tiny: tuple[str, ...]) -> None:
    process = start(*tiny, "segments.length=4000", RUN)
    out, err = process.communicate()
    assert process.returncode == 2
    assert out == ""
    assert err == error_line(err) + "\n"
    assert not left_behind(tmp_path / "run")


LIGHT = """
import atexit, sys
heavy = {"torch", "jax", "mujoco", "lightning", "scipy", "matplotlib"}
atexit.register(lambda: print("imported", *sorted(heavy & set(sys.modules)), flush=True))
from frictionzoo.run import main
main()
"""


@pytest.mark.parametrize(
    ("argument", "status"), [("--help", 0), ("model=coulomb_stribek", 2), ("segments.cuont=3", 2), ("seed=x", 2)]
)
def test_help_and_typing_errors_do_not_wait_for_heavy_imports(tmp_path: Path, argument: str, status: int) -> None:
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent)}
    command = [sys.executable, "-c", LIGHT, argument]
    finished = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert finished.returncode == status
    assert finished.stdout.splitlines()[-1] == "imported"
