"""What tests share: configurations, parts built from them, recordings, and jobs, in this process or in their own."""

import contextlib
import copy
import functools
import gc
import io
import itertools
import json
import logging
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from operator import getitem
from pathlib import Path
from typing import Any, get_type_hints

import absl.logging
import jax
import msgspec
import numpy as np
import pytest
import torch
from filelock import FileLock
from jax.experimental.compilation_cache import compilation_cache as jax_cache
from omegaconf import DictConfig, OmegaConf

from frictionzoo.bench import Bench, PositionPD
from frictionzoo.cli.run import main
from frictionzoo.core.build import build
from frictionzoo.core.config import compose_config
from frictionzoo.core.output import to_json
from frictionzoo.core.records import Record
from frictionzoo.core.segments import Segments
from frictionzoo.core.state import Signals
from frictionzoo.fit.objective import Objective
from frictionzoo.identification import Problem
from frictionzoo.models.by_name import complete_laws
from frictionzoo.report import with_matplotlib
from frictionzoo.result.comparison.runs import Run
from frictionzoo.result.curves import Curves
from frictionzoo.result.record import PACKAGES, SCHEMA_VERSION
from frictionzoo.result.types import Result
from frictionzoo.simulation.base import FORWARD
from frictionzoo.simulation.context import computing

torch.set_num_threads(1)  # torch is loaded and no longer looks at the environment

pytest.register_assert_rewrite("helpers")  # what their assertions compared is told too
pytest_plugins = ["helpers.bam", "helpers.legged", "helpers.results"]  # fixtures beside what they are made from

DATA = os.environ.get("FRICTIONZOO_DATA")
needs_data = pytest.mark.skipif(DATA is None, reason="FRICTIONZOO_DATA is not set; it names the folder of recordings")

ROOT = Path(__file__).parent.parent
CACHE_OPTIONS = {  # keep every compiled function, however small
    "jax_persistent_cache_min_compile_time_secs": 0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}
BRIEF = {  # options of an evaluation that takes no time
    **{"evaluation.horizons": "[0.1]", "evaluation.rollouts": "1", "evaluation.places": "1"},
    **{"evaluation.trajectory": "0.1", "evaluation.window": "0.02"},
}
compose_once = functools.cache(compose_config)  # what it returns is not to be changed; Hydra takes 0.1 s for each
LAUNCHERS = ("joblib", "submitit_local", "ray")  # of sweeps
UNOPTIMISED = "jax_disable_most_optimizations"  # XLA as JAX's own tests use it: compiling takes two thirds of the time


def pytest_configure(config: pytest.Config) -> None:
    """Quick tests compile in haste, they and what they start; slow ones, at full size, as users do.

    Workers leave each other their core: threads wait for each other by turning on one.
    """
    if "PYTEST_XDIST_WORKER" in os.environ:
        os.environ.update(PJRT_NPROC="1", OMP_NUM_THREADS="1")  # XLA reads its own when it is first used
    if config.option.markexpr == "not slow":
        os.environ[UNOPTIMISED.upper()] = "1"
        jax.config.update(UNOPTIMISED, True)
        older = " ".join(f"--{option}={str(value).lower()}" for option, value in FORWARD.items())
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {older}".strip()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup() -> Iterator[None]:
    """What has not ended by TESTS_UNTIL, a time in s since 1970, is skipped and listed."""
    with ending_in_time():
        yield


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Iterator[None]:
    """As above."""
    with ending_in_time():
        yield


@contextlib.contextmanager
def ending_in_time() -> Iterator[None]:
    left = float(os.environ.get("TESTS_UNTIL", "inf")) - time.time()

    def stop(*_: object) -> None:
        pytest.skip("not run to its end: TESTS_UNTIL is over, as this machine is slower than usual; run `make slow`")

    if left <= 0:
        stop()
    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, min(left, 1e6))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest tests come first: at the end one worker would wait for the other's."""
    items.sort(key=lambda item: item.path.stem not in ("test_experiments", "test_tutorials"))


