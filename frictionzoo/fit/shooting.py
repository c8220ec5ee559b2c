"""Multiple shooting: the initial state of every segment, estimated from the segment and from what lies beside it."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float

from frictionzoo.fit.blocks import Blocks
from frictionzoo.fit.sparsity import Sparsity
from frictionzoo.simulate import Values
from frictionzoo.simulate.linear import solve_spd

_MOST_LOOKS = 6  # trial states: rollouts are nearly linear in them but for sticking and sliding
_ALONE = 1e-12  # gain of the next step, as a share of the sum of squares, at which a search outside a fit ends
_FIRST, _LATER, _APART = 1e-2, 1e-4, 0.1
"""In a fit, the gain of the next step is subtracted from the sum of squares, and the search ends earlier: at these
shares of the sum at the fit's first vector and at later ones, and there at this share of the difference between the
sums of two vectors, if that is more."""
_DAMPING, _LEAST_DAMPING = 1e-2, 1e-2  # of Levenberg and Marquardt, at first and after a step that failed


class Local(NamedTuple):
    """A sum of squares near initial states, as far as it comes from single segments, by branch and segment.

    Attributes:
        square: The sum of squares.
        gradient: Half its gradient by the segment's own state, J' r.
        hessian: J' J, and `bend` of it.
        gap: Residuals of the gap between a segment's end and the next one's initial state, in the order of the states.
        gap_slopes: Their derivative by the segment's own state, which comes first.
    """

    square: Float[Array, "branches segments"]
    gradient: Float[Array, "branches segments state"]
    hessian: Float[Array, "branches segments state state"]
    gap: Float[Array, "branches segments state"]
    gap_slopes: Float[Array, "branches segments state state"]


class Mixed(NamedTuple):
    """What goes with the coordinates and with the initial states.

    Attributes:
        own: Product of the residuals' derivatives by a segment's own state and by each tangent.
        gap: Derivative of the gap's residuals by each tangent.
    """

    own: Float[Array, "branches segments state tangents"]
    gap: Float[Array, "branches segments state tangents"]


class Begun(NamedTuple):
    """Where a search for initial states begins.

    Attributes:
        states: The best states of a vector, (blocks, segments, twice nv).
        vector: That vector, of shape (coordinates,).
        slopes: Their derivative by each tangent, (branches, segments, state, tangents).
        square: The sum of squares there; infinite where it is not known.
    """

    states: Any
    vector: Any
    slopes: Any
    square: Any


class Search(NamedTuple):
    """A search for initial states, by branch and segment.

    Attributes:
        trial: The states to be tried next.
        state: The best states so far.
        local: The sum of squares at these.
        damping: Of Levenberg and Marquardt, for each segment.
        looks: Number of states that were tried.
        other: The sum of squares at the last vector of a fit; infinite at its first one, NaN outside a fit.
        gain: By how much the next trial lowers the sum of squares below the last one, as slopes predict it.
        settled: Whether the gain is small enough to end the search.
        ended: Whether the search ends.
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
    def begin(cls, begun: Float[Array, "branches segments state"], unknown: Local, other: Any = jnp.nan) -> "Search":
        """Return a search that begins at these states; `unknown` is infinite."""
        damping, no = jnp.full(begun.shape[:2], _DAMPING, begun.dtype), jnp.asarray(False)
        other, gain = (jnp.asarray(value, begun.dtype) for value in (other, 0.0))
        return cls(begun, begun, unknown, damping, jnp.asarray(0), other, gain, no, no)


class Equations(NamedTuple):
    """A sum of squares near a vector and initial states, by branch.

    Attributes:
        loss: The sum.
        gradient: Half its gradient by each tangent.
        hessian: J' J of the tangents.
        local: The same of initial states; None where these are not estimated.
        mixed: What goes with both.
    """

    loss: Float[Any, ""]
    gradient: Float[Any, "branches segments tangents"]
    hessian: Float[Any, "branches tangents tangents"]
    local: Local | None = None
    mixed: Mixed | None = None


