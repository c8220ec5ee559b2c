"""A rod on a hinge, recorded under friction of any kind, and what a law leaves of its torque."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from frictionzoo.api.library import law
from frictionzoo.bench import Bench, Force
from frictionzoo.core.log import Log
from frictionzoo.fit import Space
from frictionzoo.fit.motion import Filtering, Recordings
from frictionzoo.models import FrictionModel
from frictionzoo.result.residual_torque import Left, find_left

ARMATURE, DRY, VISCOUS, STEP = 0.05, 0.3, 0.2, 0.002
MASS, LENGTH, OWN = 0.26, 0.1127, 0.0011  # of knee_rod.xml
Friction = Callable[[float, float, float, float, float], float]
"""Beyond dry and viscous friction, of position, velocity, the torques of motor and gravity, and time."""


def record(more: Friction, seconds: float = 20.0, seed: int = 0, noise: float = 0.0, most: float = 1e3) -> Log:
    """A rod on a hinge, driven after a sum of sines by a controller whose torque is recorded, in MuJoCo's Euler steps.

    The motor gives at most `most` of it [N m].

    The friction is taken at the velocity at which the step begins, but where it would turn the motion round.
    """
    random, count = np.random.default_rng(seed), round(seconds / STEP)
    time, inertia = STEP * np.arange(count), ARMATURE + OWN + MASS * LENGTH**2
    rates = np.array([0.31, 0.73, 1.17, 1.9]) * (1 + 0.1 * random.normal(size=4))
    waves = np.array([0.9, 0.5, 0.3, 0.15])[:, None] * np.sin(
        2 * np.pi * rates[:, None] * time + random.uniform(0, 6.28, 4)[:, None]
    )
    wanted, states, ctrl = waves.sum(axis=0), np.zeros((count, 2)), np.zeros(count)
    qpos, qvel = float(wanted[0]), 0.0
    for i in range(count):
        motor = 20 * (float(wanted[i]) - qpos) - qvel
        gravity = -MASS * 9.81 * LENGTH * math.sin(qpos)
        states[i], ctrl[i] = (qpos, qvel), motor
        motor = min(max(motor, -most), most)
        free = qvel + STEP / inertia * (motor + gravity - VISCOUS * qvel)
        size = DRY + more(qpos, qvel, motor, gravity, i * STEP)
        stop = free * inertia / STEP
        qvel = free - STEP / inertia * (math.copysign(min(abs(size), abs(stop)), stop) if size > 0 else 0.0)
        qpos += STEP * qvel
    qpos, qvel = (states + noise * random.normal(size=states.shape)).T[:, :, None]
    warmth = 25 + 10 * time[:, None] / seconds
    return Log("rod", time, qpos, qvel, ctrl[:, None], "0" * 64, simulated=True, extras={"temperature": warmth})


def leave(log: Log, model: FrictionModel | None = None, **bench: Any) -> tuple[Left | None, Space]:
    """What is left of that torque, and the coordinates of the drive's values."""
    free = {"init": ARMATURE, "low": 1e-3, "high": 1.0, "scale": "log", "identify": True}
    stand = Bench("knee_rod.xml", actuator=Force(**bench), params={"armature": free})
    model = model or plain("mujoco_default", frictionloss=DRY, damping=VISCOUS)
    logs = (stand.observing(model.inputs).accept(log),)
    space = Space(stand, model, "float64")
    return find_left(Recordings(stand, model, logs), space, np.asarray(space.start), Filtering()), space


def plain(name: str, **values: float) -> FrictionModel:
    return law(name, params={key: {"init": value} for key, value in values.items()})
