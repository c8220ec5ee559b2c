"""Confidence intervals of identified parameters, and groups of parameters that the data cannot distinguish."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
import scipy.special
from jaxtyping import Bool, Float
from scipy.sparse.csgraph import connected_components

from frictionzoo.fit.base import Fit
from frictionzoo.fit.lm import MOST_COORDINATES
from frictionzoo.fit.normal_equations import NormalEquations
from frictionzoo.fit.objective import Objective
from frictionzoo.fit.space import Space

LEVEL = 0.95
WIDEST = np.log(1.5)
"""Half width of an interval, in the optimiser's coordinate, above which a parameter is not identifiable: a factor of
1.5 in logarithmic coordinates, otherwise 41 % of the parameter's scale."""
COLLINEAR = 1e-4
"""Eigenvalue of J' J, with columns scaled to length 1, below which a combination of parameters has no effect. Two
columns then agree to about 1 %; a time step or a neglected effect causes differences of that size."""
TAKES_PART = 0.1  # entry of a combination of length 1 above which a parameter belongs to it
CORRELATED = 0.99  # magnitude of the correlation above which two parameters are indistinguishable
_LASTING = 0.97  # largest correlation rho of successive stretches, the bound of Andrews and Monahan
_NOTHING = 1e-12  # curvature, as a share of the largest, below which a parameter has no effect


@dataclass(frozen=True, eq=False)
class Covariance:
    """Multivariate Student's t distribution of coordinates.

    Attributes:
        labels: Name of each coordinate, one of `Space.labels`.
        centre: Middle of each coordinate's interval.
        matrix: Scale matrix: half an interval is Student's quantile times the root of its diagonal.
        freedom: Degrees of freedom.
    """

    labels: tuple[str, ...]
    centre: Float[np.ndarray, "own"]
    matrix: Float[np.ndarray, "own own"]
    freedom: float

    def draw(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "count own"]:
        """Draw vectors: normal ones over the root of a chi-squared number that a vector's coordinates share.

        Source: S. Kotz, S. Nadarajah, "Multivariate t distributions and their applications", 2004, section 1.1.
        """
        # With fewer stretches than coordinates the matrix is singular and has no Cholesky factor.
        eigenvalues, axes = np.linalg.eigh(self.matrix)
        normal = rng.standard_normal((count, len(self.labels))) @ (axes * np.sqrt(np.maximum(eigenvalues, 0))).T
        return self.centre + normal / np.sqrt(rng.chisquare(self.freedom, (count, 1)) / self.freedom)


@dataclass(frozen=True)
class Uncertainty:
    """Confidence intervals and identifiability of the identified parameters.

    Attributes:
        intervals: Lower and upper end of each parameter's 95 % interval, in its unit, of shape (nv, 2), by full name
            such as `bench.armature`; NaN where there is no interval.
        determined: Whether the data determine the parameter in each joint, of shape (nv,), by the same names; true for
            joints with a known value.
        indistinct: Groups of parameters that the data cannot distinguish, by the names of `Space.labels`.
        missing: Why there are no intervals at all; None otherwise.
        covariance: Joint distribution of the coordinates that have an interval; None where none has.
    """

    intervals: Mapping[str, Float[np.ndarray, "nv 2"]] = field(default_factory=dict)
    determined: Mapping[str, Bool[np.ndarray, "nv"]] = field(default_factory=dict)
    indistinct: tuple[tuple[str, ...], ...] = ()
    missing: str | None = None
    covariance: Covariance | None = None

    @property
    def identifiable(self) -> dict[str, bool]:
        """Whether the data determine the parameter in all joints, by full name."""
        return {name: bool(joints.all()) for name, joints in self.determined.items()}


