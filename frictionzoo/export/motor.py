"""Position-controlled drives as in robot simulators: gains, torque limits, friction, and a delay in whole steps."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from frictionzoo.bench import Actuator
from frictionzoo.bench.actuators.dc_motor_pd import DcMotorPD
from frictionzoo.bench.actuators.joint_pd import JointPD, aim_at
from frictionzoo.bench.actuators.position_pd import PositionPD
from frictionzoo.bench.actuators.recorded_pd import RecordedPD
from frictionzoo.bench.actuators.voltage_servo import VoltageServo
from frictionzoo.core.errors import ExportError
from frictionzoo.core.state import Signals
from frictionzoo.export.base import list_values, read_optional
from frictionzoo.export.nearest import Nearest
from frictionzoo.export.simulate import simulate
from frictionzoo.result.fitted_drive import FittedDrive

INPUTS: Mapping[str, str] = {
    "gain": "of a servo's firmware; default: the recordings' median",
    "supply": "of a servo [V]; default: the recordings' median",
}
MOTOR: Mapping[str, str] = {
    "stiffness": "stiffness",
    "damping": "damping",
    "saturation_effort": "torque",
    "velocity_limit": "velocity",
    "effort_limit": "torque",
}
"""Dimension of each attribute of a `Motor`."""
LIMITS = tuple(MOTOR)[2:]
"""Attributes that limit its torque."""
_SAID: Mapping[str, str] = {
    "torque_low": "The torque limits are not symmetrical; the file has the upper one.",
    "torque_saturation": "It has no smooth saturation: the saturation torque is a hard limit in the file.",
    "delay": "Delays are whole steps of {timestep} s: {delays}.",
    "position_offset": "The position offset, {} {position}, is not in the file: add it to measured positions and to "
    "commands.",
    "torque_offset": "The constant torque, {} {torque}, is not in the file: add it, divided by the stiffness, to "
    "position targets, as in the comparison.",
}
"""What a file lacks of a bench with this parameter."""
_NEVER = 3.0  # times the stall torque: only reached by a joint driven backwards at twice the no-load speed


@dataclass(frozen=True)
class Motor:
    """Position controller and motor of one joint.

        torque = clip(stiffness (ctrl - qpos) - damping qvel, low, high), within +- effort_limit
        high = saturation_effort (1 - qvel / velocity_limit),  low = -saturation_effort (1 + qvel / velocity_limit)

    Attributes:
        stiffness: Gain on the position error [N m/rad or N/m].
        damping: Gain on the velocity [N m s/rad or N s/m].
        saturation_effort: Stall torque [N m or N]; infinite: no such limit.
        velocity_limit: No-load velocity [rad/s or m/s].
        effort_limit: Largest torque [N m or N]; infinite: no limit.
    """

    stiffness: float
    damping: float
    saturation_effort: float = np.inf
    velocity_limit: float = np.inf
    effort_limit: float = np.inf

    def torque(self, ctrl: float, qpos: float, qvel: float) -> float:
        """Return the torque or force [N m or N]."""
        wanted = self.stiffness * (ctrl - qpos) - self.damping * qvel
        if np.isfinite(self.saturation_effort):
            falling = self.saturation_effort / self.velocity_limit * qvel
            wanted = np.clip(wanted, -self.saturation_effort - falling, self.saturation_effort - falling)
        return float(np.clip(wanted, -self.effort_limit, self.effort_limit))


class Joint(NamedTuple):
    """One joint of a configuration file.

    Attributes:
        armature: [kg m^2 or kg].
        frictionloss: [N m or N].
        damping: Viscous friction [N m s/rad or N s/m].
        lag: Command delay in simulation steps.
    """

    motor: Motor
    armature: float
    frictionloss: float
    damping: float
    lag: int


def read_inputs(fitted: FittedDrive, options: Mapping[str, str]) -> dict[str, float]:
    """Return inputs of the actuator model, such as gain and supply: given values, or medians over the test rollouts."""
    names = fitted.bench.actuator.inputs
    medians = {name: float(np.median(signal)) for name, signal in fitted.segments.acting.inputs.items()}
    requested = {name: read_optional(options, name) for name in INPUTS}
    return medians | {name: value for name, value in requested.items() if value is not None and name in names}


def motors(fitted: FittedDrive, inputs: Mapping[str, float]) -> list[Motor]:
    """Return the motor of each joint, with these inputs of a servo.

    Raises:
        ExportError: The actuator is not position-controlled, or recorded gains change.
    """
    law, values = fitted.bench.actuator, fitted.values["bench"]
    if isinstance(law, RecordedPD):
        values = {**values, **_constant_gains(fitted)}
    return [_motor(law, {name: float(v[j]) for name, v in values.items()}, inputs) for j in range(fitted.bench.nv)]


def _constant_gains(fitted: FittedDrive) -> dict[str, Float[np.ndarray, "nv"]]:
    """Return the recorded gains of each joint; raise ExportError if they change, or if kp is not positive."""
    gains = {name: fitted.segments.acting.inputs[name] for name in ("kp", "kd")}
    for name, recorded in gains.items():
        low, high = recorded.min(axis=(0, 1)), recorded.max(axis=(0, 1))
        if (high > low).any() or (name == "kp" and (low <= 0).any()):
            joint = int(np.argmax((high > low) | (low <= 0)))
            raise ExportError(
                f"{name} of {fitted.bench.joints[joint]} is {low[joint]:g} to {high[joint]:g} in the recordings, "
                "expected one gain above 0, as a configuration has it; write target=mujoco or mjx"
            )
    return {name: recorded[0, 0] for name, recorded in gains.items()}


def _motor(law: Actuator, values: Mapping[str, float], inputs: Mapping[str, float]) -> Motor:
    if isinstance(law, PositionPD):
        return Motor(values["kp"], values["kd"])
    if isinstance(law, JointPD | RecordedPD):
        gain = values["torque_gain"]
        limit = min(values.get(name, np.inf) for name in ("torque_limit", "torque_saturation"))
        return Motor(gain * values["kp"], gain * values["kd"], effort_limit=gain * limit)
    if isinstance(law, DcMotorPD):
        limits = (values["stall_torque"], values["no_load_velocity"], values["torque_limit"])
        return Motor(values["kp"], values["kd"], *limits)
    if isinstance(law, VoltageServo):
        # A limited voltage and back-EMF give a DC motor's torque-speed line; its slope equals the damping.
        per_duty = values["kt_over_r"] * inputs["supply"]
        stall = per_duty * values["duty_limit"]
        damping = values["kt2_over_r"]
        return Motor(per_duty * inputs["gain"] * values["duty_gain"], damping, stall, stall / damping, _NEVER * stall)
    name = type(law).__name__
    raise ExportError(f"the bench's actuator is a {name}, expected a position-controlled one; write target=mjcf")


def lag(fitted: FittedDrive, joint: int) -> int:
    """Return the command delay in whole simulation steps."""
    if "delay" not in fitted.values["bench"]:
        return 0
    longest = fitted.sampling.history * fitted.sampling.substeps
    return min(round(float(fitted.values["bench"]["delay"][joint]) / fitted.timestep), longest)


def run_joints(
    fitted: FittedDrive, nearest: Nearest, joints: Sequence[Joint], write: Callable[[FittedDrive], str] | None = None
) -> Float[np.ndarray, "batch time nv"]:
    """Simulate the long test rollouts in MuJoCo C with a configuration file's joints and `nearest`'s offset.

    `write` gives the bench's MJCF for a drive without delay, if its friction is not MuJoCo's; actuators that it adds
    stay as they are.
    """
    has_delay = "delay" in fitted.values["bench"]
    delays = {"delay": np.array([joint.lag * fitted.timestep for joint in joints])} if has_delay else {}
    written = replace(fitted, values={**fitted.values, "bench": {**nearest.bench, **delays}})
    _, armature, loss, damping, _ = map(np.array, zip(*joints, strict=True))
    bench = {name: value for name, value in nearest.bench.items() if name != "delay"} | {"armature": armature}
    if write is None:
        text = fitted.bench.mjcf(bench, loss if loss.any() else None, damping - fitted.bench.own_damping)
    else:
        text = write(replace(fitted, values={**fitted.values, "bench": bench}))
    model, own = mujoco.MjModel.from_xml_string(text), slice(fitted.bench.nv)
    model.actuator_gainprm[own, 0], model.actuator_biasprm[own] = 1, 0  # `ctrl` is the torque
    if write is not None:
        model.actuator_ctrllimited[own] = model.actuator_forcelimited[own] = 0  # the motor's limits are in it
    aims_of = aim(fitted, [joint.motor for joint in joints])

    def step(data: mujoco.MjData, signals: Signals) -> None:
        for index, (joint, aimed) in enumerate(zip(joints, aims_of(signals), strict=True)):
            data.ctrl[index] = joint.motor.torque(float(aimed), float(data.qpos[index]), float(data.qvel[index]))
        mujoco.mj_step(model, data)

    return simulate(model, written, step)


def aim(
    fitted: FittedDrive, drives: Sequence[Motor], shifted: bool = True
) -> Callable[[Signals], Float[np.ndarray, "... nv"]]:
    """Return a function from a drive's signals to desired positions [rad or m] that include all other commands.

    `shifted` if they also include the bench's `torque_offset`.
    """
    law = fitted.bench.actuator
    combined = isinstance(law, JointPD | RecordedPD)
    gains = {**fitted.values["bench"], **(_constant_gains(fitted) if isinstance(law, RecordedPD) else {})}
    offset = fitted.values["bench"].get("torque_offset", 0.0) if shifted else 0.0
    shift = offset / np.array([drive.stiffness for drive in drives])
    return lambda signals: (aim_at(np, gains, signals.ctrl, signals.inputs) if combined else signals.ctrl) + shift


def list_lacks(fitted: FittedDrive, nearest: Nearest, held: Collection[str] = ()) -> list[str]:
    """List in a few words each why a configuration moves differently from the drive; `held` as in `say_common`."""
    acting, values = fitted.segments.acting.inputs, fitted.values["bench"]
    varied = [name for name in INPUTS if name in acting and np.ptp(acting[name]) > 0]
    reasons, delays = [nearest.lacks] if nearest.lacks else [], () if "delay" in held else values.get("delay", ())
    if any(lag(fitted, joint) * fitted.timestep != delay for joint, delay in enumerate(delays)):
        reasons.append("delays are whole steps")
    reasons += [f"one {' and one '.join(varied)} of several"] if varied else []
    if "enable" in acting and (acting["enable"] != 1).any():
        reasons.append("the servo is always enabled")
    return reasons + (["a hard limit in place of the saturation"] if "torque_saturation" in values else [])


def say_inputs(inputs: Mapping[str, float]) -> str:
    """List gain and supply of a servo with their values; empty for another drive."""
    return ", ".join(f"{name} {inputs[name]:g}" for name in INPUTS if name in inputs)


def say_not_run(program: str) -> str:
    """Say that the file's own program did not run."""
    return (
        f"{program} itself was not run: the difference is computed in MuJoCo C, from the file's values and the formula "
        "of their class."
    )


