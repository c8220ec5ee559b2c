"""Actuator of a joint, combination of several into one controller, and comparison of torques with MuJoCo C."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import mujoco
import numpy as np

from frictionzoo.bench.robot_file.dc_motors import is_dc_motor
from frictionzoo.bench.robot_file.source import Source

_STATES = 20
_SAME = 1e-9  # largest difference of a torque, relative to its largest term


class Command(NamedTuple):
    """Recorded `signal` (`ctrl`, `ctrl_velocity` or `ctrl_torque`) = `factor`, with gear, * `MjData.ctrl[index]`."""

    index: int
    signal: str
    factor: float


@dataclass(frozen=True)
class ReadActuator:
    """Actuator of the file in joint space: torque = gain ctrl + bias0 + bias1 qpos + bias2 qvel.

    Attributes:
        name: Name in the file, or its number; all names if several actuators form one controller.
        kind: `motor`, `position` (with or without velocity and torque commands), `velocity` or `general`.
        gain: Factor of the first command, including the gear.
        ctrlrange: Range of the first command, in the command's unit; NaN without a range.
        forcerange: Torque range at the joint [N m or N]; NaN without a range.
        delay: Delay of the commands in MuJoCo's steps [s].
        commands: Recorded signal of each command; the first is `ctrl`.
    """

    name: str
    kind: str
    gain: float
    bias0: float
    bias1: float
    bias2: float
    gear: float
    ctrlrange: tuple[float, float]
    forcerange: tuple[float, float]
    delay: float
    commands: tuple[Command, ...]

    @property
    def torques(self) -> tuple[float, float]:
        """Torque range [N m or N]; a motor's command range limits it too."""
        low, high = self.forcerange
        if self.kind != "motor":
            return low, high
        ends = np.sort(self.gain * np.array(self.ctrlrange))
        return clip_range((float(ends[0]), float(ends[1])), self.forcerange)

    @property
    def targets(self) -> tuple[float, float]:
        """Range of desired positions [rad or m] or velocities [rad/s or m/s]; NaN without a range or such a command."""
        if self.kind not in ("position", "velocity"):
            return np.nan, np.nan
        low, high = np.sort(np.array(self.ctrlrange) / self.gear)
        return float(low), float(high)


def clip_range(inner: tuple[float, float], outer: tuple[float, float]) -> tuple[float, float]:
    """Return the range of a value clipped to `inner` and then to `outer`; NaN means no limit."""
    if np.isnan(inner).any() or np.isnan(outer).any():
        return outer if np.isnan(inner).any() else inner
    low, high = np.clip(inner, *outer)
    return float(low), float(high)


def range_of(ends: np.ndarray, limited: bool | np.bool_) -> tuple[float, float]:
    """Return a range from its ends in the compiled model; NaN if it is not limited."""
    return (float(ends[0]), float(ends[1])) if limited else (np.nan, np.nan)


def ctrlrange(model: mujoco.MjModel, ctrl: int) -> tuple[float, float]:
    """Return the range of a command in the compiled model; NaN without a range."""
    clamps = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
    return range_of(model.actuator_ctrlrange[ctrl], clamps and bool(model.actuator_ctrllimited[ctrl]))


def combine(source: Source, joint: str, read: Sequence[ReadActuator]) -> ReadActuator | None:
    """Return the controller that a joint's actuators form, or else the first actuator; None without actuators."""
    if len(read) < 2:
        return read[0] if read else None
    names = [actuator.name for actuator in read]
    parts = {actuator.kind: actuator for actuator in read}
    is_simple = len(parts) == len(read) and all(len(actuator.commands) == 1 for actuator in read)
    if not is_simple or parts.keys() - {"position", "velocity", "motor"}:
        source.note(f"joint {joint} has {len(read)} actuators: {names[0]} is read, and {{}} left out", names[1:])
        return read[0]
    source.note(f"joint {joint}: actuators {{}} are one controller of position, velocity and torque", names)
    main = parts.get("position") or parts["velocity"]
    if len({actuator.delay for actuator in read}) > 1:
        source.note(f"delays of actuators {{}} differ: all of their commands are {main.delay:g} s late", names)
    limited = [
        part.name
        for part in read
        if not np.isnan(part.forcerange).all() or (part is not main and not np.isnan(part.ctrlrange).all())
    ]
    source.note(f"ranges of actuators {{}} are left out: they end a part of the torque of joint {joint}", limited)
    return _together(main, parts, " + ".join(names))


