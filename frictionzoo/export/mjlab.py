"""Target `mjlab`: mjlab actuator configurations, with BAM's friction where it has the identified one."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import indent
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from frictionzoo.bench.read_bam import DUTY, LAWS
from frictionzoo.core.errors import ExportError
from frictionzoo.core.templates import Code, write_literal
from frictionzoo.export.bam import KT, compare_files, holds_exactly, to_bam, write_parameters
from frictionzoo.export.base import Export, match_joint, measure, read_choice, register_target
from frictionzoo.export.configclass import ConfigFile, write_call
from frictionzoo.export.motor import (
    INPUTS,
    MOTOR,
    Joint,
    Motor,
    lag,
    list_lacks,
    motors,
    read_inputs,
    run_joints,
    say_common,
    say_inputs,
    say_not_run,
)
from frictionzoo.export.mujoco_c import LAWS as BRISTLES
from frictionzoo.export.mujoco_c import list_bristles, write_native
from frictionzoo.export.nearest import Nearest
from frictionzoo.result.fitted_drive import FittedDrive

VERSIONS = "1.6"
"""Version of mjlab with which the written files were tested."""
FRICTIONS = ("bam", "lugre", "mujoco")
_SERVO = "mx64"
"""BAM's plain voltage servo: no limit of speed or current, which others have, and it runs in mjlab."""
_BAM_HEAD = f"""\"\"\"Actuators of mjlab {VERSIONS} with BAM 1.0 (better-actuator-models), written by frictionzoo.

EntityArticulationInfoCfg(actuators=ACTUATORS), and cfg.events |= EVENTS in the environment;
set joint names to those of your robot. vin and kp_fw are those of BAM's servo {_SERVO} that
give this servo's voltages.
\"\"\"

from pathlib import Path

from bam.mjlab import BamActuatorCfg, bam_init
from mjlab.managers.event_manager import EventTermCfg

HERE = Path(__file__).parent
EVENTS = {{"bam_init": EventTermCfg(func=bam_init, mode="startup")}}

"""
_LUGRE_HEAD = f"""\"\"\"Actuators of mjlab {VERSIONS} with MuJoCo's LuGre friction, written by frictionzoo.

EntityArticulationInfoCfg(actuators=ACTUATORS); set joint names to those of your robot.
Volts are newton metres: the constants and the resistance are not those of a data sheet.
\"\"\"

from mjlab.actuator import BuiltinDcMotorActuatorCfg, DcMotorPhysicalParams

"""
_NO_EMF = 1e-9
"""Motor constant and resistance without a back-EMF that matters [N m s/rad]."""
_UNLIMITED = 1e6
"""Voltage limit of a motor without one, which mjlab asks for."""


@register_target("mjlab")
class Mjlab(ConfigFile):
    """Python file with mjlab's position or DC motor actuator and MuJoCo's joint friction, or BAM's actuator.

    A voltage servo with one of BAM's friction models, m2 to m6, gets `BamActuatorCfg` and BAM's parameter files, and a
    drive with `lugre` or `dahl` gets `BuiltinDcMotorActuatorCfg(lugre=...)`: both are the identified friction.

    Source: mjlab 1.6, `mjlab.actuator`; better-actuator-models 1.0.2, `bam.mjlab`.
    """

    options: ClassVar[Mapping[str, str]] = {
        **INPUTS,
        "friction": "bam, lugre (also dahl) or mujoco; where it is left out, the identified one if mjlab has it",
    }
    program, file, module, keyed = "mjlab", "mjlab_actuators.py", "mjlab.actuator", False
    head = f"""Actuators of mjlab {VERSIONS}, written by frictionzoo.

EntityArticulationInfoCfg(actuators=ACTUATORS); set joint names to those of your robot.
"""
    classes = ("BuiltinPositionActuatorCfg", "BuiltinPositionActuatorCfg", "DcMotorActuatorCfg")
    keywords = {
        "target_names_expr": "joint",
        **{name: name for name in MOTOR},
        "armature": "armature",
        "frictionloss": "frictionloss",
        "viscous_damping": "viscous_damping",
        "delay_min_lag": "delay",
        "delay_max_lag": "delay",
    }

    def write(self, fitted: FittedDrive, folder: Path, options: Mapping[str, str]) -> Export:
        """See `Target.write`."""
        exact = "bam" if holds_exactly(fitted) else "lugre" if fitted.model.name in BRISTLES else "mujoco"
        chosen = read_choice({"friction": exact, **options}, "friction", FRICTIONS)
        if chosen == "mujoco":
            return super().write(fitted, folder, options)
        if chosen != exact:
            laws = ", ".join(name for name, _ in list(LAWS.values())[1:])
            expected = f"a VoltageServo with {laws}" if chosen == "bam" else " or ".join(BRISTLES)
            name = type(fitted.bench.actuator).__name__
            raise ExportError(
                f"friction={chosen}: {fitted.model.name} on a {name}, expected {expected}; leave friction out"
            )
        return (_write_bam if chosen == "bam" else _write_lugre)(fitted, folder, options)

    def say_more(self, fitted: FittedDrive, drives: list[Motor], options: Mapping[str, str]) -> tuple[str, ...]:
        """See `ConfigFile.say_more`."""
        return (_say_solref(fitted),)


