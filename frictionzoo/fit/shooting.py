"""Multiple shooting: initial states of all segments, estimated from the segments and their neighbours."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float

from frictionzoo.fit.blocks import Blocks
from frictionzoo.fit.sparsity import Sparsity
from frictionzoo.simulation import Values
from frictionzoo.simulation.linear import solve_spd

_MOST_LOOKS = 6  # trial states; few, because rollouts are nearly linear in them except where a joint starts or stops
_ALONE = 1e-12  # predicted gain of the next step, as a share of the sum of squares, that ends a search outside a fit
_SETTLED, _APART = 1e-4, 0.1
"""Shares that end a search within a fit, which subtracts the predicted gain of the next step from the sum of squares
and may therefore stop early: the first of the sum or, if larger, the second of its change between two vectors."""
DAMPING, MOST_DAMPING = 1e-2, 10.0
"""Damping of Levenberg-Marquardt at first, and at least after a failed step; at most where a search begins."""
_SHORTEST = 0.03
"""Least time constant of an initial velocity, in sample intervals, that its curvature is increased by. Where a joint
sticks or velocity decays within a sample, velocity and position are indistinguishable, and without it a step would be
tens of rad/s or, where the equations are singular up to rounding, rounding error."""


class Local(NamedTuple):
    """Sum of squares of each segment near its initial state, by branch and segment.

    Attributes:
        gradient: Half its gradient with respect to the segment's initial state, J' r.
        hessian: J' J, with the curvature `bend`.
        gap: Weighted defects between the segment's end and the next initial state, in the order of the states.
        gap_slopes: Derivative of the defects with respect to the segment's initial state, which is the first axis.
    """

    square: Float[Array, "branches segments"]
    gradient: Float[Array, "branches segments state"]
    hessian: Float[Array, "branches segments state state"]
    gap: Float[Array, "branches segments state"]
    gap_slopes: Float[Array, "branches segments state state"]


class Mixed(NamedTuple):
    """Mixed second derivatives of coordinates and initial states.

    Attributes:
        own: Product of the residuals' derivatives with respect to the segment's initial state and to each tangent.
        gap: Derivative of the defects with respect to each tangent.
    """

    own: Float[Array, "branches segments state tangents"]
    gap: Float[Array, "branches segments state tangents"]


class SearchStart(NamedTuple):
    """Start of a search for initial states.

    Attributes:
        states: Best initial states at a vector, (blocks, segments, twice nv).
        vector: That vector, of shape (coordinates,).
        slopes: Derivative of the states with respect to each tangent, (branches, segments, state, tangents).
        square: The sum of squares there; infinite where unknown.
        damping: Damping of each segment, by branch: large where the motion has a corner, which is there again.
    """

    states: Any
    vector: Any
    slopes: Any
    square: Any
    damping: Any


class StateSearch(NamedTuple):
    """Progress of a search for initial states, by branch and segment.

    Attributes:
        trial: The next states to try.
        state: The best states so far.
        local: The sum of squares at the best states.
        damping: Levenberg-Marquardt damping of each segment.
        other: The sum of squares at the fit's previous vector; infinite at its first vector, NaN outside a fit.
        gain: Predicted decrease of the sum of squares from the last trial to the next.
        settled: Whether the gain is small enough to end the search.
    """

    trial: Float[Array, "branches segments state"]
    state: Float[Array, "branches segments state"]
    local: Local
    damping: Float[Array, "branches segments"]
    looks: Any
    other: Any
    gain: Any
    settled: Any
    ended: Any

    @classmethod
    def begin(
        cls,
        begun: Float[Array, "branches segments state"],
        unknown: Local,
        other: Any = jnp.nan,
        damping: Any = DAMPING,
    ) -> "StateSearch":
        """Return a search that begins at these states; `unknown` is a `Local` filled with infinity."""
        damping, no = jnp.full(begun.shape[:2], damping, begun.dtype), jnp.asarray(False)
        other, gain = (jnp.asarray(value, begun.dtype) for value in (other, 0.0))
        return cls(begun, begun, unknown, damping, jnp.asarray(0), other, gain, no, no)


class Equations(NamedTuple):
    """Sum of squares near a vector and initial states, by branch.

    Attributes:
        gradient: Half its gradient with respect to each tangent.
        hessian: J' J of the tangents.
        local: The part of the initial states; None, like `mixed`, where they are not estimated.
    """

    loss: Float[Any, ""]
    gradient: Float[Any, "branches segments tangents"]
    hessian: Float[Any, "branches tangents tangents"]
    local: Local | None = None
    mixed: Mixed | None = None


class Shooting(NamedTuple):
    """Estimator of the initial states of all segments.

    Where segments are linked, a segment's last residuals are the weighted defects between its end and the next initial
    state. Short segments then act as one long rollout that cannot diverge, and each initial state is coupled directly
    to its neighbours only.

    Source: H. Bock, K. Plitt, "A multiple shooting algorithm for direct solution of optimal control problems", 1984; Y.
    Tremolet, "Model-error estimation in 4D-Var", 2007, for weighted defects, which act like process noise, in place of
    equality constraints.

    Attributes:
        residuals: Function of values, initial states, next initial states and a block that returns the block's weighted
            errors of position and velocity, with the defects last where segments are linked.
        interval: Sample interval [s].
        bent: Function that returns `bend` of residuals by branch.
        root: Root of the weight of each joint's defect in position and velocity; None for independent segments.
    """

    residuals: Callable[[Values, Array, Array, Blocks], Float[Array, "segments time nv kinds"]]
    interval: float
    bent: Callable[[Array], Float[Array, "branches segments terms"]]
    sparsity: Sparsity
    root: Float[np.ndarray, "#nv 2"] | None

    def find_states(self, values: Values, data: Blocks) -> Float[Array, "blocks segments twice_nv"]:
        """Return the initial states that fit the segments best; for use in a compiled program."""

        def improve(search: StateSearch) -> StateSearch:
            return self.advance(search, self._look(values, search.trial, data), data)

        begun = self.by_branch(data.begun)
        unknown = jax.tree.map(
            lambda shape: jnp.full(shape.shape, jnp.inf, shape.dtype),
            jax.eval_shape(lambda: self._look(values, begun, data)),
        )
        final = jax.lax.while_loop(lambda search: ~search.ended, improve, StateSearch.begin(begun, unknown))
        return self.states_together(final.state, data)

    def by_branch(self, states: Any) -> Float[Array, "branches segments state"]:
        """Return states of shape (blocks, segments, twice nv) by branch."""
        return self.sparsity.states_by_branch(jnp.asarray(states).reshape(-1, states.shape[2]))

    def predict(
        self, begun: SearchStart, vector: Float[Array, "coordinates"]
    ) -> Float[Array, "branches segments state"]:
        """Extrapolate the best states to another vector by their slopes."""
        change = jnp.append(vector - begun.vector, jnp.zeros(1, vector.dtype))[self.sparsity.place]
        return self.by_branch(begun.states) + jnp.einsum("bsit,bt->bsi", begun.slopes, change)

    def states_together(self, state: Array, data: Blocks) -> Float[Array, "blocks segments twice_nv"]:
        """Return states by branch in the order of `Blocks.begun`."""
        return self.sparsity.states_together(state).reshape(data.begun.shape)

    def advance(self, search: StateSearch, tried: Local, data: Blocks) -> StateSearch:
        """Take one Levenberg-Marquardt step; a chain of linked segments accepts the trial if its sum decreases.

        Compiled, without bounds and with a damping for each chain, so it is not a case of `descend`.
        """
        # The number of each segment's chain of linked segments.
        numbers = jnp.arange(data.weight.size)
        chain = numbers if self.root is None else jnp.cumsum(1 - self._before(data).astype(int)) - 1
        square, best = _sum_by(chain, tried.square), _sum_by(chain, search.local.square)
        # Equal up to rounding, as in segments that only fill a block, is not a failure that damping could mend.
        better, failed = square < best, ~(square <= (1 + _ALONE) * best)

        def choose(new: Array, old: Array) -> Array:
            return jnp.where(better.reshape(*better.shape, *[1] * (new.ndim - 2)), new, old)

        state, local = choose(search.trial, search.state), jax.tree.map(choose, tried, search.local)
        damping = jnp.where(failed, jnp.maximum(10 * search.damping, DAMPING), search.damping)
        damping = jnp.where(better, 0.1 * damping, damping)
        diagonal, coupling, gradient = self._join(local, data)
        unused = self._unused(data.weight.ravel())
        identity = jnp.eye(diagonal.shape[-1])
        damped = self._determined(diagonal) * (1 + damping[:, :, None, None] * identity) + unused
        step = self._solve(damped, coupling, gradient[..., None])[..., 0]
        gain, looks = jnp.sum(step * gradient) + jnp.sum(tried.square - local.square), search.looks + 1
        total, other = jnp.sum(local.square), search.other
        change = jnp.where(jnp.isfinite(other), jnp.abs(total - gain - other), 0.0)
        threshold = jnp.where(jnp.isnan(other), _ALONE * total, jnp.maximum(_SETTLED * total, _APART * change))
        settled = gain <= threshold
        # The last step is not tried. After trials that brought nothing, as at corners of the motion, it is not trusted.
        step = jnp.where((settled & (~better | (damping >= DAMPING)))[..., None], 0.0, step)
        gain = jnp.sum(step * gradient) + jnp.sum(tried.square - local.square)
        ended = settled | (looks >= _MOST_LOOKS) | ((looks == 1) & ~jnp.all(jnp.isfinite(tried.square)))
        return StateSearch(state - step, state, local, damping, looks, other, gain, settled, ended)

    def local(self, errors: Float[Array, "branches segments terms"], slopes: Array) -> Local:
        """Return the sum of squares of residuals with derivatives `slopes`, (state, branches, segments, terms)."""
        gradient = jnp.einsum("ibsk,bsk->bsi", slopes, errors, precision="highest")
        hessian = jnp.einsum("ibsk,jbsk->bsij", self.bent(errors) * slopes, slopes, precision="highest")
        gap_slopes = jnp.moveaxis(self.gap(slopes), 0, 2)
        return Local(jnp.square(errors).sum(axis=2), gradient, hessian, self.gap(errors), gap_slopes)

    def gap(self, terms: Float[Array, "*any terms"]) -> Float[Array, "*any state"]:
        """Return the last terms of residuals or their derivatives: the defects, in the order of the states."""
        size = len(self.sparsity.states)
        return jnp.swapaxes(terms[..., -size:].reshape(*terms.shape[:-1], size // 2, 2), -1, -2).reshape(
            *terms.shape[:-1], size
        )

    def eliminate(
        self, local: Local, mixed: Mixed, data: Blocks
    ) -> tuple[
        Float[Array, "branches segments tangents"],
        Float[Array, "branches tangents tangents"],
        Float[Array, "branches segments state tangents"],
    ]:
        """Eliminate the initial states from the normal equations (Schur complement).

        Returns:
            Amounts to subtract from each segment's gradient and from the Hessian, and slopes of the best states by
            tangent.
        """
        diagonal, coupling, gradient = self._join(local, data)
        right = mixed.own
        if self.root is not None:
            before, root = self._before(data), self._by_state(right.dtype)
            right = right - before[:, None, None] * root[..., None] * jnp.roll(mixed.gap, 1, axis=1)
        diagonal = self._determined(diagonal) + self._unused(data.weight.ravel())
        solved = self._solve(diagonal, coupling, right)
        gradient_shift = jnp.einsum("bsit,bsi->bst", solved, gradient, precision="highest")
        return gradient_shift, jnp.einsum("bsit,bsiu->btu", solved, right, precision="highest"), -solved

    def _look(self, values: Values, state: Float[Array, "branches segments state"], data: Blocks) -> Local:
        """Return the sum of squares of all blocks at these states."""
        states = self.states_together(state, data)
        units = jnp.asarray(self.sparsity.states, states.dtype)[:, None, :] * jnp.ones_like(states[0, :, :1])

        def of_block(part: tuple[Blocks, Array, Array]) -> Local:
            block, own, following = part

            def errors(own: Array) -> Array:
                return self.sparsity.by_branch(self.residuals(values, own, following, block))

            slope = jax.vmap(lambda unit: jax.jvp(errors, (own,), (unit,)), out_axes=(None, 0))
            return self.local(*slope(units))

        def join(parts: Float[Array, "blocks branches segments *shape"]) -> Float[Array, "branches all *shape"]:
            return jnp.moveaxis(parts, 0, 1).reshape(parts.shape[1], -1, *parts.shape[3:])

        return jax.tree.map(join, jax.lax.map(of_block, (data, states, follow(states))))

    def _join(self, local: Local, data: Blocks) -> tuple[Array, Array, Array]:
        """Return the states' equations: diagonal blocks, the blocks right of them, and half the gradient."""
        if self.root is None:
            return local.hessian, local.gap_slopes, local.gradient
        before, root = self._before(data)[:, None], self._by_state(local.gradient.dtype)
        diagonal = local.hessian + before[:, None] * jax.vmap(jax.vmap(jnp.diag))(jnp.square(root))
        coupling = -data.linked.ravel()[:, None, None] * local.gap_slopes * root[:, :, None]
        return diagonal, coupling, local.gradient - before * root * jnp.roll(local.gap, 1, axis=1)

    def _solve(self, diagonal: Array, beside: Array, right: Float[Array, "branches segments state many"]) -> Array:
        if self.root is not None:
            return jax.vmap(solve_chain)(diagonal, beside, right)
        solve = jax.vmap(solve_spd, in_axes=(None, 1), out_axes=1)
        return jax.vmap(jax.vmap(solve))(diagonal, right)

    def _by_state(self, dtype: Any) -> Float[Array, "branches 1 state"]:
        assert self.root is not None
        root = np.broadcast_to(self.root, (self.sparsity.nv, 2))
        return self.sparsity.states_by_branch(jnp.asarray(root.T.reshape(1, -1), dtype))

    def _before(self, data: Blocks) -> Float[Array, "segments"]:
        """Return 1 for each segment that begins where the one before it ends, else 0."""
        return jnp.roll(data.linked.ravel(), 1)

    def _determined(self, diagonal: Float[Array, "branches segments state state"]) -> Array:
        """Return the diagonal blocks with the curvature that velocities of the shortest time constant have besides."""
        positions = jnp.split(jnp.diagonal(diagonal, axis1=2, axis2=3), 2, axis=2)[0]
        least = (_SHORTEST * self.interval) ** 2 * positions
        return diagonal + jax.vmap(jax.vmap(jnp.diag))(jnp.concatenate([jnp.zeros_like(least), least], axis=2))

    def _unused(self, weight: Float[Array, "segments"]) -> Float[Array, "branches segments state state"]:
        """Return the diagonal that makes the equations of unused states and segments solvable."""
        identity = jnp.eye(len(self.sparsity.states)) * (1 - weight[:, None, None])
        filled = jax.vmap(jnp.diag)(jnp.asarray(1 - np.tile(self.sparsity.mine, 2), weight.dtype))
        return filled[:, None] + identity


