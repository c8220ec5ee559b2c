"""Levenberg-Marquardt on exact Jacobians, by scipy's trust-region solver for bounded least squares."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Float

from frictionzoo.core.errors import ConfigError, refuse_outside
from frictionzoo.fit.base import Chunk, Fit, Progress, Trace, begin, refuse_nothing, refuse_torch, register_method
from frictionzoo.fit.objective import NormalEquations, Objective

MOST_TRIES = 10_000  # each is remembered with its second derivative; ten are usual
MOST_COORDINATES = 200  # a Jacobian has a column for each: more are a network's weights
_SLACK = 30.0  # of the floating-point type's precision, below which a change of the loss is rounding


Evaluate = Callable[[np.ndarray], NormalEquations]


class Memory(NamedTuple):
    """What was found so far, so that an interrupted fit is repeated from it instead of from the simulator.

    Attributes:
        loss: The objective at each vector that the solver asked for, of shape (iterations,).
        gradient: Half its gradient, (iterations, coordinates).
        hessian: Half its approximate second derivative, (iterations, coordinates, coordinates).
    """

    loss: np.ndarray
    gradient: np.ndarray
    hessian: np.ndarray


@register_method("lm")
class LevenbergMarquardt(Fit):
    """scipy's `least_squares`, method `trf`: a trust region within bounds, each coordinate scaled by its column.

    The solver is given not the residuals, of which a long log has millions, but n + 1 numbers of the same sum of
    squares, gradient and approximate second derivative for n coordinates. An iteration is one vector that it asks for.

    Source: K. Levenberg 1944; D. Marquardt 1963; M. Branch, T. Coleman, Y. Li, "A Subspace, Interior, and Conjugate
    Gradient Method for Large-Scale Bound-Constrained Minimization Problems", 1999, for the bounds.

    Args:
        iterations: Largest number of vectors that are tried.
        tolerance: Relative change of the loss or of the vector from which on the fit has converged; in float32 at least
            its precision.

    Raises:
        ConfigError: An argument is out of range.
    """

    def __init__(self, iterations: int = 100, tolerance: float = 1e-8) -> None:
        refuse_outside("fit.iterations", iterations, 1, MOST_TRIES)
        if not 0 < tolerance < 1:
            raise ConfigError(f"fit.tolerance={tolerance}; expected a number between 0 and 1")
        self._iterations = iterations
        self._tolerance = tolerance

    def total(self, objective: Objective) -> int:
        """See `Fit.total`; raises ConfigError for a network, whose Jacobian has too many columns, and for nothing.

        And for a law that exists only in torch.
        """
        refuse_nothing(objective)
        refuse_torch(objective, self.name)
        coordinates = len(objective.space.start)
        if coordinates > MOST_COORDINATES:
            raise ConfigError(
                f"fit=lm: {coordinates} coordinates ({objective.space.names[-1]} among them), expected at most "
                f"{MOST_COORDINATES}; use fit=adam"
            )
        return self._iterations

    def start(self, objective: Objective) -> Progress:
        """See `Fit.start`."""
        vector = objective.space.start
        shape = (self._iterations, *vector.shape)
        return begin(objective, vector, Memory(np.zeros(shape[0]), np.zeros(shape), np.zeros((*shape, len(vector)))))

    def chunk(self, objective: Objective, size: int) -> Chunk:
        """See `Fit.chunk`."""
        self.total(objective)
        evaluate = objective.compile_normal_equations()
        identified = jax.jit(jax.vmap(objective.space.identified))
        identified(jnp.zeros((size, len(objective.space.start)), objective.space.start.dtype))  # compiles it

        def run(progress: Progress, count: int) -> tuple[Progress, Trace]:
            solver = _Solver(objective, evaluate, progress.method, int(progress.iteration), count)
            converged = solver.solve(self._tolerance)
            following = solver.update(progress, converged)
            rows = np.zeros((size, len(progress.vector)))
            rows[: len(solver.fresh)] = solver.fresh
            params = identified(jnp.asarray(rows, progress.vector.dtype))
            done = slice(int(progress.iteration), int(progress.iteration) + size)
            gradients = 2 * np.linalg.norm(following.method.gradient[done], axis=1)
            losses = np.resize(following.method.loss[done], size)
            trace = Trace(losses, np.resize(gradients, size), dict(params))
            return following, trace

        return run


class _PauseError(Exception):
    """The chunk's iterations are used up."""


