"""MuJoCo's dry-friction constraint for a few joints, written out entry by entry so that it runs over any batch."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from frictionzoo.simulation.linear import Rows, add_diagonal, multiply, solve_rows

_LEAPS = 8  # full Newton steps, before line searches
_NEWTON_STEPS = 100  # three or four are usual
_ROUNDING = 1e-12
_RIGID = 1e6  # stiffness that holds a joint, relative to its inertia
_AT_REST = 1e-4  # velocity that counts as rest, relative to what friction alone removes in a step


class _Search(NamedTuple):
    """State of the search: steps, accelerations, the piece of each joint at them, and convergence."""

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
    """Return the force of MuJoCo's friction constraint on each joint.

    The accelerations a minimise the convex

        1/2 a' M a - a' force + sum_i s_i(a_i - reference_i)

    where s_i is quadratic, softness_i x^2 / 2, while the constraint's force stays within the limit, and linear beyond.
    One joint has a closed solution. For several, Newton's method finds it, and only its last step is differentiated
    (implicit function theorem). Where the limit is 0, so are the force and its derivative.

    Source: MuJoCo documentation, "Computation", "Constraint model", primal problem and friction loss.

    Args:
        inertia: Joint-space inertia M, by rows [kg m^2 or kg].
        force: All other forces [N m or N].
        softness: `efc_D` of each joint's row [kg m^2 or kg].
        reference: `efc_aref` of each joint's row [rad/s^2 or m/s^2].
        limit: `frictionloss` [N m or N]; 0 for a joint without dry friction.
    """
    if len(force) == 1:
        ((alone,),) = inertia
        holding = (reference - force / alone) / (1 / alone + 1 / softness)
        return jnp.where(limit == 0, 0.0, jnp.clip(holding, -limit, limit))
    problem = (inertia, force, softness, reference, limit)
    sliding = _find_sliding(*jax.lax.stop_gradient(problem))
    acceleration = _accelerations(*problem, sliding)
    return jnp.where(sliding == 0, softness * (reference - acceleration), -sliding * limit)


def rigid_step(
    inertia: Rows, force: Float[Array, "nv"], qvel: Float[Array, "nv"], timestep: float, limit: Float[Array, "nv"]
) -> tuple[Float[Array, "nv"], Float[Array, "nv"]]:
    """Compute a step with Coulomb friction that does not creep.

    A joint that friction can hold is at rest after the step. If a joint stops or reverses within the step, friction
    opposes the old motion until the stop; then it holds the joint or opposes the new motion. A friction force that is
    constant over the step, as in MuJoCo's constraint at any stiffness, would give velocities of first order in the step
    and wrong derivatives. `inertia` includes the integrator's addition, `qvel` [rad/s or m/s] is the velocity before
    the step, `timestep` is in s; the other arguments are as in `dry_friction`.

    Source: J. J. Moreau, "Unilateral contact and dry friction in finite freedom dynamics", 1988, for the implicit step.

    Returns:
        Mean accelerations, and the displacement in addition to theirs [rad or m].
    """
    diagonal = jnp.stack([jnp.asarray(row[-1]) for row in inertia])
    stiff, stop, before = _RIGID * diagonal, -qvel / timestep, jnp.sign(qvel)
    problem = (inertia, force, stiff, stop, limit)
    after = (
        _pieces(force - diagonal * stop, limit) if len(force) == 1 else _find_sliding(*jax.lax.stop_gradient(problem))
    )
    moves = jnp.abs(qvel) > _AT_REST * timestep * limit / diagonal
    changes = moves & (before * after <= 0) & (limit > 0)
    # A joint that stops within the step reverses if friction cannot hold it at rest.
    stands = stiff * _accelerations(inertia, force, stiff, jnp.where(changes, 0.0, stop), limit, after)
    after = jnp.where(changes & (after == 0), _pieces(stands, limit), after)
    slowing = _accelerations(*problem, jnp.where(changes, before, after))
    share = jnp.where(changes, jnp.clip(stop / jnp.where(changes, slowing, 1.0), 0.0, 1.0), 0.0)
    mean = share * before + (1 - share) * after
    accelerations = _accelerations(*problem, after, mean)
    friction = jnp.where(after == 0, stiff * (stop - accelerations), -mean * limit)
    early = jnp.where(changes, -before * limit - friction, 0.0) * share * timestep**2 / 2
    holding = jnp.where((after == 0) & ~changes, stiff, 0.0)
    return accelerations, solve_rows(add_diagonal(inertia, holding), early)


def _accelerations(
    inertia: Rows, force: Array, softness: Array, reference: Array, limit: Array, sliding: Array, mean: Any = None
) -> Float[Array, "nv"]:
    """Minimise `dry_friction`'s problem, each joint on one piece: -1 and 1 slide backwards and forwards, 0 holds."""
    # A joint that reverses within the step slides in the direction `mean`; None: as `sliding`.
    holds = sliding == 0
    stiff = jnp.where(holds, softness, 0.0)
    pushed = force + stiff * reference - jnp.where(holds, 0.0, (sliding if mean is None else mean) * limit)
    return solve_rows(add_diagonal(inertia, stiff), pushed)