def follow(states: Float[Array, "blocks segments state"]) -> Float[Array, "blocks segments state"]:
    """Return the initial state of each next segment; the last gets the first one's, which has no weight."""
    return jnp.roll(states.reshape(-1, states.shape[2]), -1, axis=0).reshape(states.shape)


def join_equations(parts: Sequence[Equations]) -> Equations:
    """Join the equations of all blocks, in numpy."""
    loss, hessian = (sum(getattr(part, name) for part in parts) for name in ("loss", "hessian"))
    return join_segments([part._replace(loss=(), hessian=()) for part in parts])._replace(loss=loss, hessian=hessian)


def join_segments(parts: Sequence[Any]) -> Any:
    """Join arrays of shape (branches, segments, ...) of all blocks, in numpy."""
    return jax.tree.map(lambda *own: np.concatenate(own, axis=1), *parts)


def _sum_by(chain: Array, squares: Float[Array, "branches segments"]) -> Float[Array, "branches segments"]:
    return jnp.zeros_like(squares).at[:, chain].add(squares)[:, chain]


def solve_chain(
    diagonal: Float[Array, "segments state state"],
    beside: Float[Array, "segments state state"],
    right: Float[Array, "segments state many"],
) -> Float[Array, "segments state many"]:
    """Solve a symmetric positive definite block-tridiagonal system, by one forward and one backward pass.

    `beside` holds the blocks right of the diagonal; the last one is ignored.
    """

    def ahead(carry: tuple[Array, Array, Array], row: tuple[Array, Array, Array]) -> tuple[tuple, tuple]:
        coupling, last_upper, last_target = carry
        block, upper, target = row
        factor = jnp.linalg.cholesky(block - jnp.matmul(coupling.T, last_upper, precision="highest"))
        target = target - jnp.matmul(coupling.T, last_target, precision="highest")
        coupling = cho_solve((factor, True), upper)
        return (coupling, upper, target), (coupling, cho_solve((factor, True), target))

    def back(following: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
        coupling, solved = row
        solution = solved - jnp.matmul(coupling, following, precision="highest")
        return solution, solution

    empty = jnp.zeros_like(diagonal[0])
    ends = beside.at[-1].set(0.0)
    _, rows = jax.lax.scan(ahead, (empty, empty, jnp.zeros_like(right[0])), (diagonal, ends, right))
    return jax.lax.scan(back, jnp.zeros_like(right[0]), rows, reverse=True)[1]