class Shooting(NamedTuple):
    """Initial states that are estimated along.

    Each segment's state counts in its own residuals. Where segments hold together, the last residuals of each are the
    gap to the state at which the next one begins, times a weight: short segments then act as one long rollout that
    cannot diverge. All states of a recording depend on each other, each directly on its neighbours alone.

    Source: H. Bock, K. Plitt, "A multiple shooting algorithm for direct solution of optimal control problems", 1984;
    the gaps are not closed by force but weighted, as process noise is in Y. Tremolet, "Model-error estimation in
    4D-Var", 2007.

    Attributes:
        residuals: Of a block, from values, own and following initial states and the block: weighted errors of position
            and velocity, the gap last where segments hold together.
        bent: Of residuals by branch, `bend`.
        sparsity: Branches of the robot.
        root: Root of the weight of each joint's gap in position and velocity; None where segments stand alone.
    """

    residuals: Callable[[Values, Array, Array, Blocks], Float[Array, "segments time nv kinds"]]
    bent: Callable[[Array], Float[Array, "branches segments terms"]]
    sparsity: Sparsity
    root: Float[np.ndarray, "#nv 2"] | None

    def find_states(self, values: Values, data: Blocks) -> Float[Array, "blocks segments twice_nv"]:
        """Return the initial states that fit the segments best, as part of a compiled program."""

        def improve(search: Search) -> Search:
            return self.advance(search, self._look(values, search.trial, data), data)

        begun = self.by_branch(data.begun)
        unknown = jax.tree.map(
            lambda shape: jnp.full(shape.shape, jnp.inf, shape.dtype),
            jax.eval_shape(lambda: self._look(values, begun, data)),
        )
        found = jax.lax.while_loop(lambda search: ~search.ended, improve, Search.begin(begun, unknown))
        return self.states_together(found.state, data)

    def by_branch(self, states: Any) -> Float[Array, "branches segments state"]:
        """Return states of shape (blocks, segments, twice nv) by branch."""
        return self.sparsity.states_by_branch(jnp.asarray(states).reshape(-1, states.shape[2]))

    def predict(self, begun: Begun, vector: Float[Array, "coordinates"]) -> Float[Array, "branches segments state"]:
        """Return the best states of another vector, from their slopes."""
        moved = jnp.append(vector - begun.vector, jnp.zeros(1, vector.dtype))[self.sparsity.place]
        return self.by_branch(begun.states) + jnp.einsum("bsit,bt->bsi", begun.slopes, moved)

    def states_together(self, state: Array, data: Blocks) -> Float[Array, "blocks segments twice_nv"]:
        """Return states by branch in the order of `Blocks.begun`."""
        return self.sparsity.states_together(state).reshape(data.begun.shape)

    def advance(self, search: "Search", tried: Local, data: Blocks) -> "Search":
        """Return the search after the sum of squares at its trial states is known.

        Levenberg-Marquardt steps; each counts where it lowers the error of all segments that hold together.
        """
        chain = self._chain(data)
        better = _sum_by(chain, tried.square) < _sum_by(chain, search.local.square)

        def choose(new: Array, old: Array) -> Array:
            return jnp.where(better.reshape(*better.shape, *[1] * (new.ndim - 2)), new, old)

        state, local = choose(search.trial, search.state), jax.tree.map(choose, tried, search.local)
        damping = jnp.where(better, 0.1 * search.damping, jnp.maximum(10 * search.damping, _LEAST_DAMPING))
        diagonal, beside, gradient = self._join(local, data)
        unused = self._unused(data.weight.ravel())
        damped = diagonal * (1 + damping[:, :, None, None] * jnp.eye(diagonal.shape[-1])) + unused
        step = self._solve(damped, beside, gradient[..., None])[..., 0]
        gain, looks = jnp.sum(step * gradient) + jnp.sum(tried.square - local.square), search.looks + 1
        total, other = jnp.sum(local.square), search.other
        later = jnp.maximum(_LATER * total, _APART * jnp.abs(total - gain - other))
        enough = jnp.where(jnp.isfinite(other), later, jnp.where(jnp.isnan(other), _ALONE, _FIRST) * total)
        settled = gain <= enough
        ended = settled | (looks >= _MOST_LOOKS) | ((looks == 1) & ~jnp.all(jnp.isfinite(tried.square)))
        return Search(state - step, state, local, damping, looks, other, gain, settled, ended)

    def local(self, errors: Float[Array, "branches segments terms"], slopes: Array) -> Local:
        """Of a block's residuals and their derivative by its own states, (state, branches, segments, terms)."""
        gradient = jnp.einsum("ibsk,bsk->bsi", slopes, errors, precision="highest")
        hessian = jnp.einsum("ibsk,jbsk->bsij", self.bent(errors) * slopes, slopes, precision="highest")
        gap_slopes = jnp.moveaxis(self.gap(slopes), 0, 2)
        return Local(jnp.square(errors).sum(axis=2), gradient, hessian, self.gap(errors), gap_slopes)

    def gap(self, terms: Float[Array, "*any terms"]) -> Float[Array, "*any state"]:
        """Of residuals or their derivative the last, which are those of the gap, in the order of the states."""
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
        """What the states take from each segment's gradient by the tangents, and from the second derivative.

        The Schur complement of the states in the normal equations of states and coordinates. The third is the
        derivative of the best states by each tangent.
        """
        diagonal, beside, gradient = self._join(local, data)
        # A drive that forgets its velocity within a sample does not tell that from its position: the states' equations
        # are then singular to rounding, and what they take is all rounding. So much more changes nothing else.
        identity = jnp.eye(diagonal.shape[-1], dtype=diagonal.dtype)
        diagonal = diagonal * (1 + float(jnp.finfo(diagonal.dtype).eps) ** (2 / 3) * identity)
        right = mixed.own
        if self.root is not None:
            before, root = self._before(data), self._by_state(right.dtype)
            right = right - before[:, None, None] * root[..., None] * jnp.roll(mixed.gap, 1, axis=1)
        solved = self._solve(diagonal + self._unused(data.weight.ravel()), beside, right)
        taken = jnp.einsum("bsit,bsi->bst", solved, gradient, precision="highest")
        return taken, jnp.einsum("bsit,bsiu->btu", solved, right, precision="highest"), -solved

    def _look(self, values: Values, state: Float[Array, "branches segments state"], data: Blocks) -> Local:
        """Of all blocks."""
        whole = self.states_together(state, data)
        units = jnp.asarray(self.sparsity.states, whole.dtype)[:, None, :] * jnp.ones_like(whole[0, :, :1])

        def of_block(part: tuple[Blocks, Array, Array]) -> Local:
            block, own, following = part

            def errors(own: Array) -> Array:
                return self.sparsity.by_branch(self.residuals(values, own, following, block))

            slope = jax.vmap(lambda unit: jax.jvp(errors, (own,), (unit,)), out_axes=(None, 0))
            return self.local(*slope(units))

        return jax.tree.map(join_blocks, jax.lax.map(of_block, (data, whole, follow(whole))))

    def _join(self, local: Local, data: Blocks) -> tuple[Array, Array, Array]:
        """Blocks on the diagonal of the states' equations, those right of them, and half the gradient."""
        if self.root is None:
            return local.hessian, local.gap_slopes, local.gradient
        before, root = self._before(data)[:, None], self._by_state(local.gradient.dtype)
        diagonal = local.hessian + before[:, None] * jax.vmap(jax.vmap(jnp.diag))(jnp.square(root))
        beside = -data.linked.ravel()[:, None, None] * local.gap_slopes * root[:, :, None]
        return diagonal, beside, local.gradient - before * root * jnp.roll(local.gap, 1, axis=1)

    def _solve(self, diagonal: Array, beside: Array, right: Float[Array, "branches segments state many"]) -> Array:
        if self.root is not None:
            return jax.vmap(solve_chain)(diagonal, beside, right)
        solve = jax.vmap(solve_spd, in_axes=(None, 1), out_axes=1)
        return jax.vmap(jax.vmap(solve))(diagonal, right)

    def _by_state(self, dtype: Any) -> Float[Array, "branches 1 state"]:
        assert self.root is not None
        nv = self.sparsity.states.shape[1] // 2
        return self.sparsity.states_by_branch(jnp.asarray(np.broadcast_to(self.root, (nv, 2)).T.reshape(1, -1), dtype))

    def _before(self, data: Blocks) -> Float[Array, "segments"]:
        """Whether each segment begins where the one before it ends."""
        return jnp.roll(data.linked.ravel(), 1)

    def _chain(self, data: Blocks) -> Array:
        """Number of the segments that hold together, for each one."""
        apart = jnp.arange(data.weight.size)
        return apart if self.root is None else jnp.cumsum(1 - self._before(data).astype(int)) - 1

    def _unused(self, weight: Float[Array, "segments"]) -> Float[Array, "branches segments state state"]:
        """What makes equations of initial states solvable that do not count."""
        identity = jnp.eye(len(self.sparsity.states)) * (1 - weight[:, None, None])
        return self.sparsity.unit_states(weight.dtype)[:, None] + identity