def estimate_uncertainty(
    objective: Objective,
    vector: Float[np.ndarray, "coordinates"],
    fit: Fit | None = None,
    finer: Callable[[Float[np.ndarray, "coordinates"]], Objective] | None = None,
) -> Uncertainty:
    """Estimate confidence intervals from the curvature of the objective and the spread of its gradient.

    m_g = H^-1 (s_g - s),  e_g = m_g - rho m_(g-1),  e_1 = sqrt(1 - rho^2) m_1
    C = G / (G - 1) sum_g e_g e_g' / ((1 - rho) (1 - rho)'),  interval = x +- t sqrt(diag C)

        x    the best vector, in the optimiser's coordinates
        H    J' J of all residuals
        s_g  J_g' r_g, the gradient of the stretch g; s is their mean
        rho  for each coordinate, the correlation of m_g with m_(g-1), at least 0
        G    number of stretches, at most `MOST_STRETCHES`
        t    Student's quantile with G - 1 degrees of freedom

    sigma^2 H^-1 would be several times too narrow: residuals within a rollout are strongly correlated, model error
    correlates neighbouring rollouts, and these share a noisy sample. With at least `ENOUGH_RECORDINGS` recordings a
    stretch consists of whole recordings, because a part of one does not show changes between recordings. Otherwise it
    is a period of time. Periods are nearly independent, except for model error while the motion stays similar; rho
    widens the interval accordingly. The step H^-1 s left to the minimum widens it too, so that it holds for the best
    point of a grid. Both ends are clipped to the bounds and converted to the parameter's unit.

    Halving the time step h removes about half of its effect on the estimate. With `finer`, the objective near a vector
    at half the time step, the interval extends to the estimate at time step 0: s is then 2 s_(h/2) - s_h.

    A parameter is not identifiable if it has no effect, has one only in combination with others, ended at a bound, or
    has an interval that reaches a bound or whose half width exceeds `WIDEST`. In the first three cases it has no
    interval. The parameters of one combination form a group; so do other unidentifiable parameters with strongly
    correlated estimates. A parameter that ended at a bound counts as known for the others.

    The interval describes the best-fitting value, not the drive's true value: it does not contain a model error that is
    the same throughout the data, nor the bias of noisy initial states.

    `fit` is the method that found the vector and may minimise another loss; None for the objective's loss.

    Source: P. Huber, "The behavior of maximum likelihood estimates under nonstandard conditions", 1967; H. White, "A
    heteroskedasticity-consistent covariance matrix estimator and a direct test for heteroskedasticity", 1980; K.-Y.
    Liang, S. Zeger, "Longitudinal data analysis using generalized linear models", 1986, for clusters; C. Bester, T.
    Conley, C. Hansen, "Inference with dependent data using cluster covariance estimators", 2011, for few stretches of
    time as clusters; D. Andrews, J. Monahan, "An improved heteroskedasticity and autocorrelation consistent covariance
    matrix estimator", 1992, for rho (prewhitening); L. Richardson, "The deferred approach to the limit", 1927, for time
    steps with a first-order error.
    """
    space = objective.space
    if not space.names:
        return Uncertainty(missing="nothing was identified")
    if space.weights:
        return Uncertainty(missing="a network's weights can replace its physical parameters and each other")
    if objective.torch_law:
        return Uncertainty(missing=f"{objective.torch_law} exists only in torch, where no Jacobian is taken")
    if len(vector) > MOST_COORDINATES:
        return Uncertainty(missing=f"{len(vector)} numbers were identified, more than {MOST_COORDINATES}")
    if objective.stretches < 2:
        return Uncertainty(missing="there is one segment only, and no spread between segments")
    compile_scores = Objective.compile_scores if fit is None else fit.compile_scores
    if (begun := objective.begun) is not None:  # a second search refines the states of the fit
        begun = compile_scores(objective.beginning(begun))(vector)[0].begun
    equations, scores = compile_scores(objective.beginning(begun))(vector)
    if not all(np.isfinite(part).all() for part in (equations.gradient, equations.hessian, scores)):
        return Uncertainty(missing="the derivative of the objective is not finite at the result")
    if finer is not None:
        gradient = finer(vector).beginning(begun).compile_normal_equations()(vector).gradient
        if np.isfinite(gradient).all():
            equations = equations._replace(gradient=2 * gradient - equations.gradient)
    return assess(space, vector, equations, scores)


