"""Residuals of an objective by block, and its compiled normal equations."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from frictionzoo.core.threads import usable_threads
from frictionzoo.fit.blocks import Blocks, each_part, measured_states, to_numpy, without_motion
from frictionzoo.fit.loss import Loss, bend
from frictionzoo.fit.shooting import (
    DAMPING,
    MOST_DAMPING,
    Equations,
    Local,
    Mixed,
    SearchStart,
    Shooting,
    StateSearch,
    follow,
    join_equations,
    join_segments,
)
from frictionzoo.fit.space import Space
from frictionzoo.fit.sparsity import Sparsity
from frictionzoo.simulation import Values
from frictionzoo.simulation.base import FORWARD
from frictionzoo.simulation.rollout import Rollout

_SMOOTH = 2  # trials of initial states that suffice where rollouts are nearly linear in them


@dataclass(frozen=True, eq=False)
class Residuals:
    """Weighted residuals of a block, their derivatives, and the equations that follow from them.

    Attributes:
        interval: Sample interval [s].
        terms: Number of residuals, by which sums are divided.
        stretches: See `Objective.stretches`.
    """

    space: Space
    rollout: Rollout
    loss: Loss
    sparsity: Sparsity
    interval: float
    terms: float
    stretches: int

    def __call__(
        self, values: Values, own: Array, following: Array, block: Blocks
    ) -> Float[Array, "segments time nv kinds"]:
        """Return a block's residuals; `own` and `following` are initial states, (segments, twice nv)."""
        qpos, qvel = jnp.split(own, 2, axis=1)
        predicted = self.rollout(values, qpos, qvel, block.signals, block.load)
        errors = self.loss.errors((qpos, qvel), predicted, values["bench"]["armature"], block)
        if self.loss.gap is None:
            return errors
        ends = jnp.stack([state[:, -1] for state in predicted], axis=-1)
        gaps = ends - jnp.stack(jnp.split(following, 2, axis=1), axis=-1)
        gaps = self.loss.gap * gaps * block.linked[:, None, None]
        return jnp.concatenate([errors, gaps[:, None]], axis=1)

    @property
    def shooting(self) -> Shooting:
        """Estimator of the initial states."""
        return Shooting(self, self.interval, self._bent, self.sparsity, self.loss.gap)

    def states(self, vector: Array, data: Blocks) -> tuple[Array, Array]:
        """Return initial states of all segments and of their successors, (blocks, segments, twice_nv).

        No derivative goes through their estimation: at its minimum the objective does not change with the initial
        states.
        """
        if self.loss.refine:
            values, data = jax.lax.stop_gradient((self.space.values(vector), data))
            states = jax.lax.stop_gradient(self.shooting.find_states(values, data))
        else:
            states = measured_states(data.qpos, data.qvel)
        return states, follow(states)

    def block_loss(self, vector: Array, block: Blocks, own: Array, following: Array) -> Float[Array, ""]:
        """Return a block's part of the objective."""
        return self.loss.sum(jnp.square(self(self.space.values(vector), own, following, block))) / self.terms

    def linearise(self, vector: Array, block: Blocks, own: Array, following: Array) -> tuple[Array, Any]:
        """Return a block's residuals by branch, and their linear function of directions or the derivatives themselves.

        Where the derivative of a step consists of few numbers, the rollout stores them, and a second program computes
        all derivatives from them. This is faster: the rollout, with many shared terms, compiles without fusion, and the
        derivatives, which share almost none, with it.
        """

        def residuals(vector: Array, own: Array) -> Array:
            return self.sparsity.by_branch(self(self.space.values(vector), own, following, block))

        arguments = (vector, own) if self.loss.refine else (vector,)
        function = residuals if self.loss.refine else lambda vector: residuals(vector, own)
        if self.rollout.keeps_slopes:
            return jax.linearize(function, *arguments)
        slope = jax.vmap(lambda *along: jax.jvp(function, arguments, along), out_axes=(None, 0))
        return slope(*self._directions(vector.dtype, len(own)))

    def equations(self, linearised: tuple[Array, Any], exact: bool) -> Equations:
        """Return loss, gradient by segment and Hessian over the tangents, before initial states are eliminated."""
        errors, derivatives = linearised
        if self.rollout.keeps_slopes:
            derivatives = jax.vmap(derivatives)(*self._directions(errors.dtype, errors.shape[1]))
        slopes, by_state = derivatives[: len(self.sparsity.seeds)], derivatives[len(self.sparsity.seeds) :]
        share, curvature = self.loss.shares(jnp.square(errors), exact)
        bent = self._bent(errors)
        curvature = curvature + (bent - 1) * share
        # By default a GPU rounds factors to 10 bits, too few to detect collinear coordinates.
        gradient = jnp.einsum("ibsk,bsk->bsi", slopes, share * errors, precision="highest")
        hessian = jnp.einsum("ibsk,jbsk->bij", slopes, curvature * slopes, precision="highest")
        loss = self.loss.sum(jnp.square(errors))
        if not self.loss.refine:
            return Equations(loss, gradient, hessian)
        local = self.shooting.local(errors, by_state)
        mixed = jnp.einsum("ibsk,jbsk->bsij", bent * by_state, slopes, precision="highest")
        return Equations(loss, gradient, hessian, local, Mixed(mixed, jnp.moveaxis(self.shooting.gap(slopes), 0, 3)))

    def local(self, linearised: tuple[Array, Any]) -> Local:
        """Return the part of `equations` that belongs to the initial states."""
        errors, derivatives = linearised
        along = self._directions(errors.dtype, errors.shape[1])
        by_state = jax.vmap(derivatives)(*(directions[len(self.sparsity.seeds) :] for directions in along))
        return self.shooting.local(errors, by_state)

    def finish(self, found: Equations, data: Blocks) -> tuple[Array, ...]:
        """Eliminate initial states; return loss, gradient by stretch, Hessian, and slopes of the best states if any."""
        loss, gradient, hessian, local, mixed = found
        slopes = jnp.zeros(0)
        if local is not None and mixed is not None:
            gradient_shift, hessian_shift, slopes = self.shooting.eliminate(local, mixed, data)
            gradient, hessian = gradient - gradient_shift, hessian - hessian_shift
        members = jax.nn.one_hot(data.stretch.ravel(), self.stretches, dtype=gradient.dtype)
        gradient, hessian = self.sparsity.gradient(gradient), self.sparsity.hessian(hessian)
        scores = jnp.einsum("sg,si->gi", members, gradient, precision="highest")
        return loss / self.terms, scores / self.terms, hessian / self.terms, slopes

    def _directions(self, dtype: Any, segments: int) -> tuple[Array, ...]:
        """Return the tangents of the coordinates and of estimated initial states."""
        seeds, units = (jnp.asarray(part, dtype) for part in (self.sparsity.seeds, self.sparsity.states))
        if not self.loss.refine:
            return (seeds,)
        vectors = jnp.concatenate([seeds, jnp.zeros((len(units), seeds.shape[1]), dtype)])
        states = jnp.concatenate([jnp.zeros((len(seeds), units.shape[1]), dtype), units])
        return vectors, jnp.broadcast_to(states[:, None], (len(states), segments, units.shape[1]))

    def _bent(self, errors: Float[Array, "branches segments terms"]) -> Float[Array, "branches #segments terms"]:
        """Return `bend` of residuals by branch; defects, which come last, have no width."""
        if not self.loss.encoder_step:
            return jnp.ones_like(errors)
        widths = self.loss.widths(self.sparsity.nv)
        times = errors.shape[2] // (self.sparsity.joints.shape[1] * widths.shape[1])
        rows = np.repeat(widths[None, None], times, axis=1)
        if self.loss.gap is not None:
            rows[:, -1] = 0.0
        return bend(errors, self.sparsity.by_branch(jnp.asarray(rows, errors.dtype)))


