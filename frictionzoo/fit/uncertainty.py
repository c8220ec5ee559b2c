"""How far the data determine what was identified: intervals, and parameters that cannot be told apart."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import scipy.special
from jaxtyping import Bool, Float, Int
from scipy.sparse.csgraph import connected_components

from frictionzoo.fit.base import Fit
from frictionzoo.fit.covariance import Covariance
from frictionzoo.fit.lm import MOST_COORDINATES
from frictionzoo.fit.normal_equations import NormalEquations
from frictionzoo.fit.objective import Objective
from frictionzoo.fit.space import Space

LEVEL = 0.95
WIDEST = np.log(1.5)
"""Half an interval in the optimiser's coordinate from which on a parameter is not identifiable.

In logarithms it is a factor of 1.5, elsewhere 41 % of the parameter's scale.
"""
COLLINEAR = 1e-4
"""Eigenvalue of J' J, with columns scaled to length 1, below which a combination has no effect.

Two columns then agree to about 1 %: a difference of which a time step or a neglected effect is as large a part.
"""
TAKES_PART = 0.1  # entry of a combination of length 1 from which on a parameter belongs to it
CORRELATED = 0.99  # magnitude from which on the estimates of two parameters are one
_LASTING = 0.97  # most of one stretch that the next one has, as Andrews and Monahan bound it
_NOTHING = 1e-12  # curvature, as a share of the largest, below which a parameter has no effect at all


@dataclass(frozen=True)
class Uncertainty:
    """How far data determine what was identified from them.

    Attributes:
        intervals: Lower and upper end of the 95 % interval of each identified parameter by full name, `bench.armature`,
            in its unit, of shape (nv, 2); NaN where there is none.
        determined: Whether the data determine it in each joint, of shape (nv,), by the same names; true where known.
        indistinct: Groups of parameters that the data cannot tell apart, as `Space.labels` has them.
        missing: Why there are no intervals at all; None where there are.
        covariance: How sure all those are together that have an interval; None where none has.
    """

    intervals: Mapping[str, Float[np.ndarray, "nv 2"]] = field(default_factory=dict)
    determined: Mapping[str, Bool[np.ndarray, "nv"]] = field(default_factory=dict)
    indistinct: tuple[tuple[str, ...], ...] = ()
    missing: str | None = None
    covariance: Covariance | None = None

    @property
    def identifiable(self) -> dict[str, bool]:
        """Whether the data determine each identified parameter in all joints."""
        return {name: bool(joints.all()) for name, joints in self.determined.items()}


def estimate_uncertainty(
    objective: Objective,
    vector: Float[np.ndarray, "coordinates"],
    fit: Fit | None = None,
    finer: Callable[[Float[np.ndarray, "coordinates"]], Objective] | None = None,
) -> Uncertainty:
    """Intervals of the identified parameters from the curvature of the objective and the spread of its gradient.

    m_g = H^-1 (s_g - s),  e_g = m_g - rho m_(g-1),  e_1 = sqrt(1 - rho^2) m_1
    C = G / (G - 1) sum_g e_g e_g' / ((1 - rho) (1 - rho)'),  interval = x +- t sqrt(diag C)

        x    the best vector, in the optimiser's coordinates
        H    J' J, of all residuals
        s_g  J_g' r_g, the part of the gradient that comes from the stretch g; s is their mean
        rho  of each coordinate, the correlation of m_g with that of the stretch before, 0 where it is negative
        G    number of stretches, at most `MOST_STRETCHES`
        t    Student's quantile with G - 1 degrees of freedom

    Residuals within a rollout are strongly correlated, and what a law lacks correlates those of neighbouring rollouts,
    which besides share a noisy sample: sigma^2 H^-1 would be several times too narrow. A stretch is whole recordings
    where there are at least `ENOUGH_RECORDINGS`, for what changes from one to the next is in no part of one; otherwise
    it is a part of the time. Such parts are nearly independent, but for what a law lacks while the motion stays alike:
    what one still has of the one before it, rho, widens the interval. An interval is stretched by the step
    H^-1 s that a fit has left undone, so that it also holds for the best point of a grid. Its ends are brought back
    into the bounds and into the parameter's unit.

    A simulation in steps of h moves the value by about as much again as half as long steps take back. With `finer`, an
    interval reaches to where steps of no length would have the value: s is then 2 s_(h/2) - s_h.

    A parameter is not identifiable where it has no effect, where only a combination with others has one, where it ended
    at a bound, or where its interval reaches a bound or is wider than `WIDEST`. At a bound, without effect and in a
    combination it has no interval. Those of one combination, and others that are not identifiable and whose estimates
    follow each other, are told as a group. What ended at a bound is taken as known by the others.

    The interval speaks of the value that fits best, not of the drive's: a law that is wrong in the same way throughout
    the data, and the bias of noisy initial states, are not in it.

    Args:
        objective: What was minimised.
        vector: The best one.
        fit: How it was found, which may have another loss; None: by that of the objective.
        finer: Makes the same objective near a vector, of a drive that is simulated in steps of half the length; None:
            the steps' length is not looked at.

    Source: P. Huber, "The behavior of maximum likelihood estimates under nonstandard conditions", 1967; H. White, "A
    heteroskedasticity-consistent covariance matrix estimator and a direct test for heteroskedasticity", 1980; K.-Y.
    Liang, S. Zeger, "Longitudinal data analysis using generalized linear models", 1986, for clusters; C. Bester, T.
    Conley, C. Hansen, "Inference with dependent data using cluster covariance estimators", 2011, for few stretches of
    time as clusters; D. Andrews, J. Monahan, "An improved heteroskedasticity and autocorrelation consistent covariance
    matrix estimator", 1992, for rho, there called prewhitening; L. Richardson, "The deferred approach to the limit",
    1927, for the steps, whose error is of the first order.
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
    if (begun := objective.begun) is not None:  # a fit knows them nearly, and a second search says how nearly
        begun = compile_scores(objective.beginning(begun))(vector)[0].states
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
    """The same from the normal equations at the best vector.

    Args:
        space: The coordinates, all of physical parameters.
        vector: The best one.
        equations: There, with the second derivative of a robust loss as it is.
        scores: Part of the gradient that comes from each stretch of segments.
        collinear: In place of `COLLINEAR`.
    """
    vector, low, high = (np.asarray(side, np.float64) for side in (vector, space.low, space.high))
    curvature = np.diag(equations.hessian)
    at_bound = space.at_bound(vector)
    seen = np.flatnonzero(~at_bound & (curvature > _NOTHING * curvature.max()))
    found = _solve(equations, scores, seen, float(np.finfo(space.start.dtype).eps), collinear)

    ends, own = np.full((len(vector), 2), np.nan), seen[~found.combined]
    together = _describe(space, vector, own, found)
    half = _quantile(together.freedom) * np.sqrt(np.diag(together.matrix))
    ends[own] = np.stack([together.centre - half, together.centre + half], axis=1)
    inside = (ends[:, 0] > low) & (ends[:, 1] < high)  # of NaN, False
    identifiable = inside & (ends[:, 1] - ends[:, 0] < 2 * WIDEST)
    groups = _list_groups(found.joined & ~np.logical_or.outer(identifiable[seen], identifiable[seen]))

    return Uncertainty(
        space.physical(np.clip(ends, low[:, None], high[:, None])),
        {name: space.spread(name, own, known=True) for name, own in space.split(identifiable).items()},
        tuple(tuple(space.labels[seen[i]] for i in group) for group in groups),
        covariance=together if together.labels else None,
    )


