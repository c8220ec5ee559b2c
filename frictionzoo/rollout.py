"""Segments to predicted states: many open-loop rollouts at once."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from frictionzoo.engine import Engine, Values


@dataclass(frozen=True)
class Rollout:
    """Many open-loop rollouts at once: initial states and commands to predicted states.

    Call it, or `compiled` where nothing else around it is compiled, with the values, initial qpos and qvel of shape
    (batch, nv), ctrl of shape (batch, time, nu) and, for a bench with payloads, loads of shape (batch, load). The
    answer is qpos and qvel after each step, of shape (batch, time, nv). A rollout that diverges contains non-finite
    values.

    Attributes:
        function: The rollout, not compiled.
        compiler_options: For `jax.jit` of whatever it is part of.
        forward_limit: Tangents up to which forward mode is faster than a reverse sweep.
        reverse: Whether there is a reverse mode.
    """

    function: Callable[..., tuple[Any, Any]]
    compiler_options: Mapping[str, Any]
    forward_limit: int
    reverse: bool

    def __call__(self, values: Values, qpos: Any, qvel: Any, ctrl: Any, load: Any = None) -> tuple[Any, Any]:
        """The predicted states."""
        return self.function(values, qpos, qvel, ctrl, load)

    @cached_property
    def compiled(self) -> Callable[..., tuple[Any, Any]]:
        """The same, compiled."""
        return self.compile(self.function)

    def compile(self, function: Callable[..., Any]) -> Any:
        """`jax.jit` of a function that calls this rollout."""
        return jax.jit(function, compiler_options=dict(self.compiler_options))


def make_rollout(engine: Engine) -> Rollout:
    """The rollouts of an engine.

    Only position and velocity are carried from step to step, so that reverse mode stores little.

    Args:
        engine: The simulated drive.
    """
    batched = jax.vmap(engine.step, in_axes=(None, 0, 0, 0, 0))

    def rollout(
        values: Values,
        qpos: Float[Array, "batch nv"],
        qvel: Float[Array, "batch nv"],
        ctrl: Float[Array, "batch time nu"],
        load: Float[Array, "batch load"] | None = None,
    ) -> tuple[Float[Array, "batch time nv"], Float[Array, "batch time nv"]]:
        load = jnp.zeros((len(qpos), 0), jnp.result_type(float)) if load is None else load

        def advance(state: tuple[Array, Array], command: Array) -> tuple:
            state = batched(values, state[0], state[1], command, load)
            return state, state

        _, (positions, velocities) = jax.lax.scan(advance, (qpos, qvel), jnp.swapaxes(ctrl, 0, 1))
        return jnp.swapaxes(positions, 0, 1), jnp.swapaxes(velocities, 0, 1)

    return Rollout(rollout, engine.compiler_options, engine.forward_limit, engine.reverse)
