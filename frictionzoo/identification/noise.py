"""What recordings say of their own noise, and how errors of position and velocity count by it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from frictionzoo.core.log import Log
from frictionzoo.logs.signals import find_noise

_ROUNDING = (0.2, 0.4)  # noise over the encoder's step, where rounding is all of it: 0.29
_WHOLE = 1e-3  # of a difference between readings, that it is off a whole multiple of the step
_STILL = 1e-9  # of the largest difference, that is none but for rounding of another kind
_LITTLE = 0.01  # of a position's noise, that an estimated velocity counts for: it was in the position before


class Noise(NamedTuple):
    """White noise of a drive's sensors, root mean square over recordings.

    Attributes:
        position: Of each joint [rad or m].
        velocity: Of each joint [rad/s or m/s]; 0 of one whose velocity was estimated from its position; None where all
            were.
        speed: Root mean square velocity of each joint [rad/s or m/s].
        step: To which positions are rounded [rad or m]; 0 where that is not what the noise is, or not alike in all.
    """

    position: Float[np.ndarray, "nv"]
    velocity: Float[np.ndarray, "nv"] | None
    speed: Float[np.ndarray, "nv"]
    step: float = 0.0

    @classmethod
    def of(cls, logs: Sequence[Log]) -> "Noise":
        """Of these recordings."""

        def each(name: str) -> Float[np.ndarray, "nv"]:
            found = [[find_noise(column) for column in getattr(log, name).T] for log in logs]
            return np.sqrt(np.average(np.square(found), axis=0, weights=[log.samples for log in logs]))

        speed = np.sqrt(np.concatenate([np.square(log.qvel) for log in logs]).mean(axis=0))
        position, velocity = each("qpos"), each("qvel")
        for log in logs:
            velocity[list(log.without_velocity)] = 0.0
        estimated = any(log.velocity_estimated for log in logs) or not velocity.any()
        return cls(position, None if estimated else velocity, speed, _find_step(logs, position))

    @property
    def velocity_weight(self) -> float:
        """Weight of squared velocity errors over that of squared position errors [s^2].

        As the inverse of variances, in the mean over joints that have noise; next to nothing for an estimated velocity.
        """
        if self.velocity is None:
            noise, reference, share = self.position, self.speed, _LITTLE
        else:
            noise, reference, share = self.position, self.velocity, 1.0
        counts = (noise > 0) & (reference > 0)
        ratio = share * noise[counts] / reference[counts] if counts.any() else np.zeros(1)
        found = float(np.exp(np.mean(np.log(np.square(np.maximum(ratio, 1e-12))))))
        return float(f"{found:.3g}")


def _find_step(logs: Sequence[Log], noise: Float[np.ndarray, "nv"]) -> float:
    """The encoder's step in all joints [rad or m]; 0 where positions have none, or other noise than its rounding."""
    steps = [find_step([log.qpos[:, joint] for log in logs]) for joint in range(len(noise))]
    low, high = (share * np.array(steps) for share in _ROUNDING)
    alike = max(steps) - min(steps) <= _WHOLE * max(steps)
    return float(f"{steps[0]:.6g}") if alike and ((low < noise) & (noise < high)).all() else 0.0


def find_step(columns: Sequence[Float[np.ndarray, "_"]]) -> float:
    """The step of which all differences of readings are whole multiples; 0 where there is none."""
    sizes = np.abs(np.concatenate([np.diff(column) for column in columns]))
    moved = sizes[sizes > _STILL * sizes.max(initial=0.0)]
    if not len(moved):
        return 0.0
    whole = np.round(moved / np.median(moved[moved < 1.5 * moved.min()]))
    step = float(moved @ whole / (whole @ whole))
    return step if (np.abs(moved - whole * step) < _WHOLE * step * whole).all() else 0.0