def _write_bam(fitted: FittedDrive, folder: Path, options: Mapping[str, str]) -> Export:
    given, bench, (error_gain, duty_limit) = read_inputs(fitted, options), fitted.values["bench"], DUTY[_SERVO]
    # These give the same voltages: supply clip(gain error_gain error, duty_limit).
    supply = given["supply"] * bench["duty_limit"] / duty_limit
    gain = given["gain"] * given["supply"] * bench["duty_gain"] / (supply * error_gain)
    laws, _, lacks = to_bam(fitted)
    parameters = write_parameters(fitted, folder, laws, _SERVO)
    inputs = {"gain": gain, "supply": supply, "enable": np.ones(fitted.bench.nv)}
    body = "".join(_configure(fitted, joint, file, inputs) for joint, file in enumerate(parameters))
    (folder / Mjlab.file).write_text(f"{_BAM_HEAD}ACTUATORS = (\n{indent(body, '    ')})\n", encoding="utf-8")
    nearest = Nearest.frictionless(fitted)
    reason = ", ".join([*lacks, *list_lacks(fitted, nearest)])
    torque, qpos = compare_files(fitted, [folder / file for file in parameters], reason, inputs)
    limits = (
        say_not_run(Mjlab.program),
        *say_common(fitted, nearest, {}),
        f"The servo's inputs are fixed: {say_inputs(given)}, always enabled; vin_range= draws the supply.",
        "BAM limits the torque to the stall torque, also when braking adds back-EMF.",
        "BAM 1.0.2 requires mjlab 1.3 and Python 3.12; with mjlab 1.6, install it with --no-deps.",
        KT,
        _say_solref(fitted),
    )
    return Export((Mjlab.file, *parameters), (qpos, torque), limits)


def _write_lugre(fitted: FittedDrive, folder: Path, options: Mapping[str, str]) -> Export:
    inputs, bench = read_inputs(fitted, options), fitted.values["bench"]
    drives, bristles = motors(fitted, inputs), list_bristles(fitted)
    viscous = fitted.values["friction"]["viscous_coefficient"] + fitted.bench.own_damping
    joints = [
        Joint(motor, float(bench["armature"][joint]), 0.0, float(viscous[joint]), lag(fitted, joint))
        for joint, motor in enumerate(drives)
    ]
    names = map(match_joint, fitted.bench.joints)
    body = "".join(map(_configure_motor, names, joints, bristles))
    (folder / Mjlab.file).write_text(f"{_LUGRE_HEAD}ACTUATORS = (\n{indent(body, '    ')})\n", encoding="utf-8")
    nearest = Nearest.frictionless(fitted)
    qpos = run_joints(fitted, nearest, joints, write_native)
    reason = ", ".join([*list_lacks(fitted, nearest), "bristles begin without load, and act from a step's beginning"])
    limits = (
        say_not_run(Mjlab.program),
        *say_common(fitted, nearest, inputs),
        "A dcmotor's controller outputs volts in MuJoCo 3.11, the version of mjlab 1.6; later versions may differ.",
        "The bristles' deflection is the actuator's `act`; mjlab begins with 0, a joint without load.",
    )
    return Export((Mjlab.file,), (measure("qpos", fitted, qpos, fitted.rollout()[0], reason=reason),), limits)


def _configure_motor(pattern: str, joint: Joint, bristles: Sequence[float]) -> str:
    """Write a DC motor with this torque: resistance and constants are equal, so that volts are newton metres."""
    motor = joint.motor
    has_line = np.isfinite(motor.saturation_effort)
    slope = float(motor.saturation_effort / motor.velocity_limit) if has_line else _NO_EMF
    limit = motor.saturation_effort if has_line else min(motor.effort_limit, _UNLIMITED)
    values: dict[str, Any] = {
        "target_names_expr": (pattern,),
        "motor_params": Code(f"DcMotorPhysicalParams(kt={slope!r}, ke={slope!r}, resistance={slope!r})"),
        "stiffness": motor.stiffness,
        "damping": motor.damping - slope if has_line else motor.damping,  # the back-EMF is the rest
        "voltage_limit": limit,
        **({"effort_limit": motor.effort_limit} if has_line and np.isfinite(motor.effort_limit) else {}),
        "lugre": tuple(bristles),
        "armature": joint.armature,
        "frictionloss": 0.0,
        "viscous_damping": joint.damping,
        **({"delay_min_lag": joint.lag, "delay_max_lag": joint.lag} if joint.lag else {}),
    }
    return write_call("BuiltinDcMotorActuatorCfg", {keyword: (value, "") for keyword, value in values.items()})


def _configure(fitted: FittedDrive, joint: int, file: str, inputs: Mapping[str, Float[np.ndarray, "nv"]]) -> str:
    steps = lag(fitted, joint)
    values: dict[str, tuple[Any, str]] = {
        "json_path": (Code(f"str(HERE / {write_literal(file)})"), ""),
        "target_names_expr": ((match_joint(fitted.bench.joints[joint]),), ""),
        "vin": (float(inputs["supply"][joint]), "V"),
        "kp_fw": (float(inputs["gain"][joint]), ""),
        "stiff_frictionloss": (False, "the robot's solreffriction"),
        **({"delay_min_lag": (steps, ""), "delay_max_lag": (steps, "steps")} if steps else {}),
    }
    return write_call("BamActuatorCfg", values)


def _say_solref(fitted: FittedDrive) -> str:
    """State which solreffriction the robot's joints need."""
    solref = " ".join(f"{number:g}" for number in fitted.bench.compile(constraint=False).dof_solref[0])
    return f"The friction constraint uses the robot's solreffriction: set {solref} at the joint in its MJCF."
