"""MuJoCo's dry-friction constraint for a few joints, written out entry by entry so that it runs over any batch."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from frictionzoo.engine.linear import solve_spd

_NEWTON_STEPS = 50  # three or four are usual; only rounding at a border could ask for more


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
    differentiated (the implicit function theorem).

    Source: MuJoCo documentation, "Computation", "Constraint model", primal problem and friction loss.

    Args:
        inertia: Joint-space inertia M [kg m^2 or kg].
        force: All other forces [N m or N].
        softness: `efc_D` of each joint's row [kg m^2 or kg].
        reference: `efc_aref` of each joint's row [rad/s^2 or m/s^2].
        limit: `frictionloss` [N m or N].
    """
    if len(force) == 1:
        acceleration = force / inertia[0]
        return jnp.clip((reference - acceleration) / (1 / inertia[0] + 1 / softness), -limit, limit)
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
    return jnp.where(pull > limit, 1.0, jnp.where(pull < -limit, -1.0, 0.0)).astype(acceleration.dtype)


def _find_sliding(inertia: Array, force: Array, softness: Array, reference: Array, limit: Array) -> Float[Array, "nv"]:
    """The piece of each joint at the minimum.

    Newton's full step is exact once the pieces are right. A step that does not lower the cost is replaced by a sweep
    over the joints, each moved to its own minimum, so that the search cannot go round in circles.
    """
    row = (softness, reference, limit)

    def cost(acceleration: Array) -> Array:
        offset = acceleration - reference
        pull = jnp.abs(softness * offset)
        soft = jnp.where(
            pull <= limit, softness * jnp.square(offset) / 2, limit * (jnp.abs(offset) - limit / softness / 2)
        )
        return acceleration @ (inertia @ acceleration / 2 - force) + jnp.sum(soft)

    def sweep(acceleration: Array) -> Array:
        for i in range(len(force)):
            free = force[i] - inertia[i] @ acceleration + inertia[i, i] * acceleration[i]
            own = dry_friction(inertia[i, i][None, None], free[None], *(value[i][None] for value in row))
            acceleration = acceleration.at[i].set((free + own[0]) / inertia[i, i])
        return acceleration

    def advance(state: tuple[Array, Array, Array, Bool[Array, ""]]) -> tuple:
        count, acceleration, sliding, _ = state
        proposed = _accelerations(inertia, force, *row, sliding)
        reached = _pieces(proposed, *row)
        done = jnp.all(reached == sliding)
        better = done | (count == 0) | (cost(proposed) < cost(acceleration))
        swept = sweep(acceleration)
        following = jnp.where(better, proposed, swept)
        return count + 1, following, jnp.where(better, reached, _pieces(swept, *row)), done

    start = jnp.zeros_like(force)
    state = (jnp.asarray(0), start, _pieces(solve_spd(inertia, force), *row), jnp.asarray(False))
    return jax.lax.while_loop(lambda state: ~state[3] & (state[0] < _NEWTON_STEPS), advance, state)[2]
