"""Rigid links: how their inertia adds up, and what of it MuJoCo takes."""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

LEAST = 1e-14
"""Mass [kg] and inertia [kg m^2] of a moving link that has none: MuJoCo wants some, and this one moves nothing."""
_UNPHYSICAL = 1e-9  # share of the largest principal inertia by which it may be above the sum of the others: rounding


@dataclass(frozen=True)
class Link:
    """What moves as one body.

    Attributes:
        name: Of the body, as in the file; empty where it has none.
        fused: Names of all bodies of the file that it is made of.
        mass: In kg.
        centre: Centre of mass in the body's frame [m].
        inertia: About the centre of mass, along the body's axes [kg m^2], as the file has it, physical or not.
    """

    name: str
    fused: tuple[str, ...]
    mass: float
    centre: Float[np.ndarray, "3"]
    inertia: Float[np.ndarray, "3 3"]


@dataclass(frozen=True)
class Place:
    """Where a frame is in another one."""

    position: Float[np.ndarray, "3"]
    quaternion: Float[np.ndarray, "4"]

    def of(self, inner: "Place") -> "Place":
        """Where a frame is that has this place in here."""
        quaternion = np.zeros(4)
        mujoco.mju_mulQuat(quaternion, self.quaternion, inner.quaternion)
        return Place(self.point(inner.position), quaternion)

    def point(self, inside: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """Where a point of the frame is."""
        return self.position + rotation(self.quaternion) @ inside

    def turned(self, inertia: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
        """An inertia along this frame's axes, along the other's."""
        axes = rotation(self.quaternion)
        return axes @ inertia @ axes.T


HERE = Place(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
"""The frame itself."""


def rotation(quaternion: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    """The matrix of a quaternion."""
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, quaternion)
    return axes.reshape(3, 3)


def add_up(
    masses: Float[np.ndarray, "n"], centres: Float[np.ndarray, "n 3"], inertias: Float[np.ndarray, "n 3 3"]
) -> tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Mass, centre of mass and inertia about it of several together, all along the same axes."""
    mass = float(masses.sum())
    centre = masses @ centres / mass if mass > 0 else np.zeros(3)
    total = np.zeros((3, 3))
    for each, inertia, offset in zip(masses, inertias, centres - centre, strict=True):
        total += inertia + each * (offset @ offset * np.eye(3) - np.outer(offset, offset))
    return mass, centre, total


def physical(
    mass: float, inertia: Float[np.ndarray, "3 3"]
) -> tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "4"], bool]:
    """Mass, principal inertia and its axes, as near as a body of matter can have them.

    The second moments of mass along the principal axes are what has to be positive; those that are not become nearly 0.

    Returns:
        Mass [kg], principal inertia [kg m^2], quaternion of their axes; and whether that is a change.
    """
    principal, axes = np.linalg.eigh((inertia + inertia.T) / 2)
    axes[:, 0] *= np.linalg.det(axes)  # a rotation, not a reflection
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, axes.ravel())
    moments = principal.sum() / 2 - principal
    changed = bool(mass < 0 or moments.min() < -max(_UNPHYSICAL * abs(principal).max(), LEAST))
    first, second, third = np.maximum(moments, LEAST / 2)
    # Added in this way, the largest is at most the sum of the others in floating point too.
    return max(mass, LEAST), np.array([second + third, first + third, first + second]), quaternion, changed
