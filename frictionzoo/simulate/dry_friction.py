"""MuJoCo's dry-friction constraint for a few joints, written out entry by entry so that it runs over any batch."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from frictionzoo.simulate.linear import solve_spd

_NEWTON_STEPS = 100  # three or four are usual
_ROUNDING = 1e-12


def dry_friction(
    inertia: Float[Array, "nv nv"],
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
        inertia: Joint-space inertia M [kg m^2 or kg].
        force: All other forces [N m or N].
        softness: `efc_D` of each joint's row [kg m^2 or kg].
        reference: `efc_aref` of each joint's row [rad/s^2 or m/s^2].
        limit: `frictionloss` [N m or N]; 0 for a joint without dry friction.
    """
    if len(force) == 1:
        acceleration = force / inertia[0]
        held = (reference - acceleration) / (1 / inertia[0] + 1 / softness)
        return jnp.where(limit == 0, 0.0, jnp.clip(held, -limit, limit))
    problem = (inertia, force, softness, reference, limit)
    sliding = _find_sliding(*jax.lax.stop_gradient(problem))
    return _force(_accelerations(*problem, sliding), *problem[2:], sliding)


def _accelerations(
    inertia: Array, force: Array, softness: Array, reference: Array, limit: Array, sliding: Array
) -> Float[Array, "nv"]:
    """Minimum of the problem in which each joint keeps to one piece: -1 and 1 slide backwards and forwards, 0 holds."""
    holds = sliding == 0
    stiff = jnp.where(holds, softness, 0.0)
    pushed = force + stiff * reference - jnp.where(holds, 0.0, sliding * limit)
    return solve_spd(inertia + jnp.diag(stiff), pushed)


def _force(acceleration: Array, softness: Array, reference: Array, limit: Array, sliding: Array) -> Array:
    return jnp.where(sliding == 0, softness * (reference - acceleration), -sliding * limit)


def _pieces(acceleration: Array, softness: Array, reference: Array, limit: Array) -> Float[Array, "nv"]:
    pull = softness * (acceleration - reference)
    slides = (pull > limit) | (limit == 0)  # without dry friction nothing holds, not even a joint that nothing pulls
    return jnp.where(slides, 1.0, jnp.where(pull < -limit, -1.0, 0.0)).astype(acceleration.dtype)


def _find_sliding(inertia: Array, force: Array, softness: Array, reference: Array, limit: Array) -> Float[Array, "nv"]:
    """The piece of each joint at the minimum; NaN where the search does not end.

    The cost is convex and quadratic within each combination of pieces. Newton's step for the present combination goes
    to the minimum of that quadratic; if that lies in the same pieces, it is the answer, and otherwise the search goes
    on from the lowest point on the way there, which is found exactly.
    """
    row = (softness, reference, limit)

    def slope(acceleration: Array, direction: Array) -> Array:
        soft = jnp.clip(softness * (acceleration - reference), -limit, limit)
        return direction @ (inertia @ acceleration - force + soft)

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

    def advance(state: tuple[Array, Array, Array, Bool[Array, ""]]) -> tuple:
        count, acceleration, _, _ = state
        sliding = _pieces(acceleration, *row)
        proposed = _accelerations(inertia, force, *row, sliding)
        direction = proposed - acceleration
        # At a border, rounding may name either piece: both have the same answer.
        near = jnp.all(jnp.abs(direction) <= _ROUNDING * (jnp.abs(proposed) + jnp.abs(acceleration)))
        done = near | jnp.all(_pieces(proposed, *row) == sliding)
        share = jnp.where(done, 0.0, lowest(acceleration, direction))
        return count + 1, acceleration + share * direction, sliding, done

    start = solve_spd(inertia, force)
    state = (jnp.asarray(0), start, jnp.zeros_like(force), jnp.asarray(False))
    _, _, sliding, done = jax.lax.while_loop(lambda state: ~state[3] & (state[0] < _NEWTON_STEPS), advance, state)
    return jnp.where(done, sliding, jnp.nan)
