"""The posterior of what was identified, by NUTS: the joint distribution with the shape that the data give it."""

import importlib.util
import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Bool, Float, Int

from frictionzoo.core.errors import ConfigError, FitError
from frictionzoo.fit.base import Fit
from frictionzoo.fit.blocks import Blocks
from frictionzoo.fit.covariance import Covariance
from frictionzoo.fit.objective import Objective

_log = logging.getLogger(__name__)

MOST_COORDINATES = 20
"""Coordinates up to which it is sampled: each draw takes tens of gradients, and each gradient a tangent for each."""
CHAINS = 4
WARMUP = 300
"""Steps of each chain in which the sampler finds its step size and scales; they are no draws."""
FEWEST = 250
"""Draws of each chain at least, by which it is judged whether the chains agree."""
LARGEST_RHAT = 1.05
LEAST_EFFECTIVE = 100.0
_LEFT = 1.0  # standard deviations from the best vector to the minimum, from which on a fit has not converged
_FAR = 100.0  # standard deviations from the middle up to which is sampled where bounds are farther
_FLAT = 1.8  # standard deviation of the logit of a number that may be anywhere between 0 and 1
_SINGULAR = 1e-8  # eigenvalue of a correlation matrix below which it has no inverse
_STEP = 0.5  # first step size, in standard deviations


@dataclass(frozen=True, eq=False)
class Fitted:
    """What a fit minimised and where it ended, with the data; in memory only: a pickle or deep copy of it is None.

    Attributes:
        objective: What was minimised.
        vector: The best one.
        fit: How it was found.
    """

    objective: Objective
    vector: Float[np.ndarray, "coordinates"]
    fit: Fit

    def __reduce__(self) -> tuple[Any, ...]:
        return type(None), ()  # compiled functions cannot be copied


@dataclass(frozen=True, eq=False)
class Chains:
    """Draws of the posterior, and whether the chains that made them agree.

    Attributes:
        vectors: Draws; a coordinate that was not sampled has its best value.
        rhat: By the label of each sampled coordinate, rank-normalised split R-hat: 1 where the chains agree.
        effective: By the same labels, the bulk effective sample size of all draws, of which `vectors` are some.
        divergences: At how many draws the sampler's steps went astray.
    """

    vectors: Float[np.ndarray, "count coordinates"]
    rhat: dict[str, float]
    effective: dict[str, float]
    divergences: int


