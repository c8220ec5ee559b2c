"""Robots for tests: a whole arm, and recordings by MuJoCo C of any drive under a position controller."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np

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
    gains: Mapping[str, float | Sequence[float]],
    headers: Mapping[str, Sequence[str]],
    *,
    seconds: float = 10.0,
    noise: tuple[float, float] = (2e-6, 1e-3),
    seed: int = 0,
    substeps: int = 1,
) -> None:
    """A recording by MuJoCo C under its own position controllers, as CSV with a sample each step of the `mjcf`.

    `truth` has armature, frictionloss and damping of each joint, `gains` kp and kd; `noise` is the standard deviation
    of positions [rad] and velocities [rad/s]. A command lasts through the `substeps` of a sample: a drive's motion
    knows of no steps, and with one of 1 or 2 ms, what it does to friction is in the recording.
    """
    spec = mujoco.MjSpec.from_string(mjcf)
    for index, joint in enumerate(spec.joints):
        joint.armature, joint.frictionloss = truth["armature"][index], truth["frictionloss"][index]
        joint.damping = [truth["damping"][index], 0.0, 0.0]
        actuator = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        kp, kd = (float(np.broadcast_to(gains[gain], len(spec.joints))[index]) for gain in ("kp", "kd"))
        actuator.set_to_position(kp=kp, kv=kd)
    model = spec.compile()
    data, rng, time = mujoco.MjData(model), np.random.default_rng(seed), np.arange(0, seconds, model.opt.timestep)
    model.opt.timestep /= substeps
    frequencies, phases = rng.uniform(0.5, 9.0, (4, model.nv)), rng.uniform(0, 2 * np.pi, (4, model.nv))
    amplitudes = rng.uniform(0.5, 1.0, (4, model.nv)) / frequencies
    ctrl = (amplitudes * np.sin(time[:, None, None] * frequencies + phases)).sum(axis=1)
    states = np.empty((len(time), 2 * model.nv))
    data.qpos[:] = ctrl[0]
    for state, data.ctrl[:] in zip(states, ctrl, strict=True):
        state[:] = np.concatenate([data.qpos, data.qvel])
        mujoco.mj_step(model, data, nstep=substeps)
    states += rng.normal(size=states.shape) * np.repeat(noise, model.nv)
    columns = ",".join(["time", *itertools.chain(*headers.values())])
    np.savetxt(path, np.hstack([time[:, None], states, ctrl]), fmt="%.9g", delimiter=",", header=columns, comments="")
