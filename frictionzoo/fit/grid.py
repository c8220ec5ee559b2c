"""Exhaustive search, the paper's non-gradient competitor."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from frictionzoo.core.errors import ConfigError
from frictionzoo.fit.base import (
    Chunk,
    Fit,
    Progress,
    Trace,
    begin,
    compile_chunk,
    keep_best,
    refuse_nothing,
    refuse_torch,
    register_method,
)
from frictionzoo.fit.objective import Blocks, Objective

MOST_COMBINATIONS = 100_000_000  # and JAX counts them in 32 bits
MOST_STATES = 1_000_000_000  # simulated at once: some GB of memory


@register_method("grid")
class Grid(Fit):
    """Every combination of evenly spaced values; an iteration is one combination, a chunk simulates many at once.

    The values are evenly spaced in each parameter's coordinate: in the value itself where its scale is a number, in its
    logarithm where its scale is `log`.

    Source: Kovalev et al., Proc. MIPT 18(2), 2026, MuJoCo-GridSearch.

    Args:
        points: Values of each parameter; the bounds are the first and the last.

    Raises:
        ConfigError: Fewer than two points.
    """

    def __init__(self, points: int = 11) -> None:
        if points < 2:
            raise ConfigError(f"fit.points={points}; expected at least 2")
        self._points = points

    def total(self, objective: Objective) -> int:
        """See `Fit.total`; raises ConfigError for a network, which has no bounds, and for nothing at all.

        And for a law that exists only in torch.
        """
        refuse_nothing(objective)
        refuse_torch(objective, self.name)
        if objective.space.weights:
            raise ConfigError(
                f"fit=grid: {objective.space.weights[0]} has no bounds; expected physical parameters only, use fit=adam"
            )
        combinations = self._points ** len(objective.space.start)
        if combinations > MOST_COMBINATIONS:
            raise ConfigError(
                f"fit.points={self._points}: {combinations:g} combinations of {len(objective.space.start)} parameters, "
                f"expected at most {MOST_COMBINATIONS:g}; lower it"
            )
        return combinations

    def start(self, objective: Objective) -> Progress:
        """See `Fit.start`."""
        return begin(objective, self._combination(objective, jnp.asarray(0)), ())

    def chunk(self, objective: Objective, size: int) -> Chunk:
        """See `Fit.chunk`. A combination that diverges loses; it does not end the search."""
        at_once = size * objective.data.qpos[0].size
        if at_once > MOST_STATES:
            raise ConfigError(
                f"loop.chunk={size}: {at_once:g} states simulated at once, expected at most {MOST_STATES:g}; lower it"
            )

        def run(progress: Progress, count: Array, data: Blocks) -> tuple[Progress, Trace]:
            rows = jnp.arange(size)
            vectors = jax.vmap(lambda row: self._combination(objective, progress.iteration + row))(rows)
            losses = jax.vmap(objective.loss, in_axes=(0, None))(vectors, data)
            candidates = jnp.where(jnp.isfinite(losses) & (rows < count), losses, jnp.inf)
            row = jnp.argmin(candidates)
            best = keep_best(
                progress._replace(vector=vectors[row], iteration=progress.iteration + row), candidates[row]
            )
            iteration = progress.iteration + count
            following = best._replace(iteration=iteration, vector=self._combination(objective, iteration))
            return following, Trace(losses, jnp.zeros_like(losses), jax.vmap(objective.space.identified)(vectors))

        return compile_chunk(self, objective, run)

    def _combination(self, objective: Objective, index: Array) -> Float[Array, "coordinates"]:
        low, high = objective.space.low, objective.space.high
        digits = (index // self._points ** jnp.arange(len(low))) % self._points
        return low + (high - low) * digits / (self._points - 1)
