"""What the caller brings to programs that read no actuator law of MuJoCo: torques, and the inertia of payloads."""

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from given import Given


def make_torque(
    given: Given, module: Any, bench: mujoco.MjModel, rollout: int
) -> Callable[[int, np.ndarray, np.ndarray], np.ndarray]:
    """Torques of the bench's actuators in a rollout, from the number of the step, positions and velocities.

    `module` is `drive.py`, which has the law's controller.
    """
    law, gain, bias = module.Actuator(), bench.actuator_gainprm[:, 0], bench.actuator_biasprm.T

    def torque(number: int, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        signals = {name: signal[rollout, number] for name, signal in given.acting.items()}
        ctrl = law.control(np, module.ACTUATOR, qpos, qvel, signals.pop("ctrl"), signals)
        return gain * ctrl + bias[0] + bias[1] * qpos + bias[2] * qvel

    return torque


def find_matter(bench: mujoco.MjModel, body: int) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass and inertia about that of a body, in the frame of its link, which is that of its joint."""
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, bench.body_iquat[body])
    axes = axes.reshape(3, 3)
    anchor = bench.jnt_pos[bench.body_jntadr[body]] if bench.body_jntnum[body] else np.zeros(3)
    return bench.body_mass[body], bench.body_ipos[body] - anchor, axes * bench.body_inertia[body] @ axes.T
