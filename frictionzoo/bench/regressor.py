"""Inverse dynamics of a compiled MuJoCo model, and its regressor on inertial parameters, vectorised over samples."""

import copy
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from frictionzoo.core.errors import BenchError

_OFF = (
    mujoco.mjtDisableBit.mjDSBL_CONSTRAINT  # friction, limits, contacts and equalities
    | mujoco.mjtDisableBit.mjDSBL_CONTACT
    | mujoco.mjtDisableBit.mjDSBL_ACTUATION
    | mujoco.mjtDisableBit.mjDSBL_SENSOR
)


def without_drives(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a copy of a compiled model without armature, constraints, contacts and actuation.

    Raises:
        BenchError: A joint is neither a hinge nor a slide.
    """
    simple = np.isin(model.jnt_type, [int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)])
    for joint in np.flatnonzero(~simple):
        raise BenchError(
            f"joint {model.joint(joint).name or joint}: a free or a ball joint, expected hinges and slides; weld its "
            "body to the world"
        )
    bare = copy.copy(model)
    bare.dof_armature[:] = 0
    bare.opt.disableflags |= int(_OFF)
    bare.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_INVDISCRETE)
    return bare


def inverse_torque(
    model: mujoco.MjModel,
    qpos: Float[np.ndarray, "time nv"],
    qvel: Float[np.ndarray, "time nv"],
    qacc: Float[np.ndarray, "time nv"],
) -> Float[np.ndarray, "time nv"]:
    """Return the torque of a motion with links, springs and dampers, without armature and constraints [N m or N].

    Raises:
        BenchError: A joint is neither a hinge nor a slide.
    """
    model = without_drives(model)
    data, torque = mujoco.MjData(model), np.empty_like(qpos)
    for row, data.qpos[:], data.qvel[:], data.qacc[:] in zip(torque, qpos, qvel, qacc, strict=True):
        mujoco.mj_inverse(model, data)
        row[:] = data.qfrc_inverse
    return torque


def inertial_regressor(
    model: mujoco.MjModel,
    bodies: Sequence[int],
    qpos: Float[np.ndarray, "time nv"],
    qvel: Float[np.ndarray, "time nv"],
    qacc: Float[np.ndarray, "time nv"],
) -> Float[np.ndarray, "time nv bodies 10"]:
    """Return the derivative of a motion's torque with respect to the ten inertial parameters of bodies, given by index.

    With the angular velocity w and acceleration e of a body and the acceleration a of its origin minus gravity, all in
    the body frame, its force and its torque about the origin are

        f = m a + e x mc + w x (w x mc),   n = mc x a + I e + w x I w

    Each joint between the body and the world takes the component about or along its axis. The regressor of all bodies
    times their parameters equals `inverse_torque` without springs, dampers and other passive forces.

    Source: C. Atkeson, C. An, J. Hollerbach, "Estimation of inertial parameters of manipulator loads and links", 1986.

    Raises:
        BenchError: A joint is neither a hinge nor a slide, or a body has gravity compensation, which depends on mass.
    """
    model, chosen = without_drives(model), np.asarray(bodies, int)
    for body in chosen[model.body_gravcomp[chosen] != 0]:
        raise BenchError(
            f"body {model.body(body).name}: gravcomp={model.body_gravcomp[body]:g}, expected 0 of a body whose inertia "
            "is identified; take it out of the MJCF"
        )
    axes, w, e, a = _motions(model, chosen, qpos, qvel, qacc)
    zero = np.zeros((*w.shape[:-1], 3, 1))
    inertia = _times_six(e) + _cross(w) @ _times_six(w)
    torque = np.concatenate([zero, -_cross(a), inertia], axis=-1)
    first_moment = _cross(e) + _cross(w) @ _cross(w)
    force = np.concatenate([a[..., None], first_moment, np.zeros((*w.shape[:-1], 3, 6))], axis=-1)
    regressor = axes @ np.concatenate([torque, force], axis=-2)
    return np.ascontiguousarray(regressor.swapaxes(1, 2))


def _motions(
    model: mujoco.MjModel, bodies: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, qacc: np.ndarray
) -> tuple[Any, Any, Any, Any]:
    """Return joint axes (time, bodies, nv, 6), rotation first; w, e, a (time, bodies, 3) of `inertial_regressor`."""
    data, samples = mujoco.MjData(model), len(qpos)
    position, rotation = np.empty((samples, model.nbody, 3)), np.empty((samples, model.nbody, 9))
    cdof, cdof_dot = np.empty((2, samples, model.nv, 6))
    centre = np.empty((samples, model.nbody, 3))
    for sample, (data.qpos[:], data.qvel[:]) in enumerate(zip(qpos, qvel, strict=True)):
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        position[sample], rotation[sample], centre[sample] = data.xpos, data.xmat, data.subtree_com
        cdof[sample], cdof_dot[sample] = data.cdof, data.cdof_dot
    moved_by = _moved_by(model)[bodies]
    frame = rotation[:, bodies].reshape(samples, len(bodies), 3, 3).swapaxes(-1, -2)
    # MuJoCo's spatial vectors refer to the centre of mass of the kinematic tree and to the world's axes.
    offset = (position - centre[:, model.body_rootid])[:, bodies]
    axes = _seen_from(frame, offset, np.where(moved_by[:, :, None], cdof[:, None], 0))
    velocity = np.einsum("tbvk,tv->tbk", axes, qvel)
    acceleration = np.einsum("tbvk,tv->tbk", axes, qacc)
    drift = np.einsum("bv,tvk,tv->tbk", moved_by, cdof_dot, qvel)
    acceleration += _seen_from(frame, offset, drift[:, :, None])[:, :, 0]
    w, v, e = velocity[..., :3], velocity[..., 3:], acceleration[..., :3]
    gravity = np.array(model.opt.gravity) * (not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    a = acceleration[..., 3:] + np.cross(w, v) - frame @ gravity
    return axes, w, e, a


def _seen_from(frame: np.ndarray, offset: np.ndarray, spatial: np.ndarray) -> np.ndarray:
    """Transform spatial vectors (time, bodies, n, 6) from the tree's centre to body origins and body frames."""
    angular, linear = spatial[..., :3], spatial[..., 3:]
    linear = linear + np.cross(angular, offset[:, :, None])
    to_body = frame.swapaxes(-1, -2)
    return np.concatenate([angular @ to_body, linear @ to_body], axis=-1)


def _moved_by(model: mujoco.MjModel) -> Bool[np.ndarray, "bodies nv"]:
    moved = np.zeros((model.nbody, model.nv), bool)
    for body in range(1, model.nbody):
        moved[body] = moved[model.body_parentid[body]]
        start = model.body_dofadr[body]
        moved[body, start : start + model.body_dofnum[body]] |= start >= 0
    return moved


def _cross(vector: np.ndarray) -> np.ndarray:
    """Return the matrices of the cross product with vectors (..., 3) from the left."""
    x, y, z = np.moveaxis(vector, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vector.shape, 3)


def _times_six(vector: np.ndarray) -> np.ndarray:
    """Return the matrices that map Ixx, Iyy, Izz, Ixy, Ixz, Iyz to I v, for vectors v (..., 3)."""
    x, y, z = np.moveaxis(vector, -1, 0)
    zero = np.zeros_like(x)
    rows = [x, zero, zero, y, z, zero, zero, y, zero, x, zero, z, zero, zero, z, zero, x, y]
    return np.stack(rows, axis=-1).reshape(*vector.shape[:-1], 3, 6)
