"""Embedded position controller without a torque limit."""

from collections.abc import Mapping
from typing import Any, ClassVar

from frictionzoo.bench.actuators.base import Actuator, Affine, Sections, Value, register_actuator


@register_actuator("position_pd")
class PositionPD(Actuator):
    """Embedded position controller: torque = kp (ctrl - qpos) - kd qvel, with the desired position ctrl."""

    dimensions: ClassVar[Mapping[str, str]] = {"kp": "stiffness", "kd": "damping"}

    def __init__(self, params: Sections = None, *, kp: Value = None, kd: Value = None) -> None:
        super().__init__(params, kp=kp, kd=kd)

    def affine(self, values: Mapping[str, Any]) -> Affine:
        """See `Actuator.affine`."""
        return Affine(values["kp"], values.get("torque_offset", 0 * values["kp"]), -values["kp"], -values["kd"])
