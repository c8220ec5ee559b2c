"""Derivatives of residuals by coordinates and initial states, as tangents that are taken side by side."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from frictionzoo.fit.sparsity import Sparsity


class Seen(NamedTuple):
    """Residuals at one vector, and what their derivative is made of.

    Attributes:
        residuals: By branch.
        along: A linear function of directions, with the numbers that it needs; or the slopes themselves.
    """

    residuals: Float[Array, "branches segments terms"]
    along: Any


class Tangents(NamedTuple):
    """The directions in which residuals are differentiated: coordinates, and initial states that are estimated along.

    Where the derivative of a step is made of few numbers, a rollout keeps them, and all tangents follow from these in
    a program of their own. That is faster twice: the rollout is compiled without fusion, which its many shared terms
    need, and the tangents, which share next to nothing, with it.

    Attributes:
        sparsity: Branches of the robot.
        refine: Whether initial states are among them.
        apart: Whether a rollout keeps what its derivative is made of.
    """

    sparsity: Sparsity
    refine: bool
    apart: bool

    def look(self, residuals: Callable[..., Array], vector: Array, own: Float[Array, "segments twice_nv"]) -> Seen:
        """The first program: a rollout.

        Args:
            residuals: Of a vector and initial states.
            vector: Where.
            own: Initial states.
        """
        given = (vector, own) if self.refine else (vector,)
        function = residuals if self.refine else lambda vector: residuals(vector, own)
        if self.apart:
            return Seen(*jax.linearize(function, *given))
        slope = jax.vmap(lambda *along: jax.jvp(function, given, along), out_axes=(None, 0))
        return Seen(*slope(*self._directions(vector.dtype, len(own))))

    def slopes(
        self, seen: Seen
    ) -> tuple[Float[Array, "tangents branches segments terms"], Float[Array, "state branches segments terms"]]:
        """The second: derivatives by the coordinates' tangents, and by a segment's own initial state."""
        found = seen.along
        if self.apart:
            found = jax.vmap(found)(*self._directions(seen.residuals.dtype, seen.residuals.shape[1]))
        count = len(self.sparsity.seeds)
        return found[:count], found[count:]

    def _directions(self, dtype: Any, segments: int) -> tuple[Array, ...]:
        seeds, units = (jnp.asarray(part, dtype) for part in (self.sparsity.seeds, self.sparsity.states))
        if not self.refine:
            return (seeds,)
        vectors = jnp.concatenate([seeds, jnp.zeros((len(units), seeds.shape[1]), dtype)])
        states = jnp.concatenate([jnp.zeros((len(seeds), units.shape[1]), dtype), units])
        return vectors, jnp.broadcast_to(states[:, None], (len(states), segments, units.shape[1]))
