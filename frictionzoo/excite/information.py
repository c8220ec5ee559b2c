"""What a recording will say of the parameters, from exact sensitivities, before it is made."""

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
from frictionzoo.simulate.rollout import Rollout

_NOTHING = 1e-12  # curvature, as a share of each parameter's own, that is added so that a matrix can be inverted


@dataclass(frozen=True)
class Noise:
    """What measuring will add: standard deviations of white noise.

    Attributes:
        quantum: Step of the encoder [rad or m], for uniform noise of its size.
        position_noise: Of measured positions besides that [rad or m].
        velocity_noise: Of measured velocities [rad/s or m/s].

    Raises:
        ConfigError: One is negative, or nothing is added at all.
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

    @property
    def variances(self) -> tuple[float, float]:
        """Of a measured position and of a measured velocity."""
        return self.position_noise**2 + self.quantum**2 / 12, self.velocity_noise**2


class Sensed(NamedTuple):
    """The motion that a command makes, and how it depends on the parameters.

    Attributes:
        qpos: At each sample, of shape (batch, samples, nv).
        qvel: The same.
        slopes: Of positions and velocities after the first sample of each whole segment, by the coordinates and by the
            segment's initial positions and velocities, of shape (segments, tangents, batch, length, nv, 2).
    """

    qpos: Array
    qvel: Array
    slopes: Array


class Information(NamedTuple):
    """What a fit of segments will find, one matrix for each of a batch of recordings.

    Attributes:
        hessian: H, how sharply the sum of squares rises.
        spread: S, the covariance of its gradient under the noise.
    """

    hessian: Float[Array, "batch coordinates coordinates"]
    spread: Float[Array, "batch coordinates coordinates"]

    @property
    def covariance(self) -> Float[Array, "batch coordinates coordinates"]:
        """H^-1 S H^-1 of the coordinates that are found."""
        own = jnp.sqrt(jnp.diagonal(self.hessian, axis1=1, axis2=2))
        own = jnp.where(own > 0, own, 1.0)
        scale = own[:, :, None] * own[:, None, :]
        inverse = jnp.linalg.inv(self.hessian / scale + _NOTHING * jnp.eye(own.shape[1])) / scale
        return inverse @ self.spread @ inverse


@dataclass(frozen=True)
class Sensitivity:
    """A drive whose recordings are fitted in segments from measured initial states, as `Objective` does it.

    Attributes:
        space: The parameters that are to be found.
        rollout: The simulated drive.
        sampling: Of the recording.
        length: Sample intervals in a segment.
        weights: Of squared errors of position and velocity in the fit.
        noise: Of the sensors.
    """

    space: Space
    rollout: Rollout
    sampling: Sampling
    length: int
    weights: tuple[float, float]
    noise: Noise

    def segments(self, samples: int) -> int:
        """How many there are in a recording."""
        return (samples - 1) // self.length

    def look(self, vector: Array, home: Float[np.ndarray, "nv"], signals: Signals, load: Array) -> Sensed:
        """Simulate recordings from rest, with their derivatives.

        Args:
            vector: Coordinates of the parameters.
            home: Where the drive rests [rad or m].
            signals: Each of shape (batch, history + samples - 1, nv).
            load: What the payload changes in the model, of shape (batch, load).
        """
        samples = signals.ctrl.shape[1] - self.sampling.history
        count = self.segments(samples + 1)
        first = self.length * np.arange(count)[:, None]
        window = first + np.arange(self.sampling.history + self.length)
        cut = signals.map(lambda signal: jnp.moveaxis(signal[:, window], 1, 0))
        batch, nv = signals.ctrl.shape[0], signals.ctrl.shape[2]
        seeds = self._seeds(batch, nv, vector.dtype)

        def segment(state: tuple[Array, Array], driving: Signals) -> tuple[Any, Any]:
            def run(vector: Array, qpos: Array, qvel: Array) -> Array:
                return jnp.stack(self.rollout(self.space.values(vector), qpos, qvel, driving, load), axis=-1)

            slope = jax.vmap(lambda *along: jax.jvp(run, (vector, *state), along), out_axes=(None, 0))
            after, slopes = slope(*seeds)
            return (after[:, -1, :, 0], after[:, -1, :, 1]), (after, slopes)

        start = jnp.broadcast_to(jnp.asarray(home, vector.dtype), (batch, nv)), jnp.zeros((batch, nv), vector.dtype)
        # Only states are kept for a reverse sweep, and a segment is simulated anew in it.
        end, (after, slopes) = jax.lax.scan(jax.checkpoint(segment), start, cut)
        parts = [jnp.stack(start, axis=-1)[:, None], jnp.moveaxis(after, 0, 1).reshape(batch, -1, nv, 2)]
        if samples > count * self.length:  # what fills no segment says nothing, and keeps the limits as the rest does
            last = signals.map(lambda signal: signal[:, count * self.length :])
            parts.append(jnp.stack(self.rollout(self.space.values(vector), *end, last, load), axis=-1))
        whole = jnp.concatenate(parts, axis=1)
        return Sensed(whole[..., 0], whole[..., 1], slopes)

    def half_widths(self, information: Information, segments: int) -> Float[np.ndarray, "batch coordinates"]:
        """Half of each 95 % interval, in the optimiser's coordinates, as `estimate_uncertainty` will report it.

        NaN for a parameter that has no effect.
        """
        quantile = scipy.special.stdtrit(max(min(segments, MOST_STRETCHES) - 1, 1), (1 + LEVEL) / 2)
        variances = np.diagonal(np.asarray(information.covariance), axis1=1, axis2=2)
        effect = np.diagonal(np.asarray(information.hessian), axis1=1, axis2=2) > 0
        return np.where(effect, quantile * np.sqrt(np.maximum(variances, 0)), np.nan)

    def _seeds(self, batch: int, nv: int, dtype: Any) -> tuple[Array, Array, Array]:
        """Directions: each coordinate, then each joint's initial position, then its velocity."""
        count = len(self.space.start)
        unit = np.eye(count + 2 * nv)
        parts = unit[:, :count], unit[:, count : count + nv], unit[:, count + nv :]
        vectors, qpos, qvel = (jnp.asarray(part, dtype) for part in parts)
        spread = (len(unit), batch, nv)
        return vectors, jnp.broadcast_to(qpos[:, None], spread), jnp.broadcast_to(qvel[:, None], spread)