def assess(
    space: Space,
    vector: Float[np.ndarray, "coordinates"],
    equations: NormalEquations,
    scores: Float[np.ndarray, "stretches coordinates"],
    collinear: float = COLLINEAR,
) -> Uncertainty:
    """Estimate confidence intervals from the normal equations at the best vector; see `estimate_uncertainty`.

    All coordinates belong to physical parameters. The Hessian has the exact second derivative of a robust loss.
    `scores` holds the gradient of each stretch; `collinear` replaces `COLLINEAR`.
    """
    vector, (_, low, high) = np.asarray(vector, np.float64), space.box
    curvature = np.diag(equations.hessian)
    at_bound = space.at_bound(vector)
    effective = np.flatnonzero(~at_bound & (curvature > _NOTHING * curvature.max()))
    precision = float(np.finfo(space.start.dtype).eps)
    matrix, step, combined, joined = _solve(equations, scores, effective, precision, collinear)

    intervals, subset, kept = np.full((len(vector), 2), np.nan), effective[~combined], ~combined
    labels = tuple(space.labels[index] for index in subset)
    covariance = _widen(labels, vector[subset], matrix[np.ix_(kept, kept)], step[kept], len(scores) - 1.0)
    half = _quantile(covariance.freedom) * np.sqrt(np.diag(covariance.matrix))
    intervals[subset] = np.stack([covariance.centre - half, covariance.centre + half], axis=1)
    inside = (intervals[:, 0] > low) & (intervals[:, 1] < high)  # of NaN, False
    identifiable = inside & (intervals[:, 1] - intervals[:, 0] < 2 * WIDEST)
    unidentifiable = ~np.logical_or.outer(identifiable[effective], identifiable[effective])
    count, number_of = connected_components(joined & unidentifiable, directed=False)
    groups = [effective[number_of == number] for number in range(count)]

    return Uncertainty(
        space.physical(np.clip(intervals, low[:, None], high[:, None])),
        {name: space.spread(name, subset, known=True) for name, subset in space.split(identifiable).items()},
        tuple(tuple(space.labels[index] for index in group) for group in groups if len(group) > 1),
        covariance=covariance if covariance.labels else None,
    )


def _solve(
    equations: NormalEquations, scores: np.ndarray, seen: np.ndarray, precision: float, collinear: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the solution for the coordinates that have an effect, `seen`.

    Returns:
        Their covariance; the Newton step to the minimum; whether each has an effect only in combination with others;
        whether two belong to the same such combination, or have strongly correlated estimates.
    """
    scale = np.sqrt(np.diag(equations.hessian)[seen])
    eigenvalues, axes = np.linalg.eigh(equations.hessian[np.ix_(seen, seen)] / np.outer(scale, scale))
    # Eigenvalues near the precision of the matrix are rounding error: their combinations have no effect.
    kept = eigenvalues > 100 * precision
    inverse = (axes[:, kept] / eigenvalues[kept]) @ axes[:, kept].T / np.outer(scale, scale)
    stretches, centred = len(scores), scores[:, seen] - scores[:, seen].mean(axis=0)
    moved = _whiten(centred @ inverse)  # factored, so that no variance rounds below 0
    covariance = stretches / (stretches - 1) * moved.T @ moved

    null = axes[:, eigenvalues < collinear]
    share = null @ null.T
    combined = np.diag(share) > TAKES_PART**2
    width = np.sqrt(np.diag(inverse))
    correlated = np.abs(inverse) > CORRELATED * np.outer(width, width)
    joined = np.where(
        np.outer(combined, combined),
        np.abs(share) > TAKES_PART * np.sqrt(np.outer(np.diag(share), np.diag(share))),
        correlated & ~np.logical_or.outer(combined, combined),
    )
    return covariance, -inverse @ equations.gradient[seen], combined, joined


def _whiten(moved: Float[np.ndarray, "stretches seen"]) -> Float[np.ndarray, "stretches seen"]:
    """Remove the correlation of successive stretches (prewhitening), and rescale to the long-run variance."""
    square = np.square(moved).sum(axis=0)
    rho = np.divide((moved[1:] * moved[:-1]).sum(axis=0), square, out=np.zeros_like(square), where=square > 0)
    rho = np.clip(rho, 0.0, _LASTING)
    innovations = np.concatenate([np.sqrt(1 - rho**2) * moved[:1], moved[1:] - rho * moved[:-1]])
    return innovations / (1 - rho)


def _widen(
    labels: tuple[str, ...], best: np.ndarray, matrix: np.ndarray, step: np.ndarray, freedom: float
) -> Covariance:
    """Return the distribution of these coordinates, shifted and widened by half the step left to the minimum."""
    deviation = np.sqrt(np.diag(matrix))
    product = np.outer(deviation, deviation)
    correlation = np.divide(matrix, product, out=np.eye(len(labels)), where=product > 0)
    stretched = deviation + np.abs(step) / 2 / _quantile(freedom)
    return Covariance(labels, best + step / 2, correlation * np.outer(stretched, stretched), freedom)


def _quantile(freedom: float) -> float:
    return float(scipy.special.stdtrit(freedom, (1 + LEVEL) / 2))
