"""Commands as Fourier series with soft ramps at both ends."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from frictionzoo.core.errors import ConfigError
from frictionzoo.data.signals import Signal

_SLOWEST = 0.5  # frequency below which the amplitude of a coefficient no longer grows [Hz]


@dataclass(frozen=True)
class Series:
    """Periodic command q(t) = home + w(t) sum_k a_k cos(2 pi k t / T) + b_k sin(2 pi k t / T).

    w rises from 0 to 1 over the first ramp, with zero speed and acceleration at both ends of the ramp, and falls
    likewise over the last. Coefficients are scaled as velocities: 1 is a velocity amplitude of 1 rad/s or 1 m/s. Below
    the frequency `_SLOWEST` the position amplitude stays constant.

    Source: J. Swevers, C. Ganseman, D. Tukel, J. De Schutter, H. Van Brussel, "Optimal robot excitation and
    identification", IEEE Transactions on Robotics and Automation 13(5), 1997, for periodic series with optimised
    coefficients.

    Attributes:
        samples: Samples of the whole command.
        interval: Time between samples [s].
        period: T in samples.
        ramp: Samples of each ramp.
        bandwidth: Highest frequency [Hz].
        ends: Whether the command ends with a ramp; if not, it is cut off.

    Raises:
        ConfigError: No harmonic of the period lies within the bandwidth, or the sampling rate is too low for it.
    """

    samples: int
    interval: float
    period: int
    ramp: int
    bandwidth: float
    ends: bool = True

    def __post_init__(self) -> None:
        if self.harmonics < 1 or not self.bandwidth < 0.25 / self.interval:
            low, high = 1 / (self.period * self.interval), 0.25 / self.interval
            raise ConfigError(
                f"bandwidth={self.bandwidth:g}: expected {low:.3g} Hz, a harmonic, to {high:.3g} Hz, a quarter of rate"
            )

    @property
    def harmonics(self) -> int:
        """Number of harmonics."""
        return int(self.bandwidth * self.period * self.interval)

    @property
    def frequencies(self) -> Float[np.ndarray, "harmonics"]:
        """Frequencies of the harmonics [Hz]."""
        return np.arange(1, self.harmonics + 1) / (self.period * self.interval)

    @property
    def shortened(self) -> "Series":
        """First ramp and one period, which represents all others; the series itself if it has only one."""
        count = self.ramp + self.period + 1
        return self if self.samples < count + self.period else replace(self, samples=count, ends=False)

    @cached_property
    def window(self) -> Signal:
        """Factor w at each sample."""
        rise = np.clip(np.arange(self.samples) / self.ramp, 0, 1)
        rise = np.minimum(rise, rise[::-1]) if self.ends else rise
        return rise**3 * (10 - 15 * rise + 6 * rise**2)

    @cached_property
    def basis(self) -> Float[np.ndarray, "coefficients period"]:
        """One period of each term, for a coefficient of 1."""
        angle = 2 * np.pi * self.frequencies[:, None] * self.interval * np.arange(self.period)
        size = 1 / (2 * np.pi * np.maximum(self.frequencies, _SLOWEST))[:, None]
        return np.concatenate([size * np.cos(angle), size * np.sin(angle)])

    def command(
        self, xp: Any, coefficients: Float[Any, "... nv coefficients"], home: Float[np.ndarray, "nv"]
    ) -> tuple[Any, Any]:
        """Return position [rad or m] and velocity [rad/s or m/s] of the command, of shape (..., samples, nv)."""
        one_period = coefficients @ xp.asarray(self.basis)
        in_period = np.arange(self.samples) % self.period
        moved = xp.moveaxis(one_period, -1, -2)[..., in_period, :] * self.window[:, None]
        step = self.interval
        inner = (moved[..., 2:, :] - moved[..., :-2, :]) / (2 * step)
        at_rest = xp.zeros_like(moved[..., :1, :])  # at rest at both ends
        return home + moved, xp.concatenate([at_rest, inner, at_rest], axis=-2)