def inform(
    slopes: Float[Array, "segments tangents batch length nv 2"], weights: tuple[float, float], noise: Noise
) -> Information:
    """What the fit finds from white noise in all samples.

    With J the derivative of a segment's states by the coordinates, P that by its initial state, W the weights and
    V the variances of a sample's noise n, a step of the fit is H^-1 s with

        H = sum J' W J,   s = sum J' W (n - P n_0)

    where n_0 is the noise of the segment's first sample, which is the last one of the segment before: the gradient
    is a sum of independent terms, one a sample, of which each contributes to the covariance of s.

    Source: G. Goodwin, R. Payne, "Dynamic System Identification: Experiment Design and Data Analysis", 1977, for
    information as what an experiment is designed by.

    Args:
        slopes: As `Sensed` has them.
        weights: Of squared errors of position and velocity.
        noise: Of the sensors.
    """
    count = slopes.shape[1] - 2 * slopes.shape[4]
    variances = jnp.asarray(noise.variances)
    by_value, by_state = slopes[:, :count], slopes[:, count:]
    weighed = jnp.asarray(weights) * by_value
    hessian = jnp.einsum("sibtjk,shbtjk->bih", weighed, by_value)
    # By position and velocity of each joint, in the order in which they are stacked.
    start = -jnp.einsum("sibtjk,shbtjk->sbih", weighed, by_state)
    start = jnp.moveaxis(start.reshape(*start.shape[:3], 2, -1), 3, 4)
    last = jnp.moveaxis(weighed[:, :, :, -1], 1, 2)
    nothing = jnp.zeros_like(last[:1])
    edge = jnp.concatenate([start, nothing]) + jnp.concatenate([nothing, last])
    inner = weighed[:, :, :, :-1]
    spread = jnp.einsum("sibtjk,shbtjk,k->bih", inner, inner, variances)
    spread += jnp.einsum("sbijk,sbhjk,k->bih", edge, edge, variances)
    return Information(hessian, spread)


def relative(space: Space, vector: np.ndarray, half: np.ndarray) -> Mapping[str, tuple[float, float, float]]:
    """Value, half of its interval in its unit, and that as a share of the value, by the coordinate's label.

    The half is the larger of the two sides of the value; the share is NaN where the value is 0.
    """
    ends = space.pick(space.physical(np.stack([vector, vector - half, vector + half], axis=1)))
    found = {}
    for label, (value, low, high) in ends.items():
        width = max(value - low, high - value)
        found[label] = (float(value), float(width), float(width / abs(value)) if value else float("nan"))
    return found
