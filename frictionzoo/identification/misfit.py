"""What a first fit leaves: noise, what an encoder rounds, or more, which the law lacks."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

_TAILS = 10.0  # fourth over squared second moment of errors from which on a law lacks something; of noise 3
_BEYOND = 3.0  # times the noise of positions, that errors are then
_EVEN, _NO_MORE = 2.8, 1.5  # kurtosis, and times the noise, up to which errors are taken for rounding, 1.8 and 1
_WIDE = 0.3  # times the median absolute error, from which on one counts less than its square


class Misfit(NamedTuple):
    """Errors of position beside the noise of the encoder.

    Attributes:
        beyond: Root mean square error over the noise, of the joint in which it is largest.
        kurtosis: Fourth over squared second moment, of the joint in which it is largest.
        scale: Error from which on a robust loss is to count less than its square, as `loss.robust_scale` has it: in
            rad or m, or where each joint's errors count over their size, over that.
    """

    beyond: float
    kurtosis: float
    scale: float

    @classmethod
    def of(cls, errors: Float[np.ndarray, "batch time nv"], noise: Float[np.ndarray, "nv"], by_joint: bool) -> "Misfit":
        """Of rollouts, those that diverge left out.

        Args:
            errors: Of position [rad or m].
            noise: Of each joint's measured position [rad or m].
            by_joint: Whether each joint's errors count over their size.
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
        """Whether the law lacks something."""
        return self.kurtosis > _TAILS or self.beyond > _BEYOND

    @property
    def is_rounding(self) -> bool:
        """Whether nothing is left but what the encoder rounds."""
        return self.kurtosis < _EVEN and self.beyond < _NO_MORE

    def __str__(self) -> str:
        return f"errors are {self.beyond:.2g} times the noise, with kurtosis {self.kurtosis:.2g} (noise: 3)"
