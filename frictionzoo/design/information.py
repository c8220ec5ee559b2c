"""Information about the parameters in a planned recording, computed from exact sensitivities."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Array, Float

from frictionzoo.core.errors import ConfigError
from frictionzoo.core.segments import Sampling
from frictionzoo.core.state import Signals
from frictionzoo.fit import Space
from frictionzoo.fit.blocks import MOST_STRETCHES
from frictionzoo.fit.uncertainty import LEVEL
from frictionzoo.simulation.rollout import Rollout

_NOTHING = 1e-12  # regularisation of the inverse, as a share of each parameter's curvature


@dataclass(frozen=True)
class Noise:
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


class Sensed(NamedTuple):
    """Positions and velocities at the samples under a command, each of shape (batch, samples, nv), with derivatives.

    Attributes:
        slopes: Derivatives of positions and velocities after the first sample of each complete segment, with respect to
            the coordinates and the segment's initial positions and velocities, of shape (segments, tangents, batch,
            length, nv, 2).
    """

    qpos: Array
    qvel: Array
    slopes: Array


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


@dataclass(frozen=True)
class Sensitivity:
    """A drive with a fit of segments from measured initial states, as in `Objective`.

    Attributes:
        length: Sample intervals in a segment.
        weights: Weights of squared position and velocity errors in the loss.
    """

    space: Space
    rollout: Rollout
    sampling: Sampling
    length: int
    weights: tuple[float, float]
    noise: Noise

    def segments(self, samples: int) -> int:
        """Return the number of segments in a recording of this many samples."""
        return (samples - 1) // self.length

    def look(self, vector: Array, home: Float[np.ndarray, "nv"], signals: Signals, load: Array) -> Sensed:
        """Simulate recordings from rest, with derivatives.

        `vector` has the parameters' coordinates, `home` is the initial position [rad or m]. The signals have the shape
        (batch, history + samples - 1, nv), the payload's `load` (batch, load).
        """
        samples = signals.ctrl.shape[1] - self.sampling.history
        count = self.segments(samples + 1)
        begins = self.length * np.arange(count)[:, None]
        window = begins + np.arange(self.sampling.history + self.length)
        cut = signals.map(lambda signal: jnp.moveaxis(signal[:, window], 1, 0))
        batch, nv = signals.ctrl.shape[0], signals.ctrl.shape[2]
        # Tangent directions: all coordinates, then all initial positions, then all initial velocities.
        coordinates = len(self.space.start)
        unit = np.eye(coordinates + 2 * nv)
        parts = np.split(unit, [coordinates, coordinates + nv], axis=1)
        vectors, *states = (jnp.asarray(part, vector.dtype) for part in parts)
        seeds = vectors, *(jnp.broadcast_to(part[:, None], (len(unit), batch, nv)) for part in states)

        def segment(state: tuple[Array, Array], driving: Signals) -> tuple[Any, Any]:
            def run(vector: Array, qpos: Array, qvel: Array) -> Array:
                return jnp.stack(self.rollout(self.space.values(vector), qpos, qvel, driving, load), axis=-1)

            slope = jax.vmap(lambda *along: jax.jvp(run, (vector, *state), along), out_axes=(None, 0))
            after, slopes = slope(*seeds)
            return (after[:, -1, :, 0], after[:, -1, :, 1]), (after, slopes)

        start = jnp.broadcast_to(jnp.asarray(home, vector.dtype), (batch, nv)), jnp.zeros((batch, nv), vector.dtype)
        # To save memory, the reverse sweep stores only states and simulates each segment again.
        end, (after, slopes) = jax.lax.scan(jax.checkpoint(segment), start, cut)
        parts = [jnp.stack(start, axis=-1)[:, None], jnp.moveaxis(after, 0, 1).reshape(batch, -1, nv, 2)]
        if samples > count * self.length:  # an incomplete segment adds no information, but must keep the limits
            last = signals.map(lambda signal: signal[:, count * self.length :])
            parts.append(jnp.stack(self.rollout(self.space.values(vector), *end, last, load), axis=-1))
        states = jnp.concatenate(parts, axis=1)
        return Sensed(states[..., 0], states[..., 1], slopes)

    def half_widths(self, information: Information, segments: int) -> Float[np.ndarray, "batch coordinates"]:
        """Return half of each 95 % interval in coordinates, as in `estimate_uncertainty`; NaN without effect."""
        quantile = scipy.special.stdtrit(max(min(segments, MOST_STRETCHES) - 1, 1), (1 + LEVEL) / 2)
        variances = np.diagonal(np.asarray(information.covariance), axis1=1, axis2=2)
        effect = np.diagonal(np.asarray(information.hessian), axis1=1, axis2=2) > 0
        return np.where(effect, quantile * np.sqrt(np.maximum(variances, 0)), np.nan)


def inform(
    slopes: Float[Array, "segments tangents batch length nv 2"], weights: tuple[float, float], noise: Noise
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
