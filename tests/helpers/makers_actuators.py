"""Model files with actuators of every kind, and what MuJoCo C makes of them."""

import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import frictionzoo as fz
from frictionzoo.bench import Bench
from frictionzoo.core.state import Signals
from frictionzoo.models.mujoco_default import MujocoDefault
from frictionzoo.simulation.proof import Cases, simulate_in_c
from frictionzoo.simulation.rollout import applied

STEP, STEPS, ROLLOUTS = 0.004, 30, 2
ARM = """<mujoco><compiler angle="radian"/><option timestep="{step}" integrator="{integrator}"/>
<default><default class="drive"><position kp="3" kv="0.08"/><joint {joint}/></default></default><worldbody>
<body name="upper"><joint name="j0" class="drive" axis="0 1 0" armature="0.02" damping="0.1" frictionloss="0.05"
 range="-0.5 0.8" limited="false"/><inertial pos="0.02 0 -0.1" mass="0.8" diaginertia="0.01 0.01 0.002"/>
<body name="lower" pos="0 0 -0.2"><joint name="j1" class="drive" axis="0 1 0" armature="0.01" damping="0.05"
 frictionloss="0.03" range="-0.4 0.9" limited="false"/>
<inertial pos="0 0.01 -0.1" mass="0.4" diaginertia="0.004 0.004 0.001"/></body>
</body></worldbody><actuator>{actuators}</actuator></mujoco>"""
"""An arm in which what `Variant` says is to be filled in."""


class Variant(NamedTuple):
    """An arm with the same actuators at both joints, of different size.

    Attributes:
        actuators: Elements with the fields `{joint}` and `{gain}`.
        joint: Attributes of both joints.
        integrator: Of MuJoCo.
    """

    actuators: str
    joint: str = ""
    integrator: str = "Euler"

    def text(self) -> str:
        own = "".join(self.actuators.format(joint=f"j{index}", gain=3 / (1 + index)) for index in range(2))
        return ARM.format(step=STEP, actuators=own, joint=self.joint, integrator=self.integrator)


POSITION = '<position name="p{{joint}}" joint="{{joint}}" kp="{{gain}}" kv="0.08" gear="{0}" {1}/>'
MOTOR = '<motor name="m{{joint}}" joint="{{joint}}" gear="{0}" {1}/>'
VELOCITY = '<velocity name="v{{joint}}" joint="{{joint}}" kv="0.05" gear="{0}" {1}/>'
STIFF = '<position name="p{{joint}}" joint="{{joint}}" kp="{{gain}}" gear="{0}" {1}/>'
PID = '<pid name="c{{joint}}" joint="{{joint}}" kp="{{gain}}" kv="0.08" gear="{0}" {1}/>'
KINDS = {
    "position without kv": STIFF,
    "position": POSITION,
    "dampratio": POSITION.replace('kv="0.08"', 'dampratio="0.6"'),
    "joint in parent": POSITION.replace(" joint=", " jointinparent="),
    "class": '<position name="p{{joint}}" joint="{{joint}}" class="drive" gear="{0}" {1}/>',
    "general": '<general name="g{{joint}}" joint="{{joint}}" gainprm="3" biastype="affine" biasprm="0 -3 -0.08" '
    'gear="{0}" {1}/>',
    "affine gain": '<general joint="{{joint}}" gaintype="affine" gainprm="3 0 0" biastype="affine" '
    'biasprm="0 -3 -0.08" gear="{0}" {1}/>',
    "velocity": VELOCITY,
    "general velocity": '<general joint="{{joint}}" gainprm="0.03" biastype="affine" biasprm="0 0 -0.03" '
    'gear="{0}" {1}/>',
    "velocity and motor": VELOCITY + MOTOR,
    "motor": MOTOR,
    "general motor": '<general joint="{{joint}}" gainprm="2.5" gear="{0}" {1}/>',
    "PID": PID,
    "PID with torque": PID.replace("kp=", 'input="pos vel ff" kp='),
    "position and velocity": STIFF + VELOCITY,
    "velocity and position": VELOCITY + POSITION,
    "position and motor": POSITION + MOTOR.replace("gear", 'armature="0.003" gear'),
    "all three": STIFF + MOTOR + VELOCITY,
}
OF_ONE = {"position": POSITION, "velocity": VELOCITY, "motor": MOTOR}
GEARS = (1, 2, -3)
RANGES = {  # of the actuator and of the joint
    "ctrlrange": ('ctrlrange="-0.4 0.9"', ""),
    "one-sided ctrlrange": ('ctrlrange="0 0.9"', ""),
    "no limit": ('ctrlrange="-0.4 0.9" ctrllimited="false" forcerange="-1 1" forcelimited="false"', ""),
    "forcerange": ('forcerange="-0.8 0.8"', ""),
    "lopsided forcerange": ('forcerange="-0.4 1.1"', ""),
    "one-sided forcerange": ('forcerange="0 1.1"', ""),
    "actuatorfrcrange": ("", 'actuatorfrcrange="-0.9 0.9"'),
    "lopsided actuatorfrcrange": ("", 'actuatorfrcrange="-0.3 1.2"'),
    "all": ('ctrlrange="-0.9 0.4" forcerange="-0.8 0.8"', 'actuatorfrcrange="-0.7 1.9"'),
}
DELAYS = {
    "two steps": 'delay="0.008" nsample="4"',
    "held for two of them": 'delay="0.006" nsample="4"',
    "a sixth": 'delay="0.00066" nsample="1"',
    "interpolated": 'delay="0.006" nsample="4" interp="linear"',
    "interpolated within a step": 'delay="0.001" nsample="4" interp="linear"',
    "short buffer": 'delay="0.02" nsample="2"',
}


