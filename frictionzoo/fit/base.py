"""The interface of a fit: a state that advances by iterations inside one compiled call."""

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from frictionzoo.fit.objective import Objective


class Progress(NamedTuple):
    """Where a fit stands.

    Attributes:
        iteration: Iterations done.
        vector: Coordinates of the next iteration.
        best: Coordinates with the lowest loss so far.
        best_loss: That loss; infinite before the first.
        best_iteration: Its iteration, from 0; -1 before the first.
        broken: Whether a loss or a gradient was not finite; then nothing moves any more.
        gradient: The gradient of the last iteration.
        method: What the method keeps besides (moments of Adam).
    """

    iteration: Int[Array, ""]
    vector: Float[Array, "coordinates"]
    best: Float[Array, "coordinates"]
    best_loss: Float[Array, ""]
    best_iteration: Int[Array, ""]
    broken: Any
    gradient: Float[Array, "coordinates"]
    method: Any


class Trace(NamedTuple):
    """One row an iteration, in JAX inside a chunk and in numpy outside.

    Attributes:
        loss: The objective, of shape (rows,).
        grad_norm: Length of its gradient, of shape (rows,); 0 where the method uses none.
        params: Values of the identified physical parameters, each of shape (rows, nv).
    """

    loss: Any
    grad_norm: Any
    params: dict[str, Any]


class Fit(ABC):
    """A way of finding parameters.

    Attributes:
        name: Its name in results.
    """

    name: str

    @abstractmethod
    def total(self, objective: Objective) -> int:
        """Number of iterations that the whole fit takes.

        Raises:
            ConfigError: The method cannot search this space.
        """

    @abstractmethod
    def start(self, objective: Objective) -> Progress:
        """Where the fit begins."""

    @abstractmethod
    def iterate(self, objective: Objective, progress: Progress) -> tuple[Progress, Float[Array, ""], Float[Array, ""]]:
        """One iteration: the next progress, this iteration's loss and gradient norm."""

    def chunk(self, objective: Objective, size: int) -> Any:
        """A compiled function (progress, count) -> (progress, Trace) of up to `size` iterations.

        The count is an argument and not a constant: a chunk cut short runs the same machine code, so that where a fit
        was interrupted does not change a bit of its result.
        """

        def run(progress: Progress, count: Array) -> tuple[Progress, Trace]:
            empty = jnp.zeros(size, progress.vector.dtype)
            shapes = jax.eval_shape(objective.space.identified, progress.vector)
            params = {name: jnp.zeros((size, *shape.shape), shape.dtype) for name, shape in shapes.items()}

            def body(row: Array, carry: tuple[Progress, Trace]) -> tuple[Progress, Trace]:
                progress, trace = carry
                here = objective.space.identified(progress.vector)
                following, loss, grad_norm = self.iterate(objective, progress)
                written = Trace(
                    trace.loss.at[row].set(loss),
                    trace.grad_norm.at[row].set(grad_norm),
                    {name: values.at[row].set(here[name]) for name, values in trace.params.items()},
                )
                return _freeze(progress, following), written

            return jax.lax.fori_loop(0, count, body, (progress, Trace(empty, empty, params)))

        return jax.jit(run)


def _freeze(progress: Progress, following: Progress) -> Progress:
    """Once broken, everything but the offending gradient stays as it was."""
    kept = jax.tree.map(lambda old, new: jnp.where(following.broken, old, new), progress, following)
    return kept._replace(
        broken=following.broken, gradient=jnp.where(progress.broken, progress.gradient, following.gradient)
    )


def begin(objective: Objective, vector: Float[Array, "coordinates"], method: Any) -> Progress:
    """Progress before the first iteration, at this vector."""
    dtype = vector.dtype
    return Progress(
        iteration=jnp.asarray(0),
        vector=vector,
        best=vector,
        best_loss=jnp.asarray(jnp.inf, dtype),
        best_iteration=jnp.asarray(-1),
        broken=jnp.asarray(False),
        gradient=jnp.zeros_like(vector),
        method=method,
    )


def keep_best(progress: Progress, loss: Float[Array, ""]) -> Progress:
    """The same progress, with its vector as the best one if this is its loss and the lowest."""
    better = loss < progress.best_loss
    return progress._replace(
        best=jnp.where(better, progress.vector, progress.best),
        best_loss=jnp.where(better, loss, progress.best_loss),
        best_iteration=jnp.where(better, progress.iteration, progress.best_iteration),
    )
