"""Adam on the whole training set, the paper's recipe for every gradient model."""

import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from frictionzoo.errors import ConfigError
from frictionzoo.fit.base import Fit, Progress, begin, keep_best
from frictionzoo.fit.objective import Objective


class Adam(Fit):
    """optax's Adam in scaled coordinates, projected onto the bounds after each step.

    Projection keeps the gradient at a bound alive, so that a parameter that touched it can come back.

    Source: D. Kingma, J. Ba, "Adam: A Method for Stochastic Optimization", 2015; Kovalev et al. 2026 for the recipe.

    Args:
        iterations: Number of updates.
        learning_rate: Step of a coordinate; in logarithmic coordinates a share of the value.
        b2: Share that the mean of squared gradients keeps from one iteration to the next, in [0, 1).
        derivative: `forward`, `reverse` or `auto`.

    Raises:
        ConfigError: An argument is out of range.
    """

    name = "adam"

    def __init__(self, iterations: int, learning_rate: float, b2: float, derivative: str) -> None:
        if iterations < 1:
            raise ConfigError(f"fit.iterations={iterations}; expected at least 1")
        if not learning_rate > 0:
            raise ConfigError(f"fit.learning_rate={learning_rate}; expected a positive number")
        if not 0 <= b2 < 1:
            raise ConfigError(f"fit.b2={b2}; expected a number from 0 to less than 1")
        if derivative not in ("auto", "forward", "reverse"):
            raise ConfigError(f"fit.derivative={derivative}; expected auto, forward or reverse")
        self._iterations = iterations
        self._derivative = derivative
        self._optimiser = optax.adam(learning_rate, b2=b2)

    def total(self, objective: Objective) -> int:
        """See `Fit.total`."""
        return self._iterations

    def start(self, objective: Objective) -> Progress:
        """See `Fit.start`."""
        vector = objective.space.start
        return begin(objective, vector, self._optimiser.init(vector))

    def iterate(self, objective: Objective, progress: Progress) -> tuple[Progress, Float[Array, ""], Float[Array, ""]]:
        """See `Fit.iterate`."""
        loss, gradient = objective.value_and_grad(self._derivative)(progress.vector)
        updates, moments = self._optimiser.update(gradient, progress.method, progress.vector)
        moved = optax.apply_updates(progress.vector, updates)
        progress = keep_best(progress, loss)
        following = progress._replace(
            iteration=progress.iteration + 1,
            vector=jnp.clip(jnp.asarray(moved), objective.space.low, objective.space.high),
            broken=progress.broken | ~jnp.isfinite(loss) | ~jnp.isfinite(gradient).all(),
            gradient=gradient,
            method=moments,
        )
        return following, loss, jnp.linalg.norm(gradient)
