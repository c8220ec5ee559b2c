"""What every engine offers: one simulation step of a bench with a friction law in it."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from frictionzoo.bench import Bench
from frictionzoo.core.state import DriveState, FrictionTerms, Signals

Values = Mapping[str, Mapping[str, Any]]
"""Physical values by owner (`bench`, `friction`) and name."""


@dataclass(frozen=True)
class Friction:
    """A friction law as two functions over `jax.numpy`.

    Attributes:
        settle: Called once, where a rollout begins. Gets the law's values and the first state; returns its memory,
            of shape (nv, memory).
        advance: Called in each step. Gets the law's values, the state, the memory and the time step [s]; returns the
            friction terms that act during the step, and the memory after it.
    """

    settle: Callable[[Mapping[str, Any], DriveState], Array]
    advance: Callable[[Mapping[str, Any], DriveState, Array, float], tuple[FrictionTerms, Array]]


UNFUSED: dict[str, str | bool] = {"xla_disable_hlo_passes": "fusion", "xla_cpu_use_fusion_emitters": True}
"""Compiler options that switch XLA's fusion off on CPUs.

Fusion computes a term anew wherever it is used. The dynamics of many joints use each term many times, so that the
compiled step becomes slow. The newer emitters are asked for too: without fusion, the older ones mixed up the arrays of
two joints (jaxlib 0.10.2).
"""

FORWARD: dict[str, str | bool] = {"xla_cpu_use_fusion_emitters": False}
"""Those of functions without a reverse sweep that are fused: XLA's older emitters of code for CPUs.

They compile in two thirds of the time; rollouts and tangents run up to a third faster, reverse sweeps a fifth slower.
"""


class Engine(ABC):
    """Simulates a bench with a friction law, one step at a time; JAX differentiates the step in all values.

    Attributes:
        bench: What is simulated.
        friction: The friction law.
        name: What chooses it, `engine=NAME`, and what results call it.
        note: One line that a run prints about it, or "".
        compiler_options: Options for XLA where a step of this engine is compiled with a reverse sweep.
        forward_options: The same where there is none.
        forward_limit: Number of parameters up to which forward mode is the faster way to the derivative.
        branches: Number of the branch of each joint, from 0: joints of different ones do not move each other.
        reverse: Whether the step can be differentiated in reverse mode. It cannot where a solver iterates until it has
            converged: JAX has no reverse mode for a loop of unknown length.
        keeps_slopes: Whether the derivative of a step is made of few numbers, which a rollout can keep for tangents
            that are taken afterwards.
    """

    name: ClassVar[str]
    note: str = ""
    compiler_options: Mapping[str, Any]
    forward_options: Mapping[str, Any]
    forward_limit: ClassVar[int]
    reverse: bool = True
    keeps_slopes: bool = False
    branches: tuple[int, ...]
    bench: Bench
    friction: Friction

    @abstractmethod
    def step(
        self,
        values: Values,
        qpos: Float[Array, "nv"],
        qvel: Float[Array, "nv"],
        signals: Signals,
        load: Float[Array, "load"],
        memory: Float[Array, "nv memory"],
        rigid: bool = False,
        midway: Float[Array, "nv"] | None = None,
    ) -> tuple[Float[Array, "nv"], Float[Array, "nv"], Float[Array, "nv memory"]]:
        """Simulate one time step.

        Args:
            values: Values of the bench's parameters and of the friction law's.
            qpos: Position [rad or m].
            qvel: Velocity [rad/s or m/s].
            signals: What was recorded besides the state, each of shape (nv,).
            load: How the payload of the recording changes the model, from `Bench.load`.
            memory: The friction law's, from `start` or from the step before.
            rigid: Dry friction as `rigid_step` has it in place of MuJoCo's constraint, where nothing else is
                constrained.
            midway: Velocity expected in the middle of the step, for the links' Coriolis and centrifugal forces [rad/s
                or m/s]; None for MuJoCo's, that before the step.

        Returns:
            Position, velocity and the friction law's memory after the step.
        """

    def start(
        self, values: Values, qpos: Array, qvel: Array, signals: Signals, load: Array
    ) -> Float[Array, "nv memory"]:
        """The friction law's memory where a rollout begins; arguments as in `step`."""
        return self.friction.settle(values["friction"], self.drive_state(values, qpos, qvel, signals, load))

    @abstractmethod
    def drive_state(self, values: Values, qpos: Array, qvel: Array, signals: Signals, load: Array) -> DriveState:
        """What the friction law sees in this state: velocity, torques and so on; arguments as in `step`."""


def control(bench: Bench, values: Values, qpos: Array, qvel: Array, signals: Signals) -> Float[Array, "nv"]:
    """What the controller makes of the commands; arguments as in `Engine.step`."""
    return bench.actuator.control(jnp, values["bench"], qpos, qvel, signals.ctrl, signals.inputs)


def friction_of(module: Any) -> Friction:
    """The two functions of a friction module, over `jax.numpy`."""
    return Friction(partial(module.settle, jnp), partial(module.advance, jnp))


def without_memory(terms: Callable[[Mapping[str, Any], DriveState], FrictionTerms]) -> Friction:
    """A law that depends on the present state alone, from its one function of the law's values and the state."""
    return Friction(
        settle=lambda values, state: jnp.zeros((*state.qvel.shape, 0)),
        advance=lambda values, state, memory, timestep: (terms(values, state), memory),
    )
