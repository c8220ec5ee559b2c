"""The target `mjlab`: actuator configurations of mjlab, one a joint."""

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

FILE = "mjlab_actuators.py"
_DOCSTRING = """Actuators of mjlab 1.6 or later, written by frictionzoo.

EntityArticulationInfoCfg(actuators=ACTUATORS); set joint names to those of your robot.
"""
_FRICTION = ("armature", "frictionloss", "viscous_damping")


@register_target("mjlab")
class Mjlab(Target):
    """A Python file with mjlab's position or DC motor actuator and MuJoCo's joint friction.

    Source: documentation of mjlab 1.6, "Actuators".
    """

    options: ClassVar[Mapping[str, str]] = INPUTS
    packages: ClassVar[tuple[str, ...]] = ("mujoco",)

    def write(self, fitted: Identified, folder: Path, options: Mapping[str, str]) -> Export:
        """See `Target.write`."""
        inputs = read_inputs(fitted, options)
        drives, nearest = motors(fitted, inputs), find_nearest(fitted)
        calls = [_call(fitted, nearest, joint, drive) for joint, drive in enumerate(drives)]
        imports = f"from mjlab.actuator import {', '.join(sorted({cls for cls, _ in calls}))}"
        entries = [write_call(cls, fields) for cls, fields in calls]
        (folder / FILE).write_text(write_module(_DOCSTRING, imports, "ACTUATORS", entries))
        came = run_joints(fitted, nearest, read_mjlab((folder / FILE).read_text()))
        difference = measure("qpos", fitted, came, fitted.rollout()[0])
        solref = " ".join(f"{number:g}" for number in fitted.bench.compile(constraint=False).dof_solref[0])
        softness = f"The friction constraint's solreffriction is the robot's: set {solref} at the joint in its MJCF."
        return Export((FILE,), (difference,), (*say_common(fitted, nearest, inputs, "mjlab"), softness))


def read_mjlab(text: str) -> list[Joint]:
    """What a written file says of each joint.

    Args:
        text: The file.
    """
    return [read_joint(fields, _FRICTION, "delay_min_lag") for _, fields in read_calls(text)]


def _call(fitted: Identified, nearest: Nearest, joint: int, motor: Motor) -> tuple[str, list[Field]]:
    units, steps = UNITS[fitted.bench.joint_type], lag(fitted, joint)
    cls, own = _actuator(fitted, motor)
    late = [Field("delay_min_lag", str(steps), "steps"), Field("delay_max_lag", str(steps), "steps")] if steps else []
    return cls, [
        Field("target_names_expr", f'("^{fitted.bench.joints[joint]}$",)'),
        *own,
        Field("armature", repr(float(nearest.bench["armature"][joint])), units["inertia"]),
        Field("frictionloss", repr(float(nearest.frictionloss[joint])), units["torque"]),
        Field("viscous_damping", repr(viscous_friction(fitted, nearest, joint)), units["damping"]),
        *late,
    ]


def _actuator(fitted: Identified, motor: Motor) -> tuple[str, list[Field]]:
    """Class and keywords of the actuator alone."""
    units = UNITS[fitted.bench.joint_type]
    gains = [
        Field("stiffness", repr(motor.stiffness), units["stiffness"]),
        Field("damping", repr(motor.damping), f"{units['damping']}, of the controller"),
    ]
    if not np.isfinite(motor.saturation_effort):
        return "BuiltinPositionActuatorCfg", gains
    return "DcMotorActuatorCfg", [
        *gains,
        Field("saturation_effort", repr(motor.saturation_effort), f"{units['torque']}, at standstill"),
        Field("velocity_limit", repr(motor.velocity_limit), f"{units['velocity']}, without load"),
        Field("effort_limit", repr(motor.effort_limit), units["torque"]),
    ]