def compile_equations(
    residuals: Residuals, data: Blocks, start: Array, exact: bool
) -> Callable[[Array, Blocks, SearchStart | None], tuple[Any, ...]]:
    """Compile the function for loss, gradient by stretch, Hessian, and next start of initial states or None.

    Each trial of initial states is a pass over all blocks. Where a joint sticks or turns back, trials fail or many
    follow, with the derivatives by the states only. `start` is the initial vector, on all devices; `exact` is for
    `Loss.shares`.
    """
    shooting, finish, by_branch = residuals.shooting, jax.jit(residuals.finish), jax.jit(residuals.shooting.by_branch)
    measured, devices = measured_states(data.qpos, data.qvel), len(data.qpos.sharding.device_set)
    example = tuple(jax.device_put(part, data.begun.sharding) for part in (measured, follow(measured)))
    solve_block, compile_states = _compile_both(residuals, exact, devices, start, next(each_part(data, example)))

    def run(solve: Callable[..., Any], vector: Array, data: Blocks, states: Array) -> list[Any]:
        sharding = data.begun.sharding  # the one that the programs were compiled for
        blocks = each_part(data, tuple(jax.device_put(part, sharding) for part in (states, follow(states))))
        # Threads pay off for blocks on one device, but not for the operations of several.
        with ThreadPoolExecutor(usable_threads() if devices == 1 else 1) as pool:
            return list(pool.map(lambda part: jax.tree.map(np.asarray, solve(vector, part)), blocks))

    def equations(vector: Array, data: Blocks, states: Array) -> Equations:
        return join_equations(run(solve_block, vector, data, states))

    @jax.jit
    def begin(vector: Array, begun: SearchStart, data: Blocks) -> tuple[Array, Array]:
        trial = shooting.predict(begun, vector)
        return trial, shooting.states_together(trial, data)

    @jax.jit
    def advance(search: StateSearch, tried: Local, data: Blocks) -> tuple[StateSearch, Array, Array]:
        search = shooting.advance(search, tried, data)
        trial, best = (shooting.states_together(state, data) for state in search[:2])
        return search, trial, best

    def evaluate(vector: Array, data: Blocks, begun: SearchStart | None) -> tuple[Any, ...]:
        host = without_motion(data)
        if not residuals.loss.refine:
            return *to_numpy(finish(equations(vector, data, measured_states(data.qpos, data.qvel)), host)[:3]), None
        trial, states = by_branch(data.begun), data.begun
        if begun is not None:
            trial, states = begin(vector, begun, host)
        search = system = None
        while search is None or not search.ended:
            tried, system, local = states, None, None
            is_smooth = search is None or (search.looks < _SMOOTH and (search.damping < DAMPING).all())
            if is_smooth or compile_states is None:
                system = equations(vector, data, states)
                local = system.local
            else:
                local = join_segments(run(compile_states(), vector, data, states))
            assert local is not None
            if search is None:
                unknown = jax.tree.map(lambda part: np.full_like(part, np.inf), local)
                known = (np.nan, DAMPING) if begun is None else (begun.square, begun.damping)
                search = StateSearch.begin(trial, unknown, *known)
            search, states, best = advance(search, local, host)
        is_at_trial = (begun is not None and search.settled) or not np.isfinite(search.local.square).all()
        if system is None or not (is_at_trial or np.array_equal(tried, best)):
            system = equations(vector, data, tried if is_at_trial else best)
        if begun is not None and search.settled:
            system = system._replace(loss=system.loss - search.gain)
        elif not is_at_trial:
            states = best
        *sums, slopes = finish(system, host)
        damping = np.clip(search.damping, DAMPING, MOST_DAMPING)
        return *to_numpy(sums), SearchStart(*map(np.asarray, (states, vector, slopes, system.loss, damping)))

    return evaluate


