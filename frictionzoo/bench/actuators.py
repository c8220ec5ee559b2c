"""Actuator laws: how a recorded command becomes torque, as MuJoCo's affine actuator computes it.

MuJoCo's affine actuator gives `gain * ctrl + bias0 + bias1 * qpos + bias2 * qvel`; a law here is the four coefficients
as functions of its parameters, so that the fitted simulation and the exported MJCF hold the same actuator.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

from frictionzoo.params import Param, read_params


class Affine(NamedTuple):
    """Coefficients of MuJoCo's affine actuator, each of shape (nv,).

    Attributes:
        gain: Factor of the command.
        bias0: Constant torque.
        bias1: Factor of the position.
        bias2: Factor of the velocity.
    """

    gain: Any
    bias0: Any
    bias1: Any
    bias2: Any


class Actuator(ABC):
    """An actuator law.

    Attributes:
        dimensions: Dimension of each parameter, a key of `frictionzoo.params.UNITS`.
        params: Each parameter's value or initial value, bounds and scale.

    Args:
        params: Section of each parameter: `init`, `low`, `high`, `scale`, `identify`.

    Raises:
        ConfigError: A parameter is missing, unknown, or its bounds make no sense.
    """

    dimensions: ClassVar[Mapping[str, str]]

    def __init__(self, params: Mapping[str, Mapping[str, Any]]) -> None:
        self.params: dict[str, Param] = read_params(type(self).__name__, self.dimensions, params)

    @abstractmethod
    def affine(self, values: Mapping[str, Any]) -> Affine:
        """MuJoCo's coefficients for these parameter values, each of shape (nv,)."""


class PositionPD(Actuator):
    """Embedded position controller: torque = kp (ctrl - qpos) - kd qvel, ctrl the desired position."""

    dimensions = {"kp": "stiffness", "kd": "damping"}

    def affine(self, values: Mapping[str, Any]) -> Affine:
        """See `Actuator.affine`."""
        return Affine(values["kp"], 0 * values["kp"], -values["kp"], -values["kd"])


class Force(Actuator):
    """Force drive: force = force_gain ctrl + force_offset, ctrl in the unit that was recorded (volts, newtons)."""

    dimensions = {"force_gain": "torque/command", "force_offset": "torque"}

    def affine(self, values: Mapping[str, Any]) -> Affine:
        """See `Actuator.affine`."""
        zero = 0 * values["force_gain"]
        return Affine(values["force_gain"], values["force_offset"], zero, zero)
