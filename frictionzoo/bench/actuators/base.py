"""Interface of actuator laws, which convert a recorded command into torque.

MuJoCo's affine actuator gives `gain * ctrl + bias0 + bias1 * qpos + bias2 * qvel`. An actuator law returns these four
coefficients; bias0 includes the bench's `torque_offset`. The fitted simulation and the exported MJCF therefore contain
the same actuator. A controller also transforms the command before MuJoCo's actuator receives it.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float

from frictionzoo.core.described import Described
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.params import Param, read_params, refuse_negative
from frictionzoo.core.registry import KINDS, Registry

Sections = Mapping[str, Mapping[str, Any]] | None
"""Section of each parameter by name."""
Value = float | int | Sequence[float | int] | Mapping[str, Any] | None
"""A known value for all joints, one a joint, a section as `free` returns it, or None: not stated."""


class Affine(NamedTuple):
    """Coefficients of MuJoCo's torque `gain * ctrl + bias0 + bias1 * qpos + bias2 * qvel`, each of shape (nv,)."""

    gain: Any
    bias0: Any
    bias1: Any
    bias2: Any


class Actuator(Described, ABC):
    """Base class of actuator laws.

    Attributes:
        dimensions: Dimension of each parameter, one of `frictionzoo.core.units.DIMENSIONS`.
        optional: Parameters that may be omitted or known to be 0; the law then omits their effect.
        ends: Parameters among `optional` that keep their effect at 0.
        positive: Parameters whose initial value must be above 0 in each joint, with advice for the error message.
        defaults: Default section of parameters.
        inputs: Signals that the controller needs in addition to `ctrl`, from `Log.extras`.
        optional_inputs: Default values of the inputs that a recording may lack.
        commands: Inputs that are commands; the delay of `ctrl` applies to them too.
        params: Value or initial value, bounds and scale of each parameter.
        said: Names of the parameters in the arguments, also of those dropped because they are 0.

    Args:
        params: Section of each parameter: `init`, `low`, `high`, `scale`, `identify`.
        values: Parameters by name: `PositionPD(kp=15, kd=0.5)`; a list has one value per joint, None is not stated.

    Raises:
        ConfigError: A parameter is missing, unknown, given twice or not positive, or its bounds are invalid.
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
    records_none: ClassVar[bool] = False

    def __init__(self, params: Sections = None, **values: Value) -> None:
        owner, sections = type(self).__name__, dict(params or {})
        values = {name: value for name, value in values.items() if value is not None}
        for name in sections.keys() & values.keys():
            raise ConfigError(f"{owner}: {name} is given twice, expected a value or a section; leave one out")
        arguments = {**sections, **values}
        self.params: dict[str, Param] = read_params(
            owner, self.dimensions, arguments, self.optional, self.defaults, self.ends
        )
        self.said: frozenset[str] = frozenset(arguments)
        for name, advice in self.positive.items():
            init: Any = self.params[name].init if name in self.params else None
            if init is not None and not np.all(np.array([*init.values()] if isinstance(init, Mapping) else init) > 0):
                raise ConfigError(f"{owner}: {name}={init}; expected above 0; {advice}")
        refuse_negative(f"{owner}: ", self.params)

    @property
    def has_controller(self) -> bool:
        """Whether a controller transforms the command before MuJoCo's actuator receives it."""
        return type(self).control is not Actuator.control

    @property
    def needs_state(self) -> bool:
        """Whether `ctrl` of MuJoCo's actuator depends on the state in each step; if not, `combine` returns it."""
        return self.has_controller

    @abstractmethod
    def affine(self, values: Mapping[str, Any]) -> Affine:
        """Return MuJoCo's coefficients for parameter values, with the bench's `torque_offset` [N m or N] if any."""

    def control(
        self, xp: Any, values: Mapping[str, Any], qpos: Any, qvel: Any, command: Any, inputs: Mapping[str, Any]
    ) -> Any:
        """Return the `ctrl` that MuJoCo's actuator receives in one simulation step, of shape (..., nv).

        `xp` is `numpy`, `jax.numpy` or `torch`, `command` the recorded `ctrl`, and `inputs` has the signals named in
        `inputs`. Positions are in rad or m, velocities in rad/s or m/s.
        """
        return command

    def combine(self, values: Mapping[str, Any], command: Any, inputs: Mapping[str, Any]) -> Any:
        """Return one MuJoCo command equivalent to all recorded commands, for a law that needs no state."""
        return command

    def force_range(self, values: Mapping[str, Any]) -> Float[np.ndarray, "nv 2"] | None:
        """Return the torque range [N m or N] of a MuJoCo actuator with the command `combine`; None without a limit."""
        return None


REGISTRY = Registry(KINDS["actuators"], Actuator, "affine")

register_actuator = REGISTRY.register
"""Class decorator that registers an actuator law by name; see `Registry.register`."""
