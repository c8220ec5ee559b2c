"""Weighted least squares on torque: parameters for which inverse dynamics matches the measured torque."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float

from frictionzoo.bench.inertia import LogCholesky, is_consistent
from frictionzoo.fit.normal_equations import NormalEquations, bounded_step
from frictionzoo.fit.space import Box

Lack = Callable[[Float[np.ndarray, "coordinates"]], Float[np.ndarray, "rows nv"]]
Slope = Callable[[Float[np.ndarray, "coordinates"]], Float[np.ndarray, "rows nv coordinates"]]

_PASSES = 50  # rounds of weights; five are usual
_SETTLED = 1e-3  # relative change of the weights below which they have converged
_STEPS = 10  # steps with the same weights; few, because the weights still change
_STIFFEST = 1e6  # damping above which only rounding could lower the loss
_HALVINGS = 6  # step lengths tried, each half of the one before
_BEND = 1e-5  # step of the finite difference in coordinates
_TOLERANCE = 1e-7  # least predicted decrease, as a share of the loss: a hundredth of a standard error


@dataclass(frozen=True)
class Links:
    """Bodies whose inertia is identified together with the drives' parameters.

    Attributes:
        regressor: Torque per unit of each inertial parameter, filtered and decimated.
        around: Coordinates of the bodies; all are 0 for the model file's inertia.
        spread: Standard deviation of each coordinate's prior, whose mean is 0.
    """

    regressor: Float[np.ndarray, "rows nv bodies 10"]
    around: LogCholesky
    spread: Float[np.ndarray, "bodies 10"]

    def torque(self, parameters: Float[np.ndarray, "bodies 10"]) -> Float[np.ndarray, "rows nv"]:
        """Return the torque that bodies with these parameters need beyond the model file's bodies."""
        return np.einsum("rvbk,bk->rv", self.regressor, parameters - self.maker)

    @cached_property
    def maker(self) -> Float[np.ndarray, "bodies 10"]:
        """Parameters of the bodies in the model file."""
        return self.around.parameters(np.zeros_like(self.spread))

    def prior(
        self, parameters: Float[np.ndarray, "bodies 10"]
    ) -> tuple[float, Float[np.ndarray, "bodies 10"], Float[np.ndarray, "2 bodies 10 10"]]:
        """Return the prior's loss, half its gradient, and half its second derivative in two versions.

        The first is the Gauss-Newton approximation. The second adds positive curvature only: the logarithmic
        coordinates bend towards a body without extent, and Gauss-Newton steps would leave the physically consistent
        bodies.
        """
        coordinates = self.around.coordinates(parameters)
        by_parameters = np.linalg.inv(self.around.slopes(coordinates))
        sloped = by_parameters / self.spread[:, :, None]
        gauss = sloped.swapaxes(1, 2) @ sloped
        pulls = [[self._pull(coordinates + side * step) for side in (1, -1)] for step in _BEND * np.eye(10)]
        curvature = np.stack([(up - down) / (2 * _BEND) for up, down in pulls], axis=-1) @ by_parameters
        values, axes = np.linalg.eigh((curvature + curvature.swapaxes(1, 2)) / 2 - gauss)
        complete = gauss + (axes * np.maximum(values, 0)[:, None, :]) @ axes.swapaxes(1, 2)
        return self.far(parameters), self._pull(coordinates), np.stack([gauss, complete])

    def far(self, parameters: Float[np.ndarray, "bodies 10"]) -> float:
        """Return the prior's loss."""
        return float(np.square(self.around.coordinates(parameters) / self.spread).sum())

    def _pull(self, at: Float[np.ndarray, "bodies 10"]) -> Float[np.ndarray, "bodies 10"]:
        """Return half the prior's gradient with respect to the parameters, at these coordinates."""
        return np.linalg.solve(self.around.slopes(at).swapaxes(1, 2), (at / self.spread**2)[..., None])[..., 0]


@dataclass(frozen=True)
class Balance:
    """Result of the weighted least squares.

    Attributes:
        bodies: Inertial parameters of the bodies, of shape (bodies, 10); no row without `Links`.
        residual: Residual torque at all samples, moving or not [N m or N].
        sigma: Standard deviation of each joint's residual torque where it moves, used as weight [N m or N].
        information: J' J of the weighted measurements, over `vector` and then the parameters, body after body.
        prior: The prior's contribution to it.
    """

    vector: Float[np.ndarray, "coordinates"]
    bodies: Float[np.ndarray, "bodies 10"]
    residual: Float[np.ndarray, "rows nv"]
    sigma: Float[np.ndarray, "nv"]
    information: Float[np.ndarray, "all all"]
    prior: Float[np.ndarray, "all all"]

    @property
    def errors(self) -> Float[np.ndarray, "coordinates"]:
        """Standard error of each entry of `vector`; infinite where undetermined."""
        return np.sqrt(np.diag(invert(self.information + self.prior)))[: len(self.vector)]


def append_links(
    slopes: Float[np.ndarray, "rows nv coordinates"], links: Links | None
) -> Float[np.ndarray, "rows nv all"]:
    """Return derivatives of the residual torque, extended by those with respect to the links' parameters."""
    if links is None:
        return slopes
    return np.concatenate([slopes, -links.regressor.reshape(*slopes.shape[:2], -1)], axis=-1)


