"""Search for the command of maximal information: a Fourier series with coefficients optimised within limits."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from frictionzoo.bench.limits import KINDS, Limits
from frictionzoo.core.errors import ConfigError, closest, refuse_outside
from frictionzoo.core.telling import tell, tell_progress
from frictionzoo.design.information import Information
from frictionzoo.design.series import Series
from frictionzoo.design.task import Task

CRITERIA = ("determinant", "worst")
_BEGIN = 0.8  # share of the limits used by the first series
_STEP = 0.1  # step size of Adam, as a share of the coefficients' root mean square
_SPECTRA = (0.5, 0.0, 1.0)  # exponents of the decay of velocity with frequency, for the starting points in turn
_OVER, _MEAN = 4.0, 100.0  # penalty weights of the largest excess and of the mean square excess
_SHARP = 20.0  # sharpness of the smooth maximum
_TRIALS = 20  # largest number of scalings
_LEAST = 0.01  # share of the velocity limit below which the drive counts as not moving


@dataclass(frozen=True)
class SearchOptions:
    """Options of the search.

    Attributes:
        criterion: `determinant`: product of all intervals, with correlations; `worst`: the widest interval.
        starts: Number of random starting points; the best result counts.
        iterations: Steps from each starting point.
        seed: Seed of the random series.

    Raises:
        ConfigError: An option is invalid.
    """

    criterion: str = "determinant"
    starts: int = 3
    iterations: int = 200
    seed: int = 0

    def __post_init__(self) -> None:
        if self.criterion not in CRITERIA:
            raise ConfigError(f"criterion={self.criterion}: unknown; {closest(self.criterion, CRITERIA)}")
        for name, low, high in (("starts", 1, 1000), ("iterations", 1, 1_000_000), ("seed", 0, 2**63 - 1)):
            refuse_outside(name, getattr(self, name), low, high)


class Optimum(NamedTuple):
    """Result of the search.

    Attributes:
        coefficients: Coefficients of the best series.
        values: Lowest loss from each starting point: `score` plus penalties for the limits; NaN if it diverged.
        first: Loss at each starting point.
    """

    coefficients: Float[np.ndarray, "nv coefficients"]
    values: Float[np.ndarray, "starts"]
    first: Float[np.ndarray, "starts"]


def design(
    task: Task, series: Series, limits: Limits, search: SearchOptions, reference: Float[np.ndarray, "own"]
) -> Optimum:
    """Optimise the coefficients of a series with Adam and exact gradients, from several starting points in parallel.

    Limits are soft penalties here; `scale_within` enforces them. `series` comes from `Series.shortened`. `reference` is
    half of each reference interval, in the optimiser's coordinates, for the criterion `worst`.

    Raises:
        ConfigError: The search diverges from all starting points.
    """
    evaluate = task.drive.rollout.compile(_assess(task, series, limits, search.criterion, reference))
    tell("design: compiling, starting amplitudes")
    begin = _draw(series, len(limits.home), search)
    for _ in range(3):  # the torque is not proportional to the amplitude
        _, (_, used) = evaluate(begin, np.ones(len(begin)))[0]
        size = np.nan_to_num(np.asarray(used).max(axis=1), nan=10.0)
        begin = begin * np.minimum(_BEGIN / size, 2.0)[:, None, None]
    size = np.sqrt(np.square(begin).mean(axis=(1, 2)))
    optimiser = optax.adam(optax.cosine_decay_schedule(_STEP, search.iterations))
    vectors = jnp.asarray(begin / size[:, None, None])
    state = optimiser.init(vectors)
    first, best, optima = None, jnp.full(len(vectors), jnp.inf), vectors
    tell("design: search")
    for iteration in range(search.iterations):
        tell_progress(f"iteration {iteration} of {search.iterations}")
        (_, (values, _)), gradient = evaluate(vectors, size)
        better = values < best  # False for NaN
        best, optima = jnp.where(better, values, best), jnp.where(better[:, None, None], vectors, optima)
        first = values if first is None else first
        updates, state = optimiser.update(jnp.nan_to_num(gradient, posinf=0.0, neginf=0.0), state)
        vectors = vectors + cast(Array, updates)
    losses, initial = (np.asarray(value, np.float64) for value in (best, first))
    if not np.isfinite(losses).any():
        raise ConfigError("no command moves this drive within these limits; raise them, or check the bench")
    chosen = int(np.nanargmin(losses))
    return Optimum(np.asarray(optima)[chosen] * size[chosen], np.where(np.isfinite(losses), losses, np.nan), initial)


def _draw(series: Series, nv: int, search: SearchOptions) -> Float[np.ndarray, "starts nv coefficients"]:
    """Draw random series whose velocity spectra decay differently with frequency."""
    rng = np.random.default_rng(search.seed)
    falling = [np.tile(series.frequencies ** -_SPECTRA[i % len(_SPECTRA)], 2) for i in range(search.starts)]
    draws = rng.normal(size=(search.starts, nv, 2 * series.harmonics))
    return 0.1 * draws * np.array(falling)[:, None]


def _assess(
    task: Task, series: Series, limits: Limits, criterion: str, reference: Float[np.ndarray, "own"]
) -> Callable[..., Any]:
    """Return the function that evaluates all series: losses, gradient, and used shares of the limits."""

    def total(vectors: Array, size: Array) -> tuple[Array, tuple[Array, Array]]:
        ctrl, speed = series.command(jnp, vectors * size[:, None, None], limits.home)
        # Of a shortened series only the period after the ramp counts for the information.
        motion, information = task.see(ctrl, speed, limits.home, 0 if series.ends else series.ramp)
        shares = jnp.moveaxis(motion.shares(jnp, limits), 1, 0).reshape(len(vectors), len(KINDS), -1)
        excess = jnp.maximum(shares - 1, 0)
        penalty = _OVER * excess.max(axis=2).sum(axis=1) + _MEAN * jnp.square(excess).mean(axis=2).sum(axis=1)
        values = score(information, criterion, reference) + penalty
        return jnp.sum(jnp.where(jnp.isfinite(values), values, 0.0)), (values, shares.max(axis=2))

    return jax.value_and_grad(total, has_aux=True)


def score(information: Information, criterion: str, reference: Float[Any, "coordinates"]) -> Float[Array, "batch"]:
    """Return the criterion for each recording: a mean or a smooth maximum of the logarithms of half intervals.

    `determinant` uses the full covariance and so counts correlations between parameters.
    """
    covariance = information.covariance
    if criterion == "determinant":
        return jnp.linalg.slogdet(covariance)[1] / (2 * covariance.shape[1])
    half = jnp.log(jnp.diagonal(covariance, axis1=1, axis2=2)) / 2 - jnp.log(reference)
    return jax.nn.logsumexp(_SHARP * half, axis=1) / _SHARP


def scale_within(
    task: Task, series: Series, limits: Limits, coefficients: Float[np.ndarray, "nv coefficients"]
) -> tuple[Float[np.ndarray, "nv coefficients"], Information]:
    """Scale the series down until the whole command and its motion keep all limits; return it and its information.

    Raises:
        ConfigError: No scale keeps the limits, or the drive does not move with it.
    """
    simulate = task.drive.rollout.compile(lambda ctrl, speed: task.see(ctrl, speed, limits.home))
    factor = 1.0
    for _ in range(_TRIALS):
        commands = (part[None] for part in series.command(np, factor * coefficients, limits.home))
        motion, information = jax.tree.map(np.asarray, simulate(*commands))
        used = float(motion.shares(np, limits).max())
        if used <= 1:
            break
        # Some friction does not depend on the amplitude, which must therefore fall by more than the excess.
        factor *= min(used**-1.2, 0.999) if np.isfinite(used) else 0.5
    if not used <= 1 or np.abs(motion.qvel).max() < _LEAST * limits.velocity.max():
        raise ConfigError(
            "the drive does not move within these limits: holding it and friction need the whole torque; raise it"
        )
    return factor * coefficients, information
