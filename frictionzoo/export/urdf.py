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
from frictionzoo.export.motor import INPUTS, Motor, list_lacks, motors, read_inputs, say_inputs
from frictionzoo.export.nearest import Nearest, find_nearest, say_law
from frictionzoo.export.skeleton import DRAKE, WORLD, JointedLink, build, read_links, run_links, say_lacks
from frictionzoo.result.fitted_drive import FittedDrive

FILE = "bench.urdf"
_KINDS = {"hinge": "continuous", "slide": "prismatic", "fixed": "fixed"}
_NONE = "1e6"  # limits of a slide [m, m/s, N]: URDF cannot express a slide without limits
_PARAMS = ("stiffness", "damping", "effort_limit", "saturation_effort", "velocity_limit")


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
    joints = list(zip(fitted.bench.joints, nearest.bench["armature"], drives or fitted.bench.nv * [None], strict=True))
    plugin = build("hardware", build("plugin", "mock_components/GenericSystem"))
    interfaces = [_write_interfaces(name, drive) for name, _, drive in joints]
    root = build(
        *("robot", {"name": "bench", "xmlns:drake": DRAKE}),
        write_comment(f"frictionzoo: {nearest.remark or say_law(fitted.model)}"),
        build("link", {"name": WORLD}),
        *(part for link in read_links(fitted, nearest) for part in _write_link(link)),
        *(_write_transmission(name, armature) for name, armature, _ in joints),
        build("ros2_control", {"name": "bench", "type": "system"}, plugin, *interfaces),
    )
    return write_xml(root)


def _write_link(link: JointedLink) -> tuple[ET.Element, ET.Element]:
    entries = {f"i{'xyz'[i]}{'xyz'[j]}": in_full(link.inertia[i, j]) for i in range(3) for j in range(i, 3)}
    inertial = build(
        *("inertial", build("origin", {"xyz": in_full(link.com), "rpy": "0 0 0"})),
        *(build("mass", {"value": in_full(link.mass)}), build("inertia", entries)),
    )
    slide = {"lower": f"-{_NONE}", "upper": _NONE, "effort": _NONE, "velocity": _NONE}
    moving = [
        build("axis", {"xyz": in_full(link.axis)}),
        build("limit", slide) if link.kind == "slide" else None,
        build("dynamics", {"damping": in_full(link.damping), "friction": in_full(link.friction)}),
    ]
    joint = build(
        *("joint", {"name": link.joint, "type": _KINDS[link.kind]}),
        build("origin", {"xyz": in_full(link.pos), "rpy": in_full(link.rpy)}),
        *(build("parent", {"link": link.parent}), build("child", {"link": link.name})),
        *(() if link.kind == "fixed" else moving),
    )
    return build("link", {"name": link.name}, inertial), joint


def _write_transmission(joint: str, armature: float) -> ET.Element:
    """Write Drake's transmission; the armature is rotor_inertia gear_ratio^2."""
    drake = {"drake:rotor_inertia": in_full(armature), "drake:gear_ratio": "1"}
    return build(
        *("transmission", {"name": f"{joint}_transmission"}),
        *(build("type", "transmission_interface/SimpleTransmission"), build("joint", {"name": joint})),
        build("actuator", {"name": joint}, *(build(tag, {"value": value}) for tag, value in drake.items())),
    )


def _write_interfaces(name: str, drive: Motor | None) -> ET.Element:
    params = {param: getattr(drive, param) for param in _PARAMS} if drive else {}
    return build(
        *("joint", {"name": name}, build("command_interface", {"name": "position" if drive else "effort"})),
        *(build("state_interface", {"name": sensed}) for sensed in ("position", "velocity", "effort")),
        *(build("param", {"name": n}, in_full(value)) for n, value in params.items() if np.isfinite(value)),
    )


def _say(fitted: FittedDrive, nearest: Nearest, drives: list[Motor], inputs: Mapping[str, float]) -> list[str]:
    limits = [
        "Drake and ros2_control were not run: the difference is computed in MuJoCo, with the file's "
        "drake:rotor_inertia as armature and the bench's actuator.",
        "Replace ros2_control's plugin mock_components/GenericSystem by your hardware's, which may ignore <param>.",
    ]
    if not drives:
        return [*limits, "The command is an effort: the file does not convert the recorded commands to it."]
    if listed := say_inputs(inputs):
        limits.append(f"Gains in <param> are valid at {listed}.")
    exact = [lack for lack in list_lacks(fitted, nearest) if lack not in (nearest.lacks, "delays are whole steps")]
    return limits + ([f"Gains in <param> leave out: {', '.join(exact)}."] if exact else [])
