"""The target `sdf`: the bench as SDFormat, with what Gazebo and Drake take from one."""

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from frictionzoo.bench.template import in_full
from frictionzoo.export.base import Target, measure, register_target
from frictionzoo.export.nearest import Nearest, find_nearest, say_exact
from frictionzoo.export.skeleton import DRAKE, WORLD, Link, list_numbers, read_links, run_links, say_lacks
from frictionzoo.export.written import Export
from frictionzoo.result.identified import Identified

FILE = "bench.sdf"
_VERSION = "1.7"  # the first in which poses may name the frame that they are in
_KINDS = {"hinge": "revolute", "slide": "prismatic", "fixed": "fixed"}
_TYPES = {"revolute": mujoco.mjtJoint.mjJNT_HINGE, "prismatic": mujoco.mjtJoint.mjJNT_SLIDE}
_ENTRIES = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")  # in the order of MuJoCo's `fullinertia`


@register_target("sdf")
class Sdf(Target):
    """The bench as SDFormat: dynamics with dry friction, as Gazebo reads them, and armature as Drake does."""

    packages: ClassVar[tuple[str, ...]] = ("mujoco",)

    def write(self, fitted: Identified, folder: Path, options: Mapping[str, str]) -> Export:
        """See `Target.write`."""
        nearest = find_nearest(fitted)
        text = write_sdf(fitted, nearest)
        (folder / FILE).write_text(text)
        spec, inertia = read_sdf(text)
        came = run_links(spec, fitted, nearest, [inertia[joint] for joint in fitted.bench.joints])
        difference = measure("qpos", fitted, came, fitted.rollout()[0], reason=nearest.lacks)
        said = (
            "Gazebo and Drake were not run: the difference is that of the file's numbers, read back, in MuJoCo, with "
            "its drake:rotor_inertia as armature and the bench's actuator.",
            "The actuator is left out: the caller computes its force or torque from the recorded commands.",
        )
        return Export((FILE,), (difference,), (*say_lacks(fitted, nearest), *said))


def write_sdf(fitted: Identified, nearest: Nearest) -> str:
    """The file; the frame of a joint is that of its link."""
    root = ET.Element("sdf", {"version": _VERSION, "xmlns:drake": DRAKE})
    root.append(ET.Comment(f" frictionzoo: {nearest.remark or say_exact(fitted.model)} ".replace("--", "- -")))
    model = ET.SubElement(root, "model", name="bench")
    armature = dict(zip(fitted.bench.joints, nearest.bench["armature"], strict=True))
    links = read_links(fitted, nearest)
    joints = {link.joint for link in links}
    # A model has one name for one thing, and MuJoCo's bodies may be called like joints.
    names = {WORLD: WORLD} | {link.name: f"{link.name}_link" if link.name in joints else link.name for link in links}
    for link in links:
        named = link._replace(name=names[link.name], parent=names[link.parent])
        _add_link(model, named)
        _add_joint(model, named, armature.get(link.joint))
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def _add_link(model: ET.Element, link: Link) -> None:
    element = ET.SubElement(model, "link", name=link.name)
    pose = ET.SubElement(element, "pose", {} if link.parent == WORLD else {"relative_to": link.parent})
    pose.text = list_numbers([*link.pos, *link.rpy])
    inertial = ET.SubElement(element, "inertial")
    ET.SubElement(inertial, "pose").text = list_numbers([*link.com, 0.0, 0.0, 0.0])
    ET.SubElement(inertial, "mass").text = in_full(link.mass)
    inertia = ET.SubElement(inertial, "inertia")
    for entry in _ENTRIES:
        row, column = ("xyz".index(axis) for axis in entry[1:])
        ET.SubElement(inertia, entry).text = in_full(link.inertia[row, column])


def _add_joint(model: ET.Element, link: Link, armature: float | None) -> None:
    """Without limits, which a joint of SDFormat need not have."""
    joint = ET.SubElement(model, "joint", name=link.joint, type=_KINDS[link.kind])
    ET.SubElement(joint, "parent").text = link.parent
    ET.SubElement(joint, "child").text = link.name
    if link.kind != "fixed":
        axis = ET.SubElement(joint, "axis")
        ET.SubElement(axis, "xyz").text = list_numbers(link.axis)
        dynamics = ET.SubElement(axis, "dynamics")
        ET.SubElement(dynamics, "damping").text = in_full(link.damping)
        ET.SubElement(dynamics, "friction").text = in_full(link.friction)
    if armature is not None:
        ET.SubElement(joint, "drake:rotor_inertia").text = in_full(armature)
        ET.SubElement(joint, "drake:gear_ratio").text = "1"


def read_sdf(text: str) -> tuple[mujoco.MjSpec, dict[str, float]]:
    """The links of such a file for MuJoCo, which reads no SDFormat, and the rotor's inertia by joint."""
    spec, inertia = mujoco.MjSpec(), dict[str, float]()
    bodies, links = {WORLD: spec.worldbody}, dict[str, ET.Element]()
    for element in ET.fromstring(text).findall("./model/*"):
        name = element.get("name", "")
        if element.tag == "link":
            links[name] = element
            continue
        child = element.findtext("child", "")
        body = bodies[child] = bodies[element.findtext("parent", "")].add_body(name=child)
        _read_link(body, links[child])
        if (axis := element.find("axis")) is not None:
            joint = body.add_joint(name=name, type=_TYPES[element.get("type", "")], axis=_numbers(axis, "xyz"))
            (joint.damping[0],), (joint.frictionloss,) = (
                _numbers(axis, f"dynamics/{tag}") for tag in ("damping", "friction")
            )
        if element.find(f"{{{DRAKE}}}rotor_inertia") is not None:
            rotor, ratio = (_numbers(element, f"{{{DRAKE}}}{tag}")[0] for tag in ("rotor_inertia", "gear_ratio"))
            inertia[name] = rotor * ratio**2
    return spec, inertia


def _read_link(body: mujoco.MjsBody, link: ET.Element) -> None:
    pose, inertial = _numbers(link, "pose"), _numbers(link, "inertial/pose")
    body.pos, body.quat = pose[:3], Rotation.from_euler("xyz", pose[3:]).as_quat(scalar_first=True)
    body.ipos, body.explicitinertial = inertial[:3], True
    (body.mass,) = _numbers(link, "inertial/mass")
    body.fullinertia = np.concatenate([_numbers(link, f"inertial/inertia/{entry}") for entry in _ENTRIES])


def _numbers(element: ET.Element, path: str) -> list[float]:
    return [float(word) for word in element.findtext(path, "").split()]
