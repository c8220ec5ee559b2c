"""What tests share: configurations, parts built from them, recordings, and jobs, in this process or in their own."""

import logging
import os
import subprocess
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import absl.logging
import jax
import numpy as np
import pytest
import torch
from jax.experimental.compilation_cache import compilation_cache as jax_cache
from omegaconf import DictConfig, OmegaConf

from frictionzoo.bench import Bench
from frictionzoo.build import build
from frictionzoo.compare import Run
from frictionzoo.config import compose_config
from frictionzoo.report.curves import Curves
from frictionzoo.run import main

# As for XLA in `pytest_configure`; torch is loaded and no longer looks at the environment.
torch.set_num_threads(1)

DATA = os.environ.get("FRICTIONZOO_DATA")
needs_data = pytest.mark.skipif(DATA is None, reason="FRICTIONZOO_DATA is not set; it names the folder of recordings")

ROOT = Path(__file__).parent.parent
CACHE_OPTIONS = {  # keep every compiled function, however small
    "jax_persistent_cache_min_compile_time_secs": 0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}
BRIEF = {  # options of an evaluation that takes no time
    "evaluation.horizons": "[0.1]",
    "evaluation.rollouts": "1",
    "evaluation.places": "1",
    "evaluation.trajectory": "0.1",
    "evaluation.window": "0.02",
}
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


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Experiments, the longest tests, come first: at the end one worker would wait for the other's."""
    items.sort(key=lambda item: item.path.stem != "test_experiments")


def slow_but(quick: Collection[Any], values: Iterable[Any]) -> list[Any]:
    """Parameters of a test; those that are not among the quick ones make slow tests."""
    return [
        pytest.param(
            *(value if isinstance(value, tuple) else (value,)), marks=[] if value in quick else pytest.mark.slow
        )
        for value in values
    ]


@dataclass(frozen=True)
class Finished:
    """What a command left: exit status, standard output and standard error."""

    status: int
    out: str
    err: str


@pytest.fixture(scope="session")
def compose() -> Callable[..., DictConfig]:
    """Composes a job's configuration from overrides, as the command line would."""
    return compose_config


@pytest.fixture(scope="session")
def make() -> Callable[..., Any]:
    """Builds the part `section` of the configuration with these overrides; more arguments go to the constructor."""

    def make(section: str, *overrides: str, **more: Any) -> Any:
        config = OmegaConf.to_container(compose_config(*overrides), resolve=True)
        return build(config[section], **more)

    return make


@pytest.fixture(scope="session")
def knee(make: Callable[..., Any]) -> Bench:
    """The paper's bench."""
    return make("bench")


@pytest.fixture(scope="session")
def compilation_cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the workers of the tests, and the programs that they start, share compiled functions."""
    folder = tmp_path_factory.getbasetemp()
    folder = (folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder) / "xla"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="session", autouse=True)
def compiled_once(compilation_cache: Path) -> None:
    """Most of a test's time goes into compiling: what was compiled before, with other parameters say, is read."""
    _configure_jax({"jax_compilation_cache_dir": str(compilation_cache), **CACHE_OPTIONS})


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A CSV recording of 1.5 s at 1 ms: the paper's rod under its controller, with Coulomb and viscous friction."""
    samples, timestep, inertia = 1500, 1e-3, 0.0011 + 0.26 * 0.1127**2 + 0.04
    time = timestep * np.arange(samples)
    ctrl = 0.6 * np.sin(2 * np.pi * 1.5 * time) + 0.3 * np.sin(2 * np.pi * 0.7 * time)
    qpos, qvel = np.zeros((2, samples))
    for i in range(samples - 1):
        friction = 0.1 * np.tanh(qvel[i] / 0.01) + 0.05 * qvel[i]
        torque = 20 * (ctrl[i] - qpos[i]) - qvel[i] - 0.26 * 9.81 * 0.1127 * np.sin(qpos[i]) - friction
        qvel[i + 1] = qvel[i] + timestep * torque / inertia
        qpos[i + 1] = qpos[i] + timestep * qvel[i + 1]
    path = tmp_path_factory.mktemp("recording") / "knee.csv"
    table = np.stack([time, qpos, qvel, ctrl], axis=1)
    np.savetxt(path, table, fmt="%.9g", delimiter=",", header="time,qpos,qvel,ctrl", comments="")
    return path


@pytest.fixture(scope="session")
def tiny(recording: Path) -> tuple[str, ...]:
    """Overrides of a job of seconds. Its rollouts have one shape, so that little is compiled."""
    return (
        *("data=files", f"data.train=[{recording}]", "data.split.gap=0.05", "dtype=float64"),
        *("segments.count=20", "loop.chunk=2", "loop.progress=false"),
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


@pytest.fixture
def start(compilation_cache: Path, tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen]]:
    """Starts `python -m frictionzoo.run` as a process in the test's folder; none outlives the test."""
    cache = {"JAX_COMPILATION_CACHE_DIR": compilation_cache, **{key.upper(): v for key, v in CACHE_OPTIONS.items()}}
    started: list[subprocess.Popen] = []

    def start(*overrides: str) -> subprocess.Popen:
        environment = {**os.environ, "PYTHONPATH": str(ROOT), **{key: str(value) for key, value in cache.items()}}
        command = [sys.executable, "-m", "frictionzoo.run", *overrides]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        started.append(subprocess.Popen(command, cwd=tmp_path, env=environment, **pipes))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.communicate()


