"""Adam on the whole training set, the paper's recipe for every gradient model."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array

from frictionzoo.core.errors import ConfigError, closest
from frictionzoo.fit.base import (
    Chunk,
    Fit,
    Progress,
    Trace,
    begin,
    compile_chunk,
    keep_best,
    refuse_nothing,
    register_method,
)
from frictionzoo.fit.objective import Blocks, Objective

SCHEDULES: Mapping[str, Callable[[float, int], Any]] = {
    "constant": lambda rate, iterations: rate,
    "cosine": optax.cosine_decay_schedule,
}


@register_method("adam")
class Adam(Fit):
    """optax's Adam in scaled coordinates, projected onto the bounds after each step.

    Projection keeps the gradient at a bound alive, so that a parameter that touched it can come back.

    Source: D. Kingma, J. Ba, "Adam: A Method for Stochastic Optimization", 2015; Kovalev et al. 2026 for the recipe;
    I. Loshchilov, F. Hutter, "SGDR: Stochastic Gradient Descent with Warm Restarts", 2017, for the cosine.

    Args:
        iterations: Number of updates.
        learning_rate: Step of a coordinate; in logarithmic coordinates a share of the value.
        b2: Share that the mean of squared gradients keeps from one iteration to the next, in [0, 1).
        derivative: `forward`, `reverse` or `auto`.
        schedule: `constant`, or `cosine`: the rate falls to 0 by half a cosine over the iterations. At a constant rate
            the weights of a network go on jumping about their best values.

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
        self._iterations = iterations
        self._derivative = derivative
        self._optimiser = optax.adam(SCHEDULES[schedule](learning_rate, iterations), b2=b2)

    def total(self, objective: Objective) -> int:
        """See `Fit.total`; raises ConfigError where nothing is to be identified."""
        refuse_nothing(objective)
        return self._iterations

    def start(self, objective: Objective) -> Progress:
        """See `Fit.start`."""
        vector = objective.space.start
        return begin(objective, vector, self._optimiser.init(vector))

    def chunk(self, objective: Objective, size: int) -> Chunk:
        """See `Fit.chunk`."""
        value_and_grad = objective.value_and_grad(self._derivative)
        repeat: Callable[..., Any] = jax.lax.fori_loop

        def record(row: Array, carry: tuple[Progress, Trace], loss: Array, gradient: Array) -> tuple[Progress, Trace]:
            progress, trace = carry
            here = objective.space.identified(progress.vector)
            written = Trace(
                trace.loss.at[row].set(loss),
                trace.grad_norm.at[row].set(jnp.linalg.norm(gradient)),
                {name: values.at[row].set(here[name]) for name, values in trace.params.items()},
            )
            return self._update(objective, progress, loss, gradient), written

        if objective.torch_law:
            value_and_grad(objective.space.start, objective.data)  # compiles it
            repeat, record = _repeat, objective.compile(record)

        def run(progress: Progress, count: Array, data: Blocks) -> tuple[Progress, Trace]:
            empty = jnp.zeros(size, progress.vector.dtype)
            shapes = jax.eval_shape(objective.space.identified, progress.vector)
            params = {name: jnp.zeros((size, *shape.shape), shape.dtype) for name, shape in shapes.items()}

            def body(row: Array, carry: tuple[Progress, Trace]) -> tuple[Progress, Trace]:
                return record(row, carry, *value_and_grad(carry[0].vector, data))

            return repeat(0, count, body, (progress, Trace(empty, empty, params)))

        return compile_chunk(self, objective, run)

    def _update(self, objective: Objective, progress: Progress, loss: Array, gradient: Array) -> Progress:
        updates, moments = self._optimiser.update(gradient, progress.method, progress.vector)
        moved = jnp.asarray(optax.apply_updates(progress.vector, updates))
        following = keep_best(progress, loss)._replace(
            iteration=progress.iteration + 1,
            vector=jnp.clip(moved, objective.space.low, objective.space.high),
            broken=progress.broken | ~jnp.isfinite(loss) | ~jnp.isfinite(gradient).all(),
            gradient=gradient,
            method=moments,
        )
        # Once broken, everything but the offending gradient stays as it was.
        kept = jax.tree.map(lambda old, new: jnp.where(following.broken, old, new), progress, following)
        return kept._replace(
            broken=following.broken, gradient=jnp.where(progress.broken, progress.gradient, following.gradient)
        )


def _repeat(start: int, stop: Array, body: Callable[[Any, Any], Any], carry: Any) -> Any:
    """`jax.lax.fori_loop` for a body that cannot be compiled."""
    for row in range(start, int(stop)):
        carry = body(jnp.asarray(row), carry)
    return carry
