"""Impedance controller of a robot's joint."""

import copy
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from frictionzoo.bench.actuators.base import Actuator, Affine, Sections, Value, register_actuator
from frictionzoo.bench.actuators.saturation import (
    ENDS,
    LIMITS,
    POSITIONS,
    POSITIVE,
    beyond_mujoco,
    force_range,
    saturate,
    within_range,
)
from frictionzoo.core.errors import ConfigError

GAIN: Mapping[str, Any] = {"init": 1.0, "low": 0.5, "high": 2.0, "scale": "log", "identify": False}
"""Default section of `torque_gain`: the joint gives the torque that the controller requests."""


@register_actuator("joint_pd")
class JointPD(Actuator):
    """Impedance controller of a robot's joint with commands of position, velocity and torque.

        torque = torque_gain sat(kp (ctrl - qpos) + kd (ctrl_velocity - qvel) + ctrl_torque)

    with kp [N m/rad or N/m], kd [N m s/rad or N s/m], the desired position ctrl [rad or m], the desired velocity
    ctrl_velocity [rad/s or m/s] and the feed-forward torque ctrl_torque [N m or N]. Recordings without ctrl_velocity or
    ctrl_torque use 0. torque_gain [1] is the ratio of the joint's torque to the requested torque.

    sat depends on the optional parameters. torque_saturation [N m or N] is kappa in kappa tanh(torque / kappa).
    torque_limit [N m or N] clips the torque to [-torque_limit, torque_limit]; torque_low [N m or N] replaces the lower
    limit. ctrl_low and ctrl_high [rad or m] clip ctrl. `bench=robot` reads these limits from the file.

    A joint whose kp is known to be 0 is a velocity servo: its ctrl is the desired velocity [rad/s or m/s],

        torque = torque_gain sat(kd (ctrl + ctrl_velocity - qvel) + ctrl_torque)

    A joint whose kp and kd are known to be 0 has no actuator, and ctrl has no effect on it.

    MuJoCo's actuator is a position actuator with these gains. Its `ctrl` is ctrl + (kd ctrl_velocity + ctrl_torque) /
    kp; a limit changes `ctrl` such that the actuator gives the limited torque. Where kp is 0, it is a velocity actuator
    with the gain kd, else a motor. The integrator implicitfast treats kd as implicit at the limit as well.

    Source: B. Katz, "A low cost modular actuator for dynamic robots", MIT, 2018, the controller of the motors of the
    MIT Mini Cheetah, also used by Unitree and others; hyperbolic tangent: arXiv 2505.14266, 2025.
    """

    dimensions: ClassVar[Mapping[str, str]] = {
        "kp": "stiffness",
        "kd": "damping",
        "torque_gain": "1",
        **LIMITS,
        **POSITIONS,
    }
    optional: ClassVar[tuple[str, ...]] = (*LIMITS, *POSITIONS)
    ends: ClassVar[tuple[str, ...]] = ENDS
    positive: ClassVar[Mapping[str, str]] = POSITIVE
    defaults: ClassVar[Mapping[str, Mapping[str, Any]]] = {"torque_gain": GAIN}
    inputs: ClassVar[tuple[str, ...]] = ("ctrl_velocity", "ctrl_torque")
    optional_inputs: ClassVar[Mapping[str, float]] = {"ctrl_velocity": 0.0, "ctrl_torque": 0.0}
    commands: ClassVar[tuple[str, ...]] = inputs

    def __init__(
        self,
        params: Sections = None,
        *,
        kp: Value = None,
        kd: Value = None,
        torque_gain: Value = None,
        torque_limit: Value = None,
        torque_saturation: Value = None,
        torque_low: Value = None,
        ctrl_low: Value = None,
        ctrl_high: Value = None,
    ) -> None:
        super().__init__(
            params,
            kp=kp,
            kd=kd,
            torque_gain=torque_gain,
            torque_limit=torque_limit,
            torque_saturation=torque_saturation,
            torque_low=torque_low,
            ctrl_low=ctrl_low,
            ctrl_high=ctrl_high,
        )
        stiffness, damping = (_list_values(self.params[name].init) for name in ("kp", "kd"))
        self.all_stiff: bool = bool((stiffness > 0).all())  # whether each joint has a kp above 0
        if not self.all_stiff and (self.params["kp"].is_identified or not (damping > 0).any()):
            raise ConfigError(
                f"JointPD: kp={self.params['kp'].init}; expected above 0, or a known 0 with kd above 0 for commands of "
                "velocity; take Force for commands of torque alone, RecordedPD for gains that recordings have"
            )

    def with_soft_joints(self) -> "JointPD":
        """Return the law for a robot whose file has no kp for some joints."""
        other = copy.copy(self)
        other.all_stiff = False
        return other

    @property
    def needs_state(self) -> bool:
        """See `Actuator.needs_state`."""
        return beyond_mujoco(self.params)

    def affine(self, values: Mapping[str, Any]) -> Affine:
        """See `Actuator.affine`."""
        stiffness, damping = (values["torque_gain"] * values[name] for name in ("kp", "kd"))
        gain = stiffness if self.all_stiff else values["torque_gain"] * self._unit(values)
        return Affine(gain, values.get("torque_offset", 0 * stiffness), -stiffness, -damping)

    def control(
        self, xp: Any, values: Mapping[str, Any], qpos: Any, qvel: Any, command: Any, inputs: Mapping[str, Any]
    ) -> Any:
        """See `Actuator.control`."""
        target, unit = self._aim(xp, values, command, inputs), self._unit(values)
        if self.all_stiff:
            requested = values["kp"] * (target - qpos) - values["kd"] * qvel
        else:
            requested = unit * target - values["kp"] * qpos - values["kd"] * qvel
        limited = saturate(xp, values, requested)
        return target if limited is requested else target + (limited - requested) / unit

    def combine(self, values: Mapping[str, Any], command: Any, inputs: Mapping[str, Any]) -> Any:
        """See `Actuator.combine`."""
        return self._aim(np, values, command, inputs)

    def _unit(self, values: Mapping[str, Any]) -> Any:
        """Return the torque per unit of the command of MuJoCo's actuator, before `torque_gain`."""
        kp, kd = values["kp"], values["kd"]
        return kp if self.all_stiff else kp + (kp <= 0) * (kd + (kd <= 0))

    def _aim(self, xp: Any, values: Mapping[str, Any], command: Any, inputs: Mapping[str, Any]) -> Any:
        """Return the command of MuJoCo's actuator that is equivalent to all commands together."""
        if self.all_stiff:
            return aim_at(xp, values, command, inputs)
        main = ((values["kp"] > 0) | (values["kd"] > 0)) * within_range(xp, values, command)
        return main + (values["kd"] * inputs["ctrl_velocity"] + inputs["ctrl_torque"]) / self._unit(values)

    def force_range(self, values: Mapping[str, Any]) -> Float[np.ndarray, "nv 2"] | None:
        """See `Actuator.force_range`."""
        return force_range(values, values["torque_gain"])


def aim_at(xp: Any, values: Mapping[str, Any], command: Any, inputs: Mapping[str, Any]) -> Any:
    """Return the desired position that is equivalent to all commands together."""
    command = within_range(xp, values, command)
    return command + (values["kd"] * inputs["ctrl_velocity"] + inputs["ctrl_torque"]) / values["kp"]


def _list_values(init: Any) -> Float[np.ndarray, "_"]:
    """Return the values of an initial value for all joints; 1 for one that the robot's file has to give."""
    values = [*init.values()] if isinstance(init, Mapping) else 1.0 if init is None else init
    return np.atleast_1d(np.array(values, np.float64))
