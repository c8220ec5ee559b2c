"""What recordings say of their own noise, and how errors of position and velocity count by it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from frictionzoo.core.log import Log
from frictionzoo.logs.signals import find_noise

_LITTLE = 0.01  # of a position's noise, that an estimated velocity counts for: it was in the position before


class Noise(NamedTuple):
    """White noise of a drive's sensors, root mean square over recordings.

    Attributes:
        position: Of each joint [rad or m].
        velocity: Of each joint [rad/s or m/s]; None where velocities were estimated from positions.
        speed: Root mean square velocity of each joint [rad/s or m/s].
    """

    position: Float[np.ndarray, "nv"]
    velocity: Float[np.ndarray, "nv"] | None
    speed: Float[np.ndarray, "nv"]

    @classmethod
    def of(cls, logs: Sequence[Log]) -> "Noise":
        """Of these recordings."""

        def each(name: str) -> Float[np.ndarray, "nv"]:
            found = [[find_noise(column) for column in getattr(log, name).T] for log in logs]
            return np.sqrt(np.average(np.square(found), axis=0, weights=[log.samples for log in logs]))

        speed = np.sqrt(np.concatenate([np.square(log.qvel) for log in logs]).mean(axis=0))
        estimated = any(log.velocity_estimated for log in logs)
        return cls(each("qpos"), None if estimated else each("qvel"), speed)

    @property
    def velocity_weight(self) -> float:
        """Weight of squared velocity errors over that of squared position errors [s^2].

        As the inverse of variances, in the mean over joints; next to nothing for an estimated velocity.
        """
        tiny = np.finfo(float).tiny
        if self.velocity is None:
            ratio = _LITTLE * self.position / np.maximum(self.speed, tiny)
        else:
            ratio = self.position / np.maximum(self.velocity, tiny)
        found = float(np.exp(np.mean(np.log(np.square(np.maximum(ratio, 1e-12))))))
        return float(f"{found:.3g}")
