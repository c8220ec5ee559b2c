"""An arm that torque drives: recorded by MuJoCo C, and objectives on its recordings."""

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from frictionzoo.bench import Bench
from frictionzoo.core.log import Log
from frictionzoo.core.segments import Segments, cut_segments
from frictionzoo.fit import Objective, Space
from frictionzoo.models.registry import get_model
from frictionzoo.simulation.drive import Drive

STEP = 0.002  # s
TRUTH = {"armature": [0.3, 0.1], "frictionloss": [1.5, 0.6], "damping": [0.8, 0.3]}
ARM = f"""<mujoco><option timestep="{STEP}"><flag contact="disable"/></option><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 1 0"/>
    <inertial pos="0 0 -0.15" mass="2" diaginertia="0.02 0.02 0.002"/>
    <body name="fore" pos="0 0 -0.3"><joint name="elbow" axis="0 1 0"/>
      <inertial pos="0.02 0 -0.12" mass="1" diaginertia="0.006 0.006 .001"/></body></body></worldbody></mujoco>"""


def swing(seconds: float, seed: int = 0, mass: float = 1.0) -> Log:
    """A recording by MuJoCo C of torques and states without noise, under a controller that nobody knows."""
    spec = mujoco.MjSpec.from_string(ARM)
    for index, joint in enumerate(spec.joints):
        joint.armature, joint.frictionloss = TRUTH["armature"][index], TRUTH["frictionloss"][index]
        joint.damping = [TRUTH["damping"][index], 0, 0]
    fore = spec.body("fore")
    fore.mass = mass
    fore.inertia = mass * fore.inertia
    model = spec.compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    time = np.arange(0, seconds, STEP)
    rate, phase = 2 * np.pi * rng.uniform(0.2, 1.5, (5, 2)), rng.uniform(0, 6, (5, 2))
    desired = (1.5 / rate * np.sin(rate * time[:, None, None] + phase)).sum(axis=1)
    qpos, qvel, torques = (np.empty((len(time), 2)) for _ in range(3))
    data.qpos[:] = desired[0]
    for sample, wish in enumerate(desired):
        qpos[sample], qvel[sample] = data.qpos, data.qvel
        torques[sample] = data.qfrc_applied[:] = 300 * (wish - data.qpos) - 20 * data.qvel
        mujoco.mj_step(model, data)
    return Log(f"swing{seed}", time, qpos, qvel, torques, "hash", True)


SECTION = {"init": 0.5, "low": 1e-2, "high": 10.0, "scale": "log", "identify": True}
WEIGHTS = {"position": 1e4, "velocity": 10.0, "refine": True}


@dataclass
class Shot:
    """An objective on two recordings of the arm."""

    objective: Objective
    segments: Segments


def shoot(bench: Bench, law: str, length: int, *logs: Log, **loss: Any) -> Shot:
    """Segments of these recordings, one after the other."""
    model = get_model(law)(2, {name: SECTION for name in get_model(law).dimensions})
    sampling = bench.sampling(logs[0].timestep)
    segments = cut_segments([bench.accept(log) for log in logs], None, length, sampling.history)
    rollout = Drive.assemble(bench, model, "auto", sampling).rollout
    return Shot(Objective(Space(bench, model, "float64"), rollout, segments, **WEIGHTS | loss), segments)
