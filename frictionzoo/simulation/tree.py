"""Dynamics of a tree of hinges and slides in link frames, where constants stay constant.

MJX computes in the world frame, in which almost nothing is constant. In link frames most geometry folds away: a leg's
dynamics take a quarter of the operations, an arm's a third. Each link keeps only the mass properties that its joint can
feel; those that the joint's rotation does not change move to the parent link.

Source: R. Featherstone, "Rigid Body Dynamics Algorithms", 2008 (recursive Newton-Euler, composite rigid bodies); W.
Khalil, J.-F. Kleinfinger, "Minimum operations and minimum parameters of the dynamic models of tree structure robots",
1987.
"""

from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from frictionzoo.simulation.linear import Rows

_TRIANGLE = np.tril_indices(3)
_NOTHING = 1e-15  # rounding, as a share of an array's largest entry: the accuracy of quaternion products


FIELDS = ("nbody", "body_parentid", "body_pos", "body_quat", "body_jntadr", "body_jntnum", "jnt_pos", "jnt_type")
FIELDS += ("jnt_axis", "body_mass", "body_ipos", "body_iquat", "body_inertia")
"""Fields of a MuJoCo model that `links_of` needs."""


class TreeLink(NamedTuple):
    """Link of one joint, in a frame that moves with it and has its origin on the joint's axis.

    Attributes:
        parent: Index of the parent link; -1 for the fixed world.
        axis: Joint axis, a unit vector.
        turn: Rotation from this frame to the parent's at the reference position, of shape (3, 3).
        place: Origin in the parent's frame at the reference position [m].
        mass: Mass [kg].
        moment: First moment of mass [kg m].
        inertia: Inertia about the origin [kg m^2], of shape (3, 3).
    """

    parent: int
    slides: bool
    axis: Any
    turn: Any
    place: Any
    mass: Any
    moment: Any
    inertia: Any


class Pose(NamedTuple):
    """Pose of a link in its parent's frame: rotation, of shape (3, 3), and origin [m]."""

    turn: Any
    place: Any


def links_of(xp: ModuleType, model: Any) -> list[TreeLink]:
    """Return the links of a model of hinges and slides, one a joint, in the joints' order.

    `model` is MuJoCo's compiled model, or an object with its `FIELDS`; `xp` is `jax.numpy` if inertias of bodies are
    traced.
    """
    links: list[TreeLink] = []
    frames: list[tuple[int, Pose]] = []  # of each body: the link that carries it, and its pose in that link
    for body in range(model.nbody):
        carrier, pose = frames[model.body_parentid[body]] if body else (-1, Pose(np.eye(3), np.zeros(3)))
        pose = Pose(pose.turn @ _rotation(np, model.body_quat[body]), pose.place + pose.turn @ model.body_pos[body])
        first_joint = int(model.body_jntadr[body])
        for joint in range(first_joint, first_joint + int(model.body_jntnum[body])):
            anchor, slides = model.jnt_pos[joint], bool(model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE)
            origin = pose.turn, pose.place + pose.turn @ anchor
            links.append(TreeLink(carrier, slides, model.jnt_axis[joint], *origin, 0.0, np.zeros(3), np.zeros((3, 3))))
            carrier, pose = len(links) - 1, Pose(np.eye(3), -anchor)
        frames.append((carrier, pose))
        if carrier >= 0:
            centre = pose.place + pose.turn @ model.body_ipos[body]
            axes = pose.turn @ _rotation(xp, model.body_iquat[body])
            about_centre = (axes * model.body_inertia[body]) @ axes.T
            mass = model.body_mass[body]
            moment, inertia = mass * centre, about_centre + mass * _spread(xp, centre, centre)
            links[carrier] = _added(links[carrier], mass, moment, inertia)
    return links


