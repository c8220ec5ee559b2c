"""Torques and payload inertia for programs that do not read MuJoCo's actuator parameters."""

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from given import Given


def make_torque(
    given: Given, module: Any, bench: mujoco.MjModel, rollout: int
) -> Callable[[int, np.ndarray, np.ndarray], np.ndarray]:
    """Return a function from step number, positions and velocities to the actuator torques in a rollout.

    `module` is `drive.py`, which contains the actuator's controller.
    """
    law, gain, bias = module.Actuator(), bench.actuator_gainprm[:, 0], bench.actuator_biasprm.T

    def torque(number: int, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        signals = {name: signal[rollout, number] for name, signal in given.acting.items()}
        ctrl = law.control(np, module.ACTUATOR, qpos, qvel, signals.pop("ctrl"), signals)
        return gain * ctrl + bias[0] + bias[1] * qpos + bias[2] * qvel

    return torque


def find_matter(bench: mujoco.MjModel, body: int) -> tuple[float, np.ndarray, np.ndarray]:
    """Return a body's mass, centre of mass and inertia about that centre, in the frame of its joint."""
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, bench.body_iquat[body])
    axes = axes.reshape(3, 3)
    anchor = bench.jnt_pos[bench.body_jntadr[body]] if bench.body_jntnum[body] else np.zeros(3)
    return bench.body_mass[body], bench.body_ipos[body] - anchor, axes * bench.body_inertia[body] @ axes.T
