"""BAM's parameter files: read, simulated by BAM's own equations apart from this package, and identified again."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from omegaconf import OmegaConf

from frictionzoo.bench.read_bam import LAWS, main, read_bam
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.state import DriveState
from frictionzoo.export.bam import friction_budget
from frictionzoo.fit.chunk import search
from frictionzoo.identification import Problem
from frictionzoo.models import get_model

M1 = {
    **{"kt": 1.1776, "R": 2.4787, "armature": 0.0261, "q_offset": -0.0506, "command_delay": 0.0},
    **{"error_gain_ratio": 1.0049, "friction_base": 0.0515, "friction_viscous": 0.0599},
    **{"model": "m1", "actuator": "sts3215"},
}
M2 = {**M1, "model": "m2", "friction_stribeck": 0.03, "dtheta_stribeck": 0.2, "alpha": 1.35}
M3 = {**M1, "model": "m3", "load_friction_base": 0.08}
M4 = {**M2, **M3, "model": "m4", "load_friction_stribeck": 0.05}
M5 = {
    **{**M2, "model": "m5", "load_friction_motor": 0.05, "load_friction_external": 0.12},
    **{"load_friction_motor_stribeck": 0.02, "load_friction_external_stribeck": 0.06},
}
M6 = {**M5, "model": "m6", "load_friction_motor_quad": 0.03, "load_friction_external_quad": 0.07}
SUPPLY, GRAVITY, SAMPLE, STEP = 12.0, 9.81, 0.01, 0.0002
LENGTH = 0.15
MASSES, GAINS = (0.4, 1.0), (4, 8, 16, 32)


def command(time: np.ndarray | float, phase: np.ndarray) -> np.ndarray:
    """Two sines, fast enough that inertia shows and with reversals, where dry friction does."""
    return 0.8 * np.sin(2 * np.pi * 0.6 * time + phase) + 0.4 * np.sin(2 * np.pi * 1.7 * time + 2 * phase)


def dry(bam: dict[str, Any], motor: np.ndarray, external: np.ndarray, velocity: np.ndarray) -> Any:
    """The limit of BAM's dry friction [N m]: m6 with its own terms, of which the other laws lack some."""
    of = lambda name: bam.get(f"load_friction_{name}", 0.0)  # noqa: E731
    load, at_rest = (
        of(together) * np.abs(external - motor) + np.abs(of(f"external{part}") * external - of(f"motor{part}") * motor)
        for together, part in (("base", ""), ("stribeck", "_stribeck"))
    )
    always = bam["friction_base"] + load
    if bam["model"] in ("m1", "m3"):
        return always
    driving = of("external_quad") * external**2 * (np.abs(external) < np.abs(motor))
    driven = of("motor_quad") * motor**2 * (np.abs(external) > np.abs(motor))
    opposed = np.sign(external) != np.sign(motor)
    share = np.exp(-(np.abs(velocity / bam["dtheta_stribeck"]) ** bam["alpha"]))
    return always + share * (bam["friction_stribeck"] + at_rest + opposed * (driving + driven))


def simulate(bam: dict[str, Any], mass: np.ndarray, gain: np.ndarray, seconds: float) -> dict[str, np.ndarray]:
    """A pendulum of point masses under BAM's m1 to m6: friction is what stops the joint, up to a limit."""
    phase = np.arange(len(mass), dtype=float)
    position, velocity = np.zeros((2, len(mass)))
    inertia = mass * LENGTH**2 + bam["armature"]
    recorded = {name: [] for name in ("position", "speed", "goal_position")}
    every = round(SAMPLE / STEP)
    for i in range(round(seconds / STEP)):
        if i % every == 0:
            goal = command(i * STEP, phase)
            for name, value in zip(recorded, (position, velocity, goal), strict=True):
                recorded[name].append(value)
        duty = np.clip(gain * 0.166 * bam["error_gain_ratio"] * (goal - position), -0.97, 0.97)
        motor = bam["kt"] / bam["R"] * (SUPPLY * duty - bam["kt"] * velocity)
        external = -mass * GRAVITY * LENGTH * np.sin(position + bam["q_offset"])
        limit = dry(bam, motor, external, velocity) + bam["friction_viscous"] * np.abs(velocity)
        net = motor + external
        stop = inertia / STEP * velocity + net
        velocity = velocity + STEP / inertia * (net - np.clip(stop, -limit, limit))
        position = position + STEP * velocity
    return {name: np.array(values) for name, values in recorded.items()}


