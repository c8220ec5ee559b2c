"""Target `sdf`: the bench as SDFormat, for Gazebo and Drake."""

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from frictionzoo.bench.template import in_full
from frictionzoo.core.errors import ExportError
from frictionzoo.core.xml import write_comment, write_xml
from frictionzoo.export.base import Export, Target, measure, read_choice, register_target
from frictionzoo.export.nearest import Nearest, find_nearest, say_law
from frictionzoo.export.skeleton import (
    DRAKE,
    WORLD,
    JointedLink,
    build,
    find_free_name,
    read_links,
    run_links,
    say_lacks,
)
from frictionzoo.result.fitted_drive import FittedDrive

FILE = "bench.sdf"
_VERSION = "1.7"  # the first version with poses relative to a named frame
_KINDS = {"hinge": "revolute", "slide": "prismatic", "fixed": "fixed"}
_TYPES = {"revolute": mujoco.mjtJoint.mjJNT_HINGE, "prismatic": mujoco.mjtJoint.mjJNT_SLIDE}
_PLACES = ("joints", "links")
_LEVEL = 1e-6  # share of gravity along a slide that counts as 0
_ENTRIES = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")  # order of MuJoCo's `fullinertia`


@register_target("sdf")
class Sdf(Target):
    """SDFormat of the bench: damping and dry friction, read by Gazebo, and armature, read by Drake."""

    options: ClassVar[Mapping[str, str]] = {"armature": "joints, as Drake reads it, or links, for Gazebo; else joints"}
    packages: ClassVar[tuple[str, ...]] = ("mujoco",)

    def write(self, fitted: FittedDrive, folder: Path, options: Mapping[str, str]) -> Export:
        """See `Target.write`."""
        nearest, in_links = find_nearest(fitted), read_choice(options, "armature", _PLACES) == "links"
        text = write_sdf(fitted, nearest, in_links)
        (folder / FILE).write_text(text, encoding="utf-8")
        spec, inertia = read_sdf(text)
        qpos = run_links(spec, fitted, nearest, [inertia.get(joint, 0.0) for joint in fitted.bench.joints])
        lacks = ", ".join(
            filter(None, (nearest.lacks, "rotors turn with their links" if in_links and fitted.bench.nv > 1 else ""))
        )
        difference = measure("qpos", fitted, qpos, fitted.rollout()[0], reason=lacks)
        remarks = (
            "Gazebo and Drake were not run: the difference is computed in MuJoCo from the file's values, with "
            f"{'the armature in the links' if in_links else 'its drake:rotor_inertia as armature'} and the bench's "
            "actuator.",
            "The actuator is left out: the caller computes its force or torque from the recorded commands.",
        )
        return Export((FILE,), (difference,), (*say_lacks(fitted, nearest, in_links), *remarks))


def write_sdf(fitted: FittedDrive, nearest: Nearest, in_links: bool = False) -> str:
    """Write the file; a joint has the frame of its link. With `in_links`, links instead of joints have the armature.

    Raises:
        ExportError: The links cannot represent the armature, or SDFormat the bench.
    """
    armature = dict(zip(fitted.bench.joints, nearest.bench["armature"], strict=True))
    links, parts = read_links(fitted, nearest), list[ET.Element]()
    names = _name_links(links)
    for link in links:
        own = armature.get(link.joint)
        loaded = _load(link, own, fitted) if in_links and own is not None else link
        parts += [_write_link(loaded, names), _write_joint(link, names, None if in_links else own)]
    comment = write_comment(f"frictionzoo: {nearest.remark or say_law(fitted.model)}")
    model = build("model", {"name": "bench"}, *parts)
    return write_xml(build("sdf", {"version": _VERSION, "xmlns:drake": DRAKE}, comment, model))


def _name_links(links: Sequence[JointedLink]) -> dict[str, str]:
    """Choose unique names of links: in SDFormat, unlike MuJoCo, a link and a joint cannot share a name."""
    joints, names = {link.joint for link in links}, {WORLD: WORLD}
    taken = joints | {link.name for link in links}
    for link in links:
        names[link.name] = link.name if link.name not in joints else find_free_name(f"{link.name}_link", taken)
    for name in sorted(joints | {*names} - {WORLD}):
        reserved = name == WORLD or "::" in name or (name.startswith("__") and name.endswith("__"))
        if reserved or name != name.strip() or not set(name).isdisjoint("\t\r\n"):
            raise ExportError(
                f"{name!r}: SDFormat has no such name, expected one without '::', tabs, line breaks and blanks at its "
                "ends, which is neither 'world' nor between '__'; rename it in the model"
            )
    return names


def _load(link: JointedLink, armature: float, fitted: FittedDrive) -> JointedLink:
    """Add the armature to a link: to the mass for a slide; for a hinge as a thin disc about the axis."""
    bench = fitted.bench
    if bench.payload is not None:
        raise ExportError(
            f"{fitted.place}: its payload is that of a link, and so would be the armature; leave armature=links out"
        )
    if link.kind == "hinge":
        axis = link.axis / np.linalg.norm(link.axis)
        return link._replace(inertia=link.inertia + armature / 2 * (np.eye(3) + np.outer(axis, axis)))
    model = bench.compile(constraint=False)
    joint = mujoco.MjData(model)
    mujoco.mj_kinematics(model, joint)
    along = float(joint.xaxis[model.joint(link.joint).id] @ model.opt.gravity)
    if abs(along) > _LEVEL * float(np.linalg.norm(model.opt.gravity)):
        raise ExportError(
            f"{fitted.place}: gravity acts along the slide {link.joint}, and would on an armature in its link; leave "
            "armature=links out"
        )
    return link._replace(mass=link.mass + armature)


def _write_link(link: JointedLink, names: Mapping[str, str]) -> ET.Element:
    place = {} if link.parent == WORLD else {"relative_to": names[link.parent]}
    entries = {entry: link.inertia["xyz".index(entry[1]), "xyz".index(entry[2])] for entry in _ENTRIES}
    return build(
        *("link", {"name": names[link.name]}, build("pose", place, in_full([*link.pos, *link.rpy]))),
        build(
            *("inertial", build("pose", in_full([*link.com, 0.0, 0.0, 0.0])), build("mass", in_full(link.mass))),
            build("inertia", *(build(entry, in_full(value)) for entry, value in entries.items())),
        ),
    )


def _write_joint(link: JointedLink, names: Mapping[str, str], armature: float | None) -> ET.Element:
    parts = [build("parent", names[link.parent]), build("child", names[link.name])]
    if link.kind != "fixed":
        dynamics = build("damping", in_full(link.damping)), build("friction", in_full(link.friction))
        parts.append(build("axis", build("xyz", in_full(link.axis)), build("dynamics", *dynamics)))
    if armature is not None:
        parts += [build("drake:rotor_inertia", in_full(armature)), build("drake:gear_ratio", "1")]
    return build("joint", {"name": link.joint, "type": _KINDS[link.kind]}, *parts)  # limits are optional in SDFormat


def read_sdf(text: str) -> tuple[mujoco.MjSpec, dict[str, float]]:
    """Read the links of a written file for MuJoCo, which cannot read SDFormat, and the rotor inertia by joint."""
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
            (joint.damping[0],) = _numbers(axis, "dynamics/damping")
            (joint.frictionloss,) = _numbers(axis, "dynamics/friction")
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