def draw_posterior(fitted: Fitted, covariance: Covariance, count: int, seed: int) -> Chains:
    """Draw from the posterior of the coordinates that have an interval; the others keep their best value.

    p(x) ~ (1 + 2 D / n)^(-(n + k) / 2) within the bounds, 0 outside
    D = c (F(y) - F(x_0)) / 2,  y = x_0 + C (x - m),  C (c H) C = V^-1,  det C = 1

        x    the k coordinates, in each of which the prior is flat between its bounds
        F    the objective; x_0 its best vector, H half its second derivative there
        m, V, n  centre, matrix and degrees of freedom of the multivariate Student's t of `estimate_uncertainty`
        c    makes of the mean square a log-likelihood of as many independent residuals as there seem to be
        C    makes (c H)^-1 the sandwich covariance V; the identity where they are alike

    Where F is a parabola, p is that Student's t, cut off at the bounds; elsewhere it is as skewed and as curved as F. A
    sum of squares of correlated residuals, taken for a log-likelihood, would give a p several times too narrow, as
    sigma^2 H^-1 is. c adjusts its magnitude, and C what is left of its curvature; of the matrices that do so, it is the
    one that is symmetric in units of standard deviations. y is brought into the bounds. That there is no exponential of
    -D comes from V, which is known by n degrees of freedom only: the chi-squared number by whose root
    `Covariance.draw` divides is integrated out.

    Sampled is the logit of where x is between its bounds, by `CHAINS` sequences of NUTS that begin around m, of
    `WARMUP` steps and `FEWEST` draws or more. As in the intervals, a coordinate that ended at a bound counts as known;
    so does one that only has an effect together with others.

    Args:
        fitted: What was minimised, and where it ended.
        covariance: Of the coordinates that are sampled.
        count: Draws.
        seed: Of the draws.

    Raises:
        ConfigError: blackjax is not installed, there are more than `MOST_COORDINATES` coordinates, or the fit has a
            loss without rollouts.
        FitError: The fit has not converged, there are fewer stretches of data than coordinates, or chains disagree.

    Source: M. Ribatet, D. Cooley, A. Davison, "Bayesian inference from composite likelihoods, with an application to
    spatial extremes", 2012, for c and C, their magnitude and curvature adjustments; B. Shaby, "The open-faced sandwich
    adjustment for MCMC using estimating functions", 2014, does the same to draws; K. Lange, R. Little, J. Taylor,
    "Robust statistical modeling using the t distribution", 1989, for the t; M. Hoffman, A. Gelman, "The No-U-Turn
    sampler", 2014; A. Vehtari et al., "Rank-normalization, folding, and localization: an improved R-hat", 2021.
    """
    target = _Target.of(fitted, covariance)
    draws = max(FEWEST, -(-count // CHAINS))
    found, diverged = _sample(fitted.objective, target, draws, seed)
    rhat, effective = (dict(zip(covariance.labels, values, strict=True)) for values in _diagnose(found))
    chains = Chains(_pick(fitted.vector, target.own, found, count), rhat, effective, int(diverged.sum()))
    _refuse_disagreement(chains, found.shape[0] * draws)
    return chains


@dataclass(frozen=True, eq=False)
class _Target:
    """The posterior of the coordinates `own`, as a function of numbers that have no bounds and about unit spread.

    Attributes:
        own: Which of the objective's coordinates they are.
        best: The best vector, of all coordinates.
        least: The objective there.
        centre: Middle of each one's interval.
        low: From where each is sampled.
        high: Up to where.
        freedom: Degrees of freedom.
        magnitude: c.
        curvature: C.
        origin: Logit of where the centre is between the bounds.
        spread: From unit spread to logits: a factor of their covariance.
    """

    own: Int[np.ndarray, "own"]
    best: Float[np.ndarray, "coordinates"]
    least: float
    centre: Float[np.ndarray, "own"]
    low: Float[np.ndarray, "own"]
    high: Float[np.ndarray, "own"]
    freedom: float
    magnitude: float
    curvature: Float[np.ndarray, "own own"]
    origin: Float[np.ndarray, "own"]
    spread: Float[np.ndarray, "own own"]

    @classmethod
    def of(cls, fitted: Fitted, covariance: Covariance) -> "_Target":
        """The target for what was fitted; see `draw_posterior` for what is refused."""
        space, best = fitted.objective.space, np.asarray(fitted.vector, np.float64)
        _refuse(fitted, covariance)
        own = np.array([space.labels.index(label) for label in covariance.labels])
        equations, _ = fitted.objective.compile_scores()(fitted.vector)
        hessian, gradient = equations.hessian[np.ix_(own, own)], equations.gradient[own]
        magnitude, curvature = adjust(hessian, covariance.matrix)
        left = float(np.sqrt(magnitude * gradient @ np.linalg.solve(hessian, gradient)))
        if not left < _LEFT:
            raise FitError(
                f"the fit ended {left:.2g} standard deviations from its minimum, expected less than {_LEFT:g} for a "
                "posterior around it; fit with method lm, or more iterations"
            )
        deviation = np.sqrt(np.diag(covariance.matrix))
        low = np.maximum(np.asarray(space.low, np.float64)[own], covariance.centre - _FAR * deviation)
        high = np.minimum(np.asarray(space.high, np.float64)[own], covariance.centre + _FAR * deviation)
        share = np.clip((covariance.centre - low) / (high - low), 0.01, 0.99)
        of_logit = np.minimum(deviation / (high - low) / (share * (1 - share)), _FLAT)
        spread = np.linalg.cholesky(covariance.matrix / np.outer(deviation, deviation)) * of_logit[:, None]
        middle, known = covariance.centre, (magnitude, curvature, np.log(share / (1 - share)), spread)
        return cls(own, best, equations.loss, middle, low, high, covariance.freedom, *known)

    def place(self, free: Float[Array, "own"]) -> Float[Array, "own"]:
        """The coordinates of a point."""
        logit = self.origin + jnp.asarray(self.spread, free.dtype) @ free
        return jnp.asarray(self.low + (self.high - self.low) * jax.nn.sigmoid(logit), free.dtype)

    def log_density(self, free: Float[Array, "own"], loss: Callable[[Array], Array]) -> Float[Array, ""]:
        """The posterior's logarithm but for a constant, of the objective `loss` as a function of a vector."""
        logit = self.origin + jnp.asarray(self.spread, free.dtype) @ free
        moved = jnp.asarray(self.curvature, free.dtype) @ (self.place(free) - self.centre).astype(free.dtype)
        asked = jnp.clip(self.best[self.own] + moved, self.low, self.high).astype(free.dtype)
        excess = self.magnitude / 2 * (loss(jnp.asarray(self.best, free.dtype).at[self.own].set(asked)) - self.least)
        power = (self.freedom + len(self.own)) / 2
        tail = -power * jnp.log1p(jnp.maximum(2 * excess / self.freedom, -0.5))
        within = jax.nn.log_sigmoid(logit) + jax.nn.log_sigmoid(-logit)  # how fast the place moves with the logit
        return jnp.where(jnp.isfinite(excess), tail, -jnp.inf) + within.sum()


def adjust(
    hessian: Float[np.ndarray, "own own"], covariance: Float[np.ndarray, "own own"]
) -> tuple[float, Float[np.ndarray, "own own"]]:
    """The number c and the matrix C of determinant 1 with C' (c hessian) C = covariance^-1.

    Raises:
        FitError: The covariance has no inverse, or the Hessian is not positive definite.
    """
    deviation = np.sqrt(np.diag(covariance))
    unit = np.outer(deviation, deviation)
    correlation, curved = covariance / unit, hessian * unit
    if np.linalg.eigvalsh(correlation)[0] < _SINGULAR:
        raise FitError(
            f"the covariance of {len(deviation)} coordinates has no inverse, expected more stretches of data than "
            "coordinates; give longer recordings, or draw with sample"
        )
    if np.linalg.eigvalsh(curved)[0] <= 0:
        raise FitError(
            "the objective has no minimum at the result, expected a positive curvature; fit again, or with loss.robust"
            "=none"
        )
    wanted = np.linalg.inv(correlation)
    size = np.exp((np.linalg.slogdet(wanted)[1] - np.linalg.slogdet(curved)[1]) / len(deviation))
    root = np.real(scipy.linalg.sqrtm(size * curved))
    inverse = np.linalg.inv(root)
    symmetric = inverse @ np.real(scipy.linalg.sqrtm(root @ wanted @ root)) @ inverse
    return float(size), symmetric * deviation[:, None] / deviation


def _refuse(fitted: Fitted, covariance: Covariance) -> None:
    if importlib.util.find_spec("blackjax") is None:
        raise ConfigError(
            'posterior: blackjax not found, expected an installed package; pip install "frictionzoo[posterior]"'
        )
    if type(fitted.fit).compile_scores is not Fit.compile_scores:
        raise ConfigError(
            f"fit={fitted.fit.name}: its loss is a torque error, but a posterior needs rollouts; fit "
            "with method lm, or draw with sample"
        )
    if len(covariance.labels) > MOST_COORDINATES:
        raise ConfigError(
            f"{len(covariance.labels)} numbers were identified, expected at most {MOST_COORDINATES} for a posterior; "
            "draw with sample, or set some to known values"
        )


def _sample(
    objective: Objective, target: _Target, draws: int, seed: int
) -> tuple[Float[np.ndarray, "chains draws own"], Bool[np.ndarray, "chains draws"]]:
    """All draws, and at which of them the sampler's steps went astray."""
    import blackjax  # an extra

    of_all, dtype = objective.value_and_grad("auto"), objective.space.start.dtype

    def chain(key: Array, start: Array, data: Blocks) -> tuple[Array, Array]:
        def loss(vector: Array) -> Array:
            # The objective's own derivative, in place of one through its rollouts a second time.
            value, gradient = jax.lax.stop_gradient(of_all(jax.lax.stop_gradient(vector), data))
            return value + gradient @ (vector - jax.lax.stop_gradient(vector))

        def log_density(free: Array) -> Array:
            return target.log_density(free, loss)

        adaptation: Any = blackjax.window_adaptation(
            blackjax.nuts, log_density, initial_step_size=_STEP, adaptation_info_fn=lambda *told: None
        )
        warm, sampling = jax.random.split(key)
        (state, found), _ = adaptation.run(warm, start, num_steps=WARMUP)
        step = blackjax.nuts(log_density, **found).step

        def draw(state: Any, key: Array) -> tuple[Any, tuple[Array, Array]]:
            state, told = step(key, state)
            return state, (target.place(state.position), told.is_divergent)

        return jax.lax.scan(draw, state, jax.random.split(sampling, draws))[1]

    run = objective.compile(chain, forward=True)
    starts = np.random.default_rng(seed).standard_normal((CHAINS, len(target.own)))
    begun = zip(jax.random.split(jax.random.key(seed), CHAINS), starts, strict=True)
    parts = [run(*objective.spread((key, jnp.asarray(at, dtype))), objective.data) for key, at in begun]
    places, diverged = (np.stack([np.asarray(part) for part in own]) for own in zip(*parts, strict=True))
    return places.astype(np.float64), diverged


def _diagnose(found: Float[np.ndarray, "chains draws own"]) -> tuple[list[float], list[float]]:
    """R-hat and effective sample size of each coordinate."""
    from blackjax.diagnostics import ess_bulk, rhat

    both = jax.jit(lambda draws: (rhat(draws), ess_bulk(draws)))(found)  # operation by operation it takes seconds
    return np.atleast_1d(both[0]).tolist(), np.atleast_1d(both[1]).tolist()


def _pick(
    best: Float[np.ndarray, "coordinates"],
    own: Int[np.ndarray, "own"],
    found: Float[np.ndarray, "chains draws own"],
    count: int,
) -> Float[np.ndarray, "count coordinates"]:
    """So many of the draws, evenly from all chains."""
    vectors = np.repeat(np.asarray(best, np.float64)[None], count, axis=0)
    every = found.reshape(-1, len(own))
    vectors[:, own] = every[np.linspace(0, len(every) - 1, count).round().astype(int)]
    return vectors


def _refuse_disagreement(chains: Chains, draws: int) -> None:
    # NaN, of chains that never moved, is worst.
    worst = max(chains.rhat, key=lambda label: np.nan_to_num(chains.rhat[label], nan=np.inf))
    fewest = min(chains.effective, key=lambda label: np.nan_to_num(chains.effective[label], nan=-np.inf))
    rhat, effective = chains.rhat[worst], chains.effective[fewest]
    told = (
        f"posterior of {draws} draws: R-hat up to {rhat:.3g} ({worst}), effective sample size down to {effective:.0f} "
        f"({fewest}), {chains.divergences} divergences"
    )
    if not (rhat < LARGEST_RHAT and effective > LEAST_EFFECTIVE):
        raise FitError(
            f"{told}; expected R-hat below {LARGEST_RHAT:g} and a size above {LEAST_EFFECTIVE:g}: the chains do not "
            "agree; ask for more draws, or set what the data do not determine to known values"
        )
    if chains.divergences:
        _log.warning("%s; draws near a divergence may be missing", told)
    else:
        _log.info("%s", told)
