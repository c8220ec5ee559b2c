"""Many open-loop rollouts at once: predicted states of segments."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from operator import itemgetter
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from frictionzoo.core.segments import Sampling
from frictionzoo.core.state import DriveState, Signals
from frictionzoo.simulation import Engine, Values
from frictionzoo.simulation.second_order import SecondOrder

EACH_STEP = Sampling(0.0, 1, 0)
"""Each simulation step is a sample, and there is no delay."""
State = tuple[Array, Array, Array, Array]
"""Position, velocity, the friction model's memory, and in second order the previous velocity; one row a segment."""


@dataclass(frozen=True)
class Rollout:
    """Many open-loop rollouts at once: initial states and commands to predicted states.

    Call it, or `compiled` outside compiled code, with the values, initial qpos and qvel of shape (batch, nv), signals
    of shape (batch, samples, nv) as in `Segments` and, for a bench with payloads, loads of shape (batch, load). It
    returns qpos and qvel after each sample interval, of shape (batch, time, nv). A diverging rollout contains
    non-finite values.

    `function` is the rollout, not compiled. `branches` has each joint's branch, from 0; joints of different branches do
    not move each other. `keeps_slopes` is as in `Engine`.
    """

    function: Callable[..., tuple[Any, Any]]
    engine: Engine
    branches: tuple[int, ...]
    keeps_slopes: bool

    def __call__(self, values: Values, qpos: Any, qvel: Any, signals: Signals, load: Any = None) -> tuple[Any, Any]:
        """Return the predicted states."""
        return self.function(values, qpos, qvel, signals, load)

    @cached_property
    def compiled(self) -> Callable[..., tuple[Any, Any]]:
        """The compiled rollout."""
        return self.compile(self.function, forward=True)

    def compile(self, function: Callable[..., Any], forward: bool = False) -> Any:
        """Apply `jax.jit` to a function that calls this rollout; `forward` if it has no reverse sweep."""
        engine = self.engine
        return jax.jit(function, compiler_options=dict(engine.forward_options if forward else engine.compiler_options))


def make_rollout(engine: Engine, sampling: Sampling = EACH_STEP, coupled: bool = False) -> Rollout:
    """Make the rollouts of an engine; `coupled` if the friction of a joint depends on other joints.

    Steps carry only position, velocity and the friction model's memory, so reverse mode stores little. The memory
    begins as if each segment's first state had lasted.
    """
    second = SecondOrder(engine.bench, engine.friction) if sampling.second_order else None

    def step_one(values: Values, state: State, now: Signals, load: Array) -> State:
        qpos, qvel, memory, before = state
        if second is None:
            return *engine.step(values, qpos, qvel, now, load, memory), before
        adapted, midway = second.adapt(values, qpos, qvel, now, memory), qvel + (qvel - before) / 2
        return *engine.step(adapted, qpos, qvel, now, load, memory, midway), qvel

    def begin(values: Values, *state: Any) -> Array:
        return engine.friction.settle(values["friction"], engine.drive_state(values, *state))

    batched = jax.vmap(step_one, in_axes=(None, 0, 0, 0))
    started = jax.vmap(begin, in_axes=(None, 0, 0, 0, 0))

    def rollout(
        values: Values,
        qpos: Float[Array, "batch nv"],
        qvel: Float[Array, "batch nv"],
        signals: Signals,
        load: Float[Array, "batch load"] | None = None,
    ) -> tuple[Float[Array, "batch time nv"], Float[Array, "batch time nv"]]:
        load = jnp.zeros((len(qpos), 0), jnp.result_type(float)) if load is None else load

        def step(state: State, now: Signals) -> tuple[State, None]:
            return batched(values, state, now, load), None

        def advance(state: State, steps: Signals) -> tuple[State, tuple[Array, Array]]:
            several = sampling.substeps > 1
            state = jax.lax.scan(step, state, steps)[0] if several else step(state, steps.map(itemgetter(0)))[0]
            position = state[0] if second is None else second.read(*state[:2])
            return state, (position, state[1])

        acting = applied(values, signals, sampling).map(lambda signal: jnp.moveaxis(signal, 0, 2))
        memory = started(values, qpos, qvel, acting.map(itemgetter((0, 0))), load)
        start = qpos, qvel, memory, qvel[:, :0]
        if second is not None:
            start = second.begin(qpos, qvel), qvel, memory, qvel
        _, (positions, velocities) = jax.lax.scan(advance, start, acting)
        return jnp.swapaxes(positions, 0, 1), jnp.swapaxes(velocities, 0, 1)

    branches = (0,) * engine.bench.nv if coupled else engine.bench.branches
    return Rollout(rollout, engine, branches, engine.keeps_slopes)


def make_observer(engine: Engine, sampling: Sampling) -> Callable[..., DriveState]:
    """Make a function, not compiled, that returns a friction model's input at measured states.

    Returns:
        Function of values, qpos and qvel of shape (batch, time, nv), signals as in `Segments` and loads of shape
        (batch, load); it returns a state of shape (batch, time, nv).
    """
    over_time = jax.vmap(engine.drive_state, in_axes=(None, 0, 0, 0, None))
    over_batch = jax.vmap(over_time, in_axes=(None, 0, 0, 0, 0))

    def observe(values: Values, qpos: Any, qvel: Any, signals: Signals, load: Any) -> DriveState:
        now = applied(values, signals, sampling).map(lambda signal: signal[:, :, 0])
        return over_batch(values, qpos, qvel, now, load)

    return observe


def applied(values: Values, signals: Signals, sampling: Sampling) -> Signals:
    """Return the signals that act in each simulation step, each of shape (batch, time, substeps, nv).

    Commands have the bench's delay [s], if `values` contain one. A command is held until the next one. In the step in
    which a delayed command changes, their mean over the step acts, so the rollout depends continuously on the delay,
    also within a sample or a step. The samples have the shape (batch, samples, nv), as in `Segments`.
    """
    interval, substeps, history, commands, _ = sampling

    def hold(signal: Float[Array, "batch samples nv"]) -> Float[Array, "batch time substeps nv"]:
        now = signal[:, history:]
        return jnp.broadcast_to(now[:, :, None], (*now.shape[:2], substeps, now.shape[2]))

    undelayed = signals.map(hold)
    delay = values["bench"].get("delay")
    if delay is None:
        return undelayed
    # A delayed step begins at a fraction between two of the steps in which commands are held.
    offset = -delay * substeps / interval
    whole_steps = jax.lax.stop_gradient(jnp.floor(offset))
    fraction = offset - whole_steps
    step = jnp.arange(substeps)[:, None] + whole_steps.astype(int)
    sample = history + jnp.arange(undelayed.ctrl.shape[1])[:, None, None]
    joint = jnp.arange(len(delay))

    def act(command: Float[Array, "batch samples nv"]) -> Float[Array, "batch time substeps nv"]:
        late = (1 - fraction) * command[:, sample + step // substeps, joint]
        padded = jnp.concatenate([command, command[:, -1:]], axis=1)  # padding for no delay, of weight 0
        return late + fraction * padded[:, sample + (step + 1) // substeps, joint]

    late = {name: act(signals.inputs[name]) for name in commands}
    return undelayed._replace(ctrl=act(signals.ctrl), inputs=undelayed.inputs | late)