def pytest_collection_finish() -> None:
    """What was imported stays: looking for garbage in it again and again took a fifth of the tests' time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 10)


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """What all tests took together, over all workers: the suite's budget. `--durations` lists the dearest."""
    files = Counter[str]()
    for report in itertools.chain(*terminalreporter.stats.values()):
        if hasattr(report, "duration"):
            files[report.nodeid.partition("::")[0]] += report.duration
    terminalreporter.section(f"all tests: {sum(files.values()):.0f} s of workers' time; by file")
    for name, seconds in files.most_common(10):
        terminalreporter.write_line(f"{seconds:.2f}s {name}")


def slow_but(quick: Collection[Any], values: Iterable[Any]) -> list[Any]:
    """Parameters of a test; those that are not among the quick ones make slow tests."""
    return [
        pytest.param(*(each if isinstance(each, tuple) else (each,)), marks=() if each in quick else pytest.mark.slow)
        for each in values
    ]


def check_each(check: Callable[..., object], cases: Iterable[Any]) -> None:
    """A test of many cases: it fails with what the check says of each that does not pass; tuples are arguments."""
    wrong = []
    for case in cases:
        try:
            check(*(case if isinstance(case, tuple) else (case,)))
        except Exception as error:
            wrong.append(f"{case}: {type(error).__name__}: {error}")
    assert not wrong, "\n".join(wrong)


@dataclass(frozen=True)
class Finished:
    """What a command left: exit status, standard output and standard error."""

    status: int
    out: str
    err: str


@pytest.fixture(scope="session")
def compose() -> Callable[..., DictConfig]:
    """Composes a job's configuration from overrides, as the command line would."""
    return lambda *overrides: copy.deepcopy(compose_once(*overrides))


@pytest.fixture(scope="session")
def make() -> Callable[..., Any]:
    """Builds the part `section` of the configuration with these overrides; more arguments go to the constructor."""

    def make(section: str, *overrides: str, **more: Any) -> Any:
        config = OmegaConf.to_container(compose_once(*overrides), resolve=True)
        return build(complete_laws(config[section], config) if section == "model" else config[section], **more)

    return make


@pytest.fixture(scope="session")
def knee(make: Callable[..., Any]) -> Bench:
    """The paper's bench."""
    return make("bench")


TWO_JOINTS = """<mujoco><option timestep="0.001"/><worldbody><body>
<joint name="hip" axis="0 1 0"/><inertial pos="0 0 -0.1" mass="1" diaginertia="0.01 0.01 0.01"/>
<body pos="0 0 -0.2"><joint name="knee" axis="0 1 0"/>
<inertial pos="0 0 -0.1" mass="1" diaginertia="0.01 0.01 0.01"/></body>
</body></worldbody></mujoco>"""


@pytest.fixture(scope="session")
def leg(shared_folder: Path) -> Callable[..., Bench]:
    """A bench of a hip and a knee, from arguments of `Bench`."""
    path = shared_folder / "two_joints.xml"
    path.write_text(TWO_JOINTS)
    return lambda **more: Bench(str(path), ["hip", "knee"], **{"actuator": PositionPD(kp=20, kd=1), **more})


