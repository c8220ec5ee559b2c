"""Targets that write a Python file with configuration classes of another program, as text."""

import ast
from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from textwrap import indent
from typing import Any, ClassVar

import numpy as np

from frictionzoo.core.templates import write_literal
from frictionzoo.export.base import Export, Target, match_joint, measure
from frictionzoo.export.motor import (
    INPUTS,
    LIMITS,
    MOTOR,
    Joint,
    Motor,
    lag,
    list_lacks,
    motors,
    read_inputs,
    run_joints,
    say_common,
    say_not_run,
)
from frictionzoo.export.nearest import Nearest, find_nearest
from frictionzoo.export.variants import at_rest
from frictionzoo.result.fitted_drive import FittedDrive


class ConfigFile(Target):
    """Python file with `ACTUATORS`, the configuration of an actuator for each joint.

    Attributes:
        program: Name of the simulator.
        head: Docstring of the file.
        module: Module of the configuration classes.
        classes: Class of a motor without delay, with a delay, and with a torque-speed line.
        keyed: Whether `ACTUATORS` is a dict by joint instead of a tuple.
        keywords: Property by keyword, see `_list_properties`; infinite limits and delays of 0 are left out.
        late_dc: Whether the class with a torque-speed line has a delay.
        apart: Keywords that are arguments of `helper`, whose result the class unpacks.
        helper: Imports and a function `limits` for the file; empty without `apart`.
    """

    options: ClassVar[Mapping[str, str]] = INPUTS
    packages: ClassVar[tuple[str, ...]] = ("mujoco",)
    program: ClassVar[str]
    file: ClassVar[str]
    head: ClassVar[str]
    module: ClassVar[str]
    classes: ClassVar[tuple[str, str, str]]
    keyed: ClassVar[bool]
    keywords: ClassVar[Mapping[str, str]]
    late_dc: ClassVar[bool] = True
    apart: ClassVar[tuple[str, ...]] = ()
    helper: ClassVar[str] = ""

    @abstractmethod
    def say_more(self, fitted: FittedDrive, drives: list[Motor], options: Mapping[str, str]) -> tuple[str, ...]:
        """List further limits of this simulator."""

    def choose_keywords(self, options: Mapping[str, str]) -> Mapping[str, str]:
        """Return `keywords` for these options of the target."""
        return self.keywords

    def write(self, fitted: FittedDrive, folder: Path, options: Mapping[str, str]) -> Export:
        """See `Target.write`."""
        inputs = read_inputs(fitted, options)
        keywords = self.choose_keywords(options)
        drives, nearest = motors(fitted, inputs), find_nearest(fitted)
        calls = [self._configure(keywords, fitted, nearest, joint, drive) for joint, drive in enumerate(drives)]
        classes = {call.partition("(")[0] for call in calls}
        keys = [f"{write_literal(name)}: " if self.keyed else "" for name in fitted.bench.joints]
        body = "".join(key + call for key, call in zip(keys, calls, strict=True))
        opening, closing = "{}" if self.keyed else "()"
        with_helper = "**limits(" in body
        names = sorted(classes | ({"ActuatorBaseCfg"} if with_helper else set()))
        preamble = f"from {self.module} import {', '.join(names)}"
        if with_helper:
            preamble = f"from dataclasses import fields\n\n{preamble}\n\n\n{self.helper}\n"
        text = f'"""{self.head}"""\n\n{preamble}\n\nACTUATORS = {opening}\n{indent(body, "    ")}{closing}\n'
        (folder / self.file).write_text(text, encoding="utf-8")
        # If the file has no delay, the caller delays the commands.
        read = self.read(text, keywords)
        joints = [joint._replace(lag=joint.lag or lag(fitted, i)) for i, joint in enumerate(read)]
        difference = measure(
            *("qpos", fitted, run_joints(fitted, nearest, joints), fitted.rollout()[0]),
            reason=", ".join(list_lacks(fitted, nearest)),
        )
        more = self.say_more(fitted, drives, options)
        limits = (say_not_run(self.program), *say_common(fitted, nearest, inputs), *more)
        return Export((self.file,), (difference,), limits)

    def _configure(
        self, keywords: Mapping[str, str], fitted: FittedDrive, nearest: Nearest, joint: int, motor: Motor
    ) -> str:
        properties, has_line = _list_properties(fitted, nearest, joint, motor), np.isfinite(motor.saturation_effort)
        if has_line and not self.late_dc:
            properties["delay"] = 0, ""
        late = bool(properties["delay"][0])
        names = [match_joint(fitted.bench.joints[joint])]
        properties["joint"] = names if self.keyed else tuple(names), ""
        if not late:
            del properties["delay"]
        arguments = {keyword: properties[name] for keyword, name in keywords.items() if name in properties}
        apart = {keyword: arguments.pop(keyword) for keyword in self.apart if keyword in arguments}
        limits = indent(write_call("**limits", apart), "    ") if apart else ""
        return write_call(self.classes[2 if has_line else late], arguments, limits)

    def read(self, text: str, keywords: Mapping[str, str] | None = None) -> list[Joint]:
        """Read each joint from a written file, without running it; `keywords` if not those of the class."""
        (value,) = (node.value for node in ast.parse(text).body if isinstance(node, ast.Assign))
        calls = value.values if isinstance(value, ast.Dict) else getattr(value, "elts", [])
        return [_read_call(call, keywords or self.keywords) for call in calls if isinstance(call, ast.Call)]


