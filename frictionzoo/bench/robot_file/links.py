"""Rigid links: sum of inertias, and correction to an inertia that MuJoCo accepts."""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

LEAST = 1e-14
"""Mass [kg] and inertia [kg m^2] of a moving link without any: MuJoCo requires some, and these have no effect."""
_UNPHYSICAL = 1e-9  # violation of the triangle inequality that counts as rounding, relative to the largest inertia


@dataclass(frozen=True)
class Link:
    """Rigid group of the file's bodies `fused`, in the frame of the first, whose name may be empty.

    Mass [kg], centre [m] and inertia about it in the body's axes [kg m^2] come from the file and may be unphysical.
    """

    name: str
    fused: tuple[str, ...]
    mass: float
    centre: Float[np.ndarray, "3"]
    inertia: Float[np.ndarray, "3 3"]


@dataclass(frozen=True)
class Place:
    """Position and orientation of a frame in another frame."""

    position: Float[np.ndarray, "3"]
    quaternion: Float[np.ndarray, "4"]

    def of(self, inner: "Place") -> "Place":
        """Return the place of a frame that has the place `inner` in this frame."""
        quaternion = np.zeros(4)
        mujoco.mju_mulQuat(quaternion, self.quaternion, inner.quaternion)
        return Place(self.point(inner.position), quaternion)

    def point(self, inside: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """Return the coordinates in the outer frame of a point given in this frame."""
        return self.position + rotation(self.quaternion) @ inside

    def turned(self, inertia: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
        """Return an inertia, given in this frame's axes, in the outer frame's axes."""
        axes = rotation(self.quaternion)
        return axes @ inertia @ axes.T


HERE = Place(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
"""Identity: place of a frame in itself."""


def rotation(quaternion: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation matrix of a quaternion."""
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, quaternion)
    return axes.reshape(3, 3)


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


def physical(
    mass: float, inertia: Float[np.ndarray, "3 3"]
) -> tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "4"], bool]:
    """Return mass [kg], principal inertia [kg m^2] and quaternion of a physical body, and whether they were corrected.

    The second moments of mass along the principal axes must be positive; others are raised to nearly 0.
    """
    principal, axes = np.linalg.eigh((inertia + inertia.T) / 2)
    axes[:, 0] *= np.linalg.det(axes)  # a rotation, not a reflection
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, axes.ravel())
    moments = principal.sum() / 2 - principal
    changed = bool(mass < 0 or moments.min() < -max(_UNPHYSICAL * abs(principal).max(), LEAST))
    first, second, third = np.maximum(moments, LEAST / 2)
    # With these sums, the largest is at most the sum of the others in floating point too.
    return max(mass, LEAST), np.array([second + third, first + third, first + second]), quaternion, changed
