"""Inverse dynamics of a compiled MuJoCo model, and the regressor of its torque on the links' inertial parameters.

The kinematics comes from MuJoCo. This module adds the derivative of the recursive Newton-Euler algorithm with respect
to mass, centre and inertia, vectorised over samples.
"""

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
    """Return the torque of a motion with links, springs and dampers, by MuJoCo's inverse dynamics [N m or N].

    It excludes armature and MuJoCo's constraints, such as dry friction.

    Args:
        model: Compiled model with hinges and slides.
        qpos: Positions [rad or m].
        qvel: Velocities [rad/s or m/s].
        qacc: Accelerations [rad/s^2 or m/s^2].

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
    """Return the derivative of a motion's torque with respect to the ten inertial parameters of selected bodies.

    With the angular velocity w and acceleration e of a body and the acceleration a of its origin minus gravity, all in
    the body frame, its force and its torque about the origin are

        f = m a + e x mc + w x (w x mc),   n = mc x a + I e + w x I w

    Each joint between the body and the world takes the component about or along its axis. The regressor of all bodies
    times their parameters equals `inverse_torque` without springs, dampers and other passive forces.

    Source: C. Atkeson, C. An, J. Hollerbach, "Estimation of inertial parameters of manipulator loads and links", 1986.

    Args:
        model: Compiled model with hinges and slides.
        bodies: Indices of the bodies.
        qpos: Positions [rad or m].
        qvel: Velocities [rad/s or m/s].
        qacc: Accelerations [rad/s^2 or m/s^2].

    Raises:
        BenchError: A joint is neither a hinge nor a slide, or a body has gravity compensation, which depends on mass.
    """
    model, chosen = without_drives(model), np.asarray(bodies, int)
    for body in chosen[model.body_gravcomp[chosen] != 0]:
        raise BenchError(
            f"body {model.body(body).name}: gravcomp={model.body_gravcomp[body]:g}, expected 0 of a body whose inertia "
            "is identified; take it out of the MJCF"
        )
    axes, spin, turn, lift = _motions(model, chosen, qpos, qvel, qacc)
    zero = np.zeros((*spin.shape[:-1], 3, 1))
    inertia = _times_six(turn) + _cross(spin) @ _times_six(spin)
    torque = np.concatenate([zero, -_cross(lift), inertia], axis=-1)
    first = _cross(turn) + _cross(spin) @ _cross(spin)
    force = np.concatenate([lift[..., None], first, np.zeros((*spin.shape[:-1], 3, 6))], axis=-1)
    needed = axes @ np.concatenate([torque, force], axis=-2)
    return np.ascontiguousarray(needed.swapaxes(1, 2))


def _motions(
    model: mujoco.MjModel, bodies: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, qacc: np.ndarray
) -> tuple[Any, Any, Any, Any]:
    """Return the motion of bodies in their frames.

    Returns:
        Joint axes (rotation, then translation of the origin), of shape (time, bodies, nv, 6); angular velocity, angular
        acceleration, and acceleration of the origin minus gravity, each of shape (time, bodies, 3).
    """
    data, samples = mujoco.MjData(model), len(qpos)
    place, rotation = np.empty((samples, model.nbody, 3)), np.empty((samples, model.nbody, 9))
    cdof, cdof_dot = np.empty((2, samples, model.nv, 6))
    centre = np.empty((samples, model.nbody, 3))
    for at, (data.qpos[:], data.qvel[:]) in enumerate(zip(qpos, qvel, strict=True)):
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        place[at], rotation[at], centre[at] = data.xpos, data.xmat, data.subtree_com
        cdof[at], cdof_dot[at] = data.cdof, data.cdof_dot
    moved = _moved_by(model)[bodies]
    frame = rotation[:, bodies].reshape(samples, len(bodies), 3, 3).swapaxes(-1, -2)
    # MuJoCo's spatial vectors refer to the centre of mass of the kinematic tree and to the world's axes.
    offset = (place - centre[:, model.body_rootid])[:, bodies]
    axes = _seen_from(frame, offset, np.where(moved[:, :, None], cdof[:, None], 0))
    velocity = np.einsum("tbvk,tv->tbk", axes, qvel)
    acceleration = np.einsum("tbvk,tv->tbk", axes, qacc)
    drift = np.einsum("bv,tvk,tv->tbk", moved, cdof_dot, qvel)
    acceleration += _seen_from(frame, offset, drift[:, :, None])[:, :, 0]
    spin, shift, turn = velocity[..., :3], velocity[..., 3:], acceleration[..., :3]
    weightless = np.array(model.opt.gravity) * (not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    lift = acceleration[..., 3:] + np.cross(spin, shift) - frame @ weightless
    return axes, spin, turn, lift


def _seen_from(frame: np.ndarray, offset: np.ndarray, spatial: np.ndarray) -> np.ndarray:
    """Return spatial vectors (time, bodies, n, 6), given about the tree's centre, about body origins in body frames."""
    turn, shift = spatial[..., :3], spatial[..., 3:]
    shift = shift + np.cross(turn, offset[:, :, None])
    inward = frame.swapaxes(-1, -2)
    return np.concatenate([turn @ inward, shift @ inward], axis=-1)


def _moved_by(model: mujoco.MjModel) -> Bool[np.ndarray, "bodies nv"]:
    """Return for each body which joints are between it and the world."""
    moved = np.zeros((model.nbody, model.nv), bool)
    for body in range(1, model.nbody):
        moved[body] = moved[model.body_parentid[body]]
        first = model.body_dofadr[body]
        moved[body, first : first + model.body_dofnum[body]] |= first >= 0
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
