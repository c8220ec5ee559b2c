"""Impedance controller of a robot's joint with recorded gains."""

from collections.abc import Mapping
from typing import Any, ClassVar

from frictionzoo.bench.actuators.base import Actuator, Affine, Sections, Value, register_actuator
from frictionzoo.bench.actuators.joint_pd import GAIN
from frictionzoo.bench.actuators.saturation import ENDS, LIMITS, POSITIONS, POSITIVE, saturate, within_range


@register_actuator("recorded_pd")
class RecordedPD(Actuator):
    """Impedance controller of a robot's joint whose gains are recorded commands.

        torque = torque_gain sat(kp (ctrl - qpos) + kd (ctrl_velocity - qvel) + ctrl_torque)

    with recorded kp [N m/rad or N/m] and kd [N m s/rad or N s/m]; other symbols as in `JointPD`. The command of
    MuJoCo's actuator is sat(...), and its gain is torque_gain.

    Source: See `JointPD`.
    """

    dimensions: ClassVar[Mapping[str, str]] = {"torque_gain": "1", **LIMITS, **POSITIONS}
    optional: ClassVar[tuple[str, ...]] = (*LIMITS, *POSITIONS)
    ends: ClassVar[tuple[str, ...]] = ENDS
    positive: ClassVar[Mapping[str, str]] = POSITIVE
    defaults: ClassVar[Mapping[str, Mapping[str, Any]]] = {"torque_gain": GAIN}
    inputs: ClassVar[tuple[str, ...]] = ("kp", "kd", "ctrl_velocity", "ctrl_torque")
    optional_inputs: ClassVar[Mapping[str, float]] = {"ctrl_velocity": 0.0, "ctrl_torque": 0.0}
    commands: ClassVar[tuple[str, ...]] = inputs

    def __init__(
        self,
        params: Sections = None,
        *,
        torque_gain: Value = None,
        torque_limit: Value = None,
        torque_saturation: Value = None,
        torque_low: Value = None,
        ctrl_low: Value = None,
        ctrl_high: Value = None,
    ) -> None:
        super().__init__(
            params,
            torque_gain=torque_gain,
            torque_limit=torque_limit,
            torque_saturation=torque_saturation,
            torque_low=torque_low,
            ctrl_low=ctrl_low,
            ctrl_high=ctrl_high,
        )

    def affine(self, values: Mapping[str, Any]) -> Affine:
        """See `Actuator.affine`."""
        zero = 0 * values["torque_gain"]
        return Affine(values["torque_gain"], values.get("torque_offset", zero), zero, zero)

    def control(
        self, xp: Any, values: Mapping[str, Any], qpos: Any, qvel: Any, command: Any, inputs: Mapping[str, Any]
    ) -> Any:
        """See `Actuator.control`."""
        damping = inputs["kd"] * (inputs["ctrl_velocity"] - qvel)
        return saturate(
            xp, values, inputs["kp"] * (within_range(xp, values, command) - qpos) + damping + inputs["ctrl_torque"]
        )