def say_common(
    fitted: FittedDrive, nearest: Nearest, inputs: Mapping[str, float], held: Collection[str] = ()
) -> list[str]:
    """List the limits common to the files of all simulators, without those of parameters that a file holds."""
    law, values = fitted.bench.actuator, fitted.values["bench"]
    limits = [nearest.remark] if nearest.remark else []
    commands = ("ctrl_velocity", "ctrl_torque") if isinstance(law, JointPD | RecordedPD) else ()
    if feedforward := [name for name in commands if np.any(fitted.segments.acting.inputs[name])]:
        limits.append(
            f"The recordings have {' and '.join(feedforward)}: give ctrl + (kd ctrl_velocity + ctrl_torque) / kp as "
            "position target, as in the comparison, with the commanded kp and kd."
        )
    if commands and (values["torque_gain"] != 1).any():
        listed = list_values(values["torque_gain"])
        limits.append(f"Gains and limits in the file are the controller's times torque_gain, {listed}.")
    if listed := say_inputs(inputs):
        limits.append(f"The servo's inputs are fixed: {listed}, always enabled; the stiffness belongs to this gain.")
        if not held:
            limits[-1] += (
                " Braking adds back-EMF to the stall torque: effort_limit is therefore above saturation_effort."
            )
    delays = dict.fromkeys(f"{lag(fitted, j)} for {exact:.4g} s" for j, exact in enumerate(values.get("delay", ())))
    words = {**fitted.units, "timestep": f"{fitted.timestep:g}", "delays": ", ".join(delays)}
    said = {name: sentence for name, sentence in _SAID.items() if name in values and name not in held}
    return limits + [sentence.format(list_values(values[name]), **words) for name, sentence in said.items()]
