"""Hobby servo with a position controller that sets a voltage."""

from collections.abc import Mapping
from typing import Any, ClassVar

from frictionzoo.bench.actuators.base import Actuator, Affine, Sections, Value, register_actuator


@register_actuator("voltage_servo")
class VoltageServo(Actuator):
    """Voltage servo, whose proportional position controller sets the duty cycle of a DC motor.

        duty = clip(gain duty_gain (ctrl - qpos), -duty_limit, duty_limit)
        torque = kt_over_r duty supply - kt2_over_r qvel, and 0 while the motor is not enabled

    with the firmware's proportional gain `gain` [1], the duty cycle `duty_gain` [1/rad] per radian of error at a gain
    of one, and the measured `supply` [V]. From positions and velocities the torque constant kt and the resistance R are
    not identifiable separately, only kt_over_r [N m/V] and the back-EMF damping kt2_over_r [N m s/rad]. The command of
    MuJoCo's actuator is the voltage.

    Source: M. Duclusaud, G. Passault, V. Padois, O. Ly, "Extended friction models for the physics simulation of servo
    actuators", 2024, section II.
    """

    dimensions: ClassVar[Mapping[str, str]] = {
        "kt_over_r": "torque/voltage",
        "kt2_over_r": "damping",
        "duty_gain": "1/position",
        "duty_limit": "1",
    }
    inputs: ClassVar[tuple[str, ...]] = ("gain", "supply", "enable")

    def __init__(
        self,
        params: Sections = None,
        *,
        kt_over_r: Value = None,
        kt2_over_r: Value = None,
        duty_gain: Value = None,
        duty_limit: Value = None,
    ) -> None:
        super().__init__(params, kt_over_r=kt_over_r, kt2_over_r=kt2_over_r, duty_gain=duty_gain, duty_limit=duty_limit)

    def affine(self, values: Mapping[str, Any]) -> Affine:
        """See `Actuator.affine`."""
        zero = 0 * values["kt_over_r"]
        return Affine(values["kt_over_r"], values.get("torque_offset", zero), zero, -values["kt2_over_r"])

    def control(
        self, xp: Any, values: Mapping[str, Any], qpos: Any, qvel: Any, command: Any, inputs: Mapping[str, Any]
    ) -> Any:
        """See `Actuator.control`."""
        duty = inputs["gain"] * values["duty_gain"] * (command - qpos)
        duty = xp.minimum(xp.maximum(duty, -values["duty_limit"]), values["duty_limit"])
        # A disabled motor has open terminals. A voltage equal to its back-EMF gives zero current.
        generated = values["kt2_over_r"] / values["kt_over_r"] * qvel
        return inputs["enable"] * duty * inputs["supply"] + (1 - inputs["enable"]) * generated