@pytest.fixture(scope="session")
def two_joints(leg: Callable[..., Bench]) -> Bench:
    """A hip and a knee with the defaults of `leg`."""
    return leg()


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that all workers of the tests see; what is made in it is made once, under a lock."""
    folder = tmp_path_factory.getbasetemp()
    return folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder


@pytest.fixture(scope="session", autouse=True)
def compilation_cache(shared_folder: Path) -> Path:
    """A folder in which the workers of the tests, and the programs that they start, share compiled functions.

    Most of a test's time goes into compiling. JAX's own variable names a folder that is kept for the next tests.
    """
    folder = Path(os.environ.get("JAX_COMPILATION_CACHE_DIR", shared_folder / "xla"))
    folder.mkdir(parents=True, exist_ok=True)
    _configure_jax({"jax_compilation_cache_dir": str(folder), **CACHE_OPTIONS})
    return folder


def write_recording(path: Path, coulomb: float = 0.1, paces: tuple[float, float] = (1.5, 0.7)) -> Path:
    """Write what `recording` is, with this dry friction [N m] and these frequencies of the command [Hz]."""
    samples, timestep = 1500, 1e-3
    inertia, time = 0.0011 + 0.26 * 0.1127**2 + 0.04, timestep * np.arange(samples)
    ctrl = 0.6 * np.sin(2 * np.pi * paces[0] * time) + 0.3 * np.sin(2 * np.pi * paces[1] * time)
    qpos, qvel = np.zeros((2, samples))
    for i in range(samples - 1):
        friction = coulomb * np.tanh(qvel[i] / 0.01) + 0.05 * qvel[i]
        torque = 20 * (ctrl[i] - qpos[i]) - qvel[i] - 0.26 * 9.81 * 0.1127 * np.sin(qpos[i]) - friction
        qvel[i + 1] = qvel[i] + timestep * torque / inertia
        qpos[i + 1] = qpos[i] + timestep * qvel[i + 1]
    table = np.stack([time, qpos, qvel, ctrl], axis=1)
    np.savetxt(path, table, fmt="%.9g", delimiter=",", header="time,qpos,qvel,ctrl", comments="")
    return path


@pytest.fixture(scope="session")
def recording(shared_folder: Path) -> Path:
    """A CSV recording of 1.5 s at 1 ms: the paper's rod under its controller, with Coulomb and viscous friction."""
    path = shared_folder / "recording" / "knee.csv"
    with FileLock(shared_folder / "recording.lock"):
        if path.exists():
            return path
        path.parent.mkdir()
        write_recording(path)
    return path


@pytest.fixture(scope="session")
def tiny(recording: Path) -> tuple[str, ...]:
    """Overrides of a job of seconds. Its rollouts have one shape, so that little is compiled."""
    return (
        *("data=files", "bench=knee", "recipe=given", f"data.train=[{recording}]", "data.split.gap=0.05"),
        *("segments.count=20", "loop.chunk=2", "loop.progress=false", "discretisation=false", "dtype=float64"),
        *(f"{option}={value}" for option, value in BRIEF.items()),
    )


@pytest.fixture
def in_haste(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Slow tests of many small jobs compile as quick ones do."""
    monkeypatch.setenv(UNOPTIMISED.upper(), "1")
    before = jax.config.read(UNOPTIMISED)
    jax.config.update(UNOPTIMISED, True)
    yield
    jax.config.update(UNOPTIMISED, before)


def render_nothing(patch: pytest.MonkeyPatch) -> None:
    """Have figures drawn and not rendered, which is a fifth of a small job: where nobody looks at them.

    Not while `finished_run` makes a run, which is everybody's.
    """
    patch.setattr(with_matplotlib, "save_figure", lambda figure, path: None)


@pytest.fixture
def x64() -> Iterator[None]:
    """JAX computes in double precision."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def unrendered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Jobs of this test render no figures."""
    render_nothing(monkeypatch)


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Ctrl-C acts in this process and in those that it starts, also where the suite was started with SIGINT ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def start(compilation_cache: Path, tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen]]:
    """Starts `python -m frictionzoo.run` as a process in the test's folder; none outlives the test.

    Another `program` is started in its place; `variables` are added to the environment.
    """
    options = {"jax_compilation_cache_dir": compilation_cache, **CACHE_OPTIONS}
    ours = {"PYTHONPATH": str(ROOT), **{key.upper(): str(value) for key, value in options.items()}}
    started: list[subprocess.Popen] = []

    def start(
        *overrides: str, program: Sequence[str] = ("-m", "frictionzoo.run"), **variables: str
    ) -> subprocess.Popen:
        environment, pipe = {**os.environ, **ours, **variables}, subprocess.PIPE
        command = [sys.executable, *program, *overrides]
        started.append(subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=pipe, stderr=pipe, text=True))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.communicate()


