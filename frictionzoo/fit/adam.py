"""Adam on the whole training set, the paper's method for every model that it fits by gradients."""

from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
import optax

from frictionzoo.core.errors import ConfigError, closest
from frictionzoo.fit.base import Evaluation, Fit, as_start, refuse_nothing, register_method
from frictionzoo.fit.blocks import Blocks
from frictionzoo.fit.objective import Objective

SCHEDULES: Mapping[str, Callable[[float, int], Any]] = {
    "constant": lambda rate, iterations: rate,
    "cosine": optax.cosine_decay_schedule,
}


@register_method("adam")
class Adam(Fit):
    """optax's Adam in scaled coordinates, projected onto the bounds after each step.

    A parameter at a bound keeps its gradient and can move away from the bound again.

    Source: D. Kingma, J. Ba, "Adam: A Method for Stochastic Optimization", 2015; Kovalev et al. 2026 for the recipe;
    I. Loshchilov, F. Hutter, "SGDR: Stochastic Gradient Descent with Warm Restarts", 2017, for the cosine.

    Args:
        iterations: Number of updates.
        learning_rate: Step of a coordinate; in logarithmic coordinates a share of the value.
        b2: Decay rate of the mean of squared gradients, in [0, 1).
        derivative: `forward`, `reverse` or `auto`; see `Objective.value_and_grad`.
        schedule: `constant`, or `cosine`: the rate falls to 0 over the iterations by half a cosine. At a constant rate
            a network's weights keep oscillating about their best values.
        start: The method whose result is the starting point, such as `InverseDynamics`; None for the initial values.

    Raises:
        ConfigError: An argument is out of range.
    """

    def __init__(
        self,
        iterations: int = 700,
        learning_rate: float = 0.01,
        b2: float = 0.9,
        derivative: str = "auto",
        schedule: str = "constant",
        start: Fit | None = None,
    ) -> None:
        if iterations < 1:
            raise ConfigError(f"fit.iterations={iterations}; expected at least 1")
        if not learning_rate > 0:
            raise ConfigError(f"fit.learning_rate={learning_rate}; expected a positive number")
        if not 0 <= b2 < 1:
            raise ConfigError(f"fit.b2={b2}; expected a number from 0 to less than 1")
        if derivative not in ("auto", "forward", "reverse"):
            raise ConfigError(f"fit.derivative={derivative}; expected auto, forward or reverse")
        if schedule not in SCHEDULES:
            raise ConfigError(f"fit.schedule={schedule}: unknown; {closest(schedule, SCHEDULES)}")
        self.start = as_start(start)
        self._iterations = iterations
        self._derivative = derivative
        self._optimiser = optax.adam(SCHEDULES[schedule](learning_rate, iterations), b2=b2)

    def total(self, objective: Objective) -> int:
        """See `Fit.total`; raises ConfigError if there is no parameter to identify."""
        refuse_nothing(objective)
        return self._iterations

    def init(self, objective: Objective) -> tuple[Any, Any]:
        """See `Fit.init`."""
        return objective.space.start, self._optimiser.init(objective.space.start)

    def step(self, objective: Objective, vector: Any, state: Any, data: Blocks) -> tuple[Evaluation, Any, Any]:
        """See `Fit.step`."""
        loss, gradient = objective.value_and_grad(self._derivative)(vector, data)
        updates, moments = self._optimiser.update(gradient, state, vector)
        moved = jnp.asarray(optax.apply_updates(vector, updates))
        diverged = ~jnp.isfinite(loss) | ~jnp.isfinite(gradient).all()
        return Evaluation(loss, gradient, diverged), jnp.clip(moved, objective.space.low, objective.space.high), moments

    def prepare(self, objective: Objective) -> None:
        """See `Fit.prepare`; evaluates the gradient of a model that exists only in torch once."""
        objective.value_and_grad(self._derivative)(objective.space.start, objective.data)
