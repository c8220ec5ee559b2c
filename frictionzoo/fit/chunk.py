"""Chunks of a fit's iterations, for every method: progress, and a trace of each iteration."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from frictionzoo.core.errors import ConfigError
from frictionzoo.fit.base import Evaluation, Fit, Search
from frictionzoo.fit.blocks import Blocks
from frictionzoo.fit.objective import Objective

_ARRAYS = ("iteration", "vector", "best", "best_iteration", "broken", "converged", "gradient")  # JAX's, between chunks
MOST_STATES = 1_000_000_000  # states simulated at once: some GB of memory


class Progress(NamedTuple):
    """Progress of a fit.

    Attributes:
        iteration: Number of iterations done.
        vector: Coordinates of the next iteration.
        best: Coordinates with the lowest loss so far.
        best_loss: That loss; infinite before the first.
        best_iteration: Its iteration, from 0; -1 before the first.
        broken: Whether the method cannot continue; then nothing changes any more.
        gradient: The gradient of the last iteration.
        method: State of the method, such as Adam's moments.
    """

    iteration: Int[Any, ""]
    vector: Float[Any, "coordinates"]
    best: Float[Any, "coordinates"]
    best_loss: Float[Any, ""]
    best_iteration: Int[Any, ""]
    broken: Any
    converged: Any
    gradient: Float[Any, "coordinates"]
    method: Any


class Trace(NamedTuple):
    """Loss, norm of its gradient and identified physical values, one row per iteration.

    The arrays are JAX's inside a chunk and numpy's outside. The norm is 0 where the method uses no gradient.
    """

    loss: Any
    grad_norm: Any
    params: dict[str, Any]


Chunk = Callable[[Progress, int], tuple[Progress, Trace]]
"""Function of a progress and a count that does up to `count` iterations; their rows come first in the trace."""


def begin(fit: Fit, objective: Objective) -> Progress:
    """Return the progress before the first iteration."""
    vector, method = fit.init(objective)
    vector = jnp.asarray(vector, objective.space.start.dtype)
    return Progress(
        iteration=jnp.asarray(0),
        vector=vector,
        best=vector,
        best_loss=jnp.asarray(jnp.inf, vector.dtype) if _is_traced(fit, objective) else np.asarray(np.inf),
        best_iteration=jnp.asarray(-1),
        broken=jnp.asarray(False),
        converged=jnp.asarray(False),
        gradient=jnp.zeros_like(vector),
        method=method,
    )


def search(fit: Fit, objective: Objective) -> tuple[Progress, Trace]:
    """Run a whole fit in one chunk, without record or checkpoints.

    Raises:
        ConfigError: The method cannot search this space.
    """
    fit = fit.choose(objective)
    total = fit.total(objective)
    return make_chunk(fit, objective, total)(begin(fit, objective), total)


def make_chunk(fit: Fit, objective: Objective, size: int) -> Chunk:
    """Return a function that does up to `size` iterations, compiled as far as method and model allow.

    The size of the chunks does not change a bit of the result, so an interrupted fit can resume with other chunks.

    Raises:
        ConfigError: `size` vectors at once need too much memory.
    """
    if isinstance(fit, Search):
        return _compile(_try_at_once(fit, objective, size), fit, objective)
    if _is_traced(fit, objective):
        return _compile(_try_in_turn(fit, objective, size), fit, objective)
    return _try_from_python(fit, objective, size)


def _is_traced(fit: Fit, objective: Objective) -> bool:
    """Return whether JAX compiles whole iterations; otherwise Python calls them."""
    return fit.traced and not objective.torch_law


def _advance(xp: Any, progress: Progress, seen: Evaluation, vector: Any, method: Any, converged: Any) -> Progress:
    gradient = xp.asarray(seen.gradient, progress.vector.dtype)
    following = _keep_best(xp, progress, seen.loss)._replace(
        iteration=progress.iteration + 1,
        vector=xp.asarray(vector, progress.vector.dtype),
        broken=progress.broken | seen.lost,
        converged=xp.asarray(converged),
        gradient=gradient,
        method=method,
    )
    # Once broken, nothing changes but the gradient, which shows the cause.
    kept = jax.tree.map(lambda old, new: xp.where(following.broken, old, new), progress, following)
    return kept._replace(broken=following.broken, gradient=xp.where(progress.broken, progress.gradient, gradient))


def _keep_best(xp: Any, progress: Progress, loss: Any) -> Progress:
    better = loss < progress.best_loss
    return progress._replace(
        best=xp.where(better, progress.vector, progress.best),
        best_loss=xp.where(better, loss, progress.best_loss),
        best_iteration=xp.where(better, progress.iteration, progress.best_iteration),
    )


def _try_in_turn(fit: Fit, objective: Objective, size: int) -> Callable[..., tuple[Progress, Trace]]:
    def run(progress: Progress, count: Array, data: Blocks) -> tuple[Progress, Trace]:
        empty = jnp.zeros(size, progress.vector.dtype)
        shapes = jax.eval_shape(objective.space.identified, progress.vector)
        params = {name: jnp.zeros((size, *shape.shape), shape.dtype) for name, shape in shapes.items()}

        def body(row: Array, carry: tuple[Progress, Trace]) -> tuple[Progress, Trace]:
            progress, trace = carry
            evaluation, vector, method = fit.step(objective, progress.vector, progress.method, data)
            identified = objective.space.identified(progress.vector)
            written = Trace(
                trace.loss.at[row].set(evaluation.loss),
                trace.grad_norm.at[row].set(jnp.linalg.norm(evaluation.gradient)),
                {name: values.at[row].set(identified[name]) for name, values in trace.params.items()},
            )
            return _advance(jnp, progress, evaluation, vector, method, fit.done(method)), written

        return jax.lax.fori_loop(0, count, body, (progress, Trace(empty, empty, params)))

    return run


def _try_at_once(fit: Search, objective: Objective, size: int) -> Callable[..., tuple[Progress, Trace]]:
    states = size * objective.data.qpos[0].size
    if states > MOST_STATES:
        raise ConfigError(
            f"loop.chunk={size}: {states:g} states simulated at once, expected at most {MOST_STATES:g}; lower it"
        )

    def run(progress: Progress, count: Array, data: Blocks) -> tuple[Progress, Trace]:
        rows = jnp.arange(size)
        vectors = jax.vmap(lambda row: fit.candidate(objective, progress.iteration + row))(rows)
        losses = jax.vmap(objective.loss, in_axes=(0, None))(vectors, data)
        candidates = jnp.where(jnp.isfinite(losses) & (rows < count), losses, jnp.inf)
        row = jnp.argmin(candidates)
        tried = progress._replace(vector=vectors[row], iteration=progress.iteration + row)
        iteration = progress.iteration + count
        following = _keep_best(jnp, tried, candidates[row])._replace(
            iteration=iteration, vector=fit.candidate(objective, iteration), method=iteration
        )
        return following, Trace(losses, jnp.zeros_like(losses), jax.vmap(objective.space.identified)(vectors))

    return run


def _compile(run: Callable[..., tuple[Progress, Trace]], fit: Fit, objective: Objective) -> Chunk:
    # The count is an argument, not a constant, so that a shorter chunk runs the same machine code.
    example = objective.spread((begin(fit, objective), jnp.asarray(0)))
    compiled = objective.compile(run).lower(*example, objective.data).compile()

    def chunk(progress: Progress, count: int) -> tuple[Progress, Trace]:
        return objective.collect(compiled(*objective.spread((progress, jnp.asarray(count))), objective.data))

    return chunk


def _try_from_python(fit: Fit, objective: Objective, size: int) -> Chunk:
    """Evaluate vectors one after the other, in a Python loop, until the method has converged or cannot continue."""
    fit.prepare(objective)
    identified = jax.vmap(objective.space.identified)  # not compiled: every fit reuses its few operations
    rows = np.zeros((size, *objective.space.start.shape), objective.space.start.dtype)

    def chunk(progress: Progress, count: int) -> tuple[Progress, Trace]:
        vectors, losses, norms = rows.copy(), np.zeros(size), np.zeros(size)
        for row in range(count):
            tried = jnp.asarray(progress.vector)
            evaluation, vector, method = fit.step(objective, tried, progress.method, objective.data)
            vectors[row], losses[row] = progress.vector, evaluation.loss
            norms[row] = np.linalg.norm(np.asarray(evaluation.gradient))
            progress = _advance(np, progress, evaluation, vector, method, fit.done(method))
            if progress.broken or progress.converged:
                break
        # The best loss keeps the method's precision, so that the lower of two close losses wins.
        arrays = {name: jnp.asarray(getattr(progress, name)) for name in _ARRAYS}
        return progress._replace(**arrays), Trace(losses, norms, dict(identified(jnp.asarray(vectors))))

    return chunk