@contextlib.contextmanager
def job_settings(compilation_cache: Path) -> Iterator[None]:
    """Undoes what jobs that run in this process leave behind: handlers of logging, Hydra's and JAX's settings."""
    options = {"jax_compilation_cache_dir": str(compilation_cache), **CACHE_OPTIONS}
    # Jobs set precision and device in contexts: those, made settings, would outlast them.
    before = {name: getattr(jax.config, name) for name in options}
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    with pytest.MonkeyPatch.context() as patch:
        # Hydra closes all handlers before it adds its own; absl's would close the stream that it began with, pytest's.
        patch.setattr(absl.logging.get_absl_handler().python_handler, "stream", sys.__stderr__)
        _configure_jax(options)
        yield
    root.handlers[:] = handlers
    root.setLevel(level)
    _configure_jax(before)


@pytest.fixture(scope="module")
def settings_kept(compilation_cache: Path) -> Iterator[None]:
    """After the tests of a file, the settings of the process are as they were."""
    with job_settings(compilation_cache):
        yield


def finish(command: Callable[[], None]) -> Finished:
    """Does in this process what a command does in its own."""
    out, err, status = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            command()
        except SystemExit as end:
            status = int(end.code or 0)
    return Finished(status, out.getvalue(), err.getvalue())


def run_main(*overrides: str) -> Finished:
    """Does in this process, in the present folder, what `python -m frictionzoo.run` does in its own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["frictionzoo", *overrides])
        return finish(main)


@pytest.fixture
def call(compilation_cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Finished]]:
    """Does in this process what `python -m frictionzoo.run` does in its own, in the test's folder."""
    monkeypatch.chdir(tmp_path)
    with job_settings(compilation_cache):
        yield run_main


@pytest.fixture
def pose_problem() -> Iterator[Callable[[Any], Problem]]:
    """Poses the problem of a resolved configuration; to the test's end, JAX computes as that says."""
    with contextlib.ExitStack() as stack:

        def pose_problem(settings: Any) -> Problem:
            stack.enter_context(computing(*(settings[name] for name in ("dtype", "device", "compilation_cache"))))
            return Problem.from_settings(settings)

        yield pose_problem


RUNS = {  # options of the runs of `finished_run`, besides those of `tiny`
    "mujoco_default": ("model=mujoco_default", "fit=lm"),
    "coulomb_smooth": ("model=coulomb_smooth", "fit.iterations=3"),
    "coulomb_stribeck": ("model=coulomb_stribeck", "fit=lm"),
    "neural_friction": ("model=neural_friction", "model.hidden=[4,4]", "segments.length=3", "fit.iterations=3"),
    "actuator_lstm": ("model=actuator_lstm", "model.hidden=[4]", "model.units=2", "fit=lm"),
    "sweep": ("-m", "model=baseline,coulomb_smooth", "fit.iterations=3"),
}


@pytest.fixture(scope="session")
def finished_run(
    shared_folder: Path, compilation_cache: Path, tiny: tuple[str, ...]
) -> Callable[[str], tuple[Path, Finished]]:
    """The folder of a run of `RUNS` that ended well, and what it printed; made once for all tests and workers.

    It is there to be read: a test that writes into a run's folder takes a copy.
    """

    def finished_run(name: str) -> tuple[Path, Finished]:
        haste = jax.config.read(UNOPTIMISED)  # the last bits differ with it
        home = shared_folder / "runs" / f"{name}{'_in_haste' if haste else ''}"
        told = home / "finished.json"
        home.mkdir(parents=True, exist_ok=True)
        with FileLock(home.with_suffix(".lock")):
            if not told.exists():
                option = "hydra.sweep.dir" if "-m" in RUNS[name] else "hydra.run.dir"
                with contextlib.chdir(home), job_settings(compilation_cache), pytest.MonkeyPatch.context() as patch:
                    patch.setattr("frictionzoo.report.comparison_plots.FORMATS", ("png",))  # a PDF takes as long again
                    finished = run_main(*RUNS[name], *tiny, f"{option}={home / 'run'}")
                assert finished.status == 0, finished.err
                told.write_text(json.dumps(vars(finished)))
        return home / "run", Finished(**json.loads(told.read_text()))

    return finished_run


