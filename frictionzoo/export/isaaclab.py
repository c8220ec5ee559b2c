"""The target `isaaclab`: actuator configurations of Isaac Lab, one a joint."""

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np

from frictionzoo.core.params import UNITS
from frictionzoo.export.base import Target, measure, register_target
from frictionzoo.export.configclass import Field, read_calls, write_call, write_module
from frictionzoo.export.motor import (
    INPUTS,
    Joint,
    Motor,
    lag,
    motors,
    read_inputs,
    read_joint,
    run_joints,
    say_common,
    viscous_friction,
)
from frictionzoo.export.nearest import Nearest, find_nearest
from frictionzoo.export.written import Export
from frictionzoo.result.identified import Identified

FILE = "isaaclab_actuators.py"
_DOCSTRING = """Actuators of Isaac Lab 2.3 or later on Isaac Sim 5 or later, written by frictionzoo.

ArticulationCfg(actuators=ACTUATORS); set joint names to those of your robot.
"""
_FRICTION = ("armature", "dynamic_friction", "viscous_friction")
_UNITS = (
    "friction and dynamic_friction are efforts, as of Isaac Sim 5; before, friction was a coefficient without unit, "
    "and there was no other."
)
_STICKS = (
    "PhysX holds a joint at rest up to `friction`, and while it moves `dynamic_friction` acts; the difference is that "
    "of dynamic_friction alone, in MuJoCo's softer constraint."
)


@register_target("isaaclab")
class IsaacLab(Target):
    """A Python file with Isaac Lab's implicit, delayed or DC motor actuator and PhysX's joint friction.

    Source: documentation of Isaac Lab 2.3, `isaaclab.actuators`.
    """

    options: ClassVar[Mapping[str, str]] = INPUTS
    packages: ClassVar[tuple[str, ...]] = ("mujoco",)

    def write(self, fitted: Identified, folder: Path, options: Mapping[str, str]) -> Export:
        """See `Target.write`."""
        inputs = read_inputs(fitted, options)
        drives, nearest = motors(fitted, inputs), find_nearest(fitted)
        calls = [_call(fitted, nearest, joint, drive) for joint, drive in enumerate(drives)]
        imports = f"from isaaclab.actuators import {', '.join(sorted({cls for cls, _ in calls}))}"
        named = zip(fitted.bench.joints, calls, strict=True)
        entries = [write_call(cls, fields, f'"{name}"') for name, (cls, fields) in named]
        (folder / FILE).write_text(write_module(_DOCSTRING, imports, "ACTUATORS", entries))
        joints = read_isaaclab((folder / FILE).read_text())
        joints = [joint._replace(lag=lag(fitted, place)) for place, joint in enumerate(joints)]
        difference = measure("qpos", fitted, run_joints(fitted, nearest, joints), fitted.rollout()[0])
        limits = (*say_common(fitted, nearest, inputs, "Isaac Lab"), *_say_delay(fitted, drives), _UNITS, _STICKS)
        return Export((FILE,), (difference,), limits)


def read_isaaclab(text: str) -> list[Joint]:
    """What a written file says of each joint.

    Args:
        text: The file.
    """
    return [read_joint(fields, _FRICTION, "min_delay") for _, fields in read_calls(text)]


def _call(fitted: Identified, nearest: Nearest, joint: int, motor: Motor) -> tuple[str, list[Field]]:
    units = UNITS[fitted.bench.joint_type]
    cls, own = _actuator(fitted, joint, motor)
    dynamic = float(nearest.frictionloss[joint])
    at_rest = fitted.values["friction"].get("static_torque", nearest.frictionloss)
    return cls, [
        Field("joint_names_expr", f'["^{fitted.bench.joints[joint]}$"]'),
        Field("stiffness", repr(motor.stiffness), units["stiffness"]),
        Field("damping", repr(motor.damping), f"{units['damping']}, of the controller"),
        *own,
        Field("armature", repr(float(nearest.bench["armature"][joint])), units["inertia"]),
        Field("friction", repr(max(dynamic, float(at_rest[joint]))), f"{units['torque']}, at rest"),
        Field("dynamic_friction", repr(dynamic), units["torque"]),
        Field("viscous_friction", repr(viscous_friction(fitted, nearest, joint)), units["damping"]),
    ]


def _actuator(fitted: Identified, joint: int, motor: Motor) -> tuple[str, list[Field]]:
    """Class, and keywords that only it has."""
    units, steps = UNITS[fitted.bench.joint_type], lag(fitted, joint)
    if np.isfinite(motor.saturation_effort):
        return "DCMotorCfg", [
            Field("saturation_effort", repr(motor.saturation_effort), f"{units['torque']}, at standstill"),
            Field("velocity_limit", repr(motor.velocity_limit), f"{units['velocity']}, without load"),
            Field("effort_limit", repr(motor.effort_limit), units["torque"]),
        ]
    if steps:
        return "DelayedPDActuatorCfg", [
            Field("min_delay", str(steps), "steps"),
            Field("max_delay", str(steps), "steps"),
        ]
    return "ImplicitActuatorCfg", []


def _say_delay(fitted: Identified, drives: list[Motor]) -> list[str]:
    """DC motors act at once."""
    late = max(lag(fitted, joint) for joint in range(fitted.bench.nv))
    if not late or not np.isfinite(drives[0].saturation_effort):
        return []
    return [f"DCMotorCfg has no delay: give its commands {late} steps late, as for the difference."]
