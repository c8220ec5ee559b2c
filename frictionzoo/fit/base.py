"""The interface of a fit: a state that advances by iterations inside one compiled call."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from frictionzoo.core.described import Described
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.registry import KINDS, Registry
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
        converged: Whether the method sees nothing left to gain.
        gradient: The gradient of the last iteration.
        method: What the method keeps besides (moments of Adam).
    """

    iteration: Int[Array, ""]
    vector: Float[Array, "coordinates"]
    best: Float[Array, "coordinates"]
    best_loss: Float[Array, ""]
    best_iteration: Int[Array, ""]
    broken: Any
    converged: Any
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


Chunk = Callable[[Progress, int], tuple[Progress, Trace]]
"""(progress, count) to the progress after up to `count` more iterations, and a trace whose first rows are theirs."""


class Fit(Described, ABC):
    """A way of finding parameters.

    Attributes:
        name: Its name in results, set by `register_method`.
    """

    name: ClassVar[str]

    def choose(self, objective: Objective) -> "Fit":
        """The method that does the work for this objective: this one, unless it leaves the choice to the law."""
        return self

    @abstractmethod
    def total(self, objective: Objective) -> int:
        """Largest number of iterations that the whole fit takes.

        Raises:
            ConfigError: The method cannot search this space.
        """

    @abstractmethod
    def start(self, objective: Objective) -> Progress:
        """Where the fit begins."""

    @abstractmethod
    def chunk(self, objective: Objective, size: int) -> Chunk:
        """The function that does up to `size` iterations, compiled.

        How iterations are cut into chunks must not change a bit of the result: an interrupted fit goes on in others.
        """


REGISTRY = Registry(KINDS["methods"], Fit, "chunk")

register_method = REGISTRY.register
"""Class decorator that makes a fit method known by its name, as `Registry.register`."""


def refuse_nothing(objective: Objective) -> None:
    """Refuse to search where nothing is to be found.

    Args:
        objective: With the space to be searched.

    Raises:
        ConfigError: Nothing is to be identified.
    """
    if not objective.space.names:
        raise ConfigError(
            "no parameter is to be identified, expected at least one; set identify: true for one, or fit=known"
        )


def refuse_torch(objective: Objective, name: str) -> None:
    """Refuse a law that exists only in torch, of which there is a gradient and nothing else.

    Args:
        objective: With the law.
        name: Of the method.

    Raises:
        ConfigError: It is such a law.
    """
    if objective.torch_law:
        raise ConfigError(
            f"fit={name}: {objective.torch_law} exists only in torch, expected a formula over xp; use fit=adam"
        )


def begin(objective: Objective, vector: Float[Array, "coordinates"], method: Any) -> Progress:
    """Progress before the first iteration, at this vector."""
    return Progress(
        iteration=jnp.asarray(0),
        vector=vector,
        best=vector,
        best_loss=jnp.asarray(jnp.inf, vector.dtype),
        best_iteration=jnp.asarray(-1),
        broken=jnp.asarray(False),
        converged=jnp.asarray(False),
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


def compile_chunk(fit: Fit, objective: Objective, run: Callable[..., tuple[Progress, Trace]]) -> Chunk:
    """A chunk from a JAX function (progress, count, data) to (progress, trace).

    The count is an argument and not a constant: a chunk cut short runs the same machine code. Where the law exists only
    in torch, the function is called as it is.
    """
    if objective.torch_law:
        return lambda progress, count: run(progress, jnp.asarray(count), objective.data)
    example = objective.spread((fit.start(objective), jnp.asarray(0)))
    compiled = objective.compile(run).lower(*example, objective.data).compile()

    def chunk(progress: Progress, count: int) -> tuple[Progress, Trace]:
        return objective.collect(compiled(*objective.spread((progress, jnp.asarray(count))), objective.data))

    return chunk
