"""Contacts, inertia and payload of a bench's compiled MuJoCo model."""

import copy

import mujoco
import numpy as np
from jaxtyping import Float

from frictionzoo.core.log import Payload

NO_FRICTION_CONSTRAINT = mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
"""MJCF flags that disable the friction constraint."""
NO_PAYLOAD = Payload(0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
INERTIAL = 11
"""Number of entries of a load that describe the body; the remaining ones are the joint-space inertia."""


def can_collide(model: mujoco.MjModel) -> bool:
    """Return whether MuJoCo checks any two geoms for contacts, without regard to excluded pairs of the MJCF.

    MuJoCo ignores geoms of one body or of bodies welded together and, unless `filterparent` is disabled, a moving body
    and its parent.

    Source: MuJoCo documentation, "Computation", "Collision detection", selection.
    """
    compatible = (model.geom_contype[:, None] & model.geom_conaffinity[None, :]) != 0
    body = model.body_weldid[model.geom_bodyid]
    parent = model.body_weldid[model.body_parentid[body]]
    # A fixed parent may touch its children.
    child = (parent[:, None] == body[None, :]) & (body[None, :] != 0)
    filtered = (child | child.T) & (not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT)
    return bool(((compatible | compatible.T) & (body[:, None] != body[None, :]) & ~filtered).any())


def combine(model: mujoco.MjModel, body: int, payload: Payload) -> Float[np.ndarray, "load"]:
    """Add a payload to a body of the model, given by index, and return the load in the format of `Bench.load`."""
    masses = np.array([model.body_mass[body], payload.mass])
    centres = np.stack([model.body_ipos[body], payload.position])
    inertias = np.stack([inertia_of(model, body), np.diag(payload.inertia)])
    mass, centre, total = add_up(masses, centres, inertias)
    principal, quaternion = principal_axes(total)
    # Body and payload may both have no mass.
    inertial = np.concatenate([[mass], centre if mass > 0 else centres[0], quaternion, principal])
    put_inertial(model, body, inertial)
    return np.concatenate([inertial, rigid_inertia(model).ravel()])


def rotation(quaternion: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation matrix of a quaternion."""
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, quaternion)
    return axes.reshape(3, 3)


def inertia_of(model: mujoco.MjModel, body: int) -> Float[np.ndarray, "3 3"]:
    """Return the inertia of a body, given by index, about its centre of mass in the axes of its frame [kg m^2]."""
    axes = rotation(model.body_iquat[body])
    return axes * model.body_inertia[body] @ axes.T


def principal_axes(inertia: Float[np.ndarray, "3 3"]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "4"]]:
    """Return the principal moments of an inertia and the quaternion of its principal axes."""
    principal, axes = np.linalg.eigh(inertia)
    axes[:, 0] *= np.linalg.det(axes)  # a rotation, not a reflection
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, axes.ravel())
    return principal, quaternion


def add_up(
    masses: Float[np.ndarray, "n"], centres: Float[np.ndarray, "n 3"], inertias: Float[np.ndarray, "n 3 3"]
) -> tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Return total mass, centre of mass and inertia about it of several bodies, all in the same axes."""
    mass = float(masses.sum())
    centre = masses @ centres / mass if mass > 0 else np.zeros(3)
    total = np.zeros((3, 3))
    for body_mass, inertia, offset in zip(masses, inertias, centres - centre, strict=True):
        total += inertia + body_mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))
    return mass, centre, total


def put_inertial(model: mujoco.MjModel, body: int, inertial: Float[np.ndarray, "11"]) -> None:
    """Set mass, centre, principal axes and inertia of a body, given by index, to the first entries of a load."""
    model.body_mass[body], model.body_ipos[body] = inertial[0], inertial[1:4]
    model.body_iquat[body], model.body_inertia[body] = inertial[4:8], inertial[8:]
    # Clear shortcuts that MuJoCo's compiler chose for the body without the payload.
    model.body_sameframe[body] = model.body_simple[body] = 0
    model.dof_simplenum[:] = 0
    mujoco.mj_setConst(model, mujoco.MjData(model))  # updates subtree masses, which set the origin of inertias


def rigid_inertia(model: mujoco.MjModel) -> Float[np.ndarray, "nv nv"]:
    """Return the joint-space inertia at the reference position [kg m^2 or kg], bit-identical for any armature."""
    return rigid_inertia_at(model, model.qpos0[None])[0]


def rigid_inertia_at(model: mujoco.MjModel, qpos: Float[np.ndarray, "places nv"]) -> Float[np.ndarray, "places nv nv"]:
    """Return the joint-space inertia without armature at these positions [kg m^2 or kg]."""
    model, data = copy.copy(model), mujoco.MjData(model)
    model.dof_armature[:] = 0  # a later subtraction would leave a rounding error
    # For simple bodies MuJoCo copies the compiled inertia, including armature.
    model.body_simple[:] = model.dof_simplenum[:] = 0
    inertia = np.zeros((len(qpos), model.nv, model.nv))
    for matrix, data.qpos[:] in zip(inertia, qpos, strict=True):
        # mj_forward would divide by the inertia, which may be 0 for a joint without armature.
        for stage in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_tendon, mujoco.mj_makeM):
            stage(model, data)
        mujoco.mj_fullM(model, data, matrix)
    return inertia