def write_logs(folder: Path, bam: dict[str, Any], seconds: float) -> None:
    """One log a mass and gain, in BAM's format."""
    mass, gain = (grid.ravel() for grid in np.meshgrid(MASSES, GAINS))
    recorded = simulate(bam, mass, gain, seconds)
    for column in range(len(mass)):
        entries = [
            {name: values[i, column] for name, values in recorded.items()}
            | {"timestamp": i * SAMPLE, "input_volts": SUPPLY, "torque_enable": True}
            for i in range(len(recorded["position"]))
        ]
        header = {"mass": mass[column], "length": LENGTH, "kp": int(gain[column]), "motor": "sts3215"}
        (folder / f"{column}.json").write_text(json.dumps(header | {"entries": entries}))


def options(folder: Path, file: Path, *overrides: str) -> list[str]:
    """Of an identification from these logs, with all that the parameter file says as known but for the overrides."""
    payloads = ",".join(f"{{when:{{mass:{mass}}},payload:[{mass},0,0,-{LENGTH},0,0,0]}}" for mass in MASSES)
    said = dict(override.split("=", 1) for override in (*read_bam(file).overrides(), *overrides))
    columns = "time:timestamp,qpos:[position],qvel:[speed],ctrl:[goal_position],supply:input_volts,enable:torque_enable"
    return [
        *("data=files", "bench=sts3215", "recipe=given", "dtype=float64", "compilation_cache=null"),
        *(f"data.train={folder}/*.json", f"data.payload=[{payloads}]"),
        *(f"data.columns={{{columns}}}", "data.units={time:s,qpos:rad,qvel:rad/s,ctrl:rad,supply:V}"),
        *("data.inputs={gain:kp}", "data.split.by=kp", "data.split.test=[32]"),
        *("evaluation.placement=consecutive", "evaluation.horizons=[1.0]", "evaluation.trajectory=3.0"),
        # Explicit steps h shift the damping by about d^2 h / (2 J), with d all that brakes, back-EMF included.
        *("bench.timestep=0.0005", "bench.solreffriction=[0.002,1.0]", "segments.count=null", "segments.length=100"),
        *("loss.velocity=0.01", "loss.robust=soft_l1", "loss.robust_scale=0.01"),
        *(f"{name}={value}" for name, value in said.items()),
    ]


@pytest.fixture
def write(tmp_path: Path) -> Callable[[dict[str, Any]], Path]:
    """Writes a parameter file."""

    def write(bam: dict[str, Any]) -> Path:
        path = tmp_path / f"{bam.get('model')}.json"
        path.write_text(json.dumps(bam))
        return path

    return write


def test_bams_own_equations_are_followed_and_identified(
    compose: Callable[..., Any], pose_problem: Callable[[Any], Problem], write: Callable[..., Path], tmp_path: Path
) -> None:
    """With the law that has all terms, over 3 s of motion by 1 rad; steps of 0.5 ms against 0.2 ms.

    kt and R are known: at a constant supply, back-EMF kt^2 / R and damping brake alike, and only their sum shows.
    """
    logs = tmp_path / "logs"
    logs.mkdir()
    write_logs(logs, M6, seconds=3.1)
    start = "{{init:{},low:1e-3,high:2,scale:log,identify:true}}".format
    free = {"bench.params.armature": 0.01, "model.params.frictionloss": 0.15, "model.params.damping": 0.02}
    freed = (f"{name}={start(init)}" for name, init in free.items())
    settings = compose(*options(logs, write(M6), "fit=lm", *freed))
    problem = pose_problem(OmegaConf.to_container(settings, resolve=True))
    progress, _ = search(problem.fit, problem.objective)
    found = jax.tree.map(np.asarray, problem.objective.space.values(progress.best))
    assert found["friction"]["damping"] == pytest.approx(M6["friction_viscous"], rel=0.02)
    assert found["friction"]["frictionloss"] == pytest.approx(M6["friction_base"], rel=0.02)
    assert found["bench"]["armature"] == pytest.approx(M6["armature"], rel=0.05)

    measured = problem.evaluation.trajectories
    said = {"frictionloss": M6["friction_base"], "damping": M6["friction_viscous"]}
    friction = found["friction"] | {name: np.array([value]) for name, value in said.items()}
    values = {"bench": found["bench"] | {"armature": np.array([M6["armature"]])}, "friction": friction}
    states = measured.qpos[:, 0], measured.qvel[:, 0]
    qpos, _ = problem.drive.rollout.compiled(values, *states, measured.signals, measured.load)
    assert np.abs(np.asarray(qpos) - measured.qpos[:, 1:]).max() < 0.003


