"""A drive whose command is its force, but for a factor and a constant."""

from collections.abc import Mapping
from typing import Any, ClassVar

from frictionzoo.bench.actuators.base import Actuator, Affine, register_actuator


@register_actuator("force")
class Force(Actuator):
    """Force drive: force = force_gain ctrl + force_offset, ctrl in the unit that was recorded (volts, newtons)."""

    dimensions: ClassVar[Mapping[str, str]] = {"force_gain": "torque/command", "force_offset": "torque"}

    def affine(self, values: Mapping[str, Any]) -> Affine:
        """See `Actuator.affine`."""
        zero = 0 * values["force_gain"]
        return Affine(values["force_gain"], values["force_offset"], zero, zero)
