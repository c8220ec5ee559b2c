"""A whole arm at once: armature, dry friction and damping of five joints from one recording."""

import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np
import pytest
from conftest import BRIEF

JOINTS = [f"joint{index}" for index in range(5)]
TRUTH = {
    "armature": np.array([0.5, 0.45, 0.3, 0.15, 0.08]),
    "frictionloss": np.array([1.2, 1.5, 0.8, 0.5, 0.3]),
    "damping": np.array([1.0, 1.4, 0.7, 0.4, 0.2]),
}
HEADERS = {signal: [f"{signal}{index}" for index in range(5)] for signal in ("qpos", "qvel", "ctrl")}
GAINS = {"kp": 400.0, "kd": 40.0}
LENGTHS, MASSES = (0.15, 0.2, 0.2, 0.2, 0.1), (4.0, 4.0, 3.0, 2.0, 1.0)  # m, kg
TIMESTEP = 1e-3


def arm() -> str:
    """An MJCF of the size of a small collaborative robot, without what is identified."""
    body = ""
    for index in reversed(range(len(JOINTS))):
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


def record(
    path: Path,
    mjcf: str,
    truth: Mapping[str, Sequence[float]],
    gains: Mapping[str, float],
    headers: Mapping[str, Sequence[str]],
    *,
    seconds: float = 10.0,
    noise: tuple[float, float] = (2e-6, 1e-3),
    seed: int = 0,
) -> None:
    """A recording by MuJoCo C under its own position controllers, with the noise of encoders, as CSV."""
    spec = mujoco.MjSpec.from_string(mjcf)
    for index, joint in enumerate(spec.joints):
        joint.armature, joint.frictionloss = truth["armature"][index], truth["frictionloss"][index]
        joint.damping = [truth["damping"][index], 0.0, 0.0]
        actuator = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=gains["kp"], kv=gains["kd"])
    model = spec.compile()
    data, rng, time = mujoco.MjData(model), np.random.default_rng(seed), np.arange(0, seconds, model.opt.timestep)
    frequencies, phases = rng.uniform(0.5, 9.0, (4, model.nv)), rng.uniform(0, 2 * np.pi, (4, model.nv))
    amplitudes = rng.uniform(0.5, 1.0, (4, model.nv)) / frequencies
    ctrl = (amplitudes * np.sin(time[:, None, None] * frequencies + phases)).sum(axis=1)
    states = np.empty((len(time), 2 * model.nv))
    data.qpos[:] = ctrl[0]
    for state, data.ctrl[:] in zip(states, ctrl, strict=True):
        state[:] = np.concatenate([data.qpos, data.qvel])
        mujoco.mj_step(model, data)
    states += rng.normal(size=states.shape) * np.repeat(noise, model.nv)
    columns = ",".join(["time", *itertools.chain(*headers.values())])
    np.savetxt(path, np.hstack([time[:, None], states, ctrl]), fmt="%.9g", delimiter=",", header=columns, comments="")


@pytest.mark.slow
def test_fifteen_parameters_of_an_arm_in_one_run(call: Callable, tmp_path: Path, in_haste: None) -> None:
    (tmp_path / "arm.xml").write_text(arm())
    record(tmp_path / "arm.csv", arm(), TRUTH, GAINS, HEADERS)
    finished = call(
        *("model=mujoco_default", "fit=lm", "data=files", "data.train=[arm.csv]", "data.simulated=true"),
        *("bench.mjcf=arm.xml", f"bench.joint=[{','.join(JOINTS)}]", "hydra.run.dir=run", "loop.progress=false"),
        *(f"bench.actuator.params.{name}.init={value}" for name, value in GAINS.items()),
        *(f"data.columns.{signal}=[{','.join(names)}]" for signal, names in HEADERS.items()),
        *("bench.params.armature.init=0.2", "model.params.frictionloss.init=0.5", "model.params.damping.init=0.5"),
        *("segments.length=20", "segments.count=null", *(f"{option}={value}" for option, value in BRIEF.items())),
    )
    assert finished.status == 0, finished.err
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert result["engine"] == "specialised"
    found = {parameter["name"]: parameter["value"] for parameter in result["parameters"] if parameter["identified"]}
    assert found.keys() == TRUTH.keys()
    for name, truth in TRUTH.items():
        np.testing.assert_allclose(found[name], truth, rtol=0.05, err_msg=name)
