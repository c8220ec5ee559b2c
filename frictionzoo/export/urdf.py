"""Target `urdf`: the bench as URDF, for Drake and ros2_control."""

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import ClassVar

import mujoco
import numpy as np

from frictionzoo.bench.template import in_full
from frictionzoo.core.errors import ExportError
from frictionzoo.core.xml import write_comment, write_xml
from frictionzoo.export.base import Export, Target, measure, register_target
from frictionzoo.export.motor import INPUTS, Motor, list_lacks, motors, read_inputs
from frictionzoo.export.nearest import Nearest, find_nearest, say_law
from frictionzoo.export.skeleton import DRAKE, WORLD, Link, list_numbers, read_links, run_links, say_lacks
from frictionzoo.result.fitted_drive import FittedDrive

FILE = "bench.urdf"
_KINDS = {"hinge": "continuous", "slide": "prismatic", "fixed": "fixed"}
_NONE = "1e6"  # limits of a slide [m, m/s, N]: URDF cannot express a slide without limits
_SENSED = ("position", "velocity", "effort")


@register_target("urdf")
class Urdf(Target):
    """URDF of the bench: damping and friction, armature for Drake, interfaces and gains for ros2_control."""

    options: ClassVar[Mapping[str, str]] = INPUTS
    packages: ClassVar[tuple[str, ...]] = ("mujoco",)

    def write(self, fitted: FittedDrive, folder: Path, options: Mapping[str, str]) -> Export:
        """See `Target.write`."""
        nearest, drives, inputs = find_nearest(fitted), [], read_inputs(fitted, options)
        with suppress(ExportError):  # the command is not a position
            drives = motors(fitted, inputs)
        text = write_urdf(fitted, nearest, drives)
        (folder / FILE).write_text(text, encoding="utf-8")
        armature = [float(tag.get("value", "nan")) for tag in ET.fromstring(text).iter(f"{{{DRAKE}}}rotor_inertia")]
        qpos = run_links(mujoco.MjSpec.from_string(text), fitted, nearest, armature)
        difference = measure("qpos", fitted, qpos, fitted.rollout()[0], reason=nearest.lacks)
        return Export((FILE,), (difference,), (*say_lacks(fitted, nearest), *_say(fitted, nearest, drives, inputs)))


def write_urdf(fitted: FittedDrive, nearest: Nearest, drives: list[Motor]) -> str:
    """Write the file; `drives` is empty if the command is not a position."""
    robot = ET.Element("robot", {"name": "bench", "xmlns:drake": DRAKE})
    robot.append(write_comment(f"frictionzoo: {nearest.remark or say_law(fitted.model)}"))
    ET.SubElement(robot, "link", name=WORLD)
    for link in read_links(fitted, nearest):
        _add_link(robot, link)
    system = ET.Element("ros2_control", name="bench", type="system")
    ET.SubElement(ET.SubElement(system, "hardware"), "plugin").text = "mock_components/GenericSystem"
    for index, name in enumerate(fitted.bench.joints):
        _add_transmission(robot, name, nearest.bench["armature"][index])
        _add_interfaces(system, name, drives[index] if drives else None)
    robot.append(system)
    return write_xml(robot)


def _add_link(robot: ET.Element, link: Link) -> None:
    inertial = ET.SubElement(ET.SubElement(robot, "link", name=link.name), "inertial")
    ET.SubElement(inertial, "origin", xyz=list_numbers(link.com), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=in_full(link.mass))
    entries = {f"i{'xyz'[i]}{'xyz'[j]}": in_full(link.inertia[i, j]) for i in range(3) for j in range(i, 3)}
    ET.SubElement(inertial, "inertia", entries)
    joint = ET.SubElement(robot, "joint", name=link.joint, type=_KINDS[link.kind])
    ET.SubElement(joint, "origin", xyz=list_numbers(link.pos), rpy=list_numbers(link.rpy))
    ET.SubElement(joint, "parent", link=link.parent)
    ET.SubElement(joint, "child", link=link.name)
    if link.kind == "fixed":
        return
    ET.SubElement(joint, "axis", xyz=list_numbers(link.axis))
    if link.kind == "slide":
        ET.SubElement(joint, "limit", lower=f"-{_NONE}", upper=_NONE, effort=_NONE, velocity=_NONE)
    ET.SubElement(joint, "dynamics", damping=in_full(link.damping), friction=in_full(link.friction))


def _add_transmission(robot: ET.Element, joint: str, armature: float) -> None:
    """Add Drake's transmission; the armature is rotor_inertia gear_ratio^2."""
    transmission = ET.SubElement(robot, "transmission", name=f"{joint}_transmission")
    ET.SubElement(transmission, "type").text = "transmission_interface/SimpleTransmission"
    ET.SubElement(transmission, "joint", name=joint)
    actuator = ET.SubElement(transmission, "actuator", name=joint)
    ET.SubElement(actuator, "drake:rotor_inertia", value=in_full(armature))
    ET.SubElement(actuator, "drake:gear_ratio", value="1")


def _add_interfaces(system: ET.Element, name: str, drive: Motor | None) -> None:
    joint = ET.SubElement(system, "joint", name=name)
    ET.SubElement(joint, "command_interface", name="position" if drive else "effort")
    for sensed in _SENSED:
        ET.SubElement(joint, "state_interface", name=sensed)
    if drive is None:
        return
    for param in ("stiffness", "damping", "effort_limit", "saturation_effort", "velocity_limit"):
        if np.isfinite(value := getattr(drive, param)):
            ET.SubElement(joint, "param", name=param).text = in_full(value)


def _say(fitted: FittedDrive, nearest: Nearest, drives: list[Motor], inputs: Mapping[str, float]) -> list[str]:
    limits = [
        "Drake and ros2_control were not run: the difference is that of the file in MuJoCo, with its "
        "drake:rotor_inertia as armature and the bench's actuator.",
        "ros2_control's plugin is mock_components/GenericSystem, to be replaced by your hardware's, which reads "
        "<param> or not.",
    ]
    if not drives:
        return [*limits, "The command is an effort: what makes one of the recorded commands is not in the file."]
    if inputs.keys() & INPUTS.keys():
        listed = ", ".join(f"{name} {value:g}" for name, value in inputs.items() if name in INPUTS)
        limits.append(f"Gains in <param> are those at {listed}.")
    exact = [lack for lack in list_lacks(fitted, nearest) if lack not in (nearest.lacks, "delays are whole steps")]
    return limits + ([f"Gains in <param> leave out: {', '.join(exact)}."] if exact else [])