def _together(main: ReadActuator, parts: Mapping[str, ReadActuator], name: str) -> ReadActuator:
    velocity, motor = parts.get("velocity"), parts.get("motor")
    velocity = None if velocity is main else velocity
    damping = main.bias2 + (velocity.bias2 if velocity else 0.0)
    commands = list(main.commands)
    if velocity is not None:  # share of the velocity actuator in the total damping
        factor = velocity.gain / -damping if damping else 0.0
        commands.append(Command(velocity.commands[0].index, "ctrl_velocity", factor))
    if motor is not None:
        commands.append(Command(motor.commands[0].index, "ctrl_torque", motor.gain))
    return replace(main, name=name, bias2=damping, forcerange=(np.nan, np.nan), commands=tuple(commands))


def without_others(
    source: Source, joints: Sequence[int], read: Sequence[ReadActuator | None]
) -> tuple[ReadActuator | None, ...]:
    """Return the actuators whose torque equals MuJoCo C's in random states and beyond their ranges; note the others."""
    model = copy.copy(source.model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    model.actuator_delay[:] = 0
    for actuator in filter(None, read):  # remove the ranges that were not read
        model.actuator_ctrllimited[[command.index for command in actuator.commands[1:]]] = False
        if len(_owners(model, actuator)) > 1:
            model.actuator_forcelimited[_owners(model, actuator)] = False
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    worst = np.zeros(len(joints))
    for _ in range(_STATES):
        _draw(model, data, rng)
        for index, (joint, actuator) in enumerate(zip(joints, read, strict=True)):
            if actuator is not None:
                worst[index] = max(worst[index], _compare(model, data, joint, actuator))
    differing = [actuator.name for actuator, error in zip(read, worst, strict=True) if actuator and error > _SAME]
    source.note("actuators {} are left out: their torque in MuJoCo differs from their coefficients", differing)
    return tuple(None if error > _SAME else actuator for actuator, error in zip(read, worst, strict=True))


def _owners(model: mujoco.MjModel, actuator: ReadActuator) -> list[int]:
    """Return the indices of the file's actuators that this one represents."""
    commands = np.array([command.index for command in actuator.commands])
    first, last = model.actuator_ctrladr, model.actuator_ctrladr + model.actuator_ctrlnum
    return np.flatnonzero(((commands[:, None] >= first) & (commands[:, None] < last)).any(axis=0)).tolist()


def _draw(model: mujoco.MjModel, data: mujoco.MjData, rng: np.random.Generator) -> None:
    """Draw a random state and commands beyond their ranges, with filters in steady state."""
    data.qvel[:], data.qpos[:] = rng.normal(0, 3, model.nv), model.qpos0
    scalar = np.isin(model.jnt_type, [int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)])
    data.qpos[model.jnt_qposadr[scalar]] = rng.uniform(-2, 2, scalar.sum())
    low, high = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [[-3.0, 3.0]]).T
    data.ctrl[:] = (low + high) / 2 + (high - low) * rng.uniform(-1, 1, model.nu)
    for index in np.flatnonzero((model.actuator_actnum == 1) & (model.actuator_ctrlnum > 0)):
        ctrl = int(model.actuator_ctrladr[index])
        data.act[model.actuator_actadr[index]] = _within(data.ctrl[ctrl], ctrlrange(model, ctrl))
    for stage in (mujoco.mj_fwdPosition, mujoco.mj_fwdVelocity, mujoco.mj_fwdActuation):
        stage(model, data)


def _compare(model: mujoco.MjModel, data: mujoco.MjData, joint: int, actuator: ReadActuator) -> float:
    """Return the difference from MuJoCo C's torque, relative to the largest term, but at least to 1 N m or N."""
    owners = _owners(model, actuator)
    if any(is_dc_motor(model, index) for index in owners):
        return 0.0  # its friction and back-EMF count as the joint's
    dof = int(model.jnt_dofadr[joint])
    parts = [actuator.bias0, actuator.bias1 * data.qpos[model.jnt_qposadr[joint]], actuator.bias2 * data.qvel[dof]]
    for number, command in enumerate(actuator.commands):
        gain = {"ctrl": actuator.gain, "ctrl_velocity": -actuator.bias2 * command.factor}.get(
            command.signal, command.factor
        )
        ctrl = data.ctrl[command.index]
        parts.append(gain * (_within(ctrl, actuator.ctrlrange) if number == 0 else ctrl))
    expected = float(np.dot(model.actuator_gear[owners, 0], data.actuator_force[model.actuator_outadr[owners]]))
    torque = _within(sum(parts), actuator.forcerange)
    return abs(torque - expected) / max(1.0, float(np.abs(parts).max()))


def _within(value: float, ends: tuple[float, float]) -> float:
    return float(np.fmin(np.fmax(value, ends[0]), ends[1]))
