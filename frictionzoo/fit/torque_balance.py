"""Weighted least squares on torque: the numbers that let inverse dynamics balance what was measured.

Functions of arrays and of callables; what the coordinates mean is the caller's.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Bool, Float

from frictionzoo.bench.inertia import LogCholesky, is_consistent
from frictionzoo.fit.normal_equations import NormalEquations, compress

Lack = Callable[[Float[np.ndarray, "coordinates"]], Float[np.ndarray, "rows nv"]]
Slope = Callable[[Float[np.ndarray, "coordinates"]], Float[np.ndarray, "rows nv coordinates"]]

_PASSES = 20  # rounds of weights; three are usual
_SETTLED = 1e-3  # relative change of the weights below which they count as found
_STEPS = 200  # of one search; ten are usual
_HALVINGS = 6  # of a step that does not lower the loss
_TOLERANCE = 1e-9  # share of the loss that a step has to promise


@dataclass(frozen=True)
class Links:
    """Bodies whose inertia is identified along.

    Attributes:
        regressor: Torque for each unit of each of their parameters, filtered and decimated.
        around: Their coordinates.
        spread: Standard deviation of each coordinate's prior, whose mean is 0, the maker's value.
    """

    regressor: Float[np.ndarray, "rows nv bodies 10"]
    around: LogCholesky
    spread: Float[np.ndarray, "bodies 10"]

    def torque(self, parameters: Float[np.ndarray, "bodies 10"]) -> Float[np.ndarray, "rows nv"]:
        """What bodies with these parameters need above what the maker's need."""
        return np.einsum("rvbk,bk->rv", self.regressor, parameters - self.maker)

    @cached_property
    def maker(self) -> Float[np.ndarray, "bodies 10"]:
        """Parameters of the maker's bodies."""
        return self.around.parameters(np.zeros_like(self.spread))

    def pulled(
        self, parameters: Float[np.ndarray, "bodies 10"]
    ) -> tuple[np.ndarray, Float[np.ndarray, "bodies 10 10"]]:
        """Coordinates of bodies as shares of the prior's deviation, and their derivative by the parameters."""
        coordinates = self.around.coordinates(parameters)
        slopes = np.linalg.inv(self.around.slopes(coordinates))
        return coordinates / self.spread, slopes / self.spread[:, :, None]


class Box(NamedTuple):
    """Where coordinates start, and their bounds, each of shape (coordinates,)."""

    start: Float[np.ndarray, "coordinates"]
    low: Float[np.ndarray, "coordinates"]
    high: Float[np.ndarray, "coordinates"]


@dataclass(frozen=True)
class Balance:
    """What weighted least squares found.

    Attributes:
        vector: The coordinates.
        bodies: Parameters of the bodies, of shape (bodies, 10); no row without `Links`.
        residual: Torque that is left, at all samples, moving or not [N m or N].
        sigma: Standard deviation of each joint's residual where it moves, by which it was weighted.
        information: J' J of the weighted measurements, over `vector` and then the parameters, body after body.
        prior: What the prior adds to it.
    """

    vector: Float[np.ndarray, "coordinates"]
    bodies: Float[np.ndarray, "bodies 10"]
    residual: Float[np.ndarray, "rows nv"]
    sigma: Float[np.ndarray, "nv"]
    information: Float[np.ndarray, "all all"]
    prior: Float[np.ndarray, "all all"]

    @property
    def covariance(self) -> Float[np.ndarray, "all all"]:
        """Of `vector` and then the parameters; infinite on the diagonal where nothing determines one."""
        return invert(self.information + self.prior)

    @property
    def errors(self) -> Float[np.ndarray, "coordinates"]:
        """Standard error of each of `vector`."""
        return np.sqrt(np.diag(self.covariance))[: len(self.vector)]


