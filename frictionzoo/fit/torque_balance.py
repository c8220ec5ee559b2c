"""Weighted least squares on torque: parameters for which inverse dynamics matches the measured torque."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float

from frictionzoo.bench.inertia import LogCholesky, inertial_parameters, is_consistent
from frictionzoo.bench.regressor import inertial_regressor
from frictionzoo.fit.normal_equations import Damping, NormalEquations, descend
from frictionzoo.fit.space import Box
from frictionzoo.fit.torque_equation import TorqueEquation

_PASSES = 50  # rounds of weights; five are usual
_SETTLED = 1e-3  # relative change of the weights below which they have converged
_STEPS = 10  # steps with the same weights; few, because the weights still change
_LENGTHS = tuple(0.5**halvings for halvings in range(6))  # shares of a step that are tried
_BEND = 1e-5  # step of the finite difference in coordinates
_TOLERANCE = 1e-7  # least predicted decrease, as a share of the loss: a hundredth of a standard error


@dataclass(frozen=True)
class FreeLinks:
    """Bodies whose inertia is identified together with the drives' parameters.

    Attributes:
        regressor: Torque per unit of each inertial parameter, filtered and decimated.
        around: Coordinates of the bodies; all are 0 for the model file's inertia.
        spread: Standard deviation of each coordinate's prior, whose mean is 0.
    """

    regressor: Float[np.ndarray, "rows nv bodies 10"]
    around: LogCholesky
    spread: Float[np.ndarray, "bodies 10"]

    @classmethod
    def of(cls, equation: TorqueEquation, bodies: Sequence[int], spread: Float[np.ndarray, "10"]) -> "FreeLinks":
        """Return torque regressor and prior of bodies; `spread` are standard deviations of a body's coordinates."""
        model = equation.bench.compile(constraint=False)
        regressor = np.concatenate([inertial_regressor(model, bodies, *motion) for motion in equation.motions])
        names = [model.body(body).name for body in bodies]
        around = LogCholesky.around(inertial_parameters(model, bodies), names)
        return cls(equation.decimate(regressor), around, np.tile(spread, (len(bodies), 1)))

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
        loss = float(np.square(coordinates / self.spread).sum())
        return loss, self._pull(coordinates), np.stack([gauss, complete])

    def _pull(self, at: Float[np.ndarray, "bodies 10"]) -> Float[np.ndarray, "bodies 10"]:
        """Return half the prior's gradient with respect to the parameters, at these coordinates."""
        return np.linalg.solve(self.around.slopes(at).swapaxes(1, 2), (at / self.spread**2)[..., None])[..., 0]


@dataclass(frozen=True)
class BalanceSolution:
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
    slopes: Float[np.ndarray, "rows nv coordinates"], links: FreeLinks | None
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


def balance(equation: TorqueEquation, links: FreeLinks | None = None) -> BalanceSolution:
    """Minimise the residual torque, with each joint weighted by the inverse deviation of its residual.

    Least squares repeats with the deviations of the previous residuals until the weights converge. For models that are
    linear in their coordinates this is the inverse dynamics identification model (IDIM-LS) with weights; others take a
    few Gauss-Newton steps in each round. The inertia of `links` is identified too.

    Source: M. Gautier, "Dynamic identification of robots with power model", 1997; M. Gautier, P. Poignet, "Extended
    Kalman filtering and weighted least squares dynamic identification of robot", 2001, for the weights; T. Lee, P.
    Wensing, F. Park, "Geometric robot dynamic identification: a convex programming approach", 2020, for a prior around
    the model file's bodies.
    """
    unknowns, moving = _Unknowns(equation, links), equation.moving
    box = unknowns.box
    sigma = _deviation(unknowns.residual(box.start), moving, 0.0)
    for _ in range(_PASSES):
        evaluate = partial(unknowns.evaluate, sigma=sigma)
        values, _, converged = descend(
            evaluate, box, _STEPS + 1, _TOLERANCE, damping=Damping(0.0, 1e-3), lengths=_LENGTHS
        )
        box = box._replace(start=values)
        last_sigma, sigma = sigma, _deviation(unknowns.residual(values), moving, len(values) / len(sigma))
        if converged and (np.abs(sigma / last_sigma - 1) < _SETTLED).all():
            break
    information, prior = (
        part.hessian for part in (unknowns.measured(box.start, sigma), unknowns.prior(box.start, whole=False))
    )
    return BalanceSolution(*unknowns.split(box.start), unknowns.residual(box.start), sigma, information, prior)


@dataclass(frozen=True)
class _Unknowns:
    """Residual torque as a function of all unknowns: the vector, then the bodies' inertial parameters.

    The torque is linear in these. In the bodies' coordinates the valley of nearly equal torques is narrow and curved,
    and a search needs thousands of steps.
    """

    equation: TorqueEquation
    links: FreeLinks | None

    @property
    def box(self) -> Box:
        start, low, high = self.equation.box
        bodies = np.zeros(0) if self.links is None else self.links.maker.ravel()
        free = np.full(len(bodies), np.inf)
        return Box(np.append(np.clip(start, low, high), bodies), np.append(low, -free), np.append(high, free))

    def split(self, at: Float[np.ndarray, "all"]) -> tuple[Float[np.ndarray, "_"], Float[np.ndarray, "bodies 10"]]:
        size = len(self.equation.box.start)
        return at[:size], at[size:].reshape(-1, 10)

    def residual(self, at: Float[np.ndarray, "all"]) -> Float[np.ndarray, "rows nv"]:
        vector, bodies = self.split(at)
        lack = self.equation.lack(vector)
        return lack if self.links is None else lack - self.links.torque(bodies)

    def evaluate(self, at: Float[np.ndarray, "all"], sigma: Float[np.ndarray, "nv"]) -> NormalEquations:
        """Return the normal equations; an infinite loss where the parameters are not physically consistent."""
        if not is_consistent(self.split(at)[1]).all():
            return NormalEquations(np.inf, np.zeros(len(at)), np.zeros((len(at), len(at))))
        one, other = self.measured(at, sigma), self.prior(at, whole=True)
        return NormalEquations(one.loss + other.loss, one.gradient + other.gradient, one.hessian + other.hessian)

    def measured(self, at: Float[np.ndarray, "all"], sigma: Float[np.ndarray, "nv"]) -> NormalEquations:
        moving, slopes = self.equation.moving, append_links(self.equation.slope(self.split(at)[0]), self.links)
        rows, residual = (slopes / sigma[:, None])[moving], (self.residual(at) / sigma)[moving]
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


def _deviation(
    residual: Float[np.ndarray, "rows nv"], moving: Bool[np.ndarray, "rows nv"], used: float
) -> Float[np.ndarray, "nv"]:
    """Return the standard deviation of each joint's residual, less `used` degrees of freedom."""
    squares = np.where(moving, np.square(residual), 0).sum(axis=0)
    deviation = np.sqrt(squares / np.maximum(moving.sum(axis=0) - used, 1))
    return np.maximum(deviation, 1e-9 * max(float(deviation.max()), 1e-300))
