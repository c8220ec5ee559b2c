"""Target `isaaclab`: Isaac Lab actuator configurations."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from frictionzoo.export.base import read_choice, register_target
from frictionzoo.export.configclass import ConfigFile
from frictionzoo.export.motor import INPUTS, MOTOR, Motor, lag
from frictionzoo.result.fitted_drive import FittedDrive

VERSIONS = "2.3 to 3.0"
"""Oldest and newest version of Isaac Lab with which the written files were tested."""
PHYSICS = ("physx", "newton")
_PHYSX = (
    "With PhysX, friction and dynamic_friction are efforts since Isaac Sim 5; before, friction was a dimensionless "
    "coefficient, without dynamic_friction.",
    "PhysX holds a joint at rest up to `friction`; in motion, `dynamic_friction` acts. The difference is computed with "
    "dynamic_friction alone, in MuJoCo's softer constraint.",
    "For Isaac Lab 3 on Newton, which has one dry friction, `friction`, set physics=newton.",
)
_NEWTON = (
    "`friction` is the dry friction of Newton's MuJoCo solver, whose constraint has the robot's solreffriction; in "
    "PhysX it is the friction at rest: set physics=physx.",
)


@register_target("isaaclab")
class IsaacLab(ConfigFile):
    """Python file with Isaac Lab's ideal, delayed or DC motor actuator and the joint friction of PhysX or Newton.

    `ImplicitActuatorCfg` is not used: PhysX integrates its gains implicitly, which adds a damping of step * stiffness.

    Source: Isaac Lab 2.3.2 and 3.0.0, `isaaclab.actuators`.
    """

    options: ClassVar[Mapping[str, str]] = {
        **INPUTS,
        "physics": "of Isaac Lab: physx, or newton for the one dry friction of Newton; physx where it is left out",
    }
    program, file, module, keyed = "Isaac Lab", "isaaclab_actuators.py", "isaaclab.actuators", True
    head = f"""Actuators of Isaac Lab {VERSIONS}, written by frictionzoo.

ArticulationCfg(actuators=ACTUATORS); set joint names to those of your robot, whose
USD has the limits of torque and velocity that are not here.
"""
    classes, late_dc = ("IdealPDActuatorCfg", "DelayedPDActuatorCfg", "DCMotorCfg"), False
    keywords = {
        "joint_names_expr": "joint",
        **{name: name for name in MOTOR},
        "min_delay": "delay",
        "max_delay": "delay",
        "armature": "armature",
        "friction": "static_friction",
        "dynamic_friction": "frictionloss",
        "viscous_friction": "viscous_damping",
    }
    apart = ("velocity_limit", "effort_limit")
    helper = '''def limits(**values):
    """Name the limits as this version of Isaac Lab does."""
    if "actuator_effort_limit" not in {field.name for field in fields(ActuatorBaseCfg)}:
        return values  # Isaac Lab 2
    named = {f"actuator_{name}": value for name, value in values.items()}
    if "effort_limit" in values:  # the solver clips the torque, too, by default at the limit of the USD
        named["joint_effort_limit"] = values["effort_limit"]
    return named
'''

    def choose_keywords(self, options: Mapping[str, str]) -> Mapping[str, str]:
        """See `ConfigFile.choose_keywords`."""
        if read_choice(options, "physics", PHYSICS) == "physx":
            return self.keywords
        dry = {"friction": "frictionloss", "dynamic_friction": ""}
        return {keyword: name for keyword, name in {**self.keywords, **dry}.items() if name}

    def say_more(self, fitted: FittedDrive, drives: list[Motor], options: Mapping[str, str]) -> tuple[str, ...]:
        """See `ConfigFile.say_more`."""
        limits = _NEWTON if options.get("physics") == "newton" else _PHYSX
        steps = max(lag(fitted, joint) for joint in range(fitted.bench.nv))
        if not steps or not np.isfinite(drives[0].saturation_effort):  # DCMotorCfg has no delay
            return limits
        return f"DCMotorCfg has no delay: give its commands {steps} steps late, as for the difference.", *limits
