"""The interface of an actuator law: how a recorded command becomes torque.

MuJoCo's affine actuator gives `gain * ctrl + bias0 + bias1 * qpos + bias2 * qvel`. A law here is these four
coefficients as functions of its parameters and of the bench's `torque_offset`, a part of bias0, so that the fitted
simulation and the exported MJCF hold the same actuator, and, where that is not enough, what its controller makes of the
command before the actuator gets it.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float

from frictionzoo.core.described import Described
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.params import Param, read_params, refuse_negative
from frictionzoo.core.registry import KINDS, Registry


class Affine(NamedTuple):
    """Coefficients of MuJoCo's affine actuator, each of shape (nv,).

    Attributes:
        gain: Factor of `ctrl`.
        bias0: Constant torque.
        bias1: Factor of the position.
        bias2: Factor of the velocity.
    """

    gain: Any
    bias0: Any
    bias1: Any
    bias2: Any


class Actuator(Described, ABC):
    """An actuator law.

    Attributes:
        name: Set by `register_actuator`.
        dimensions: Dimension of each parameter, a key of `frictionzoo.core.params.UNITS`.
        optional: Parameters that need not be given, and that are left out then: what they stand for is not there.
        ends: Those among `optional` that are there where they are 0.
        positive: Parameters that begin above 0 in each joint where they are there, and what else to do.
        defaults: Section of each parameter that is known where nothing is said of it.
        inputs: What the controller needs in each sample besides `ctrl`; recordings have it among their `extras`.
        optional_inputs: What those among them are that a recording may lack.
        commands: Those among them that are commands as `ctrl` is: they act as late.
        params: Each parameter's value or initial value, bounds and scale.
        said: Names of those of which something was given, though it be that they are not there.

    Args:
        params: Section of each parameter: `init`, `low`, `high`, `scale`, `identify`.
        values: Parameters that are known, by name, in place of their sections: `PositionPD(kp=15, kd=0.5)`, or with a
            list of one value a joint.

    Raises:
        ConfigError: A parameter is missing, unknown, given twice, 0 or below where it may not be, or its bounds make no
            sense.
    """

    name: ClassVar[str]
    dimensions: ClassVar[Mapping[str, str]]
    optional: ClassVar[tuple[str, ...]] = ()
    ends: ClassVar[tuple[str, ...]] = ()
    positive: ClassVar[Mapping[str, str]] = {}
    defaults: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    inputs: ClassVar[tuple[str, ...]] = ()
    optional_inputs: ClassVar[Mapping[str, float]] = {}
    commands: ClassVar[tuple[str, ...]] = ()

    def __init__(self, params: Mapping[str, Mapping[str, Any]] | None = None, **values: Any) -> None:
        owner, sections = type(self).__name__, dict(params or {})
        for name in sections.keys() & values.keys():
            raise ConfigError(f"{owner}: {name} is given twice, expected a value or a section; leave one out")
        given = {**sections, **values}
        self.params: dict[str, Param] = read_params(
            owner, self.dimensions, given, self.optional, self.defaults, self.ends
        )
        self.said: frozenset[str] = frozenset(given)
        for name, advice in self.positive.items():
            init: Any = self.params[name].init if name in self.params else None
            if init is not None and not np.all(np.array([*init.values()] if isinstance(init, Mapping) else init) > 0):
                raise ConfigError(f"{owner}: {name}={init}; expected above 0; {advice}")
        refuse_negative(f"{owner}: ", self.params)

    @property
    def has_controller(self) -> bool:
        """Whether MuJoCo's actuator gets something else than the command."""
        return type(self).control is not Actuator.control

    @property
    def needs_state(self) -> bool:
        """Whether a program has to compute in each step, from the state, what MuJoCo's actuator gets.

        Where it does not, `combine` gives what the actuator gets, and `force_range` what limits its torque.
        """
        return self.has_controller

    @abstractmethod
    def affine(self, values: Mapping[str, Any]) -> Affine:
        """MuJoCo's coefficients for these parameter values, each of shape (nv,).

        Args:
            values: Value of each parameter, and the bench's `torque_offset` [N m or N] where it has one; bias0 has it.
        """

    def control(
        self, xp: Any, values: Mapping[str, Any], qpos: Any, qvel: Any, command: Any, inputs: Mapping[str, Any]
    ) -> Any:
        """What the drive's controller hands to MuJoCo's actuator as `ctrl` in one simulation step, of shape (..., nv).

        Args:
            xp: Array namespace, `numpy`, `jax.numpy` or `torch`.
            values: Value of each parameter.
            qpos: Position [rad or m].
            qvel: Velocity [rad/s or m/s].
            command: As recorded, `ctrl`.
            inputs: Each of `inputs`.
        """
        return command

    def combine(self, values: Mapping[str, Any], command: Any, inputs: Mapping[str, Any]) -> Any:
        """Return the one command of a MuJoCo actuator that asks for the same torque as all recorded ones together.

        Arguments are those of `control`. It is of no use where the law `needs_state`.
        """
        return command

    def force_range(self, values: Mapping[str, Any]) -> Float[np.ndarray, "nv 2"] | None:
        """Return the range of torque [N m or N] of a MuJoCo actuator that gets `combine`; None without a limit."""
        return None


REGISTRY = Registry(KINDS["actuators"], Actuator, "affine")

register_actuator = REGISTRY.register
"""Class decorator that makes an actuator law known by its name, as `Registry.register`."""