def invert(information: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Covariance of a positive semidefinite information matrix; infinite variances where it has none."""
    scale = np.sqrt(np.diag(information))
    seen = scale > 0
    scale = np.where(seen, scale, 1.0)
    values, axes = np.linalg.eigh(information / np.outer(scale, scale))
    kept = values > len(values) * np.finfo(float).eps * max(values[-1], 0.0)
    covariance = (axes[:, kept] / values[kept]) @ axes[:, kept].T / np.outer(scale, scale)
    lost = np.square(axes[:, ~kept]).sum(axis=1) > 1e-8
    covariance[lost, lost] = np.inf
    return covariance


def balance(
    lack: Lack,
    slope: Slope,
    box: Box,
    moving: Bool[np.ndarray, "rows nv"],
    links: Links | None = None,
) -> Balance:
    """Coordinates with the least weighted torque left over, joint by joint weighted by what is left there.

    Weights are found in turns: least squares with the residuals' deviations of the turn before, until they stay. Of
    laws that are linear in their coordinates this is the inverse dynamics identification model (IDIM-LS) with weights;
    others take a few steps of Gauss and Newton in each turn.

    Source: M. Gautier, "Dynamic identification of robots with power model", 1997; M. Gautier, P. Poignet, "Extended
    Kalman filtering and weighted least squares dynamic identification of robot", 2001, for the weights; T. Lee, P.
    Wensing, F. Park, "Geometric robot dynamic identification: a convex programming approach", 2020, for a prior around
    the maker's bodies.

    Args:
        lack: Motor torque less what the drive's other parts need, with the maker's bodies, filtered and decimated.
        slope: Its derivative.
        box: Where to start, and bounds.
        moving: Which samples count, joint by joint.
        links: Bodies that are identified along.
    """
    equation = _Equation(lack, slope, links, moving, box)
    at = equation.start
    sigma = _deviation(equation.left(at), moving, 0.0)
    for _ in range(_PASSES):
        at, before = _descend(equation, at, sigma), sigma
        sigma = _deviation(equation.left(at), moving, len(at) / len(before))
        if (np.abs(sigma / before - 1) < _SETTLED).all():
            break
    vector, bodies = equation.split(at)
    information, prior = (part.hessian for part in (equation.measured(at, sigma), equation.prior(at)))
    return Balance(vector, bodies, equation.left(at), sigma, information, prior)


@dataclass(frozen=True)
class _Equation:
    """What is left of the torque as a function of all numbers, the vector's and then the bodies' parameters.

    Of the bodies, not their coordinates: the torque is linear in the parameters. In coordinates the valley of nearly
    equal torques is narrow and bent, and a search takes thousands of steps along it.
    """

    lack: Lack
    slope: Slope
    links: Links | None
    moving: Bool[np.ndarray, "rows nv"]
    box: Box

    @property
    def start(self) -> Float[np.ndarray, "all"]:
        return np.append(np.clip(*self.box), [] if self.links is None else self.links.maker)

    @property
    def bounds(self) -> tuple[Float[np.ndarray, "all"], Float[np.ndarray, "all"]]:
        free = np.full(0 if self.links is None else self.links.maker.size, np.inf)
        return np.append(self.box.low, -free), np.append(self.box.high, free)

    def split(self, at: Float[np.ndarray, "all"]) -> tuple[Float[np.ndarray, "_"], Float[np.ndarray, "bodies 10"]]:
        size = len(self.box.start)
        return at[:size], at[size:].reshape(-1, 10)

    def left(self, at: Float[np.ndarray, "all"]) -> Float[np.ndarray, "rows nv"]:
        vector, bodies = self.split(at)
        return self.lack(vector) if self.links is None else self.lack(vector) - self.links.torque(bodies)

    def loss(self, at: Float[np.ndarray, "all"], sigma: Float[np.ndarray, "nv"]) -> float:
        """Infinite where no body has these parameters."""
        if not is_consistent(self.split(at)[1]).all():
            return np.inf
        weighted = (self.left(at) / sigma)[self.moving]
        return float(weighted @ weighted) + self.prior(at).loss

    def measured(self, at: Float[np.ndarray, "all"], sigma: Float[np.ndarray, "nv"]) -> NormalEquations:
        """The part of the weighted measurements."""
        slopes = self.slope(self.split(at)[0])
        if self.links is not None:
            slopes = np.concatenate([slopes, -self.links.regressor.reshape(*slopes.shape[:2], -1)], axis=-1)
        rows, rest = (slopes / sigma[:, None])[self.moving], (self.left(at) / sigma)[self.moving]
        return NormalEquations(float(rest @ rest), rows.T @ rest, rows.T @ rows)

    def prior(self, at: Float[np.ndarray, "all"]) -> NormalEquations:
        """The part of the prior."""
        gradient, hessian, loss = np.zeros(len(at)), np.zeros((len(at), len(at))), 0.0
        if self.links is not None:
            vector, bodies = self.split(at)
            first = len(vector)
            for share, slopes in zip(*self.links.pulled(bodies), strict=True):
                own = slice(first, first + 10)
                gradient[own], hessian[own, own] = slopes.T @ share, slopes.T @ slopes
                loss, first = loss + float(share @ share), first + 10
        return NormalEquations(loss, gradient, hessian)


def _descend(
    equation: _Equation, at: Float[np.ndarray, "all"], sigma: Float[np.ndarray, "nv"]
) -> Float[np.ndarray, "all"]:
    """The numbers with the least loss: steps of Gauss, Newton, Levenberg and Marquardt within bounds."""
    loss, damping = equation.loss(at, sigma), 0.0
    for _ in range(_STEPS):
        parts = equation.measured(at, sigma), equation.prior(at)
        gradient, hessian = parts[0].gradient + parts[1].gradient, parts[0].hessian + parts[1].hessian
        step = _step(gradient, hessian * (1 + damping * np.eye(len(at))), *(end - at for end in equation.bounds))
        promised = -float(2 * step @ gradient + step @ hessian @ step)
        if promised <= _TOLERANCE * loss:
            break
        for share in 0.5 ** np.arange(_HALVINGS):
            tried = equation.loss(at + share * step, sigma)
            if tried < loss:
                at, loss, damping = at + share * step, tried, damping / 10 if share == 1 else damping
                break
        else:
            damping = max(10 * damping, 1e-3)
            if damping > 1e6:
                break
    return at


def _step(
    gradient: Float[np.ndarray, "all"],
    hessian: Float[np.ndarray, "all all"],
    low: Float[np.ndarray, "all"],
    high: Float[np.ndarray, "all"],
) -> Float[np.ndarray, "all"]:
    """The step to the least of a quadratic within bounds."""
    scale = np.sqrt(np.maximum(np.diag(hessian), np.finfo(float).tiny))
    residual, slopes = compress(NormalEquations(0.0, gradient, hessian), 1.0)
    found = scipy.optimize.lsq_linear(slopes / scale, -residual, (low * scale, high * scale))
    return np.clip(found.x / scale, low, high)


def _deviation(
    residual: Float[np.ndarray, "rows nv"], moving: Bool[np.ndarray, "rows nv"], used: float
) -> Float[np.ndarray, "nv"]:
    """Of each joint's residual, with so many degrees of freedom used up in it."""
    squares = np.where(moving, np.square(residual), 0).sum(axis=0)
    deviation = np.sqrt(squares / np.maximum(moving.sum(axis=0) - used, 1))
    return np.maximum(deviation, 1e-9 * max(float(deviation.max()), 1e-300))
