"""Interface of engines: one simulation step of a bench with a friction model."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import jax.numpy as jnp
import jaxlib.version
from jaxtyping import Array, Float

from frictionzoo.bench import Bench
from frictionzoo.core.state import DriveState, FrictionTerms, Signals

Values = Mapping[str, Mapping[str, Any]]
"""Physical values by owner (`bench`, `friction`) and name."""


@dataclass(frozen=True)
class Friction:
    """Friction model as two functions over `jax.numpy`.

    Attributes:
        settle: Called once at the start of a rollout with the model's values and the first state; returns the memory,
            of shape (nv, memory).
        advance: Called in each step with values, state, memory and time step [s]; returns the friction terms that act
            during the step, and the memory in this state.
    """

    settle: Callable[[Mapping[str, Any], DriveState], Array]
    advance: Callable[[Mapping[str, Any], DriveState, Array, float], tuple[FrictionTerms, Array]]


def _emitters(newer: bool) -> dict[str, str | bool]:
    """Return the XLA option that chooses the code emitters for CPUs; jaxlib 0.11.1 and later have only newer ones."""
    return {"xla_cpu_use_fusion_emitters": newer} if jaxlib.version.__version_info__ < (0, 11, 1) else {}


UNFUSED: dict[str, str | bool] = {"xla_disable_hlo_passes": "fusion"} | _emitters(newer=True)
"""Compiler options that switch off XLA's fusion on CPUs. Fusion recomputes a term wherever it is used, which makes the
compiled step of many joints slow. Without fusion, the older emitters mixed up the arrays of two joints (jaxlib 0.10.2),
so the newer ones are set too."""

FORWARD: dict[str, str | bool] = _emitters(newer=False)
"""Compiler options for fused functions without a reverse sweep: XLA's older code emitters for CPUs. They compile in two
thirds of the time; rollouts and tangents run up to a third faster, reverse sweeps a fifth slower."""


class Engine(ABC):
    """Simulator of one step of a bench with a friction model; JAX differentiates it in all values.

    Attributes:
        name: Value of `engine=NAME` and name in results.
        note: One line that a run prints about it, or "".
        compiler_options: XLA options for compiling a step with a reverse sweep.
        forward_options: XLA options for compiling a step without one.
        forward_limit: Largest number of parameters for which forward mode is faster than reverse mode.
        reverse: Whether the step has a reverse mode. JAX has none for a solver that iterates until convergence.
        keeps_slopes: Whether a step's derivative consists of few numbers, which a rollout can keep for later tangents.
    """

    name: ClassVar[str]
    note: str = ""
    compiler_options: Mapping[str, Any]
    forward_options: Mapping[str, Any]
    forward_limit: ClassVar[int]
    reverse: bool = True
    keeps_slopes: bool = False
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
        midway: Float[Array, "nv"] | None = None,
    ) -> tuple[Float[Array, "nv"], Float[Array, "nv"], Float[Array, "nv memory"]]:
        """Simulate one time step.

        Args:
            values: Values of the bench's and the friction model's parameters.
            qpos: Position [rad or m].
            qvel: Velocity [rad/s or m/s].
            signals: Recorded signals other than the state, each of shape (nv,).
            load: Effect of the payload on the bench's MuJoCo model, from `Bench.load`.
            memory: The friction model's memory, from `Friction.settle` or the previous step.
            midway: Expected velocity in the middle of a step of second order, for the links' Coriolis and centrifugal
                forces [rad/s or m/s]. Dry friction at MuJoCo's stiffness limit then stands for friction that does not
                creep: it follows `rigid_step`, if nothing else is constrained. None: a step as in MuJoCo.

        Returns:
            Position, velocity and memory after the step.
        """

    @abstractmethod
    def drive_state(self, values: Values, qpos: Array, qvel: Array, signals: Signals, load: Array) -> DriveState:
        """Return the state that the friction model reads; arguments as in `step`."""


def control(bench: Bench, values: Values, qpos: Array, qvel: Array, signals: Signals) -> Float[Array, "nv"]:
    """Compute MuJoCo's ctrl from the recorded commands; arguments as in `Engine.step`."""
    return bench.actuator.control(jnp, values["bench"], qpos, qvel, signals.ctrl, signals.inputs)


def friction_of(module: Any, midway: bool = False) -> Friction:
    """Return a friction module's two functions, over `jax.numpy`; `midway` for its torque in the middle of the step."""
    return Friction(partial(module.settle, jnp), partial(module.advance_midway if midway else module.advance, jnp))


def without_memory(terms: Callable[[Mapping[str, Any], DriveState], FrictionTerms]) -> Friction:
    """Make a friction model without memory from a function of the model's values and the state."""
    return Friction(
        settle=lambda values, state: jnp.zeros((*state.qvel.shape, 0)),
        advance=lambda values, state, memory, timestep: (terms(values, state), memory),
    )