def _configure_jax(options: dict[str, Any]) -> None:
    for name, value in options.items():
        jax.config.update(name, value)
    jax_cache.reset_cache()


@pytest.fixture(scope="session")
def make_runs() -> Callable[..., list[Run]]:
    """Makes runs to compare: each one's error is larger than that of the one before it.

    Arguments are `labels`, of which `baseline` is the model without friction; `joints`, how many; and for one label
    each, `diverged`, whose every rollout leaves the finite numbers halfway, and `grid`, found by a grid search.
    """
    return lambda labels, joints=1, diverged=None, grid=None: [
        make_run(i, label, joints, label == diverged, label == grid) for i, label in enumerate(labels)
    ]


def changed(record: Any, **changes: Any) -> Any:
    """Copy a record with other content, as if read from its file; a mapping changes only its own keys of a section."""

    def merge(content: Any, changes: Any) -> Any:
        if not isinstance(content, dict) or not isinstance(changes, dict):
            return changes
        return content | {key: merge(content.get(key), value) for key, value in changes.items()}

    return msgspec.convert(merge(to_json(record), to_json(changes)), type(record))


def put(record: Any, path: str, value: Any) -> None:
    """Set a field of a record or an entry of its lists, by a path such as `fit.moving`, to plain content."""
    *sections, key = [int(name) if name.isdigit() else name for name in path.split(".")]
    section: Any = functools.reduce(getitem, sections, record)
    if isinstance(section, Record):
        kind = get_type_hints(type(section), include_extras=True)[str(key)]
        setattr(section, str(key), msgspec.convert(to_json(value), kind))
    else:
        section[key] = value


def trace_nothing(segments: Segments) -> Curves:
    """The curves of a drive that nobody draws."""
    none, flat, states = np.empty(0), np.empty((0, segments.qpos.shape[2])), (segments.qpos, segments.qvel)
    moved = [state[:, 1:] for state in states]
    loads = np.empty((segments.count, 0))
    return Curves(*states, segments.signals, loads, *moved, *moved, *[none] * 6, *[flat] * 3, {})


def spoil(objective: Objective) -> None:
    """Make the commands of the first block NaN."""
    data = objective.data
    objective.data = data._replace(signals=data.signals.map(lambda signal: signal.at[0].set(np.nan)))


def make_run(place: int, label: str, joints: int = 1, diverged: bool = False, grid: bool = False) -> Run:
    """Make the run at this place of a ranking."""
    noise = np.random.default_rng(place)
    time = 0.01 * np.arange(101)[None, :, None]
    measured = np.sin(5 * time + np.arange(3)[:, None, None] + np.arange(joints))
    size = 0.5 if label == "baseline" else 0.01 * (1 + place)
    error = size * np.sin(9 * time + place)[:, 1:] + 0.002 * noise.normal(size=(3, 100, joints))
    if diverged:
        error[:, 50:] = np.inf
    mae = np.full(6, np.nan) if diverged else np.abs(error).mean() * (1 + 0.1 * noise.normal(size=6))
    velocity = np.linspace(-2, 2, 11)
    friction = (1 + place) * np.tanh(velocity)[:, None] * np.ones(joints)
    values = np.linspace(0.5, 1 + place, 4)[:, None] * np.ones(joints)
    moved = measured[:, 1:]
    curves = Curves(
        *(measured, 5 * measured, Signals(moved), np.zeros((3, 0))),
        *(moved + error, 5 * (moved + error), moved, 5 * moved),
        *(mae, mae, *np.abs(noise.normal(size=(3, 40))), velocity),
        *(friction, friction - 0.1 * place, friction + 0.1 * place),
        {"iteration": np.arange(4.0), "loss": np.array([4.0, 5.0, 3.0, 1.0]), "friction.damping": values},
    )
    return Run(label, Path(f"{place}_{label}"), _make_result(place, label, curves, grid), curves)


