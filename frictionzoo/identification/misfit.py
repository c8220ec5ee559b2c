"""Cause of a first fit's residual: noise, encoder rounding, or an effect that the friction model lacks."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

_TAILS = 10.0  # kurtosis of errors above which the model lacks something; noise has 3
_BEYOND = 3.0  # RMS error over the position noise above which the model lacks something
_EVEN, _NO_MORE = 2.8, 1.5  # kurtosis and RMS error over noise below which errors count as rounding (1.8 and 1)
_WIDE = 0.3  # threshold of the robust loss, in median absolute errors


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
