"""Target `mjlab`: mjlab actuator configurations."""

from frictionzoo.export.base import register_target
from frictionzoo.export.configclass import MOTOR, ConfigFile
from frictionzoo.export.motor import Motor
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
    classes = ("BuiltinPositionActuatorCfg", "BuiltinPositionActuatorCfg", "DcMotorActuatorCfg")
    keywords = {
        "target_names_expr": "joint",
        **MOTOR,
        "armature": "armature",
        "frictionloss": "frictionloss",
        "viscous_damping": "viscous_damping",
        "delay_min_lag": "delay",
        "delay_max_lag": "delay",
    }

    def say_more(self, fitted: FittedDrive, drives: list[Motor]) -> tuple[str, ...]:
        """See `ConfigFile.say_more`."""
        solref = " ".join(f"{number:g}" for number in fitted.bench.compile(constraint=False).dof_solref[0])
        return (f"The friction constraint's solreffriction is the robot's: set {solref} at the joint in its MJCF.",)
