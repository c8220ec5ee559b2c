"""Links and joints of a bench, as description formats of robots have them: the frame of a link is that of its joint."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from frictionzoo.bench.template import in_full
from frictionzoo.core.errors import ExportError
from frictionzoo.core.params import UNITS
from frictionzoo.export.base import list_values
from frictionzoo.export.bench import say_limits, write_bench
from frictionzoo.export.nearest import Nearest
from frictionzoo.export.simulate import run_loaded
from frictionzoo.result.identified import Identified

WORLD = "world"
DRAKE = "http://drake.mit.edu"


class Link(NamedTuple):
    """A link and the joint that holds it.

    Attributes:
        name: Of the link.
        parent: Of the link that holds it, or `WORLD`.
        pos: Of its frame in that of the parent [m].
        rpy: Turn of its frame about the parent's fixed axes x, y, z [rad].
        mass: [kg].
        com: Centre of mass in its frame [m].
        inertia: About the centre of mass, along the axes of its frame [kg m^2].
        joint: Name of the joint; that of a fixed one is the link's.
        kind: `hinge`, `slide`, or `fixed`.
        axis: Of the joint, in the link's frame.
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


def read_links(fitted: Identified, nearest: Nearest) -> list[Link]:
    """Those of the bench with the friction that MuJoCo's joints can hold.

    Raises:
        ExportError: It has what a tree of links with a joint each has not.
    """
    model = mujoco.MjModel.from_xml_string(write_bench(fitted, nearest))
    if (model.body_jntnum > 1).any() or model.neq or model.ntendon:
        raise ExportError(
            f"{fitted.place}: a body with several joints, an equality or a tendon, expected links with a joint each; "
            "write target=mjcf"
        )
    bodies, joints = (
        {of(at).name for at in range(n)} for of, n in ((model.body, model.nbody), (model.joint, model.njnt))
    )
    names = [model.body(body).name or find_free_name(f"link{body}", bodies) for body in range(model.nbody)]
    fixed = [find_free_name(f"{name}_fixed", joints) for name in names]
    return [_read_link(model, body, names, fixed[body]) for body in range(1, model.nbody)]


def find_free_name(name: str, taken: set[str]) -> str:
    """The name, with underscores where others have it; it is taken from now on."""
    while name in taken:
        name += "_"
    taken.add(name)
    return name


def _read_link(model: mujoco.MjModel, body: int, names: Sequence[str], fixed: str) -> Link:
    parent, joint = int(model.body_parentid[body]), int(model.body_jntadr[body])
    turned = Rotation.from_quat(model.body_quat[body], scalar_first=True)
    axes = Rotation.from_quat(model.body_iquat[body], scalar_first=True).as_matrix()
    at = _anchor(model, body)
    moving = (fixed, "fixed", np.array([0.0, 0.0, 1.0]), 0.0, 0.0)
    if joint >= 0:
        kind, dof = (
            "hinge" if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE else "slide",
            model.jnt_dofadr[joint],
        )
        friction = float(model.dof_damping[dof]), float(model.dof_frictionloss[dof])
        moving = (model.joint(joint).name, kind, model.jnt_axis[joint], *friction)
    return Link(
        *(names[body], names[parent]),
        model.body_pos[body] - _anchor(model, parent) + turned.apply(at),
        turned.as_euler("xyz"),
        *(float(model.body_mass[body]), model.body_ipos[body] - at, axes * model.body_inertia[body] @ axes.T),
        *moving,
    )


def _anchor(model: mujoco.MjModel, body: int) -> Float[np.ndarray, "3"]:
    """Where the frame of a body's joint lies in that of the body [m]."""
    return model.jnt_pos[model.body_jntadr[body]] if model.body_jntnum[body] else np.zeros(3)


def run_links(
    spec: mujoco.MjSpec, fitted: Identified, nearest: Nearest, armature: Sequence[float]
) -> Float[np.ndarray, "batch time nv"]:
    """Positions of the long test rollouts in MuJoCo C.

    Args:
        spec: The links that were read from a written file.
        fitted: The drive.
        nearest: What MuJoCo's joints can hold of it.
        armature: Of each joint [kg m^2 or kg].

    What these files have not is that of the bench: options, actuators, `solreffriction` and positions of rest.
    """
    text = write_bench(fitted, nearest)
    bench, law = mujoco.MjModel.from_xml_string(text), fitted.bench.actuator.affine(nearest.bench)
    ends = fitted.bench.actuator.force_range(nearest.bench)
    spec.option, spec.compiler.fusestatic = mujoco.MjSpec.from_string(text).option, 0
    for index, name in enumerate(fitted.bench.joints):
        joint = spec.joint(name)
        joint.armature, joint.solref_friction = armature[index], bench.dof_solref[index]
        gain, *bias = (float(coefficient[index]) for coefficient in law)
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.gainprm[0], actuator.biastype, actuator.biasprm[:3] = gain, mujoco.mjtBias.mjBIAS_AFFINE, bias
        if ends is not None:
            actuator.forcelimited, actuator.forcerange = True, ends[index]
    model, payload = spec.compile(), fitted.bench.payload
    model.qpos0[:] = bench.qpos0

    def begin(data: mujoco.MjData, rollout: int) -> None:
        if payload is not None and fitted.segments.load is not None:  # a payload is in the frame of the bench's body
            model.body_ipos[payload] -= _anchor(bench, payload)

    return run_loaded(model, fitted, begin=begin, late=True)


def list_numbers(values: Iterable[float]) -> str:
    """Numbers as these formats have them, at full precision."""
    return " ".join(map(in_full, values))


def say_lacks(fitted: Identified, nearest: Nearest, in_links: bool = False) -> tuple[str, ...]:
    """What every such description leaves out; `in_links` says that the armature is in the links."""
    values, units = fitted.values["bench"], UNITS[fitted.bench.joint_type]
    armature = list_values(nearest.bench["armature"])
    whose = f"Only Drake reads the armature, {armature} {units['inertia']}, from drake:rotor_inertia: set it where a "
    whose += "program has one. Gazebo has none."
    said = [
        *say_limits(fitted, nearest),
        f"The armature, {armature} {units['inertia']}, is in the links: set none." if in_links else whose,
        "Drake reads no dry friction: its joints have damping alone.",
        "Shapes are left out, and so are solreffriction, gravity and the time step.",
    ]
    if "delay" in values and not fitted.bench.actuator.needs_state:  # whose limit says so
        said.append(
            f"Commands act {list_values(values['delay'])} s late, which the caller does, as for the difference."
        )
    if "position_offset" in values:
        offset = list_values(values["position_offset"])
        said.append(f"The recorded positions lack {offset} {units['position']}, which these joints do not.")
    return tuple(said)
