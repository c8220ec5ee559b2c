"""Target `isaaclab`: Isaac Lab actuator configurations."""

import numpy as np

from frictionzoo.core.params import UNITS
from frictionzoo.export.base import match_joint, register_target
from frictionzoo.export.configclass import ConfigFile, Field, list_delay, list_motor
from frictionzoo.export.motor import Motor, lag
from frictionzoo.export.nearest import Nearest
from frictionzoo.export.variants import at_rest
from frictionzoo.result.fitted_drive import FittedDrive

_UNITS = (
    "friction and dynamic_friction are efforts, as of Isaac Sim 5; before, friction was a coefficient without unit, "
    "and there was no other."
)
_STICKS = (
    "PhysX holds a joint at rest up to `friction`, and while it moves `dynamic_friction` acts; the difference is that "
    "of dynamic_friction alone, in MuJoCo's softer constraint."
)


@register_target("isaaclab")
class IsaacLab(ConfigFile):
    """Python file with Isaac Lab's ideal, delayed or DC motor actuator and PhysX's joint friction.

    `ImplicitActuatorCfg` is not used: PhysX integrates its gains implicitly, which adds a damping of step * stiffness.

    Source: documentation of Isaac Lab 2.3, `isaaclab.actuators`.
    """

    program, file, module, keyed = "Isaac Lab", "isaaclab_actuators.py", "isaaclab.actuators", True
    head = """Actuators of Isaac Lab 2.3 or later on Isaac Sim 5 or later, written by frictionzoo.

ArticulationCfg(actuators=ACTUATORS); set joint names to those of your robot, whose
USD has the limits of torque and velocity that are not here.
"""
    keywords = ("armature", "dynamic_friction", "viscous_friction", "min_delay")

    def configure(self, fitted: FittedDrive, nearest: Nearest, joint: int, motor: Motor) -> tuple[str, list[Field]]:
        """See `ConfigFile.configure`."""
        units, cls, delay = UNITS[fitted.bench.joint_type], "DCMotorCfg", []
        if not np.isfinite(motor.saturation_effort):
            delay = list_delay(fitted, joint, "min_delay", "max_delay")
            cls = "DelayedPDActuatorCfg" if delay else "IdealPDActuatorCfg"
        dynamic = nearest.frictionloss[joint]
        return cls, [
            Field("joint_names_expr", [match_joint(fitted.bench.joints[joint])]),
            *list_motor(fitted, motor),
            *delay,
            Field("armature", nearest.bench["armature"][joint], units["inertia"]),
            Field(
                "friction", at_rest(fitted, fitted.values, nearest.frictionloss)[joint], f"{units['torque']}, at rest"
            ),
            Field("dynamic_friction", dynamic, units["torque"]),
            Field("viscous_friction", nearest.damping[joint] + fitted.bench.own_damping[joint], units["damping"]),
        ]

    def say_more(self, fitted: FittedDrive, drives: list[Motor]) -> tuple[str, ...]:
        """See `ConfigFile.say_more`."""
        steps = max(lag(fitted, joint) for joint in range(fitted.bench.nv))
        if not steps or not np.isfinite(drives[0].saturation_effort):  # DCMotorCfg has no delay
            return _UNITS, _STICKS
        return f"DCMotorCfg has no delay: give its commands {steps} steps late, as for the difference.", _UNITS, _STICKS
