"""MuJoCo's dry-friction constraint for a few joints, written out entry by entry so that it runs over any batch."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from frictionzoo.simulate.linear import Rows, add_diagonal, multiply, solve_rows

_LEAPS = 8  # of Newton's whole steps, before each is shortened to the lowest point on its way
_NEWTON_STEPS = 100  # three or four are usual
_ROUNDING = 1e-12


class _Search(NamedTuple):
    """How far it is: steps, the accelerations, the piece of each joint that they come from, and whether it is over."""

    count: Any
    acceleration: Any
    sliding: Any
    done: Any


def dry_friction(
    inertia: Rows,
    force: Float[Array, "nv"],
    softness: Float[Array, "nv"],
    reference: Float[Array, "nv"],
    limit: Float[Array, "nv"],
) -> Float[Array, "nv"]:
    """Force of MuJoCo's friction constraint on each joint.

    The accelerations a minimise the convex

        1/2 a' M a - a' force + sum_i s_i(a_i - reference_i)

    where s_i is quadratic, softness_i x^2 / 2, while the constraint's force stays within the limit, and linear beyond.
    For one joint the answer is closed; for several it is found by Newton's method, of which only the last step is
    differentiated (the implicit function theorem). Where the limit is 0, so are the force and its derivative.

    Source: MuJoCo documentation, "Computation", "Constraint model", primal problem and friction loss.

    Args:
        inertia: Joint-space inertia M, by its rows [kg m^2 or kg].
        force: All other forces [N m or N].
        softness: `efc_D` of each joint's row [kg m^2 or kg].
        reference: `efc_aref` of each joint's row [rad/s^2 or m/s^2].
        limit: `frictionloss` [N m or N]; 0 for a joint without dry friction.
    """
    if len(force) == 1:
        ((alone,),) = inertia
        held = (reference - force / alone) / (1 / alone + 1 / softness)
        return jnp.where(limit == 0, 0.0, jnp.clip(held, -limit, limit))
    problem = (inertia, force, softness, reference, limit)
    sliding = _find_sliding(*jax.lax.stop_gradient(problem))
    return _force(_accelerations(*problem, sliding), *problem[2:], sliding)


def _accelerations(
    inertia: Rows, force: Array, softness: Array, reference: Array, limit: Array, sliding: Array
) -> Float[Array, "nv"]:
    """Minimum of the problem in which each joint keeps to one piece: -1 and 1 slide backwards and forwards, 0 holds."""
    holds = sliding == 0
    stiff = jnp.where(holds, softness, 0.0)
    pushed = force + stiff * reference - jnp.where(holds, 0.0, sliding * limit)
    return solve_rows(add_diagonal(inertia, stiff), pushed)


def _force(acceleration: Array, softness: Array, reference: Array, limit: Array, sliding: Array) -> Array:
    return jnp.where(sliding == 0, softness * (reference - acceleration), -sliding * limit)


def _pieces(acceleration: Array, softness: Array, reference: Array, limit: Array) -> Float[Array, "nv"]:
    pull = softness * (acceleration - reference)
    slides = (pull > limit) | (limit == 0)  # without dry friction nothing holds, not even a joint that nothing pulls
    return jnp.where(slides, 1.0, jnp.where(pull < -limit, -1.0, 0.0)).astype(acceleration.dtype)


def _find_sliding(inertia: Rows, force: Array, softness: Array, reference: Array, limit: Array) -> Float[Array, "nv"]:
    """The piece of each joint at the minimum; NaN where the search does not end.

    The cost is convex and quadratic within each combination of pieces. Newton's step for the present combination goes
    to the minimum of that quadratic; if that lies in the same pieces, it is the answer. A few such steps are nearly
    always enough. Where they go astray, the search goes on from the lowest point on the way, which is found exactly.
    """
    row = (softness, reference, limit)

    def slope(acceleration: Array, direction: Array) -> Array:
        soft = jnp.clip(softness * (acceleration - reference), -limit, limit)
        return direction @ (multiply(inertia, acceleration) - force + soft)

    def lowest(start: Array, direction: Array) -> Array:
        """How far the cost falls along a direction: its slope is a rising line with a kink at every border."""
        borders = jnp.concatenate([(reference + side * limit / softness - start) / direction for side in (-1, 1)])
        borders = jnp.where(jnp.isfinite(borders) & (borders > 0), borders, 0.0)
        slopes = jax.vmap(lambda share: slope(start + share * direction, direction))(borders)
        before = jnp.max(jnp.where(slopes < 0, borders, 0.0))
        after = jnp.min(jnp.where(slopes >= 0, jnp.where(borders > 0, borders, jnp.inf), jnp.inf))
        after = jnp.where(jnp.isfinite(after), after, before + 1)  # behind the last border the line goes straight on
        falling, rising = (slope(start + share * direction, direction) for share in (before, after))
        return before - falling * (after - before) / (rising - falling)

    def propose(sliding: Array) -> tuple[Array, Array]:
        """Newton's step for these pieces, and the pieces where it leads."""
        proposed = _accelerations(inertia, force, *row, sliding)
        return proposed, _pieces(proposed, *row)

    def leap(state: _Search) -> _Search:
        """Whole steps; a joint that would turn round is tried at rest first, or it might turn for ever."""
        proposed, sliding = propose(state.sliding)
        done = jnp.all(sliding == state.sliding)
        return _Search(state.count + 1, proposed, jnp.where(sliding * state.sliding < 0, 0.0, sliding), done)

    def descend(state: _Search) -> _Search:
        """Steps to the lowest point on their way."""
        here = _pieces(state.acceleration, *row)
        proposed, sliding = propose(here)
        direction = proposed - state.acceleration
        # At a border, rounding may name either piece: both have the same answer.
        near = jnp.all(jnp.abs(direction) <= _ROUNDING * (jnp.abs(proposed) + jnp.abs(state.acceleration)))
        done = near | jnp.all(sliding == here)
        share = jnp.where(done, 0.0, lowest(state.acceleration, direction))
        return _Search(state.count + 1, state.acceleration + share * direction, here, done)

    smooth = solve_rows(inertia, force)
    start = _Search(jnp.asarray(0), smooth, _pieces(smooth, *row), jnp.asarray(False))
    found = jax.lax.while_loop(lambda state: ~state.done & (state.count < _LEAPS), leap, start)
    found = jax.lax.while_loop(lambda state: ~state.done & (state.count < _NEWTON_STEPS), descend, found)
    return jnp.where(found.done, found.sliding, jnp.nan)
