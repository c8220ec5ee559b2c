"""Sensor noise estimated from recordings, loss weights that follow from it, and the misfit of a fit against it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from frictionzoo.core.log import Log
from frictionzoo.data.signals import find_noise

_ROUNDING = (0.2, 0.4)  # range of noise over encoder step that counts as rounding alone (0.29)
_WHOLE = 1e-3  # relative deviation of a difference between readings from a whole multiple of the step
_STILL = 1e-9  # share of the largest difference below which one is floating-point rounding
_LITTLE = 0.01  # share of the position noise, for velocities estimated from positions: they add little information
_TAILS = 10.0  # kurtosis of errors above which the model lacks something; noise has 3
_BEYOND = 3.0  # RMS error over the position noise above which the model lacks something
_EVEN, _NO_MORE = 2.8, 1.5  # kurtosis and RMS error over noise below which errors count as rounding (1.8 and 1)
_WIDE = 0.3  # threshold of the robust loss, in median absolute errors


class Noise(NamedTuple):
    """White noise of a drive's sensors, RMS over recordings.

    Attributes:
        position: Position noise of each joint [rad or m].
        velocity: Velocity noise of each joint [rad/s or m/s]; 0 for a joint without a measured velocity; None if any
            recording's velocities were estimated from positions, or no joint shows velocity noise.
        speed: RMS velocity of each joint [rad/s or m/s].
        step: Encoder step [rad or m]; 0 if rounding does not explain the noise, or the joints' steps differ.
    """

    position: Float[np.ndarray, "nv"]
    velocity: Float[np.ndarray, "nv"] | None
    speed: Float[np.ndarray, "nv"]
    step: float = 0.0

    @classmethod
    def of(cls, logs: Sequence[Log]) -> "Noise":
        """Estimate the noise of recordings."""

        def pool(name: str) -> Float[np.ndarray, "nv"]:
            noise = [[find_noise(column) for column in getattr(log, name).T] for log in logs]
            return np.sqrt(np.average(np.square(noise), axis=0, weights=[log.samples for log in logs]))

        speed = np.sqrt(np.concatenate([np.square(log.qvel) for log in logs]).mean(axis=0))
        position, velocity = pool("qpos"), pool("qvel")
        for log in logs:
            velocity[list(log.without_velocity)] = 0.0
        estimated = any(log.velocity_estimated for log in logs) or not velocity.any()
        steps = np.array([find_step([log.qpos[:, joint] for log in logs]) for joint in range(len(position))])
        low, high = (share * steps for share in _ROUNDING)
        is_rounding = ((low < position) & (position < high)).all() and np.ptp(steps) <= _WHOLE * steps.max()
        step = float(f"{steps[0]:.6g}") if is_rounding else 0.0
        return cls(position, None if estimated else velocity, speed, step)

    @property
    def velocity_weight(self) -> float:
        """Weight of squared velocity errors against squared position errors [s^2]; almost 0 if estimated."""
        if self.velocity is None:
            noise, reference, share = self.position, self.speed, _LITTLE
        else:
            noise, reference, share = self.position, self.velocity, 1.0
        counts = (noise > 0) & (reference > 0)
        ratio = share * noise[counts] / reference[counts] if counts.any() else np.zeros(1)
        weight = float(np.exp(np.mean(np.log(np.square(np.maximum(ratio, 1e-12))))))
        return float(f"{weight:.3g}")


def find_step(columns: Sequence[Float[np.ndarray, "_"]]) -> float:
    """Return the step that divides all differences between readings; 0 if there is none."""
    sizes = np.abs(np.concatenate([np.diff(column) for column in columns]))
    differences = sizes[sizes > _STILL * sizes.max(initial=0.0)]
    if not len(differences):
        return 0.0
    multiples = np.round(differences / np.median(differences[differences < 1.5 * differences.min()]))
    step = float(differences @ multiples / (multiples @ multiples))
    return step if (np.abs(differences - multiples * step) < _WHOLE * step * multiples).all() else 0.0


class Misfit(NamedTuple):
    """Position errors compared with the encoder noise.

    Attributes:
        beyond: RMS error over noise, largest over joints.
        kurtosis: Fourth over squared second moment, largest over joints.
        scale: Error beyond which a robust loss counts it less than squared, for `loss.robust_scale` [rad or m];
            dimensionless if each joint's errors are divided by their size.
    """

    beyond: float
    kurtosis: float
    scale: float

    @classmethod
    def of(cls, errors: Float[np.ndarray, "batch time nv"], noise: Float[np.ndarray, "nv"], by_joint: bool) -> "Misfit":
        """Return the misfit of position errors [rad or m] against position noise [rad or m]; ignore diverged rollouts.

        With `by_joint`, each joint's errors are divided by their size.
        """
        squares = np.square(errors[np.isfinite(errors).all(axis=(1, 2))])
        means = squares.mean(axis=(0, 1))
        kurtosis = np.square(squares).mean(axis=(0, 1)) / np.square(means)
        size = np.fmax(np.sqrt(means), noise) if by_joint else np.ones(len(means))
        widest = float(np.median(np.sqrt(squares) / size))
        scale = float(f"{max(_BEYOND * float((noise / size).max()), _WIDE * widest):.2g}")
        return cls(float((np.sqrt(means) / noise).max()), float(kurtosis.max()), scale)

    @property
    def is_more_than_noise(self) -> bool:
        """Whether the friction model lacks something."""
        return self.kurtosis > _TAILS or self.beyond > _BEYOND

    @property
    def is_rounding(self) -> bool:
        """Whether encoder rounding explains the residual."""
        return self.kurtosis < _EVEN and self.beyond < _NO_MORE

    def __str__(self) -> str:
        return f"errors are {self.beyond:.2g} times the noise, with kurtosis {self.kurtosis:.2g} (noise: 3)"
