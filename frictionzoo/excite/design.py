"""The command of which a recording says the most: a series whose coefficients are optimised within limits."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from frictionzoo.core.errors import ConfigError, closest, refuse_outside
from frictionzoo.excite.information import Information
from frictionzoo.excite.limits import KINDS, Limits
from frictionzoo.excite.series import Series
from frictionzoo.excite.task import Seen, Task

CRITERIA = ("determinant", "worst")
_BEGIN = 0.8  # share of the limits with which a search begins
_STEP = 0.1  # of Adam, as a share of the coefficients' root mean square
_SPECTRA = (0.5, 0.0, 1.0)  # exponents by which velocities fall with frequency where searches begin, in turn
_OVER, _MEAN = 4.0, 100.0  # what the farthest excess costs, and what the mean square of all does
_SHARP = 20.0  # of the smooth maximum
_TRIALS = 20  # of scaling
_LEAST = 0.01  # share of the velocity's limit below which a drive does not move


@dataclass(frozen=True)
class Search:
    """How the command is searched.

    Attributes:
        criterion: `determinant`: the product of all intervals, correlations counted; `worst`: the widest one.
        starts: Searches from random series, of which the best counts.
        iterations: Steps of each.
        seed: Of the random series.

    Raises:
        ConfigError: One is impossible.
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


class Found(NamedTuple):
    """What the search ended with.

    Attributes:
        coefficients: The best series'.
        values: Criterion of each start, the mean logarithm of half an interval; NaN of one that diverged.
        first: The same where each began.
    """

    coefficients: Float[np.ndarray, "nv coefficients"]
    values: Float[np.ndarray, "starts"]
    first: Float[np.ndarray, "starts"]


def design(task: Task, series: Series, limits: Limits, search: Search, reference: Float[np.ndarray, "own"]) -> Found:
    """Optimise the coefficients of a series by Adam on exact gradients, from several starts side by side.

    Limits are penalties here: `scale_within` holds them.

    Args:
        task: The drive.
        series: As `Series.shortened` has it.
        limits: What the command and the motion have to keep.
        search: How.
        reference: Half of each interval, in the optimiser's coordinates, over which `worst` counts.

    Raises:
        ConfigError: No start leads anywhere.
    """
    look = task.drive.rollout.compile(_assess(task, series, limits, search.criterion, reference))
    begin = _draw(series, len(limits.home), search)
    for _ in range(3):  # the torque does not follow the amplitude in proportion
        _, (_, used) = look(begin, np.ones(len(begin)))[0]
        size = np.nan_to_num(np.asarray(used).max(axis=1), nan=10.0)
        begin = begin * np.minimum(_BEGIN / size, 2.0)[:, None, None]
    size = np.sqrt(np.square(begin).mean(axis=(1, 2)))
    optimiser = optax.adam(optax.cosine_decay_schedule(_STEP, search.iterations))
    vectors = jnp.asarray(begin / size[:, None, None])
    state = optimiser.init(vectors)
    course, kept = [], vectors
    best = jnp.full(len(vectors), jnp.inf)
    for _ in range(search.iterations):
        (_, (values, _)), gradient = look(vectors, size)
        better = values < best  # of NaN, False
        best, kept = jnp.where(better, values, best), jnp.where(better[:, None, None], vectors, kept)
        course.append(values)
        updates, state = optimiser.update(jnp.nan_to_num(gradient, posinf=0.0, neginf=0.0), state)
        vectors = vectors + cast(Array, updates)
    found, began = (np.asarray(value, np.float64) for value in (best, course[0]))
    if not np.isfinite(found).any():
        raise ConfigError("no command moves this drive within these limits; raise them, or doubt the bench")
    chosen = int(np.nanargmin(found))
    return Found(np.asarray(kept)[chosen] * size[chosen], np.where(np.isfinite(found), found, np.nan), began)


def _draw(series: Series, nv: int, search: Search) -> Float[np.ndarray, "starts nv coefficients"]:
    """Random series, whose velocities fall with frequency in different ways."""
    rng = np.random.default_rng(search.seed)
    falling = [np.tile(series.frequencies ** -_SPECTRA[i % len(_SPECTRA)], 2) for i in range(search.starts)]
    draws = rng.normal(size=(search.starts, nv, 2 * series.harmonics))
    return 0.1 * draws * np.array(falling)[:, None]


def _assess(
    task: Task, series: Series, limits: Limits, criterion: str, reference: Float[np.ndarray, "own"]
) -> Callable[..., Any]:
    """The function of vectors and their sizes that has the value and its gradient, each start's, and shares used."""

    def total(vectors: Array, size: Array) -> tuple[Array, tuple[Array, Array]]:
        ctrl, speed = series.command(jnp, vectors * size[:, None, None], limits.home)
        motion, information = task.see(ctrl, speed, limits.home, series.steady)
        shares = jnp.moveaxis(motion.shares(jnp, limits), 1, 0).reshape(len(vectors), len(KINDS), -1)
        excess = jnp.maximum(shares - 1, 0)
        penalty = _OVER * excess.max(axis=2).sum(axis=1) + _MEAN * jnp.square(excess).mean(axis=2).sum(axis=1)
        values = score(information, criterion, reference) + penalty
        return jnp.sum(jnp.where(jnp.isfinite(values), values, 0.0)), (values, shares.max(axis=2))

    return jax.value_and_grad(total, has_aux=True)


def score(information: Information, criterion: str, reference: Float[Any, "coordinates"]) -> Float[Array, "batch"]:
    """What is minimised, of each recording: a mean or a smooth maximum of the logarithms of intervals.

    The determinant's is that of the covariance, so that parameters that cannot be told apart count.
    """
    covariance = information.covariance
    if criterion == "determinant":
        return jnp.linalg.slogdet(covariance)[1] / (2 * covariance.shape[1])
    half = jnp.log(jnp.diagonal(covariance, axis1=1, axis2=2)) / 2 - jnp.log(reference)
    return jax.nn.logsumexp(_SHARP * half, axis=1) / _SHARP


def scale_within(
    task: Task, series: Series, limits: Limits, coefficients: Float[np.ndarray, "nv coefficients"]
) -> tuple[Float[np.ndarray, "nv coefficients"], Seen]:
    """The same series, smaller where it has to be, so that all limits are kept along the whole command and its motion.

    Raises:
        ConfigError: None is found, or the drive does not move then.
    """
    see = task.drive.rollout.compile(lambda ctrl, speed: task.see(ctrl, speed, limits.home))
    factor = 1.0
    for _ in range(_TRIALS):
        commands = (part[None] for part in series.command(np, factor * coefficients, limits.home))
        seen = jax.tree.map(np.asarray, see(*commands))
        used = float(seen.motion.shares(np, limits).max())
        if used <= 1:
            break
        # Friction takes its part of the torque whatever the amplitude, which has to fall by more than the excess then.
        factor *= min(used**-1.2, 0.999) if np.isfinite(used) else 0.5
    if not used <= 1 or np.abs(seen.motion.qvel).max() < _LEAST * limits.velocity.max():
        raise ConfigError(
            "the drive does not move within these limits: what holds it and its friction take all of torque; raise it"
        )
    return factor * coefficients, seen
