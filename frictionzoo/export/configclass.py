"""Targets that write a Python file with configuration classes of another program, as text."""

import ast
from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from textwrap import indent
from typing import Any, ClassVar, NamedTuple

import numpy as np

from frictionzoo.core.params import UNITS
from frictionzoo.core.templates import write_literal
from frictionzoo.export.base import Export, Target, measure
from frictionzoo.export.motor import INPUTS, Joint, Motor, lag, list_lacks, motors, read_inputs, run_joints, say_common
from frictionzoo.export.nearest import Nearest, find_nearest
from frictionzoo.result.fitted_drive import FittedDrive

LIMITS = ("saturation_effort", "velocity_limit", "effort_limit")
"""Attributes of a `Motor` that limit its torque."""


class Field(NamedTuple):
    """Keyword of a configuration class, its value, and its unit for a comment."""

    name: str
    value: object
    unit: str = ""


class ConfigFile(Target):
    """Python file with `ACTUATORS`, the configuration of an actuator for each joint.

    Attributes:
        program: Name of the simulator.
        head: Docstring of the file.
        module: Module of the configuration classes.
        keyed: Whether `ACTUATORS` is a dict by joint instead of a tuple.
        keywords: Keywords of armature, dry friction, viscous friction and delay [steps].
    """

    options: ClassVar[Mapping[str, str]] = INPUTS
    packages: ClassVar[tuple[str, ...]] = ("mujoco",)
    program: ClassVar[str]
    file: ClassVar[str]
    head: ClassVar[str]
    module: ClassVar[str]
    keyed: ClassVar[bool]
    keywords: ClassVar[tuple[str, str, str, str]]

    @abstractmethod
    def configure(self, fitted: FittedDrive, nearest: Nearest, joint: int, motor: Motor) -> tuple[str, list[Field]]:
        """Return class and keywords of a joint's actuator."""

    @abstractmethod
    def say_more(self, fitted: FittedDrive, drives: list[Motor]) -> tuple[str, ...]:
        """List further limits of this simulator."""

    def write(self, fitted: FittedDrive, folder: Path, options: Mapping[str, str]) -> Export:
        """See `Target.write`."""
        inputs = read_inputs(fitted, options)
        drives, nearest = motors(fitted, inputs), find_nearest(fitted)
        calls = [self.configure(fitted, nearest, joint, drive) for joint, drive in enumerate(drives)]
        imports = f"from {self.module} import {', '.join(sorted({cls for cls, _ in calls}))}"
        keys = [f"{write_literal(name)}: " if self.keyed else "" for name in fitted.bench.joints]
        body = "".join(key + _write_call(*call) for key, call in zip(keys, calls, strict=True))
        opening, closing = "{}" if self.keyed else "()"
        text = f'"""{self.head}"""\n\n{imports}\n\nACTUATORS = {opening}\n{indent(body, "    ")}{closing}\n'
        (folder / self.file).write_text(text, encoding="utf-8")
        # If the file has no delay, the caller delays the commands.
        joints = [joint._replace(lag=joint.lag or lag(fitted, i)) for i, joint in enumerate(self.read(text))]
        difference = measure(
            *("qpos", fitted, run_joints(fitted, nearest, joints), fitted.rollout()[0]),
            reason=", ".join(list_lacks(fitted, nearest)),
        )
        limits = (*say_common(fitted, nearest, inputs, self.program), *self.say_more(fitted, drives))
        return Export((self.file,), (difference,), limits)

    def read(self, text: str) -> list[Joint]:
        """Read each joint from a written file, without running it."""
        (value,) = (node.value for node in ast.parse(text).body if isinstance(node, ast.Assign))
        calls = value.values if isinstance(value, ast.Dict) else getattr(value, "elts", [])
        return [self._read_call(call) for call in calls if isinstance(call, ast.Call)]

    def _read_call(self, call: ast.Call) -> Joint:
        fields: dict[str, Any] = {str(k.arg): ast.literal_eval(k.value) for k in call.keywords}
        *friction, delay = self.keywords
        armature, loss, damping = (float(fields[name]) for name in friction)
        motor = Motor(fields["stiffness"], fields["damping"], **{k: fields[k] for k in LIMITS if k in fields})
        return Joint(motor, armature, loss, damping, fields.get(delay, 0))


def list_motor(fitted: FittedDrive, motor: Motor) -> list[Field]:
    """List the keywords of gains and torque limits, which have the same names in all programs."""
    units = UNITS[fitted.bench.joint_type]
    gains = [
        Field("stiffness", motor.stiffness, units["stiffness"]),
        Field("damping", motor.damping, f"{units['damping']}, of the controller"),
    ]
    if not np.isfinite(motor.saturation_effort):
        limited = np.isfinite(motor.effort_limit)
        return gains + ([Field("effort_limit", motor.effort_limit, units["torque"])] if limited else [])
    limit_units = (f"{units['torque']}, at standstill", f"{units['velocity']}, without load", units["torque"])
    return gains + [Field(name, getattr(motor, name), unit) for name, unit in zip(LIMITS, limit_units, strict=True)]


def list_delay(fitted: FittedDrive, joint: int, *names: str) -> list[Field]:
    """List the keywords of smallest and largest delay [steps]; none without a delay."""
    steps = lag(fitted, joint)
    return [Field(name, steps, "steps") for name in names] if steps else []


def _write_call(cls: str, fields: list[Field]) -> str:
    lines = [f"    {f.name}={write_literal(f.value)}," + (f"  # {f.unit}" if f.unit else "") for f in fields]
    return "\n".join([f"{cls}(", *lines, "),\n"])
