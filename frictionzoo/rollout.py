"""Segments to predicted states: many open-loop rollouts at once."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from frictionzoo.engine.mjx import Values

Step = Callable[[Values, Any, Any, Any], tuple[Any, Any]]
"""(values, qpos, qvel, ctrl) of one state to the next (qpos, qvel)."""

Rollout = Callable[[Values, Any, Any, Any], tuple[Any, Any]]
"""(values, initial qpos, initial qvel, ctrl) of a batch to predicted (qpos, qvel)."""


def make_rollout(step: Step) -> Rollout:
    """The function that rolls a batch of initial states forward under recorded commands.

    Only position and velocity are carried from step to step, so that reverse mode stores little.

    Args:
        step: One step of one state, from an engine.

    Returns:
        rollout(values, qpos, qvel, ctrl), not compiled: initial qpos and qvel of shape (batch, nv) and ctrl of shape
        (batch, time, nu) to predicted qpos and qvel after each step, of shape (batch, time, nv). A rollout that
        diverges contains non-finite values.
    """
    batched = jax.vmap(step, in_axes=(None, 0, 0, 0))

    def rollout(
        values: Values,
        qpos: Float[Array, "batch nv"],
        qvel: Float[Array, "batch nv"],
        ctrl: Float[Array, "batch time nu"],
    ) -> tuple[Float[Array, "batch time nv"], Float[Array, "batch time nv"]]:
        def advance(state: tuple[Array, Array], command: Array) -> tuple:
            state = batched(values, state[0], state[1], command)
            return state, state

        _, (positions, velocities) = jax.lax.scan(advance, (qpos, qvel), jnp.swapaxes(ctrl, 0, 1))
        return jnp.swapaxes(positions, 0, 1), jnp.swapaxes(velocities, 0, 1)

    return rollout
