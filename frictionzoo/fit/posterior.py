"""Posterior of the identified parameters, sampled by NUTS."""

import importlib.util
import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Bool, Float

from frictionzoo.core.errors import ConfigError, FitError
from frictionzoo.fit.base import Fit
from frictionzoo.fit.blocks import Blocks
from frictionzoo.fit.objective import Objective
from frictionzoo.fit.uncertainty import Covariance

_log = logging.getLogger(__name__)

MOST_COORDINATES = 20
"""Largest number of coordinates to sample: a draw takes tens of gradients, a gradient one tangent per coordinate."""
CHAINS = 4
WARMUP = 300
"""Steps of each chain in which the sampler adapts its step size and scales; they are discarded."""
FEWEST = 250
"""Least number of draws of each chain, for the check whether the chains agree."""
LARGEST_RHAT = 1.05
LEAST_EFFECTIVE = 100.0
_LEFT = 1.0  # standard deviations from the best vector to the minimum above which a fit has not converged
_FAR = 100.0  # standard deviations from the centre within which to sample if bounds are farther away
_FLAT = 1.8  # standard deviation of the logit of a number that is uniform between 0 and 1
_SINGULAR = 1e-8  # eigenvalue of a correlation matrix below which it counts as singular
_STEP = 0.5  # initial step size, in standard deviations


@dataclass(frozen=True, eq=False)
class Fitted:
    """Objective of a fit, its best vector and the method; in memory only: a pickle or deep copy of it is None."""

    objective: Objective
    vector: Float[np.ndarray, "coordinates"]
    fit: Fit

    def __reduce__(self) -> tuple[Any, ...]:
        return type(None), ()  # compiled functions cannot be copied


@dataclass(frozen=True, eq=False)
class Chains:
    """Draws from the posterior, with convergence diagnostics of the chains.

    Attributes:
        vectors: Some of the draws; a coordinate that was not sampled has its best value.
        rhat: Rank-normalised split R-hat of each sampled coordinate by label; 1 if the chains agree.
        effective: Bulk effective sample size of all draws, by the same labels.
        divergences: Number of divergent draws.
    """

    vectors: Float[np.ndarray, "count coordinates"]
    rhat: dict[str, float]
    effective: dict[str, float]
    divergences: int


