"""Impedance controller of a robot's joint."""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from frictionzoo.bench.actuators.base import Actuator, Affine, register_actuator
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

    MuJoCo's actuator is a position actuator with these gains. Its `ctrl` is ctrl + (kd ctrl_velocity + ctrl_torque) /
    kp; a limit changes `ctrl` such that the actuator gives the limited torque. The integrator implicitfast treats kd as
    implicit at the limit as well.

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
    positive: ClassVar[Mapping[str, str]] = {
        "kp": "take Force for commands of torque alone, RecordedPD for gains that recordings have",
        **POSITIVE,
    }
    defaults: ClassVar[Mapping[str, Mapping[str, Any]]] = {"torque_gain": GAIN}
    inputs: ClassVar[tuple[str, ...]] = ("ctrl_velocity", "ctrl_torque")
    optional_inputs: ClassVar[Mapping[str, float]] = {"ctrl_velocity": 0.0, "ctrl_torque": 0.0}
    commands: ClassVar[tuple[str, ...]] = inputs

    @property
    def needs_state(self) -> bool:
        """See `Actuator.needs_state`."""
        return beyond_mujoco(self.params)

    def affine(self, values: Mapping[str, Any]) -> Affine:
        """See `Actuator.affine`."""
        stiffness, damping = (values["torque_gain"] * values[name] for name in ("kp", "kd"))
        return Affine(stiffness, values.get("torque_offset", 0 * stiffness), -stiffness, -damping)

    def control(
        self, xp: Any, values: Mapping[str, Any], qpos: Any, qvel: Any, command: Any, inputs: Mapping[str, Any]
    ) -> Any:
        """See `Actuator.control`."""
        target = aim_at(xp, values, command, inputs)
        requested = values["kp"] * (target - qpos) - values["kd"] * qvel
        limited = saturate(xp, values, requested)
        return target if limited is requested else target + (limited - requested) / values["kp"]

    def combine(self, values: Mapping[str, Any], command: Any, inputs: Mapping[str, Any]) -> Any:
        """See `Actuator.combine`."""
        return aim_at(np, values, command, inputs)

    def force_range(self, values: Mapping[str, Any]) -> Float[np.ndarray, "nv 2"] | None:
        """See `Actuator.force_range`."""
        return force_range(values, values["torque_gain"])


def aim_at(xp: Any, values: Mapping[str, Any], command: Any, inputs: Mapping[str, Any]) -> Any:
    """Return the desired position that is equivalent to all commands together."""
    command = within_range(xp, values, command)
    return command + (values["kd"] * inputs["ctrl_velocity"] + inputs["ctrl_torque"]) / values["kp"]
