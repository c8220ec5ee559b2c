"""MuJoCo's compiled model of a bench: its contacts, its inertia, and the payload that a body of it carries."""

import copy

import mujoco
import numpy as np
from jaxtyping import Float

from frictionzoo.core.log import Payload

NO_FRICTION_CONSTRAINT = mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
"""Flags of an MJCF that leave no friction constraint."""
NO_PAYLOAD = Payload(0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
INERTIAL = 11
"""Numbers of a load that describe the body; the others are the joint-space inertia."""


def can_collide(model: mujoco.MjModel) -> bool:
    """Whether there are geoms between which MuJoCo looks for contacts.

    Not between those of one body or of bodies welded together, nor, unless that is disabled, between a moving body and
    its parent. Pairs that the MJCF excludes count as if it did not.

    Source: MuJoCo documentation, "Computation", "Collision detection", selection.
    """
    wanted = (model.geom_contype[:, None] & model.geom_conaffinity[None, :]) != 0
    body = model.body_weldid[model.geom_bodyid]
    parent = model.body_weldid[model.body_parentid[body]]
    child = (parent[:, None] == body[None, :]) & (body[None, :] != 0)  # of one that stands still, all may touch it
    filtered = (child | child.T) & (not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT)
    return bool(((wanted | wanted.T) & (body[:, None] != body[None, :]) & ~filtered).any())


def combine(model: mujoco.MjModel, body: int, payload: Payload) -> Float[np.ndarray, "load"]:
    """What a payload makes of the body of this index, as `Bench.load` gives it; the model is changed."""
    inertial = _combine(model, body, payload)
    put_inertial(model, body, inertial)
    return np.concatenate([inertial, rigid_inertia(model).ravel()])


def _combine(model: mujoco.MjModel, body: int, payload: Payload) -> Float[np.ndarray, "11"]:
    """Mass, centre, principal axes and inertia of a body and its payload, by the parallel-axis theorem."""
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, model.body_iquat[body])
    axes = axes.reshape(3, 3)
    masses = np.array([model.body_mass[body], payload.mass])
    centres = np.stack([model.body_ipos[body], payload.position])
    inertias = [axes * model.body_inertia[body] @ axes.T, np.diag(payload.inertia)]
    # A frame without mass may carry the payload, and carry none.
    centre = masses @ centres / masses.sum() if masses.sum() > 0 else centres[0]
    total = np.zeros((3, 3))
    for mass, inertia, offset in zip(masses, inertias, centres - centre, strict=True):
        total += inertia + mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))
    principal, frame = np.linalg.eigh(total)
    frame[:, 0] *= np.linalg.det(frame)  # a rotation, not a reflection
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, frame.ravel())
    return np.concatenate([[masses.sum()], centre, quaternion, principal])


def put_inertial(model: mujoco.MjModel, body: int, inertial: Float[np.ndarray, "11"]) -> None:
    """Let the body of this index have another mass, centre, principal axes and inertia: first entries of a load."""
    model.body_mass[body], model.body_ipos[body] = inertial[0], inertial[1:4]
    model.body_iquat[body], model.body_inertia[body] = inertial[4:8], inertial[8:]
    # Shortcuts that MuJoCo's compiler allowed itself for the body without the payload.
    model.body_sameframe[body] = model.body_simple[body] = 0
    model.dof_simplenum[:] = 0
    mujoco.mj_setConst(model, mujoco.MjData(model))  # the mass of subtrees, where the origin of inertias lies


def rigid_inertia(model: mujoco.MjModel) -> Float[np.ndarray, "nv nv"]:
    """Joint-space inertia at the reference position without the armature [kg m^2 or kg], the same bits for any."""
    return rigid_inertia_at(model, model.qpos0[None])[0]


def rigid_inertia_at(model: mujoco.MjModel, qpos: Float[np.ndarray, "places nv"]) -> Float[np.ndarray, "places nv nv"]:
    """The same at these positions."""
    model, data = copy.copy(model), mujoco.MjData(model)
    model.dof_armature[:] = 0  # taken off afterwards, its rounding would stay
    model.body_simple[:] = model.dof_simplenum[:] = (
        0  # of simple bodies MuJoCo copies what it compiled, armature and all
    )
    inertia = np.zeros((len(qpos), model.nv, model.nv))
    for matrix, data.qpos[:] in zip(inertia, qpos, strict=True):
        _write_inertia(model, data, matrix)
    return inertia


def _write_inertia(model: mujoco.MjModel, data: mujoco.MjData, inertia: Float[np.ndarray, "nv nv"]) -> None:
    # Not mj_forward, which divides by the inertia: without its armature a joint may have none.
    for stage in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_tendon, mujoco.mj_makeM):
        stage(model, data)
    mujoco.mj_fullM(model, data, inertia)