def draw_posterior(fitted: Fitted, covariance: Covariance, count: int, seed: int) -> Chains:
    """Draw from the posterior of the coordinates that have an interval; the others keep their best value.

    p(x) ~ (1 + 2 D / n)^(-(n + k) / 2) within the bounds, 0 outside,
    D = c (F(y) - F(x_0)) / 2,  y = x_0 + C (x - m),  C (c H) C = V^-1,  det C = 1

        x    the k coordinates, each with a flat prior between its bounds
        F    the objective; x_0 its best vector, H half its second derivative there
        m, V, n  centre, matrix and degrees of freedom of the multivariate Student's t of `estimate_uncertainty`
        c    scales the mean square to a log-likelihood with an effective number of independent residuals
        C    makes (c H)^-1 equal to the sandwich covariance V; the identity where they agree already

    Where F is quadratic, p is that Student's t, truncated at the bounds; elsewhere p has the skewness and curvature of
    F. Residuals are correlated: their sum of squares as log-likelihood would make p several times too narrow, like
    sigma^2 H^-1. c adjusts its magnitude and C its remaining curvature; C is the solution that is symmetric in units of
    standard deviations. y is clipped to the bounds. The power replaces exp(-D) because V has n degrees of freedom only:
    it integrates out the chi-squared number by whose root `Covariance.draw` divides.

    `CHAINS` chains of NUTS sample the logit of x between its bounds. They start around m and take `WARMUP` steps and at
    least `FEWEST` draws. As in the intervals, a coordinate that ended at a bound counts as known; so does one that has
    an effect only in combination with others.

    Raises:
        ConfigError: blackjax is not installed, there are more than `MOST_COORDINATES` coordinates, or the fit has a
            loss without rollouts.
        FitError: The fit has not converged, the objective has no minimum at its end, there are too few stretches of
            data for the coordinates, or the chains disagree.

    Source: M. Ribatet, D. Cooley, A. Davison, "Bayesian inference from composite likelihoods, with an application to
    spatial extremes", 2012, for c and C, their magnitude and curvature adjustments; B. Shaby, "The open-faced sandwich
    adjustment for MCMC using estimating functions", 2014, does the same to draws; K. Lange, R. Little, J. Taylor,
    "Robust statistical modeling using the t distribution", 1989, for the t; M. Hoffman, A. Gelman, "The No-U-Turn
    sampler", 2014; A. Vehtari et al., "Rank-normalization, folding, and localization: an improved R-hat", 2021.
    """
    target = _Target(fitted, covariance)
    from blackjax.diagnostics import ess_bulk, rhat  # optional dependency

    draws = max(FEWEST, -(-count // CHAINS))
    samples, diverged = _sample(fitted.objective, target, draws, seed)
    diagnose = jax.jit(lambda draws: (rhat(draws), ess_bulk(draws)))  # without compilation it takes seconds
    measures = (np.atleast_1d(values).tolist() for values in diagnose(samples))
    rhats, effective = (dict(zip(covariance.labels, values, strict=True)) for values in measures)
    vectors, rows = np.repeat(np.asarray(fitted.vector, np.float64)[None], count, axis=0), np.concatenate(samples)
    vectors[:, target.own] = rows[np.linspace(0, len(rows) - 1, count).round().astype(int)]  # evenly from all chains
    chains = Chains(vectors, rhats, effective, int(diverged.sum()))
    _refuse_disagreement(chains, samples.shape[0] * draws)
    return chains


class _Target:
    """Posterior of the coordinates `own`, as a function of unbounded numbers with about unit spread."""

    def __init__(self, fitted: Fitted, covariance: Covariance) -> None:
        """Prepare the target of a fit; see `draw_posterior` for the errors raised."""
        space, best = fitted.objective.space, np.asarray(fitted.vector, np.float64)
        _refuse(fitted, covariance)
        own = np.array([space.labels.index(label) for label in covariance.labels])
        equations, _ = fitted.objective.compile_scores()(fitted.vector)
        hessian, gradient = equations.hessian[np.ix_(own, own)], equations.gradient[own]
        magnitude, curvature = adjust(hessian, covariance.matrix)
        offset = float(np.sqrt(magnitude * gradient @ np.linalg.solve(hessian, gradient)))
        if not offset < _LEFT:
            raise FitError(
                f"the fit ended {offset:.2g} standard deviations from its minimum, expected less than {_LEFT:g} for a "
                "posterior around it; fit with method lm, or more iterations"
            )
        deviation = np.sqrt(np.diag(covariance.matrix))
        low = np.maximum(np.asarray(space.low, np.float64)[own], covariance.centre - _FAR * deviation)
        high = np.minimum(np.asarray(space.high, np.float64)[own], covariance.centre + _FAR * deviation)
        share = np.clip((covariance.centre - low) / (high - low), 0.01, 0.99)
        logit_deviation = np.minimum(deviation / (high - low) / (share * (1 - share)), _FLAT)
        spread = np.linalg.cholesky(covariance.matrix / np.outer(deviation, deviation)) * logit_deviation[:, None]
        self.own, self.best, self.least = own, best, equations.loss
        self.centre, self.low, self.high, self.freedom = covariance.centre, low, high, covariance.freedom
        self.magnitude, self.curvature = magnitude, curvature  # c and C of `draw_posterior`
        self.origin = np.log(share / (1 - share))  # logit of the centre between the bounds
        self.spread = spread  # from unit spread to logits: a factor of their covariance

    def place(self, free: Float[Array, "own"]) -> Float[Array, "own"]:
        """Return the coordinates of a point."""
        logit = self.origin + jnp.asarray(self.spread, free.dtype) @ free
        return jnp.asarray(self.low + (self.high - self.low) * jax.nn.sigmoid(logit), free.dtype)

    def log_density(self, free: Float[Array, "own"], loss: Callable[[Array], Array]) -> Float[Array, ""]:
        """Return the logarithm of the posterior up to a constant; `loss` is the objective by vector."""
        logit = self.origin + jnp.asarray(self.spread, free.dtype) @ free
        moved = jnp.asarray(self.curvature, free.dtype) @ (self.place(free) - self.centre).astype(free.dtype)
        clipped = jnp.clip(self.best[self.own] + moved, self.low, self.high).astype(free.dtype)
        excess = self.magnitude / 2 * (loss(jnp.asarray(self.best, free.dtype).at[self.own].set(clipped)) - self.least)
        power = (self.freedom + len(self.own)) / 2
        tail = -power * jnp.log1p(jnp.maximum(2 * excess / self.freedom, -0.5))
        log_slope = jax.nn.log_sigmoid(logit) + jax.nn.log_sigmoid(-logit)  # derivative of the coordinates by the logit
        return jnp.where(jnp.isfinite(excess), tail, -jnp.inf) + log_slope.sum()


def adjust(
    hessian: Float[np.ndarray, "own own"], covariance: Float[np.ndarray, "own own"]
) -> tuple[float, Float[np.ndarray, "own own"]]:
    """Return the number c and the matrix C of determinant 1 for which C' (c hessian) C = covariance^-1.

    Raises:
        FitError: The covariance has no inverse, or the Hessian is not positive definite.
    """
    deviation = np.sqrt(np.diag(covariance))
    unit = np.outer(deviation, deviation)
    correlation, scaled_hessian = covariance / unit, hessian * unit
    if np.linalg.eigvalsh(correlation)[0] < _SINGULAR:
        raise FitError(
            f"the covariance of {len(deviation)} coordinates has no inverse, expected more stretches of data than "
            "coordinates; give longer recordings, or draw with sample"
        )
    if np.linalg.eigvalsh(scaled_hessian)[0] <= 0:
        raise FitError(
            "the objective has no minimum at the result, expected a positive curvature; fit again, or with loss.robust"
            "=none"
        )
    precision = np.linalg.inv(correlation)
    magnitude = np.exp((np.linalg.slogdet(precision)[1] - np.linalg.slogdet(scaled_hessian)[1]) / len(deviation))
    root = np.real(scipy.linalg.sqrtm(magnitude * scaled_hessian))
    inverse = np.linalg.inv(root)
    symmetric = inverse @ np.real(scipy.linalg.sqrtm(root @ precision @ root)) @ inverse
    return float(magnitude), symmetric * deviation[:, None] / deviation


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
    """Return all draws, and which of them diverged."""
    import blackjax  # optional dependency

    of_all, dtype = objective.value_and_grad("auto"), objective.space.start.dtype

    def chain(key: Array, start: Array, data: Blocks) -> tuple[Array, Array]:
        def loss(vector: Array) -> Array:
            # Linear in the vector, with the gradient already computed: JAX does not differentiate the rollouts again.
            value, gradient = jax.lax.stop_gradient(of_all(jax.lax.stop_gradient(vector), data))
            return value + gradient @ (vector - jax.lax.stop_gradient(vector))

        def log_density(free: Array) -> Array:
            return target.log_density(free, loss)

        adaptation: Any = blackjax.window_adaptation(
            blackjax.nuts, log_density, initial_step_size=_STEP, adaptation_info_fn=lambda *info: None
        )
        warm, sampling = jax.random.split(key)
        (state, tuned), _ = adaptation.run(warm, start, num_steps=WARMUP)
        step = blackjax.nuts(log_density, **tuned).step

        def draw(state: Any, key: Array) -> tuple[Any, tuple[Array, Array]]:
            state, info = step(key, state)
            return state, (target.place(state.position), info.is_divergent)

        return jax.lax.scan(draw, state, jax.random.split(sampling, draws))[1]

    run = objective.compile(chain, forward=True)
    starts = np.random.default_rng(seed).standard_normal((CHAINS, len(target.own)))
    arguments = zip(jax.random.split(jax.random.key(seed), CHAINS), starts, strict=True)
    parts = [run(*objective.spread((key, jnp.asarray(point, dtype))), objective.data) for key, point in arguments]
    samples, diverged = (np.stack([np.asarray(part) for part in group]) for group in zip(*parts, strict=True))
    return samples.astype(np.float64), diverged


def _refuse_disagreement(chains: Chains, draws: int) -> None:
    # Chains that never moved give NaN, which counts as worst.
    worst = max(chains.rhat, key=lambda label: np.nan_to_num(chains.rhat[label], nan=np.inf))
    fewest = min(chains.effective, key=lambda label: np.nan_to_num(chains.effective[label], nan=-np.inf))
    rhat, effective = chains.rhat[worst], chains.effective[fewest]
    message = (
        f"posterior of {draws} draws: R-hat up to {rhat:.3g} ({worst}), effective sample size down to {effective:.0f} "
        f"({fewest}), {chains.divergences} divergences"
    )
    if not (rhat < LARGEST_RHAT and effective > LEAST_EFFECTIVE):
        raise FitError(
            f"{message}; expected R-hat below {LARGEST_RHAT:g} and a size above {LEAST_EFFECTIVE:g}: the chains do not "
            "agree; ask for more draws, or set what the data do not determine to known values"
        )
    if chains.divergences:
        _log.warning("%s; draws near a divergence may be missing", message)
    else:
        _log.info("%s", message)
