"""Information about the parameters in a planned recording, computed from exact sensitivities."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from frictionzoo.core.errors import ConfigError
from frictionzoo.fit import Space

_NOTHING = 1e-12  # regularisation of the inverse, as a share of each parameter's curvature


@dataclass(frozen=True)
class SensorNoise:
    """White measurement noise.

    Attributes:
        quantum: Step of the encoder [rad or m]: uniform noise of this width.
        position_noise: Standard deviation of further position noise [rad or m].
        velocity_noise: Standard deviation of velocity noise [rad/s or m/s].

    Raises:
        ConfigError: A value is negative, or all are 0.
    """

    quantum: float = 2 * np.pi / 2**14
    position_noise: float = 0.0
    velocity_noise: float = 0.05

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 <= value < np.inf:
                raise ConfigError(f"{name}={value:g}: expected 0 or more")
        if not any(vars(self).values()):
            raise ConfigError("position_noise, velocity_noise and quantum are 0: expected noise; state your sensor's")


class Information(NamedTuple):
    """Information in the segments of a batch of recordings.

    Attributes:
        hessian: H, curvature of the sum of squares.
        spread: S, covariance of its gradient under the noise.
    """

    hessian: Float[Array, "batch coordinates coordinates"]
    spread: Float[Array, "batch coordinates coordinates"]

    @property
    def covariance(self) -> Float[Array, "batch coordinates coordinates"]:
        """Covariance H^-1 S H^-1 of the estimated coordinates."""
        root = jnp.sqrt(jnp.diagonal(self.hessian, axis1=1, axis2=2))
        root = jnp.where(root > 0, root, 1.0)
        scale = root[:, :, None] * root[:, None, :]
        inverse = jnp.linalg.inv(self.hessian / scale + _NOTHING * jnp.eye(root.shape[1])) / scale
        return inverse @ self.spread @ inverse


def inform(
    slopes: Float[Array, "segments tangents batch length nv 2"], weights: tuple[float, float], noise: SensorNoise
) -> Information:
    """Compute the information of a fit with white noise in all samples.

    J and P are the derivatives of a segment's states by the coordinates and by its initial state, W the weights, and n
    a sample's noise with variances V. A step of the fit is H^-1 s with

        H = sum J' W J,   s = sum J' W (n - P n_0)

    where n_0 is the noise of the segment's first sample, which is also the last sample of the previous segment. The
    gradient s is a sum of independent terms, one for each sample; their covariances add up.

    Source: G. Goodwin, R. Payne, "Dynamic System Identification: Experiment Design and Data Analysis", 1977, for
    experiment design by information.
    """
    count = slopes.shape[1] - 2 * slopes.shape[4]
    variances = jnp.asarray([noise.position_noise**2 + noise.quantum**2 / 12, noise.velocity_noise**2])
    by_value, by_state = slopes[:, :count], slopes[:, count:]
    weighed = jnp.asarray(weights) * by_value
    hessian = jnp.einsum("sibtjk,shbtjk->bih", weighed, by_value)
    # Tangents are stacked as (2, nv), states as (nv, 2).
    start = -jnp.einsum("sibtjk,shbtjk->sbih", weighed, by_state)
    start = jnp.moveaxis(start.reshape(*start.shape[:3], 2, -1), 3, 4)
    last = jnp.moveaxis(weighed[:, :, :, -1], 1, 2)
    zeros = jnp.zeros_like(last[:1])
    edge = jnp.concatenate([start, zeros]) + jnp.concatenate([zeros, last])
    inner = weighed[:, :, :, :-1]
    spread = jnp.einsum("sibtjk,shbtjk,k->bih", inner, inner, variances)
    spread += jnp.einsum("sbijk,sbhjk,k->bih", edge, edge, variances)
    return Information(hessian, spread)


def relative(space: Space, vector: np.ndarray, half: np.ndarray) -> Mapping[str, tuple[float, float, float]]:
    """Return the value, half its interval in its unit, and that half as a share of the value, by coordinate label.

    Half an interval is the larger of the two distances from the value to its ends. The share is NaN for a value of 0.
    """
    ends = space.pick(space.physical(np.stack([vector, vector - half, vector + half], axis=1)))
    by_label = {}
    for label, (value, low, high) in ends.items():
        width = max(value - low, high - value)
        by_label[label] = (float(value), float(width), float(width / abs(value)) if value else float("nan"))
    return by_label
