"""Exhaustive grid search, the paper's method without gradients."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from frictionzoo.core.errors import ConfigError
from frictionzoo.fit.base import Search, refuse_nothing, refuse_torch, register_method
from frictionzoo.fit.objective import Objective

MOST_COMBINATIONS = 100_000_000  # JAX counts them in 32 bits


@register_method("grid")
class Grid(Search):
    """Grid search over all combinations of values; an iteration is one combination, a chunk simulates many at once.

    Values are evenly spaced in each parameter's coordinate: in the value if its scale is a number, in its logarithm if
    its scale is `log`.

    Source: Kovalev et al., Proc. MIPT 18(2), 2026, MuJoCo-GridSearch.

    Args:
        points: Number of values of each parameter; the bounds are the first and the last.

    Raises:
        ConfigError: Fewer than two points.
    """

    def __init__(self, points: int = 11) -> None:
        if points < 2:
            raise ConfigError(f"fit.points={points}; expected at least 2")
        self._points = points

    def total(self, objective: Objective) -> int:
        """See `Fit.total`; refuses networks, which have no bounds, and models only in torch."""
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

    def candidate(self, objective: Objective, iteration: Any) -> Float[Array, "coordinates"]:
        """See `Search.candidate`."""
        low, high = objective.space.low, objective.space.high
        digits = (iteration // self._points ** jnp.arange(len(low))) % self._points
        return low + (high - low) * digits / (self._points - 1)
