"""Motions of an arm, and logs of the torque that they need."""

import mujoco
import numpy as np

from frictionzoo.bench.regressor import inverse_torque
from frictionzoo.core.log import Log
from helpers.robots import TRUTH

STEP = 0.002  # s


def move(nv: int, seconds: float = 8.0, seed: int = 0) -> np.ndarray:
    """Positions, velocities and accelerations of a motion that excites all joints, exactly."""
    rng, time = np.random.default_rng(seed), np.arange(0, seconds, STEP)[:, None, None]
    rates, phases = 2 * np.pi * rng.uniform(0.1, 1.5, (6, nv)), rng.uniform(0, 2 * np.pi, (6, nv))
    sizes = 1.5 * rng.uniform(0.5, 1.0, (6, nv)) / rates
    parts = (np.sin(rates * time + phases), rates * np.cos(rates * time + phases))
    waves = (parts[0], parts[1], -(rates**2) * parts[0])
    return np.stack([(sizes * wave).sum(axis=1) for wave in waves])


def log_of(qpos: np.ndarray, torque: np.ndarray, name: str = "a") -> Log:
    time = STEP * np.arange(len(qpos))
    return Log(name, time, qpos, np.gradient(qpos, STEP, axis=0), torque, "hash", True)


def needed(model: mujoco.MjModel, motion: np.ndarray) -> np.ndarray:
    """Torque of links, armature, Coulomb and viscous friction, by MuJoCo C's inverse dynamics."""
    rigid = inverse_torque(model, *motion)
    friction = TRUTH["frictionloss"] * np.sign(motion[1]) + TRUTH["damping"] * motion[1]
    return rigid + TRUTH["armature"] * motion[2] + friction