def follow(states: Float[Array, "blocks segments state"]) -> Float[Array, "blocks segments state"]:
    """The state at which the next segment begins; of the last, that of the first, which does not count."""
    return jnp.roll(states.reshape(-1, states.shape[2]), -1, axis=0).reshape(states.shape)


def join_blocks(parts: Float[Array, "blocks branches segments *shape"]) -> Float[Array, "branches all *shape"]:
    """Segments of all blocks, one after the other."""
    return jnp.moveaxis(parts, 0, 1).reshape(parts.shape[1], -1, *parts.shape[3:])


def join_equations(parts: Sequence[Equations]) -> Equations:
    """Of all blocks, in numpy."""
    loss, hessian = (sum(getattr(part, name) for part in parts) for name in ("loss", "hessian"))
    by_segment = [part._replace(loss=(), hessian=()) for part in parts]
    joined = jax.tree.map(lambda *own: np.concatenate(own, axis=1), *by_segment)
    return joined._replace(loss=loss, hessian=hessian)


def _sum_by(chain: Array, squares: Float[Array, "branches segments"]) -> Float[Array, "branches segments"]:
    """Sum over all segments that hold together, for each one."""
    return jnp.zeros_like(squares).at[:, chain].add(squares)[:, chain]


def solve_chain(
    diagonal: Float[Array, "segments state state"],
    beside: Float[Array, "segments state state"],
    right: Float[Array, "segments state many"],
) -> Float[Array, "segments state many"]:
    """Solution of symmetric positive definite equations of states each of which knows its neighbours alone.

    Block by block, as for a matrix with three diagonals: one pass ahead, one back.

    Args:
        diagonal: Blocks on the diagonal.
        beside: Those right of them; the last does not count.
        right: Right-hand sides.
    """

    def ahead(carry: tuple[Array, Array, Array], row: tuple[Array, Array, Array]) -> tuple[tuple, tuple]:
        pull, above, before = carry
        own, next_to, side = row
        factor = jnp.linalg.cholesky(own - jnp.matmul(pull.T, above, precision="highest"))
        side = side - jnp.matmul(pull.T, before, precision="highest")
        pull = cho_solve((factor, True), next_to)
        return (pull, next_to, side), (pull, cho_solve((factor, True), side))

    def back(following: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
        pull, alone = row
        found = alone - jnp.matmul(pull, following, precision="highest")
        return found, found

    empty = jnp.zeros_like(diagonal[0])
    ends = beside.at[-1].set(0.0)
    _, rows = jax.lax.scan(ahead, (empty, empty, jnp.zeros_like(right[0])), (diagonal, ends, right))
    return jax.lax.scan(back, jnp.zeros_like(right[0]), rows, reverse=True)[1]