def variants() -> Iterator[tuple[str, Variant]]:
    """Actuators that a bench holds exactly, by a name of each."""
    for (kind, text), gear in itertools.product(KINDS.items(), GEARS):
        yield f"{kind}, gear {gear}", Variant(text.format(gear, ""))
    for (what, (own, joint)), (kind, text), gear in itertools.product(RANGES.items(), OF_ONE.items(), (1, -3)):
        if (kind, gear) != ("velocity", 1):
            yield f"{kind}, gear {gear}, {what}", Variant(text.format(gear, own), joint)
    for what, own in DELAYS.items():
        for kind, text in {**OF_ONE, "pair": POSITION + VELOCITY}.items():
            yield f"{kind}, delay of {what}", Variant(text.format(2, own))
    for what, text in {"inheritrange": 'inheritrange="0.6"', "reflected": 'armature="0.01" damping="0.02"'}.items():
        yield what, Variant(POSITION.format(2, text))
    yield "reflected by both", Variant((POSITION + VELOCITY).format(-2, 'armature="0.004" damping="0.01"'))
    for kind in ("position", "velocity", "motor", "PID", "all three"):
        yield f"{kind}, implicitfast", Variant(KINDS[kind].format(2, ""), integrator="implicitfast")
    yield (
        "range of the joint, implicitfast",
        Variant(POSITION.format(2, ""), 'actuatorfrcrange="-0.9 0.9"', "implicitfast"),
    )


def save(folder: Path, text: str) -> Path:
    path = folder / "arm.xml"
    path.write_text(text)
    return path


def moved_by(model: mujoco.MjModel, states: np.ndarray, ctrl: np.ndarray) -> np.ndarray:
    """Positions and velocities in MuJoCo C of shape (2, rollouts, steps, nv), from states (2, rollouts, nv)."""
    found = np.empty((2, *ctrl.shape[:2], model.nv))
    for rollout in range(ctrl.shape[0]):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = states[:, rollout]
        for step, data.ctrl[:] in enumerate(ctrl[rollout]):
            mujoco.mj_step(model, data)
            found[:, rollout, step] = data.qpos, data.qvel
    return found


def draw(nv: int, nu: int, steps: int = STEPS, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Random states of shape (2, rollouts, nv), and commands of shape (rollouts, steps, nu) that last a few steps."""
    rng = np.random.default_rng(seed)
    ctrl = np.repeat(rng.normal(0, 1.0, (ROLLOUTS, -(-steps // 5), nu)), 5, axis=1)[:, :steps]
    return rng.normal(0, [[[0.5]], [[1.0]]], (2, ROLLOUTS, nv)), ctrl


def as_recorded(robot: fz.Robot, ctrl: np.ndarray, history: int = 0) -> Signals:
    """The file's commands as recordings have them, and so many samples of 0 before them."""
    signals = {name: np.zeros((*ctrl.shape[:2], robot.nv)) for name in ("ctrl", *robot.actuator.inputs)}
    for joint, actuator in enumerate(robot.file.actuators):
        for index, name, factor in actuator.commands if actuator else ():
            signals[name][..., joint] = factor * ctrl[..., index]
    before = {name: np.pad(one, ((0, 0), (history, 0), (0, 0))) for name, one in signals.items()}
    return Signals(before.pop("ctrl"), before)


def values_of(robot: Bench) -> Mapping[str, Any]:
    """What the file says, of bench and friction."""
    assert isinstance(robot, fz.Robot)
    known = robot.initial_values() | {"armature": robot.file.values["armature"]}
    return {"bench": known, "friction": {name: robot.file.values[name] for name in ("frictionloss", "damping")}}


def compare_in_c(robot: fz.Robot, makers: mujoco.MjModel) -> float:
    """Largest distance of the bench's MJCF and controller from the maker's file, both in MuJoCo C."""
    states, ctrl = draw(makers.nv, makers.nu)
    sampling, values = robot.sampling(robot.timestep), values_of(robot)
    commands = as_recorded(robot, ctrl, sampling.history).map(jnp.asarray)
    acting = applied(jax.tree.map(jnp.asarray, values), commands, sampling).map(lambda one: np.asarray(one)[:, :, 0])
    law = MujocoDefault(robot.nv, {name: value.tolist() for name, value in values["friction"].items()})
    ours = simulate_in_c(robot, law, values, Cases(states[0], states[1], acting, np.zeros((len(ctrl), 0))))[:2]
    return float(np.abs(ours - moved_by(makers, states, ctrl)).max())
