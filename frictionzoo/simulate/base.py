"""The interface of an engine, and how a friction law enters it."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from frictionzoo.bench import Bench, Channels
from frictionzoo.core.state import DriveState, FrictionTerms

Values = Mapping[str, Mapping[str, Any]]
"""Physical values by owner (`bench`, `friction`) and name."""


@dataclass(frozen=True)
class Friction:
    """A friction law's formula over `jax.numpy`.

    Attributes:
        settle: From its values and the first state to the memory that a simulation begins with, of shape (nv, memory).
        advance: From its values, the present state, the memory and the time step [s] to friction terms and the memory
            of the next step.
    """

    settle: Callable[[Mapping[str, Any], DriveState], Array]
    advance: Callable[[Mapping[str, Any], DriveState, Array, float], tuple[FrictionTerms, Array]]


UNFUSED: dict[str, str | bool] = {"xla_disable_hlo_passes": "fusion", "xla_cpu_use_fusion_emitters": True}
"""For XLA: its fusion on CPUs computes shared terms again for each of their uses, and of many joints there are many.

Without fusion its older emitters mixed up arrays of two joints (jaxlib 0.10.2): whoever asks for those gets the newer.
"""


class Engine(ABC):
    """One simulation step of a bench with a friction law, differentiable in all values.

    Attributes:
        name: Its name on the command line and in results.
        note: What a user may want to know of how it came to simulate.
        compiler_options: What XLA needs to know where a step of this engine is compiled.
        forward_limit: Tangents up to which forward mode is faster than a reverse sweep.
        reverse: Whether there is a reverse mode: none passes a loop of unknown length.
    """

    name: ClassVar[str]
    note: str = ""
    compiler_options: Mapping[str, Any]
    forward_limit: ClassVar[int]
    reverse: bool = True
    _friction: Friction

    @abstractmethod
    def step(
        self,
        values: Values,
        qpos: Float[Array, "nv"],
        qvel: Float[Array, "nv"],
        ctrl: Float[Array, "channels"],
        load: Float[Array, "load"],
        memory: Float[Array, "nv memory"],
    ) -> tuple[Float[Array, "nv"], Float[Array, "nv"], Float[Array, "nv memory"]]:
        """Position, velocity and the friction law's memory one time step later.

        Args:
            values: Bench and friction parameters.
            qpos: Position [rad or m].
            qvel: Velocity [rad/s or m/s].
            ctrl: The command of each joint's actuator, then each other input of the actuator law, then what the
                friction law looks at, one a joint each; see `Bench.split`.
            load: What the recording's payload changes in the model, from `Bench.load`.
            memory: The friction law's, from `start` or the step before.
        """

    def start(
        self,
        values: Values,
        qpos: Float[Array, "nv"],
        qvel: Float[Array, "nv"],
        ctrl: Float[Array, "channels"],
        load: Float[Array, "load"],
    ) -> Float[Array, "nv memory"]:
        """The friction law's memory at the beginning of a rollout; arguments as in `step`."""
        return self._friction.settle(values["friction"], self.drive_state(values, qpos, qvel, ctrl, load))

    @abstractmethod
    def drive_state(
        self,
        values: Values,
        qpos: Float[Array, "nv"],
        qvel: Float[Array, "nv"],
        ctrl: Float[Array, "channels"],
        load: Float[Array, "load"],
    ) -> DriveState:
        """What a friction law would see in this state; arguments as in `step`."""


def control(bench: Bench, values: Values, qpos: Array, qvel: Array, ctrl: Array) -> tuple[Channels, Array]:
    """The channels, and what the actuator law's controller makes of the commands; arguments as in `Engine.step`."""
    channels = bench.split(ctrl)
    command, inputs, _ = channels
    return channels, bench.actuator.control(jnp, values["bench"], qpos, qvel, command, inputs)


def friction_of(module: Any) -> Friction:
    """A friction module's formula over `jax.numpy`."""
    return Friction(partial(module.settle, jnp), partial(module.advance, jnp))


def without_memory(terms: Callable[[Mapping[str, Any], DriveState], FrictionTerms]) -> Friction:
    """A law that is a function of the present state.

    Args:
        terms: Its values and what the drive is doing to friction terms.
    """
    return Friction(
        settle=lambda values, state: jnp.zeros((*state.qvel.shape, 0)),
        advance=lambda values, state, memory, timestep: (terms(values, state), memory),
    )
