"""A whole arm at once: armature, dry friction and damping of seven joints from one recording."""

import json
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest
from conftest import BRIEF

JOINTS = [f"joint{index}" for index in range(1, 8)]
TRUTH = {
    "armature": np.array([0.5, 0.45, 0.3, 0.3, 0.15, 0.12, 0.08]),
    "frictionloss": np.array([1.2, 1.5, 0.8, 0.9, 0.5, 0.4, 0.3]),
    "damping": np.array([1.0, 1.4, 0.7, 0.8, 0.4, 0.3, 0.2]),
}
GAINS = {"kp": 400.0, "kd": 40.0}
LENGTHS = (0.15, 0.2, 0.2, 0.2, 0.2, 0.1, 0.08)  # m
MASSES = (4.0, 4.0, 3.0, 2.7, 1.7, 1.6, 0.5)  # kg
TIMESTEP, SECONDS = 1e-3, 60


def arm() -> str:
    """An MJCF of the size of a small collaborative robot, without what is identified."""
    body = ""
    for index in reversed(range(7)):
        mass, length = MASSES[index], LENGTHS[index]
        inertia = mass * (length**2 / 12 + 0.003)
        offset = LENGTHS[index - 1] if index else 0.1
        body = (
            f'<body pos="0 {0.02 * (index % 2)} {offset}"><joint name="{JOINTS[index]}" axis="0 {index % 2} '
            f'{1 - index % 2}"/><inertial pos="0.03 0.02 {length / 2}" mass="{mass}" '
            f'diaginertia="{inertia:.5f} {1.1 * inertia:.5f} {0.003 * mass:.5f}"/>{body}</body>'
        )
    return (
        f'<mujoco><option timestep="{TIMESTEP}" integrator="implicitfast"><flag contact="disable"/></option>'
        f"<worldbody>{body}</worldbody></mujoco>"
    )


def record(path: Path) -> None:
    """A recording by MuJoCo C under its own position controllers, with the noise of encoders, as CSV."""
    spec = mujoco.MjSpec.from_string(arm())
    for index, name in enumerate(JOINTS):
        joint = spec.joint(name)
        joint.armature, joint.frictionloss = TRUTH["armature"][index], TRUTH["frictionloss"][index]
        joint.damping = [TRUTH["damping"][index], 0.0, 0.0]
        spec.add_actuator(
            name=name,
            target=name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            gainprm=[GAINS["kp"]] + 9 * [0.0],
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            biasprm=[0.0, -GAINS["kp"], -GAINS["kd"]] + 7 * [0.0],
        )
    model = spec.compile()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    samples = int(SECONDS / TIMESTEP)
    time = TIMESTEP * np.arange(samples)
    frequencies, phases = rng.uniform(0.5, 9.0, (4, 7)), rng.uniform(0, 2 * np.pi, (4, 7))
    amplitudes = rng.uniform(0.5, 1.0, (4, 7)) / frequencies
    ctrl = (amplitudes * np.sin(time[:, None, None] * frequencies + phases)).sum(axis=1)
    states = np.empty((samples, 14))
    data.qpos[:] = ctrl[0]
    for index in range(samples):
        states[index] = np.concatenate([data.qpos, data.qvel])
        data.ctrl[:] = ctrl[index]
        mujoco.mj_step(model, data)
    states += rng.normal(size=states.shape) * np.repeat([2e-6, 1e-3], 7)
    columns = ["time", *(f"{signal}{index}" for signal in ("q", "v", "u") for index in range(1, 8))]
    table = np.hstack([time[:, None], states, ctrl])
    np.savetxt(path, table, fmt="%.9g", delimiter=",", header=",".join(columns), comments="")


@pytest.mark.slow
def test_twenty_one_parameters_of_an_arm_in_one_run(call: Callable, tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(arm())
    record(tmp_path / "arm.csv")
    headers = {signal: [f"{letter}{index}" for index in range(1, 8)] for signal, letter in SIGNALS.items()}
    finished = call(
        *("model=mujoco_default", "fit=lm", "data=files", "data.train=[arm.csv]", "data.simulated=true"),
        *("bench.mjcf=arm.xml", f"bench.joint=[{','.join(JOINTS)}]"),
        *(f"bench.actuator.params.{name}.init={value}" for name, value in GAINS.items()),
        *(f"data.columns.{signal}=[{','.join(names)}]" for signal, names in headers.items()),
        *("bench.params.armature.init=0.2", "model.params.frictionloss.init=0.5", "model.params.damping.init=0.5"),
        *("segments.length=20", "segments.count=null", "hydra.run.dir=run", "loop.progress=false"),
        *(f"{option}={value}" for option, value in BRIEF.items()),
    )
    assert finished.status == 0, finished.err
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert result["engine"] == "specialised"
    found = {parameter["name"]: parameter["value"] for parameter in result["parameters"] if parameter["identified"]}
    assert found.keys() == TRUTH.keys()
    for name, truth in TRUTH.items():
        np.testing.assert_allclose(found[name], truth, rtol=0.05, err_msg=name)


SIGNALS = {"qpos": "q", "qvel": "v", "ctrl": "u"}