@pytest.mark.parametrize("bam", [M1, M2, M3, M4, M5, M6], ids=lambda bam: bam["model"])
def test_a_parameter_file_is_the_law_itself(write: Callable[..., Path], bam: dict[str, Any]) -> None:
    """Its limit is BAM's over states of both signs and at rest, by the law here and by what the target `bam` computes.

    At rest the share is exp(-1e-12^(alpha / 2)), 8e-9 below 1 with this alpha.
    """
    drive = read_bam(write(bam))
    law = get_model(drive.model)
    assert drive.model == LAWS[bam["model"]][0]
    assert set(law.dimensions) == set(drive.friction)
    state = DriveState(*np.random.default_rng(0).normal(scale=2.0, size=(5, 200)))
    state.qvel[:50] *= 0.1
    state.qvel[:5] = 0.0
    section = {name: {"init": 1.0, "low": 0.0, "high": 2.0, "scale": 1.0, "identify": True} for name in drive.friction}
    terms = law(1, section).terms(np, {name: np.array(value) for name, value in drive.friction.items()}, state)
    expected = dry(bam, state.motor_torque, state.external_torque, state.qvel)
    np.testing.assert_allclose(terms.frictionloss, expected, rtol=1e-7)
    np.testing.assert_allclose(friction_budget(bam, state).frictionloss, expected, rtol=1e-12)
    assert terms.damping == bam["friction_viscous"]


def test_what_bam_does_and_we_do_not_is_said(write: Callable[..., Path]) -> None:
    assert "max_velocity" in " ".join(read_bam(write(M1 | {"max_velocity": 5.3})).remarks)
    assert not read_bam(write(M1)).remarks


def test_the_command_prints_options(write: Callable[..., Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(write(M1))]) == 0
    options = capsys.readouterr().out.split()
    assert options[:2] == ["model=mujoco_default", "fit=known"]
    assert f"bench.actuator.params.kt_over_r={{init:{M1['kt'] / M1['R']!r}," in " ".join(options)


@pytest.mark.parametrize(
    ("bam", "message"),
    [
        ({"model": "m1"}, "no model"),
        (M1 | {"actuator": "erob80_50"}, "actuator=erob80_50"),
        (M1 | {"model": "m6"}, "friction_stribeck is missing"),
        (M1 | {"model": ["m1"]}, "no model"),
        (M2 | {"alpha": 0.0}, "alpha is 0"),
        (M1 | {"R": 0.0}, "R is 0"),
        (M1 | {"friction_base": None}, "friction_base is missing"),
        (M1 | {"armature": float("nan")}, "armature is nan"),
    ],
)
def test_a_file_that_we_cannot_hold_is_refused(
    write: Callable[..., Path], capsys: pytest.CaptureFixture[str], bam: dict[str, Any], message: str
) -> None:
    path = write(bam)
    with pytest.raises(ConfigError, match=message):
        read_bam(path)
    assert main([str(path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_file_that_is_not_json_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("kt=1")
    for name in ("a.json", "none.json"):
        with pytest.raises(ConfigError, match=name):
            read_bam(tmp_path / name)
