"""Inverse dynamics of a compiled model, and its regressor: how the torque depends on the links' inertia, linearly.

The kinematics is MuJoCo's own; what it lacks is the derivative of its recursive Newton-Euler algorithm with respect to
mass, centre and inertia, which is written out here over all samples at once.
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
    """A copy of a compiled model with neither armature nor constraints: links, springs and dampers alone.

    Raises:
        BenchError: A joint is no hinge and no slide.
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
    """The torque that links, springs and dampers need for a motion, by MuJoCo's inverse dynamics [N m or N].

    Neither armature nor MuJoCo's constraints, its dry friction among them, have a part in it.

    Args:
        model: Compiled, of hinges and slides.
        qpos: Positions [rad or m].
        qvel: Velocities [rad/s or m/s].
        qacc: Accelerations [rad/s^2 or m/s^2].

    Raises:
        BenchError: A joint is no hinge and no slide.
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
    """How much torque a motion needs for each unit of each of the ten parameters of `inertia`, of chosen bodies.

    With w and e the angular velocity and acceleration of a body and a the acceleration of its origin less gravity, all
    in its own frame, the force and the torque about the origin that it needs are

        f = m a + e x mc + w x (w x mc),   n = mc x a + I e + w x I w

    Each joint between it and the world bears the part along its axis. What bodies need adds up; with all bodies of a
    model, times their parameters, it is `inverse_torque` but for springs, dampers and the like.

    Source: C. Atkeson, C. An, J. Hollerbach, "Estimation of inertial parameters of manipulator loads and links", 1986.

    Args:
        model: Compiled, of hinges and slides.
        bodies: Their indices.
        qpos: Positions [rad or m].
        qvel: Velocities [rad/s or m/s].
        qacc: Accelerations [rad/s^2 or m/s^2].

    Raises:
        BenchError: A joint is no hinge and no slide, or MuJoCo compensates a body's gravity, which depends on its mass.
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
    """How bodies move, in their own frames.

    Returns:
        Joint axes (turn, then shift of the origin), of shape (time, bodies, nv, 6); angular velocity, angular
        acceleration, and acceleration of the origin less gravity, (time, bodies, 3).
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
    # MuJoCo's spatial vectors are about the centre of mass of the whole tree, along the world's axes.
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
    """Spatial vectors (time, bodies, n, 6) about the tree's centre, as ones about bodies' origins, in their frames."""
    turn, shift = spatial[..., :3], spatial[..., 3:]
    shift = shift + np.cross(turn, offset[:, :, None])
    inward = frame.swapaxes(-1, -2)
    return np.concatenate([turn @ inward, shift @ inward], axis=-1)


def _moved_by(model: mujoco.MjModel) -> Bool[np.ndarray, "bodies nv"]:
    """Whether each joint is between each body and the world."""
    moved = np.zeros((model.nbody, model.nv), bool)
    for body in range(1, model.nbody):
        moved[body] = moved[model.body_parentid[body]]
        first = model.body_dofadr[body]
        moved[body, first : first + model.body_dofnum[body]] |= first >= 0
    return moved


def _cross(vector: np.ndarray) -> np.ndarray:
    """Matrices of the cross product with vectors (..., 3) from the left."""
    x, y, z = np.moveaxis(vector, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vector.shape, 3)


def _times_six(vector: np.ndarray) -> np.ndarray:
    """Matrices that give I v from Ixx, Iyy, Izz, Ixy, Ixz, Iyz, for vectors v (..., 3)."""
    x, y, z = np.moveaxis(vector, -1, 0)
    zero = np.zeros_like(x)
    rows = [x, zero, zero, y, z, zero, zero, y, zero, x, zero, z, zero, zero, z, zero, x, y]
    return np.stack(rows, axis=-1).reshape(*vector.shape[:-1], 3, 6)
