"""Embedded position controller of a DC motor."""

from collections.abc import Mapping
from typing import Any, ClassVar

from frictionzoo.bench.actuators.base import Actuator, Affine, Sections, Value, register_actuator


@register_actuator("dc_motor_pd")
class DcMotorPD(Actuator):
    """Position controller of a DC motor whose torque limit falls with its speed.

        torque = clip(kp (ctrl - qpos) - kd qvel, -limit(-qvel), limit(qvel))
        limit(qvel) = clip(stall_torque (1 - qvel / no_load_velocity), 0, torque_limit)

    with kp [N m/rad], kd [N m s/rad], stall_torque and torque_limit [N m] and no_load_velocity [rad/s]. The command of
    MuJoCo's actuator is this torque.

    Source: Isaac Lab, documentation of the actuator model `DCMotor`, which calls stall_torque saturation effort.
    """

    dimensions: ClassVar[Mapping[str, str]] = {
        "kp": "stiffness",
        "kd": "damping",
        "stall_torque": "torque",
        "torque_limit": "torque",
        "no_load_velocity": "velocity",
    }

    def __init__(
        self,
        params: Sections = None,
        *,
        kp: Value = None,
        kd: Value = None,
        stall_torque: Value = None,
        torque_limit: Value = None,
        no_load_velocity: Value = None,
    ) -> None:
        super().__init__(
            params,
            kp=kp,
            kd=kd,
            stall_torque=stall_torque,
            torque_limit=torque_limit,
            no_load_velocity=no_load_velocity,
        )

    def affine(self, values: Mapping[str, Any]) -> Affine:
        """See `Actuator.affine`."""
        zero = 0 * values["kp"]
        return Affine(zero + 1, values.get("torque_offset", zero), zero, zero)

    def control(
        self, xp: Any, values: Mapping[str, Any], qpos: Any, qvel: Any, command: Any, inputs: Mapping[str, Any]
    ) -> Any:
        """See `Actuator.control`."""
        torque = values["kp"] * (command - qpos) - values["kd"] * qvel
        return xp.minimum(xp.maximum(torque, -_limit(xp, values, -qvel)), _limit(xp, values, qvel))


def _limit(xp: Any, values: Mapping[str, Any], qvel: Any) -> Any:
    """Return the largest torque in the direction of positive velocity [N m]."""
    falling = values["stall_torque"] * (1 - qvel / values["no_load_velocity"])
    return xp.minimum(xp.maximum(falling, 0 * falling), values["torque_limit"])
