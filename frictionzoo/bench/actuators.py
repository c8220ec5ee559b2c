"""Actuator laws: how a recorded command becomes torque.

MuJoCo's affine actuator gives `gain * ctrl + bias0 + bias1 * qpos + bias2 * qvel`. A law here is these four
coefficients as functions of its parameters, so that the fitted simulation and the exported MJCF hold the same actuator,
and, where that is not enough, what its controller makes of the command before the actuator gets it.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

from frictionzoo.core.errors import ConfigError
from frictionzoo.core.params import Param, read_params


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


class Actuator(ABC):
    """An actuator law.

    Attributes:
        dimensions: Dimension of each parameter, a key of `frictionzoo.core.params.UNITS`.
        inputs: What the controller needs in each sample besides the command; recordings have it among their `extras`.
        params: Each parameter's value or initial value, bounds and scale.

    Args:
        params: Section of each parameter: `init`, `low`, `high`, `scale`, `identify`.
        values: Parameters that are known, by name, in place of their sections: `PositionPD(kp=15, kd=0.5)`.

    Raises:
        ConfigError: A parameter is missing, unknown, given twice, or its bounds make no sense.
    """

    dimensions: ClassVar[Mapping[str, str]]
    inputs: ClassVar[tuple[str, ...]] = ()

    def __init__(self, params: Mapping[str, Mapping[str, Any]] | None = None, **values: float | int) -> None:
        owner, sections = type(self).__name__, dict(params or {})
        for name in sections.keys() & values.keys():
            raise ConfigError(f"{owner}: {name} is given twice, expected a value or a section; leave one out")
        self.params: dict[str, Param] = read_params(owner, self.dimensions, {**sections, **values})

    @abstractmethod
    def affine(self, values: Mapping[str, Any]) -> Affine:
        """MuJoCo's coefficients for these parameter values, each of shape (nv,)."""

    def control(
        self, xp: Any, values: Mapping[str, Any], qpos: Any, qvel: Any, command: Any, inputs: Mapping[str, Any]
    ) -> Any:
        """What the drive's controller hands to MuJoCo's actuator as `ctrl` in one simulation step, of shape (..., nv).

        Args:
            xp: Array namespace, `numpy`, `jax.numpy` or `torch`.
            values: Value of each parameter.
            qpos: Position [rad or m].
            qvel: Velocity [rad/s or m/s].
            command: As recorded.
            inputs: Each of `inputs`.
        """
        return command


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


class DcMotorPD(Actuator):
    """Position controller of a DC motor whose torque is limited, the more the faster it turns.

        torque = clip(kp (ctrl - qpos) - kd qvel, -limit(-qvel), limit(qvel))
        limit(qvel) = clip(stall_torque (1 - qvel / no_load_velocity), 0, torque_limit)

    with kp [N m/rad], kd [N m s/rad], stall_torque and torque_limit [N m] and no_load_velocity [rad/s]. MuJoCo's
    actuator gets the torque.

    Source: Isaac Lab, documentation of the actuator model `DCMotor`, where stall_torque is called saturation effort.
    """

    dimensions = {
        "kp": "stiffness",
        "kd": "damping",
        "stall_torque": "torque",
        "torque_limit": "torque",
        "no_load_velocity": "velocity",
    }

    def affine(self, values: Mapping[str, Any]) -> Affine:
        """See `Actuator.affine`."""
        zero = 0 * values["kp"]
        return Affine(zero + 1, zero, zero, zero)

    def control(
        self, xp: Any, values: Mapping[str, Any], qpos: Any, qvel: Any, command: Any, inputs: Mapping[str, Any]
    ) -> Any:
        """See `Actuator.control`."""
        torque = values["kp"] * (command - qpos) - values["kd"] * qvel
        return xp.minimum(xp.maximum(torque, -_limit(xp, values, -qvel)), _limit(xp, values, qvel))


class VoltageServo(Actuator):
    """Voltage servo: a proportional position controller sets the duty cycle of a DC motor.

        duty = clip(gain duty_gain (ctrl - qpos), -duty_limit, duty_limit)
        torque = kt_over_r duty supply - kt2_over_r qvel, and 0 while the motor is not enabled

    with the firmware's proportional gain `gain` [1], the duty cycle per radian of error at a gain of one `duty_gain`
    [1/rad], and the measured `supply` [V]. Of the torque constant kt and the resistance R, positions and velocities
    tell only the combinations kt_over_r [N m/V] and kt2_over_r [N m s/rad], which is back-EMF. MuJoCo's actuator gets
    the voltage.

    Source: M. Duclusaud, G. Passault, V. Padois, O. Ly, "Extended friction models for the physics simulation of servo
    actuators", 2024, section II.
    """

    dimensions = {
        "kt_over_r": "torque/voltage",
        "kt2_over_r": "damping",
        "duty_gain": "1/position",
        "duty_limit": "1",
    }
    inputs = ("gain", "supply", "enable")

    def affine(self, values: Mapping[str, Any]) -> Affine:
        """See `Actuator.affine`."""
        zero = 0 * values["kt_over_r"]
        return Affine(values["kt_over_r"], zero, zero, -values["kt2_over_r"])

    def control(
        self, xp: Any, values: Mapping[str, Any], qpos: Any, qvel: Any, command: Any, inputs: Mapping[str, Any]
    ) -> Any:
        """See `Actuator.control`."""
        duty = inputs["gain"] * values["duty_gain"] * (command - qpos)
        duty = xp.minimum(xp.maximum(duty, -values["duty_limit"]), values["duty_limit"])
        # A motor that is not enabled has open terminals: at the voltage that it generates itself, no current flows.
        generated = values["kt2_over_r"] / values["kt_over_r"] * qvel
        return inputs["enable"] * duty * inputs["supply"] + (1 - inputs["enable"]) * generated


def _limit(xp: Any, values: Mapping[str, Any], qvel: Any) -> Any:
    """Largest torque in the direction of positive velocity [N m]."""
    falling = values["stall_torque"] * (1 - qvel / values["no_load_velocity"])
    return xp.minimum(xp.maximum(falling, 0 * falling), values["torque_limit"])
