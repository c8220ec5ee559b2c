"""Target `mjlab`: mjlab actuator configurations."""

import numpy as np

from frictionzoo.core.params import UNITS
from frictionzoo.export.base import match_joint, register_target
from frictionzoo.export.configclass import ConfigFile, Field, list_delay, list_motor
from frictionzoo.export.motor import Motor
from frictionzoo.export.nearest import Nearest
from frictionzoo.result.fitted_drive import FittedDrive


@register_target("mjlab")
class Mjlab(ConfigFile):
    """Python file with mjlab's position or DC motor actuator and MuJoCo's joint friction.

    Source: documentation of mjlab 1.6, "Actuators".
    """

    program, file, module, keyed = "mjlab", "mjlab_actuators.py", "mjlab.actuator", False
    head = """Actuators of mjlab 1.6 or later, written by frictionzoo.

EntityArticulationInfoCfg(actuators=ACTUATORS); set joint names to those of your robot.
"""
    keywords = ("armature", "frictionloss", "viscous_damping", "delay_min_lag")

    def configure(self, fitted: FittedDrive, nearest: Nearest, joint: int, motor: Motor) -> tuple[str, list[Field]]:
        """See `ConfigFile.configure`."""
        units, limited = UNITS[fitted.bench.joint_type], np.isfinite(motor.saturation_effort)
        return "DcMotorActuatorCfg" if limited else "BuiltinPositionActuatorCfg", [
            Field("target_names_expr", (match_joint(fitted.bench.joints[joint]),)),
            *list_motor(fitted, motor),
            Field("armature", nearest.bench["armature"][joint], units["inertia"]),
            Field("frictionloss", nearest.frictionloss[joint], units["torque"]),
            Field("viscous_damping", nearest.damping[joint] + fitted.bench.own_damping[joint], units["damping"]),
            *list_delay(fitted, joint, "delay_min_lag", "delay_max_lag"),
        ]

    def say_more(self, fitted: FittedDrive, drives: list[Motor]) -> tuple[str, ...]:
        """See `ConfigFile.say_more`."""
        solref = " ".join(f"{number:g}" for number in fitted.bench.compile(constraint=False).dof_solref[0])
        return (f"The friction constraint's solreffriction is the robot's: set {solref} at the joint in its MJCF.",)
