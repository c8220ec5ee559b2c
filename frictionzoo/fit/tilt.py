"""Direction of gravity in the frame of a tilted base, identified together with the drives' parameters."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from frictionzoo.bench import Bench
from frictionzoo.core.errors import ConfigError
from frictionzoo.fit.motion import Filtering, Motion, Recordings
from frictionzoo.fit.space import Box, Space
from frictionzoo.fit.torque_balance import BalanceSolution
from frictionzoo.fit.torque_equation import TorqueEquation

STEEPEST = 0.2
"""Largest share of gravity along each of the two directions perpendicular to the model file's gravity."""


@dataclass(frozen=True)
class Tilt:
    """Gravity in the frame of a tilted base.

    Attributes:
        maker: Gravity in the model file [m/s^2].
        across: Two unit vectors perpendicular to it.
        leaning: Share of gravity along each of them.
        errors: Standard error of each share.
    """

    maker: Float[np.ndarray, "3"]
    across: Float[np.ndarray, "2 3"]
    leaning: Float[np.ndarray, "2"]
    errors: Float[np.ndarray, "2"]

    @classmethod
    def upright(cls, gravity: Float[np.ndarray, "3"]) -> "Tilt":
        """Return a tilt of 0, with infinite standard errors.

        Raises:
            ConfigError: The bench has no gravity.
        """
        if not gravity.any():
            raise ConfigError("fit.tilt=true: there is no gravity on this bench; set fit.tilt=false")
        down = gravity / np.linalg.norm(gravity)
        level = np.eye(3)[np.sort(np.argsort(np.abs(down), kind="stable")[:2])]
        first = level[0] - (level[0] @ down) * down
        second = level[1] - (level[1] @ down) * down
        second -= (second @ first) * first / (first @ first)
        across = np.stack([first / np.linalg.norm(first), second / np.linalg.norm(second)])
        return cls(gravity, across, np.zeros(2), np.full(2, np.inf))

    @property
    def gravity(self) -> Float[np.ndarray, "3"]:
        """Gravity in the frame of the base, with the model file's magnitude [m/s^2]."""
        upright = np.sqrt(1 - self.leaning @ self.leaning)
        return upright * self.maker + np.linalg.norm(self.maker) * self.leaning @ self.across

    @property
    def angle(self) -> float:
        """Angle between identified gravity and the model file's [rad]."""
        return float(np.arcsin(np.linalg.norm(self.leaning)))

    def say(self) -> str:
        """Return the angle with its standard error, and gravity, in words."""
        numbers = ", ".join(f"{number:.4g}" for number in self.gravity)
        error = np.degrees(self.errors.max())
        return (
            f"{np.degrees(self.angle):.3g} +- {error:.1g} degrees from its direction in the model file, ({numbers}) "
            "m/s^2"
        )


class Tilted(TorqueEquation):
    """Torque equation with the leaning of a `Tilt` as two more coordinates, linearised at the bench's tilt.

    Args:
        at: The tilt at which it is linearised, which the bench of `recordings` has.
        bench: The bench with the links' weights.
    """

    def __init__(
        self, space: Space, recordings: Recordings, filtering: Filtering, held: bool, at: Tilt, bench: Bench
    ) -> None:
        super().__init__(space, recordings, filtering, held)
        strength, upright = np.linalg.norm(at.maker), np.sqrt(1 - at.leaning @ at.leaning)
        slopes = strength * at.across - np.outer(at.leaning, at.maker) / upright
        self._columns = self._weight(bench) @ slopes.T  # torque that the links need per unit of leaning
        self._at = at
        axes = ("xyz"[int(np.argmax(np.abs(direction)))] for direction in at.across)
        self.labels = (*self.labels, *(f"gravity along {axis}" for axis in axes))
        extra = at.leaning, np.full(2, -STEEPEST), np.full(2, STEEPEST)
        self.box = Box(*(np.append(side, added) for side, added in zip(self.box, extra, strict=True)))

    def lack(self, vector: Float[np.ndarray, "coordinates"]) -> Float[np.ndarray, "rows nv"]:
        """See `TorqueEquation.lack`."""
        return super().lack(vector[:-2]) - self._columns @ (vector[-2:] - self._at.leaning)

    def slope(self, vector: Float[np.ndarray, "coordinates"]) -> Float[np.ndarray, "rows nv coordinates"]:
        """See `TorqueEquation.slope`."""
        return np.concatenate([super().slope(vector[:-2]), -self._columns], axis=-1)

    def physical(self, vector: Float[np.ndarray, "coordinates"]) -> Float[np.ndarray, "coordinates"]:
        """See `TorqueEquation.physical`; gravity in m/s^2."""
        return np.append(super().physical(vector[:-2]), np.linalg.norm(self._at.maker) * vector[-2:])

    def tilt(self, found: BalanceSolution) -> Tilt:
        """Return the tilt that the least squares found."""
        return Tilt(self._at.maker, self._at.across, found.vector[-2:], found.errors[-2:])

    def _weight(self, bench: Bench) -> Float[np.ndarray, "rows nv 3"]:
        """Return the torque that a bench's links need per m/s^2 of gravity along each world axis."""
        at_rest = [Motion(motion.qpos, 0 * motion.qvel, 0 * motion.qacc) for motion in self.motions]
        without, *torques = (
            self._inverse(bench.with_gravity(axis.tolist()), at_rest, None) for axis in (np.zeros(3), *np.eye(3))
        )
        return self.decimate(np.stack([torque - without for torque in torques], axis=-1))