def _compile_both(
    residuals: Residuals, exact: bool, devices: int, start: Any, example: Any
) -> tuple[Callable[[Array, Any], Equations], Callable[[], Callable[[Array, Any], Local]] | None]:
    """Compile a rollout and the equations from it into one function of a vector and a block.

    On one device they compile in parallel. With several, the equations need the sharding of the rollout's results. Also
    return a function that compiles the states' part at its first call, where that is cheaper.
    """
    if devices == 1:  # the shape only, so that the compilation cache finds the program
        start = jax.ShapeDtypeStruct(start.shape, start.dtype)
    rollout = residuals.rollout.compile(lambda vector, part: residuals.linearise(vector, *part), forward=True)
    lowered = rollout.lower(start, example)
    with ThreadPoolExecutor(1) as pool:
        compiling = pool.submit(lowered.compile)
        linearised = lowered.out_info if devices == 1 else compiling.result()(start, example)
        then = jax.jit(lambda linearised, part: residuals.equations(linearised, exact), compiler_options=FORWARD)
        equations = then.lower(linearised, example).compile()
        rollout = compiling.result()

    @cache
    def compile_states() -> Callable[[Array, Any], Local]:
        local = jax.jit(residuals.local, compiler_options=FORWARD).lower(linearised).compile()
        return lambda vector, part: local(rollout(vector, part))

    cheaper = residuals.loss.refine and residuals.rollout.keeps_slopes
    return lambda vector, part: equations(rollout(vector, part), part), compile_states if cheaper else None
