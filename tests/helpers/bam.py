"""BAM's parameters, logs simulated by BAM's own equations, and options of an identification from them."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from frictionzoo.bench.read_bam import read_bam

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
    """The limit of BAM's dry friction [N m]: m6 with terms that other models lack."""
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
def write_bam_file(tmp_path: Path) -> Callable[[dict[str, Any]], Path]:

    def write_bam_file(bam: dict[str, Any]) -> Path:
        path = tmp_path / f"{bam.get('model')}.json"
        path.write_text(json.dumps(bam))
        return path

    return write_bam_file