def _pieces(pull: Array, limit: Array) -> Float[Array, "nv"]:
    slides = (pull > limit) | (limit == 0)  # without dry friction nothing holds, even without load
    return jnp.where(slides, 1.0, jnp.where(pull < -limit, -1.0, 0.0)).astype(pull.dtype)


def _find_sliding(inertia: Rows, force: Array, softness: Array, reference: Array, limit: Array) -> Float[Array, "nv"]:
    """Return the piece of each joint at the minimum; NaN if the search does not converge.

    The cost is convex, and quadratic within each combination of pieces. Newton's step goes to the minimum of the
    current quadratic; if that lies in the same pieces, it is the solution. A few full steps nearly always suffice;
    otherwise the search continues with exact line searches.
    """
    row = (softness, reference, limit)

    def pieces(acceleration: Array) -> Array:
        return _pieces(softness * (acceleration - reference), limit)

    def slope(acceleration: Array, direction: Array) -> Array:
        soft = jnp.clip(softness * (acceleration - reference), -limit, limit)
        return direction @ (multiply(inertia, acceleration) - force + soft)

    def lowest(start: Array, direction: Array) -> Array:
        """Return the step length of lowest cost: the slope rises linearly along a direction, with kinks at borders."""
        borders = jnp.concatenate([(reference + side * limit / softness - start) / direction for side in (-1, 1)])
        borders = jnp.where(jnp.isfinite(borders) & (borders > 0), borders, 0.0)
        slopes = jax.vmap(lambda share: slope(start + share * direction, direction))(borders)
        before = jnp.max(jnp.where(slopes < 0, borders, 0.0))
        after = jnp.min(jnp.where(slopes >= 0, jnp.where(borders > 0, borders, jnp.inf), jnp.inf))
        after = jnp.where(jnp.isfinite(after), after, before + 1)  # beyond the last border the slope is linear
        falling, rising = (slope(start + share * direction, direction) for share in (before, after))
        return before - falling * (after - before) / (rising - falling)

    def propose(sliding: Array) -> tuple[Array, Array]:
        proposed = _accelerations(inertia, force, *row, sliding)
        return proposed, pieces(proposed)

    def leap(state: _Search) -> _Search:
        """Take a full step; a joint that would reverse is tried at rest first, which prevents endless reversals."""
        proposed, sliding = propose(state.sliding)
        done = jnp.all(sliding == state.sliding)
        return _Search(state.count + 1, proposed, jnp.where(sliding * state.sliding < 0, 0.0, sliding), done)

    def descend(state: _Search) -> _Search:
        """Take a step to the lowest point along it."""
        here = pieces(state.acceleration)
        proposed, sliding = propose(here)
        direction = proposed - state.acceleration
        # At a border, rounding may name either piece: both have the same solution.
        near = jnp.all(jnp.abs(direction) <= _ROUNDING * (jnp.abs(proposed) + jnp.abs(state.acceleration)))
        done = near | jnp.all(sliding == here)
        share = jnp.where(done, 0.0, lowest(state.acceleration, direction))
        return _Search(state.count + 1, state.acceleration + share * direction, here, done)

    smooth = solve_rows(inertia, force)
    start = _Search(jnp.asarray(0), smooth, pieces(smooth), jnp.asarray(False))
    search = jax.lax.while_loop(lambda state: ~state.done & (state.count < _LEAPS), leap, start)
    search = jax.lax.while_loop(lambda state: ~state.done & (state.count < _NEWTON_STEPS), descend, search)
    return jnp.where(search.done, search.sliding, jnp.nan)
