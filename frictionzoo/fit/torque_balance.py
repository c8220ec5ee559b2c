"""Weighted least squares on torque: the numbers that let inverse dynamics balance what was measured.

Functions of arrays and of callables; what the coordinates mean is the caller's.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float

from frictionzoo.bench.inertia import LogCholesky, is_consistent
from frictionzoo.fit.normal_equations import NormalEquations, bounded_step

Lack = Callable[[Float[np.ndarray, "coordinates"]], Float[np.ndarray, "rows nv"]]
Slope = Callable[[Float[np.ndarray, "coordinates"]], Float[np.ndarray, "rows nv coordinates"]]

_PASSES = 50  # rounds of weights; five are usual
_SETTLED = 1e-3  # relative change of the weights below which they count as found
_STEPS = 10  # with the same weights: they are not those of the end yet
_STIFFEST = 1e6  # damping with which no step lowers the loss any more but by rounding
_HALVINGS = 6  # of a step that does not lower the loss
_BEND = 1e-5  # step of the difference in coordinates
_TOLERANCE = 1e-7  # share of the loss that a step has to promise: a hundredth of a standard error


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

    def prior(
        self, parameters: Float[np.ndarray, "bodies 10"]
    ) -> tuple[float, Float[np.ndarray, "bodies 10"], Float[np.ndarray, "2 bodies 10 10"]]:
        """Of the prior at these parameters its loss, half its gradient, and half its second derivative, twice.

        First as Gauss and Newton have it, then whole but for negative curvature: towards a body without extent the
        logarithms bend, and without that steps would leave what bodies there are.
        """
        at = self.around.coordinates(parameters)
        by_parameters = np.linalg.inv(self.around.slopes(at))
        sloped = by_parameters / self.spread[:, :, None]
        gauss = sloped.swapaxes(1, 2) @ sloped
        ends = [[self._pull(at + side * step) for side in (1, -1)] for step in _BEND * np.eye(10)]
        moved = np.stack([(up - down) / (2 * _BEND) for up, down in ends], axis=-1) @ by_parameters
        values, axes = np.linalg.eigh((moved + moved.swapaxes(1, 2)) / 2 - gauss)
        whole = gauss + (axes * np.maximum(values, 0)[:, None, :]) @ axes.swapaxes(1, 2)
        return self.far(parameters), self._pull(at), np.stack([gauss, whole])

    def far(self, parameters: Float[np.ndarray, "bodies 10"]) -> float:
        """The prior's loss."""
        return float(np.square(self.around.coordinates(parameters) / self.spread).sum())

    def _pull(self, at: Float[np.ndarray, "bodies 10"]) -> Float[np.ndarray, "bodies 10"]:
        """Half the prior's gradient by the parameters, at coordinates."""
        return np.linalg.solve(self.around.slopes(at).swapaxes(1, 2), (at / self.spread**2)[..., None])[..., 0]


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
        at, lowest = _descend(equation, at, sigma)
        before, sigma = sigma, _deviation(equation.left(at), moving, len(at) / len(sigma))
        if lowest and (np.abs(sigma / before - 1) < _SETTLED).all():
            break
    vector, bodies = equation.split(at)
    information, prior = (part.hessian for part in (equation.measured(at, sigma), equation.prior(at, False)))
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
        return float(weighted @ weighted) + (0.0 if self.links is None else self.links.far(self.split(at)[1]))

    def measured(self, at: Float[np.ndarray, "all"], sigma: Float[np.ndarray, "nv"]) -> NormalEquations:
        """The part of the weighted measurements."""
        slopes = self.slope(self.split(at)[0])
        if self.links is not None:
            slopes = np.concatenate([slopes, -self.links.regressor.reshape(*slopes.shape[:2], -1)], axis=-1)
        rows, rest = (slopes / sigma[:, None])[self.moving], (self.left(at) / sigma)[self.moving]
        return NormalEquations(float(rest @ rest), rows.T @ rest, rows.T @ rows)

    def prior(self, at: Float[np.ndarray, "all"], whole: bool) -> NormalEquations:
        """The part of the prior, with its whole second derivative or that of Gauss and Newton."""
        gradient, hessian, loss = np.zeros(len(at)), np.zeros((len(at), len(at))), 0.0
        if self.links is not None:
            vector, bodies = self.split(at)
            loss, pull, curvatures = self.links.prior(bodies)
            gradient[len(vector) :] = pull.ravel()
            hessian[len(vector) :, len(vector) :] = scipy.linalg.block_diag(*curvatures[int(whole)])
        return NormalEquations(loss, gradient, hessian)


def _descend(
    equation: _Equation, at: Float[np.ndarray, "all"], sigma: Float[np.ndarray, "nv"]
) -> tuple[Float[np.ndarray, "all"], bool]:
    """Steps of Gauss, Newton, Levenberg and Marquardt within bounds, and whether they came to the least loss."""
    loss, damping = equation.loss(at, sigma), 0.0
    for _ in range(_STEPS):
        parts = equation.measured(at, sigma), equation.prior(at, whole=True)
        gradient, hessian = parts[0].gradient + parts[1].gradient, parts[0].hessian + parts[1].hessian
        step = bounded_step(gradient, hessian * (1 + damping * np.eye(len(at))), *(end - at for end in equation.bounds))
        promised = -float(2 * step @ gradient + step @ hessian @ step)
        if promised <= _TOLERANCE * loss:
            return at, True
        for share in 0.5 ** np.arange(_HALVINGS):
            tried = equation.loss(at + share * step, sigma)
            if tried < loss:
                at, loss, damping = at + share * step, tried, damping / 10 if share == 1 else damping
                break
        else:
            damping = max(10 * damping, 1e-3)
            if damping > _STIFFEST:
                return at, True
    return at, False


def _deviation(
    residual: Float[np.ndarray, "rows nv"], moving: Bool[np.ndarray, "rows nv"], used: float
) -> Float[np.ndarray, "nv"]:
    """Of each joint's residual, with so many degrees of freedom used up in it."""
    squares = np.where(moving, np.square(residual), 0).sum(axis=0)
    deviation = np.sqrt(squares / np.maximum(moving.sum(axis=0) - used, 1))
    return np.maximum(deviation, 1e-9 * max(float(deviation.max()), 1e-300))