def regroup(xp: ModuleType, links: Sequence[TreeLink]) -> list[TreeLink]:
    """Return links with the same dynamics and fewer numbers.

    A hinge's rotation does not move mass, moments along its axis, or a thin rod's inertia on the axis. These go to the
    parent link: the mass becomes 0, and the inertia loses that rod.
    """
    links = list(links)
    for index in reversed(range(len(links))):
        link = links[index]
        if link.slides:
            continue
        across = np.eye(3) - np.outer(link.axis, link.axis)
        side = across[np.argmin(np.abs(link.axis))]
        rod = (side @ link.inertia @ side) / (side @ side) * across
        along = link.axis * (link.axis @ link.moment)
        links[index] = link._replace(mass=0.0, moment=link.moment - along, inertia=link.inertia - rod)
        if link.parent >= 0:
            fixed = Pose(link.turn, link.place)
            links[link.parent] = _carrying(xp, links[link.parent], fixed, link.mass, along, rod)
    return links


def without_rounding(links: Sequence[TreeLink]) -> list[TreeLink]:
    """Set entries that are only rounding to 0."""

    def clean(name: str, value: Any) -> Any:
        if name in ("parent", "slides"):
            return value
        largest = max(float(np.max(np.abs(getattr(link, name)))) for link in links)
        return np.where(np.abs(value) > _NOTHING * largest, value, 0.0)

    return [TreeLink(*(clean(name, value) for name, value in link._asdict().items())) for link in links]


def flatten(links: Sequence[TreeLink]) -> Float[np.ndarray, "numbers"]:
    """Return all numbers of links in one array; symmetric inertias by their lower triangle."""
    return np.concatenate([np.ravel(part) for link in links for part in (*link[2:-1], link.inertia[_TRIANGLE])])