@pytest.fixture
def call(
    compilation_cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Iterator[Callable[..., Finished]]:
    """Does in this process what `python -m frictionzoo.run` does in its own, in the test's folder."""
    options = {"jax_compilation_cache_dir": str(compilation_cache), **CACHE_OPTIONS}
    before = {name: getattr(jax.config, name) for name in (*options, "jax_enable_x64", "jax_default_device")}
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    # Hydra closes all handlers before it adds its own, and absl's would close the stream that it began with, pytest's.
    monkeypatch.setattr(absl.logging.get_absl_handler().python_handler, "stream", sys.__stderr__)
    _configure_jax(options)

    def call(*overrides: str) -> Finished:
        monkeypatch.setattr(sys, "argv", ["frictionzoo", *overrides])
        capsys.readouterr()
        try:
            main()
            status = 0
        except SystemExit as end:
            status = int(end.code or 0)
        written = capsys.readouterr()
        return Finished(status, written.out, written.err)

    yield call
    root.handlers[:] = handlers
    root.setLevel(level)
    _configure_jax(before)


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

    def make_runs(
        labels: Sequence[str], joints: int = 1, diverged: str | None = None, grid: str | None = None
    ) -> list[Run]:
        return [_make_run(i, label, joints, label == diverged, label == grid) for i, label in enumerate(labels)]

    return make_runs


def _make_run(place: int, label: str, joints: int, diverged: bool, grid: bool) -> Run:
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
    curves = Curves(
        *(
            measured,
            5 * measured,
            measured[:, 1:],
            np.zeros((3, 0)),
            measured[:, 1:] + error,
            5 * (measured[:, 1:] + error),
        ),
        *(mae, mae, *np.abs(noise.normal(size=(3, 40))), velocity),
        *(friction, friction - 0.1 * place, friction + 0.1 * place),
        {"iteration": np.arange(4.0), "loss": np.array([4.0, 5.0, 3.0, 1.0]), "friction.damping": values},
    )
    return Run(label, Path(f"{place}_{label}"), _make_result(place, label, curves, grid), curves)


def _make_result(place: int, label: str, curves: Curves, grid: bool) -> dict[str, Any]:
    joints, damping = curves.qpos.shape[2], curves.history["friction.damping"][-1]
    metrics = {
        part: _measure(curves.test_mae * share) for part, share in (("train", 0.8), ("test", 1), ("baseline", 2))
    }
    paper = {"model": metrics["test"], "baseline": metrics["baseline"]}
    log = {"samples": 500, "sha256": 64 * "a", "payload": None}
    return {
        "model": label.split()[0],
        "joints": [f"joint {i}" for i in range(joints)],
        "data": {
            **{"name": "waves", "sha256": 64 * "a", "simulated": True, "timestep": 0.01, "samples": 1000},
            "logs": [{"name": part, "part": part, **log} for part in ("train", "test")],
        },
        "parameters": [
            {
                **{"name": "damping", "owner": "friction", "unit": "N m s/rad", "low": 0.1, "high": 100.0},
                "value": damping.tolist() if joints > 1 else float(damping[0]),
                **{"identified": True, "at_bound": False, "interval": None, "identifiable": None},
            }
        ],
        **{"indistinct": [], "no_intervals": "nobody asked", "network": None},
        "metrics": metrics,
        "by_horizon": [{"horizon": 0.5, **metrics}],
        "paper": {"a": paper, "b": paper},
        "evaluation": {"sha256": 64 * "b", "window": 0.1},
        "fit": {
            **{"method": "grid" if grid else "adam", "iterations": 3, "best_iteration": 3, "loss": 1.0},
            "stopped": "finished",
        },
        "timing": {"setup": 1.0, "compile": 2.0, "fit": 3.25, "uncertainty": 0.25, "evaluate": 0.5, "total": 7.0},
        **{"seed": place, "dtype": "float32", "engine": "specialised"},
        "settings": {"seed": place},
    }


def _measure(mae: np.ndarray) -> dict[str, Any]:
    lost = int(np.isnan(mae).sum())
    errors = {"position_mae": mae.mean(), "position_mae_std": mae.std(), "position_rmse": 0.1, "velocity_rmse": 0.1}
    return {
        **{key: None if lost else float(error) for key, error in errors.items()},
        **{"unit": "rad", "velocity_unit": "rad/s", "horizon": 0.5, "rollouts": len(mae), "diverged": lost},
    }
