"""Links and joints of a bench for robot description formats, in which a link has the frame of its joint."""

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from frictionzoo.core.errors import ExportError
from frictionzoo.export.base import list_values
from frictionzoo.export.bench import say_limits, write_bench
from frictionzoo.export.nearest import Nearest
from frictionzoo.export.simulate import equip, run_loaded
from frictionzoo.result.fitted_drive import FittedDrive

WORLD = "world"
DRAKE = "http://drake.mit.edu"


class JointedLink(NamedTuple):
    """A link and the joint that holds it.

    Attributes:
        parent: Name of its parent link, or `WORLD`.
        pos: Position of its frame in the parent's [m].
        rpy: Rotation of its frame about the parent's fixed axes x, y, z [rad].
        mass: [kg].
        com: Centre of mass in its frame [m].
        inertia: About the centre of mass, in the axes of its frame [kg m^2].
        joint: Name of the joint; for a fixed joint, the link's name with `_fixed`.
        kind: `hinge`, `slide`, or `fixed`.
        axis: Axis of the joint in the link's frame.
        damping: [N m s/rad or N s/m].
        friction: Dry friction [N m or N].
    """

    name: str
    parent: str
    pos: Float[np.ndarray, "3"]
    rpy: Float[np.ndarray, "3"]
    mass: float
    com: Float[np.ndarray, "3"]
    inertia: Float[np.ndarray, "3 3"]
    joint: str
    kind: str
    axis: Float[np.ndarray, "3"]
    damping: float
    friction: float


def read_links(fitted: FittedDrive, nearest: Nearest) -> list[JointedLink]:
    """Read the links of the bench, with MuJoCo's joint friction.

    Raises:
        ExportError: The bench has several joints in a body, an equality or a tendon.
    """
    model = mujoco.MjModel.from_xml_string(write_bench(fitted, nearest))
    if (model.body_jntnum > 1).any() or model.neq or model.ntendon:
        raise ExportError(
            f"{fitted.place}: a body with several joints, an equality or a tendon, expected links with a joint each; "
            "write target=mjcf"
        )
    bodies = {model.body(index).name for index in range(model.nbody)}
    joints = {model.joint(index).name for index in range(model.njnt)}
    names = [model.body(body).name or find_free_name(f"link{body}", bodies) for body in range(model.nbody)]
    fixed = [find_free_name(f"{name}_fixed", joints) for name in names]
    return [_read_link(model, body, names, fixed[body]) for body in range(1, model.nbody)]


def find_free_name(name: str, taken: set[str]) -> str:
    """Return the name, with underscores appended until it is free, and add it to `taken`."""
    while name in taken:
        name += "_"
    taken.add(name)
    return name


def _read_link(model: mujoco.MjModel, body: int, names: Sequence[str], fixed: str) -> JointedLink:
    parent, joint = int(model.body_parentid[body]), int(model.body_jntadr[body])
    rotation = Rotation.from_quat(model.body_quat[body], scalar_first=True)
    axes = Rotation.from_quat(model.body_iquat[body], scalar_first=True).as_matrix()
    anchor = _anchor(model, body)
    joint_fields = (fixed, "fixed", np.array([0.0, 0.0, 1.0]), 0.0, 0.0)
    if joint >= 0:
        kind = "hinge" if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE else "slide"
        dof = model.jnt_dofadr[joint]
        friction = float(model.dof_damping[dof]), float(model.dof_frictionloss[dof])
        joint_fields = (model.joint(joint).name, kind, model.jnt_axis[joint], *friction)
    return JointedLink(
        *(names[body], names[parent]),
        model.body_pos[body] - _anchor(model, parent) + rotation.apply(anchor),
        rotation.as_euler("xyz"),
        *(float(model.body_mass[body]), model.body_ipos[body] - anchor, axes * model.body_inertia[body] @ axes.T),
        *joint_fields,
    )


def _anchor(model: mujoco.MjModel, body: int) -> Float[np.ndarray, "3"]:
    """Return the position of a body's joint in the body's frame [m]."""
    return model.jnt_pos[model.body_jntadr[body]] if model.body_jntnum[body] else np.zeros(3)


def run_links(
    spec: mujoco.MjSpec, fitted: FittedDrive, nearest: Nearest, armature: Sequence[float]
) -> Float[np.ndarray, "batch time nv"]:
    """Simulate the long test rollouts in MuJoCo C with links from a written file; return positions.

    Options, actuators, `solreffriction` and reference positions, which these formats lack, come from the bench.
    `armature` has a value for each joint [kg m^2 or kg].
    """
    spec.compiler.fusestatic, payload = 0, fitted.bench.payload
    bench = equip(spec, write_bench(fitted, nearest), armature)
    model = spec.compile()
    model.qpos0[:] = bench.qpos0

    def begin(data: mujoco.MjData, rollout: int) -> None:
        if payload is not None and fitted.segments.load is not None:  # a payload is in the frame of the bench's body
            model.body_ipos[payload] -= _anchor(bench, payload)

    return run_loaded(model, fitted, begin=begin, late=True)


def build(tag: str, *parts: "str | Mapping[str, str] | ET.Element[Any] | None") -> "ET.Element[Any]":
    """Build an XML element from its text, attributes and children."""
    element = ET.Element(tag)
    for part in parts:
        if isinstance(part, str):
            element.text = part
        elif isinstance(part, ET.Element):
            element.append(part)
        elif part is not None:
            element.attrib |= part
    return element


def say_lacks(fitted: FittedDrive, nearest: Nearest, in_links: bool = False) -> tuple[str, ...]:
    """List the limits common to these formats; `in_links`: the armature is in the links."""
    values, units = fitted.values["bench"], fitted.units
    armature = f"{list_values(nearest.bench['armature'])} {units['inertia']}"
    limits = [
        *say_limits(fitted, nearest),
        f"The armature, {armature}, is in the links: set none."
        if in_links
        else f"Only Drake reads the armature, {armature}, from drake:rotor_inertia: set it where a program has one. "
        "Gazebo has none.",
        "Drake reads no dry friction: its joints have damping alone.",
        "Shapes are left out, and so are solreffriction, gravity and the time step.",
    ]
    if "delay" in values and not fitted.bench.actuator.needs_state:  # a limit already says it otherwise
        limits.append(
            f"Commands act {list_values(values['delay'])} s late, which the caller does, as for the difference."
        )
    if "position_offset" in values:
        offset = list_values(values["position_offset"])
        limits.append(f"The recorded positions lack {offset} {units['position']}, which these joints do not.")
    return tuple(limits)