def _read_call(call: ast.Call, keywords: Mapping[str, str]) -> Joint:
    unpacked = [keyword.value for keyword in call.keywords if keyword.arg is None]
    arguments = [*call.keywords, *(inner for one in unpacked if isinstance(one, ast.Call) for inner in one.keywords)]
    of = {keywords[one.arg]: ast.literal_eval(one.value) for one in arguments if one.arg is not None}
    motor = Motor(**{name: of[name] for name in MOTOR if name in of})
    return Joint(motor, of["armature"], of["frictionloss"], of["viscous_damping"], of.get("delay", 0))


def _list_properties(fitted: FittedDrive, nearest: Nearest, joint: int, motor: Motor) -> dict[str, tuple[Any, str]]:
    """Return what keywords can have, each with its unit for a comment, except infinite limits."""
    units, torque = fitted.units, fitted.units["torque"]
    properties: dict[str, tuple[Any, str]] = {
        "stiffness": (motor.stiffness, units["stiffness"]),
        "damping": (motor.damping, f"{units['damping']}, of the controller"),
        "saturation_effort": (motor.saturation_effort, f"{torque}, at standstill"),
        "velocity_limit": (motor.velocity_limit, f"{units['velocity']}, without load"),
        "effort_limit": (motor.effort_limit, torque),
        "delay": (lag(fitted, joint), "steps"),
        "armature": (nearest.bench["armature"][joint], units["inertia"]),
        "static_friction": (at_rest(fitted, fitted.values, nearest.frictionloss)[joint], f"{torque}, at rest"),
        "frictionloss": (nearest.frictionloss[joint], torque),
        "viscous_damping": (nearest.damping[joint] + fitted.bench.own_damping[joint], units["damping"]),
    }
    return {name: entry for name, entry in properties.items() if name not in LIMITS or np.isfinite(entry[0])}


def write_call(name: str, arguments: Mapping[str, tuple[Any, str]], more: str = "") -> str:
    """Write a call as an item of a list: one argument per line, each with a comment or an empty one, then `more`."""
    lines = (
        f"    {keyword}={write_literal(value)},{comment and f'  # {comment}'}\n"
        for keyword, (value, comment) in arguments.items()
    )
    return "".join([f"{name}(\n", *lines, more, "),\n"])