class _Solution(NamedTuple):
    """Of the coordinates that have an effect.

    Attributes:
        covariance: Of their estimates.
        freedom: Degrees of freedom by which it is known.
        step: From the best vector to the minimum, as far as the curvature tells.
        combined: Whether only a combination with others has an effect.
        joined: Which two have an effect in one combination only, or estimates that follow each other.
    """

    covariance: Float[np.ndarray, "seen seen"]
    freedom: float
    step: Float[np.ndarray, "seen"]
    combined: Bool[np.ndarray, "seen"]
    joined: Bool[np.ndarray, "seen seen"]


def _solve(
    equations: NormalEquations, scores: np.ndarray, seen: np.ndarray, precision: float, collinear: float
) -> _Solution:
    scale = np.sqrt(np.diag(equations.hessian)[seen])
    eigenvalues, axes = np.linalg.eigh(equations.hessian[np.ix_(seen, seen)] / np.outer(scale, scale))
    # An eigenvalue near the precision of its matrix is rounding: its combination counts as having no effect.
    kept = eigenvalues > 100 * precision
    inverse = (axes[:, kept] / eigenvalues[kept]) @ axes[:, kept].T / np.outer(scale, scale)
    stretches, centred = len(scores), scores[:, seen] - scores[:, seen].mean(axis=0)
    moved = _whiten(centred @ inverse)  # a product with itself has no diagonal that rounds to below 0
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
    return _Solution(covariance, stretches - 1.0, -inverse @ equations.gradient[seen], combined, joined)


def _whiten(moved: Float[np.ndarray, "stretches seen"]) -> Float[np.ndarray, "stretches seen"]:
    """What is new in each stretch, as much larger as its lasting effect on all that follow makes it."""
    square = np.square(moved).sum(axis=0)
    kept = np.divide((moved[1:] * moved[:-1]).sum(axis=0), square, out=np.zeros_like(square), where=square > 0)
    kept = np.clip(kept, 0.0, _LASTING)
    new = np.concatenate([np.sqrt(1 - kept**2) * moved[:1], moved[1:] - kept * moved[:-1]])
    return new / (1 - kept)


def _describe(
    space: Space, vector: Float[np.ndarray, "coordinates"], own: Int[np.ndarray, "own"], found: _Solution
) -> Covariance:
    """Of these coordinates, stretched so that half an interval reaches as far as what the fit left undone, too."""
    kept = ~found.combined
    matrix, step = found.covariance[np.ix_(kept, kept)], found.step[kept]
    deviation = np.sqrt(np.diag(matrix))
    both = np.outer(deviation, deviation)
    correlation = np.divide(matrix, both, out=np.eye(len(own)), where=both > 0)
    stretched = deviation + np.abs(step) / 2 / _quantile(found.freedom)
    labels = tuple(space.labels[at] for at in own)
    return Covariance(labels, vector[own] + step / 2, correlation * np.outer(stretched, stretched), found.freedom)


def _quantile(freedom: float) -> float:
    return float(scipy.special.stdtrit(freedom, (1 + LEVEL) / 2))


def _list_groups(joined: Bool[np.ndarray, "seen seen"]) -> list[Int[np.ndarray, "members"]]:
    """Sets of two and more that are joined to each other, directly or by others."""
    count, label = connected_components(joined, directed=False)
    groups = (np.flatnonzero(label == number) for number in range(count))
    return [group for group in groups if len(group) > 1]