def unflatten(links: Sequence[TreeLink], changes: Mapping[int, Any]) -> list[TreeLink]:
    """Replace some numbers of `flatten`, perhaps by traced ones; the rest stay constants."""
    entries: list[Any] = list(flatten(links))
    for place, number in changes.items():
        entries[place] = number
    changed, remaining = [], iter(entries)
    for link in links:
        axis, turn, place, mass, moment = (_array([next(remaining) for _ in range(n)]) for n in (3, 9, 3, 1, 3))
        triangle = [next(remaining) for _ in range(6)]
        square = _array([triangle[max(i, j) * (max(i, j) + 1) // 2 + min(i, j)] for i in range(3) for j in range(3)])
        changed.append(TreeLink(*link[:2], axis, turn.reshape(3, 3), place, mass[0], moment, square.reshape(3, 3)))
    return changed


def _array(entries: Sequence[Any]) -> Any:
    """Make an array: numpy's for numbers, JAX's if any is traced."""
    numeric = all(isinstance(entry, float) for entry in entries)
    return np.array(entries) if numeric else jnp.stack([jnp.asarray(entry) for entry in entries])


def poses(links: Sequence[TreeLink], displacement: Float[Array, "nv"]) -> list[Pose]:
    """Return the links' poses for joint displacements from the reference [rad or m]."""
    return [
        Pose(link.turn, link.place + link.turn @ (link.axis * moved))
        if link.slides
        else Pose(link.turn @ _about(link.axis, moved), link.place)
        for link, moved in zip(links, displacement, strict=True)
    ]


def bias_torque(
    links: Sequence[TreeLink], at: Sequence[Pose], qvel: Float[Array, "nv"], gravity: Float[np.ndarray, "3"]
) -> Float[Array, "nv"]:
    """Return MuJoCo's `qfrc_bias`: torque of gravity and velocities at zero acceleration [N m or N]."""
    motions: list[tuple[Any, Any, Any]] = []  # angular velocity, its derivative, acceleration of the origin
    wrenches: list[tuple[Any, Any]] = []
    for link, pose, speed in zip(links, at, qvel, strict=True):
        spin, turning, rising = motions[link.parent] if link.parent >= 0 else (np.zeros(3), np.zeros(3), -gravity)
        rising = rising + jnp.cross(turning, pose.place) + jnp.cross(spin, jnp.cross(spin, pose.place))
        spin, turning, rising = (pose.turn.T @ vector for vector in (spin, turning, rising))
        joint_velocity = link.axis * speed
        if link.slides:
            rising = rising + 2 * jnp.cross(spin, joint_velocity)
        else:
            spin, turning = spin + joint_velocity, turning + jnp.cross(spin, joint_velocity)
        motions.append((spin, turning, rising))
        whirled = jnp.cross(turning, link.moment) + jnp.cross(spin, jnp.cross(spin, link.moment))
        torque = link.inertia @ turning + jnp.cross(spin, link.inertia @ spin) + jnp.cross(link.moment, rising)
        wrenches.append((link.mass * rising + whirled, torque))
    torques: list[Array] = []
    for link, pose in reversed([*zip(links, at, strict=True)]):
        force, torque = wrenches.pop()
        torques.append(link.axis @ (force if link.slides else torque))
        if link.parent >= 0:
            carried_force, carried_torque = _carry(pose, force, torque)
            force, torque = wrenches[link.parent]
            wrenches[link.parent] = force + carried_force, torque + carried_torque
    return jnp.stack(torques[::-1])


def joint_inertia(links: Sequence[TreeLink], at: Sequence[Pose]) -> Rows:
    """Return the joint-space inertia without the armature [kg m^2 or kg]."""
    bodies = list(links)
    entries: dict[tuple[int, int], Any] = {}
    for joint in reversed(range(len(links))):
        link, pose = bodies[joint], at[joint]
        if link.parent >= 0:
            parent = bodies[link.parent]
            bodies[link.parent] = _carrying(jnp, parent, pose, link.mass, link.moment, link.inertia)
        if link.slides:
            force, torque = link.mass * link.axis, jnp.cross(link.moment, link.axis)
        else:
            force, torque = jnp.cross(link.axis, link.moment), link.inertia @ link.axis
        other = joint
        while other >= 0:
            entries[joint, other] = links[other].axis @ (force if links[other].slides else torque)
            force, torque = _carry(at[other], force, torque)
            other = links[other].parent
    return tuple(tuple(entries.get((i, j), np.zeros(())) for j in range(i + 1)) for i in range(len(links)))


def _added(link: TreeLink, mass: Any, moment: Any, inertia: Any) -> TreeLink:
    return link._replace(mass=link.mass + mass, moment=link.moment + moment, inertia=link.inertia + inertia)


def _carrying(xp: ModuleType, parent: TreeLink, pose: Pose, mass: Any, moment: Any, inertia: Any) -> TreeLink:
    """Add mass, moment and inertia of a link to its parent, moved to the parent's origin and axes."""
    turned = pose.turn @ moment
    mixed = _spread(xp, pose.place, turned)
    about = pose.turn @ inertia @ pose.turn.T + mixed + mixed.T + mass * _spread(xp, pose.place, pose.place)
    return _added(parent, mass, turned + mass * pose.place, about)


def _carry(pose: Pose, force: Any, torque: Any) -> tuple[Any, Any]:
    """Move a force and a torque from a link's origin to the parent's."""
    force = pose.turn @ force
    return force, pose.turn @ torque + jnp.cross(pose.place, force)


def _spread(xp: ModuleType, one: Any, other: Any) -> Any:
    """Return the change of inertia by a shift: one . other 1 - other one', of shape (3, 3)."""
    return (one @ other) * np.eye(3) - xp.outer(other, one)


def _about(axis: Any, angle: Array) -> Float[Array, "3 3"]:
    """Return the rotation about an axis by an angle, by Rodrigues' formula."""
    x, y, z = axis
    outer, cross = jnp.outer(axis, axis), _square(jnp, [0.0, -z, y, z, 0.0, -x, -y, x, 0.0])
    return outer + jnp.cos(angle) * (np.eye(3) - outer) + jnp.sin(angle) * cross


def _rotation(xp: ModuleType, quaternion: Any) -> Any:
    w, x, y, z = quaternion
    first = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    second = [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    return _square(xp, [*first, *second, 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])


def _square(xp: ModuleType, entries: Sequence[Any]) -> Any:
    return xp.stack([xp.asarray(entry) for entry in entries]).reshape(3, 3)
