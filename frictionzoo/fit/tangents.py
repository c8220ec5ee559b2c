"""Derivatives of residuals with respect to coordinates and initial states, as batched tangents."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from frictionzoo.fit.sparsity import Sparsity


class Seen(NamedTuple):
    """Residuals by branch at one vector, and their linear function of directions, or the derivatives themselves."""

    residuals: Float[Array, "branches segments terms"]
    along: Any


class Tangents(NamedTuple):
    """Directions in which residuals are differentiated: coordinates, and estimated initial states.

    Where the derivative of a step consists of few numbers, the rollout stores them, and a second program computes all
    tangents from them. This is faster: the rollout, with many shared terms, compiles without fusion, and the tangents,
    which share almost none, with it.

    Attributes:
        refine: Whether initial states are estimated.
        apart: Whether the rollout stores the numbers of its derivative.
    """

    sparsity: Sparsity
    refine: bool
    apart: bool

    def look(self, residuals: Callable[..., Array], vector: Array, own: Float[Array, "segments twice_nv"]) -> Seen:
        """Return residuals and their linearisation; the first program, with the rollout."""
        arguments = (vector, own) if self.refine else (vector,)
        function = residuals if self.refine else lambda vector: residuals(vector, own)
        if self.apart:
            return Seen(*jax.linearize(function, *arguments))
        slope = jax.vmap(lambda *along: jax.jvp(function, arguments, along), out_axes=(None, 0))
        return Seen(*slope(*self._directions(vector.dtype, len(own))))

    def slopes(
        self, seen: Seen
    ) -> tuple[Float[Array, "tangents branches segments terms"], Float[Array, "state branches segments terms"]]:
        """Return derivatives by the coordinates' tangents and by initial states; the second program."""
        derivatives = seen.along
        if self.apart:
            derivatives = jax.vmap(derivatives)(*self._directions(seen.residuals.dtype, seen.residuals.shape[1]))
        count = len(self.sparsity.seeds)
        return derivatives[:count], derivatives[count:]

    def _directions(self, dtype: Any, segments: int) -> tuple[Array, ...]:
        seeds, units = (jnp.asarray(part, dtype) for part in (self.sparsity.seeds, self.sparsity.states))
        if not self.refine:
            return (seeds,)
        vectors = jnp.concatenate([seeds, jnp.zeros((len(units), seeds.shape[1]), dtype)])
        states = jnp.concatenate([jnp.zeros((len(seeds), units.shape[1]), dtype), units])
        return vectors, jnp.broadcast_to(states[:, None], (len(states), segments, units.shape[1]))