class _Solver:
    """One run of scipy's solver over what is remembered and up to `count` vectors more."""

    def __init__(self, objective: Objective, evaluate: Evaluate, memory: Memory, known: int, count: int) -> None:
        self.fresh: list[np.ndarray] = []
        self.broken = False
        self._objective = objective
        self._evaluate = evaluate
        self._memory = Memory(*(part.copy() for part in memory))
        self._known, self._count = known, count
        self._vectors: list[np.ndarray] = []
        self._last: NormalEquations | None = None

    def solve(self, tolerance: float) -> bool:
        """Whether the solver ended of itself."""
        space = self._objective.space
        tolerance = max(tolerance, _SLACK * float(np.finfo(space.start.dtype).eps))
        low, high, start = (np.asarray(side, np.float64) for side in (space.low, space.high, space.start))
        try:
            found = scipy.optimize.least_squares(
                self._residuals,
                np.clip(start, low, high),
                jac=self._jacobian,  # pyright: ignore[reportArgumentType] - a function is one of its kinds
                bounds=(low, high),
                x_scale="jac",
                ftol=tolerance,
                xtol=tolerance,
                gtol=tolerance,
                max_nfev=len(self._memory.loss),
            )
        except _PauseError:
            return False
        return found.status > 0  # 0: the number of vectors is used up

    def update(self, progress: Progress, converged: bool) -> Progress:
        """The progress after this run."""
        losses = self._memory.loss[: len(self._vectors)]
        finite = np.where(np.isfinite(losses), losses, np.inf)
        best = int(np.argmin(finite)) if len(finite) and np.isfinite(finite).any() else -1
        dtype = progress.vector.dtype
        return progress._replace(
            # A vector without a finite loss is none, as in other methods.
            iteration=jnp.asarray(0 if self.broken else len(self._vectors)),
            vector=jnp.asarray(self._vectors[-1], dtype),
            best=jnp.asarray(self._vectors[max(best, 0)], dtype),
            best_loss=jnp.asarray(finite[best] if best >= 0 else np.inf, dtype),
            best_iteration=jnp.asarray(best),
            broken=jnp.asarray(self.broken),
            converged=jnp.asarray(converged),
            gradient=jnp.asarray(2 * self._memory.gradient[len(self._vectors) - 1], dtype),
            method=self._memory,
        )

    def _equations(self, vector: Float[np.ndarray, "coordinates"]) -> NormalEquations:
        """From memory, or anew; the solver asks for the same vectors in the same order whenever it starts again."""
        number = len(self._vectors)
        if number >= self._known:
            if len(self.fresh) == self._count or number == len(self._memory.loss):
                raise _PauseError
            found = self._evaluate(vector)
            for part, value in zip(self._memory, found, strict=True):
                part[number] = value
            self.fresh.append(vector.copy())
        self._vectors.append(vector.copy())
        return NormalEquations(*(part[number] for part in self._memory))

    def _residuals(self, vector: Float[np.ndarray, "coordinates"]) -> Float[np.ndarray, "compressed"]:
        equations = self._equations(vector)
        if not all(np.isfinite(part).all() for part in equations):
            if len(self._vectors) == 1:
                self.broken = True
                raise _PauseError
            return np.full(len(vector) + 1, np.inf)  # the solver takes it back and tries a shorter step
        self._last = equations
        return _compress(equations, self._unit)[0]

    def _jacobian(self, vector: Float[np.ndarray, "coordinates"]) -> Float[np.ndarray, "compressed coordinates"]:
        assert self._last is not None
        return _compress(self._last, self._unit)[1]

    @property
    def _unit(self) -> float:
        """The loss at the start, so that tolerances mean shares of it."""
        return float(self._memory.loss[0]) or 1.0


def _compress(
    equations: NormalEquations, unit: float
) -> tuple[Float[np.ndarray, "compressed"], Float[np.ndarray, "compressed coordinates"]]:
    """N + 1 residuals and their Jacobian with the same loss, gradient and J' J.

    With J' J = V diag(w) V', the rows diag(sqrt(w)) V' are a Jacobian, and diag(1 / sqrt(w)) V' J' r are the residuals'
    part within its columns' span; the last residual is the rest, which no coordinate moves.
    """
    scale = np.sqrt(np.maximum(np.diag(equations.hessian), np.finfo(float).tiny))
    eigenvalues, vectors = np.linalg.eigh(equations.hessian / np.outer(scale, scale))
    kept = eigenvalues > np.finfo(float).eps * len(scale) * max(eigenvalues[-1], 0)
    roots = np.sqrt(np.where(kept, eigenvalues, 0.0))
    jacobian = roots[:, None] * vectors.T * scale
    inside = np.where(kept, vectors.T @ (equations.gradient / scale), 0.0) / np.where(kept, roots, 1.0)
    rest = np.sqrt(max(equations.loss - inside @ inside, 0.0))
    root = np.sqrt(unit)
    return np.append(inside, rest) / root, np.vstack([jacobian, np.zeros(len(scale))]) / root
