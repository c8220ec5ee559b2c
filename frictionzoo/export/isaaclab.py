"""Target `isaaclab`: Isaac Lab actuator configurations."""

import numpy as np

from frictionzoo.export.base import register_target
from frictionzoo.export.configclass import MOTOR, ConfigFile
from frictionzoo.export.motor import Motor, lag
from frictionzoo.result.fitted_drive import FittedDrive


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
    classes, late_dc = ("IdealPDActuatorCfg", "DelayedPDActuatorCfg", "DCMotorCfg"), False
    keywords = {
        "joint_names_expr": "joint",
        **MOTOR,
        "min_delay": "delay",
        "max_delay": "delay",
        "armature": "armature",
        "friction": "static_friction",
        "dynamic_friction": "frictionloss",
        "viscous_friction": "viscous_damping",
    }

    def say_more(self, fitted: FittedDrive, drives: list[Motor]) -> tuple[str, ...]:
        """See `ConfigFile.say_more`."""
        limits = (
            "friction and dynamic_friction are efforts, as of Isaac Sim 5; before, friction was a coefficient without "
            "unit, and there was no other.",
            "PhysX holds a joint at rest up to `friction`, and while it moves `dynamic_friction` acts; the difference "
            "is that of dynamic_friction alone, in MuJoCo's softer constraint.",
        )
        steps = max(lag(fitted, joint) for joint in range(fitted.bench.nv))
        if not steps or not np.isfinite(drives[0].saturation_effort):  # DCMotorCfg has no delay
            return limits
        return f"DCMotorCfg has no delay: give its commands {steps} steps late, as for the difference.", *limits