def invert(information: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Return the covariance of a positive semidefinite information matrix; infinite variance where undetermined."""
    scale = np.sqrt(np.diag(information))
    determined = scale > 0
    scale = np.where(determined, scale, 1.0)
    values, axes = np.linalg.eigh(information / np.outer(scale, scale))
    kept = values > len(values) * np.finfo(float).eps * max(values[-1], 0.0)
    covariance = (axes[:, kept] / values[kept]) @ axes[:, kept].T / np.outer(scale, scale)
    undetermined = np.square(axes[:, ~kept]).sum(axis=1) > 1e-8
    covariance[undetermined, undetermined] = np.inf
    return covariance


def balance(
    lack: Lack,
    slope: Slope,
    box: Box,
    moving: Bool[np.ndarray, "rows nv"],
    links: Links | None = None,
) -> Balance:
    """Minimise the residual torque, with each joint weighted by the inverse deviation of its residual.

    Least squares repeats with the deviations of the previous residuals until the weights converge. For models that are
    linear in their coordinates this is the inverse dynamics identification model (IDIM-LS) with weights; others take a
    few Gauss-Newton steps in each round.

    `lack` is the residual torque with the model file's bodies, `slope` its derivative. `moving` marks the samples that
    count. The inertia of `links` is identified too.

    Source: M. Gautier, "Dynamic identification of robots with power model", 1997; M. Gautier, P. Poignet, "Extended
    Kalman filtering and weighted least squares dynamic identification of robot", 2001, for the weights; T. Lee, P.
    Wensing, F. Park, "Geometric robot dynamic identification: a convex programming approach", 2020, for a prior around
    the model file's bodies.
    """
    equation = _Equation(lack, slope, links, moving, box)
    values = equation.start
    sigma = _deviation(equation.left(values), moving, 0.0)
    for _ in range(_PASSES):
        values, converged = _descend(equation, values, sigma)
        last_sigma, sigma = sigma, _deviation(equation.left(values), moving, len(values) / len(sigma))
        if converged and (np.abs(sigma / last_sigma - 1) < _SETTLED).all():
            break
    vector, bodies = equation.split(values)
    information, prior = (part.hessian for part in (equation.measured(values, sigma), equation.prior(values, False)))
    return Balance(vector, bodies, equation.left(values), sigma, information, prior)


@dataclass(frozen=True)
class _Equation:
    """Residual torque as a function of all unknowns: the vector, then the bodies' inertial parameters.

    The torque is linear in these. In the bodies' coordinates the valley of nearly equal torques is narrow and curved,
    and a search needs thousands of steps.
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
        """Return the loss; infinite where the parameters are not physically consistent."""
        if not is_consistent(self.split(at)[1]).all():
            return np.inf
        weighted = (self.left(at) / sigma)[self.moving]
        return float(weighted @ weighted) + (0.0 if self.links is None else self.links.far(self.split(at)[1]))

    def measured(self, at: Float[np.ndarray, "all"], sigma: Float[np.ndarray, "nv"]) -> NormalEquations:
        slopes = append_links(self.slope(self.split(at)[0]), self.links)
        rows, residual = (slopes / sigma[:, None])[self.moving], (self.left(at) / sigma)[self.moving]
        return NormalEquations(float(residual @ residual), rows.T @ residual, rows.T @ rows)

    def prior(self, at: Float[np.ndarray, "all"], whole: bool) -> NormalEquations:
        """Return the normal equations of the prior, with its whole second derivative or the Gauss-Newton one."""
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
    """Take Levenberg-Marquardt steps within bounds; also return whether they reached the minimum."""
    loss, damping = equation.loss(at, sigma), 0.0
    for _ in range(_STEPS):
        parts = equation.measured(at, sigma), equation.prior(at, whole=True)
        gradient, hessian = parts[0].gradient + parts[1].gradient, parts[0].hessian + parts[1].hessian
        step = bounded_step(gradient, hessian * (1 + damping * np.eye(len(at))), *(end - at for end in equation.bounds))
        decrease = -float(2 * step @ gradient + step @ hessian @ step)
        if decrease <= _TOLERANCE * loss:
            return at, True
        for share in 0.5 ** np.arange(_HALVINGS):
            trial_loss = equation.loss(at + share * step, sigma)
            if trial_loss < loss:
                at, loss, damping = at + share * step, trial_loss, damping / 10 if share == 1 else damping
                break
        else:
            damping = max(10 * damping, 1e-3)
            if damping > _STIFFEST:
                return at, True
    return at, False


def _deviation(
    residual: Float[np.ndarray, "rows nv"], moving: Bool[np.ndarray, "rows nv"], used: float
) -> Float[np.ndarray, "nv"]:
    """Return the standard deviation of each joint's residual, less `used` degrees of freedom."""
    squares = np.where(moving, np.square(residual), 0).sum(axis=0)
    deviation = np.sqrt(squares / np.maximum(moving.sum(axis=0) - used, 1))
    return np.maximum(deviation, 1e-9 * max(float(deviation.max()), 1e-300))