def _make_result(place: int, label: str, curves: Curves, grid: bool) -> Result:
    joints, damping = curves.qpos.shape[2], curves.history["friction.damping"][-1]
    names = [f"joint {i}" for i in range(joints)]
    fitted = {"low": 0.1, "high": 100.0, "identified": True, "at_bound": False, "interval": None, "identifiable": None}
    shares = {"train": 0.8, "test": 1.0, "baseline": 2.0}
    metrics = {part: _measure(curves.test_mae * share) for part, share in shares.items()}
    kept = "position_mae", "position_rmse", "velocity_rmse"
    errors = {part: {key: row[key] for key in kept} for part, row in metrics.items()}
    paper = {"model": metrics["test"], "baseline": metrics["baseline"]}
    log = {"samples": 500, "sha256": 64 * "a", "payload": None}
    values = [float(value) for value in damping]
    by_joint = [{"name": name, "joints": [name], "value": v, **fitted} for name, v in zip(names, values, strict=True)]
    row = {"name": "damping", "owner": "friction", "unit": "N m s/rad", **fitted, "by_joint": by_joint}
    content = {
        "schema_version": SCHEMA_VERSION,
        "model": label.split()[0],
        "joints": names,
        "data": {
            **{"name": "waves", "sha256": 64 * "a", "origin": "simulated", "timestep": 0.01, "samples": 1000},
            "logs": [{"name": part, "part": part, **log} for part in ("train", "test")],
        },
        "parameters": [row | {"value": values if joints > 1 else values[0]}],
        **{"indistinct": [], "no_intervals": "nobody asked", "network": None, "torque": None, "links": None},
        "metrics": metrics,
        "by_horizon": [{"horizon": 0.5, **metrics}],
        "by_joint": [{"joint": name, **errors} for name in names],
        "paper": {"a": paper, "b": paper},
        "evaluation": {"sha256": 64 * "b", "window": 0.1},
        "fit": {
            **{"method": "grid" if grid else "adam", "iterations": 3, "best_iteration": 3, "loss": 1.0},
            **{"stopped": "finished", "falling": 0.0, "moving": []},
        },
        "timing": {"setup": 1.0, "compile": 2.0, "fit": 3.25, "uncertainty": 0.25, "evaluate": 0.5, "total": 7.0},
        **{"seed": place, "dtype": "float32", "engine": "specialised"},
        "proof": {"step": 0.0, "rollout": 1e-15, "cases": 32, "steps": 8},
        **{"warnings": [], "not_identified": None, "reference": [], "residual": None},
        "settings": {"seed": place},
        **{"columns": [], "covariance": None, "recipe": [], "notes": [], "device": "cpu", "written": [], "card": None},
        "versions": dict.fromkeys(("python", *PACKAGES), "1"),
        "verdict": {"grade": "no problems found", "findings": [], "commands": []},
    }
    return msgspec.convert(content, Result)


def _measure(mae: np.ndarray) -> dict[str, Any]:
    lost = int(np.isnan(mae).sum())
    errors = {"position_mae": mae.mean(), "position_mae_std": mae.std(), "position_rmse": 0.1, "velocity_rmse": 0.1}
    return {
        **{key: None if lost else float(error) for key, error in errors.items()},
        **{"unit": "rad", "velocity_unit": "rad/s", "horizon": 0.5, "rollouts": len(mae), "diverged": lost},
    }
