"""The interface of an engine, and how a friction law enters it."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from frictionzoo.bench import Bench
from frictionzoo.types import DriveState, FrictionTerms

Values = Mapping[str, Mapping[str, Any]]
"""Physical values by owner (`bench`, `friction`) and name."""

Friction = Callable[[Mapping[str, Any], DriveState], FrictionTerms]
"""A friction law's formula: its values and what the drive is doing to friction terms."""


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

    @abstractmethod
    def step(
        self,
        values: Values,
        qpos: Float[Array, "nv"],
        qvel: Float[Array, "nv"],
        ctrl: Float[Array, "channels"],
        load: Float[Array, "load"],
    ) -> tuple[Float[Array, "nv"], Float[Array, "nv"]]:
        """Position and velocity one time step later.

        Args:
            values: Bench and friction parameters.
            qpos: Position [rad or m].
            qvel: Velocity [rad/s or m/s].
            ctrl: The command of each joint's actuator, then each other input of the actuator law, one a joint.
            load: What the recording's payload changes in the model, from `Bench.load`.
        """

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


def control(bench: Bench, values: Values, qpos: Array, qvel: Array, ctrl: Array) -> tuple[Array, Array]:
    """The commands alone, and what the actuator law's controller makes of them; arguments as in `Engine.step`."""
    command, *rest = jnp.split(ctrl, 1 + len(bench.actuator.inputs), axis=-1)
    inputs = dict(zip(bench.actuator.inputs, rest, strict=True))
    return command, bench.actuator.control(jnp, values["bench"], qpos, qvel, command, inputs)


def friction_of(module: Any) -> Friction:
    """A friction module's formula over `jax.numpy`."""

    def friction(values: Mapping[str, Any], state: DriveState) -> FrictionTerms:
        return module.terms(jnp, values, state)

    return friction
