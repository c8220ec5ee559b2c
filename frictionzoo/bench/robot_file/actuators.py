"""Actuator, armature, damping and bristle friction of each joint in a robot's file."""

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from frictionzoo.bench.delay import read_filter
from frictionzoo.bench.robot_file.controllers import Command, ReadActuator, combine, ctrlrange, range_of, without_others
from frictionzoo.bench.robot_file.dc_motors import (
    is_dc_motor,
    read_back_emf,
    read_bristles,
    torque_per_volt,
    why_not_linear,
)
from frictionzoo.bench.robot_file.source import Source

AT_JOINT = {int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)}
_FILTERS = {int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT)}
_ROUNDING = 1e-9  # of a step
_ACTING = {  # transmissions other than a joint, for notes
    int(mujoco.mjtTrn.mjTRN_SLIDERCRANK): "a slider-crank",
    int(mujoco.mjtTrn.mjTRN_TENDON): "a tendon",
    int(mujoco.mjtTrn.mjTRN_SITE): "a site",
    int(mujoco.mjtTrn.mjTRN_BODY): "a body",
}


def read_actuators(source: Source, joints: Sequence[int]) -> tuple[ReadActuator | None, ...]:
    """Return the actuator of each joint, None without a supported one; unsupported actuators are noted."""
    model = source.model
    kinds = model.actuator_trntype.tolist()
    for kind, description in _ACTING.items():
        names = [source.name("actuator", index) for index in range(model.nactuator) if kinds[index] == kind]
        source.note(f"left out: {{n}} actuators that act by {description}, {{}}", names)
    at_joints = [index for index in range(model.nactuator) if kinds[index] in AT_JOINT]
    elsewhere = [source.name("actuator", i) for i in at_joints if int(model.actuator_trnid[i, 0]) not in joints]
    source.note("left out: {n} actuators of joints that are not chosen, {}", elsewhere)
    read = without_others(source, joints, [_read_joint(source, joint) for joint in joints])
    joints_of: dict[str, list[str]] = {}  # recorded signals that differ from the file's command by a factor
    for joint, actuator in zip(joints, read, strict=True):
        for ctrl, signal, factor in actuator.commands if actuator else ():
            if factor != 1:
                text = f"{signal} is {factor:.6g} times the file's ctrl[{ctrl}]"
                joints_of.setdefault(text, []).append(source.name("joint", joint))
    for text, names in joints_of.items():
        source.note(f"command of joint {{}}: {text}", names)
    return read


def list_movers(source: Source, joints: Sequence[int]) -> tuple[tuple[str, ...], ...]:
    """Return the names of the actuators with a command that move each joint, also by a tendon or a site."""
    model, data = source.model, mujoco.MjData(source.model)
    data.qpos[:] = model.qpos0
    scalar = np.isin(model.jnt_type, [int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)])
    data.qpos[model.jnt_qposadr[scalar]] += np.linspace(0.1, 0.2, scalar.sum())  # some transmissions rest at 0
    mujoco.mj_fwdPosition(model, data)
    commanded = [index for index in range(model.nactuator) if model.actuator_ctrlnum[index]]
    movers = []
    for joint in joints:
        data.qvel[:] = 0
        data.qvel[source.dof(joint)] = 1
        mujoco.mj_fwdVelocity(model, data)
        acting = [index for index in commanded if data.actuator_velocity[model.actuator_outadr[index]]]
        movers.append(tuple(source.name("actuator", index) for index in acting))
    return tuple(movers)


def read_friction(source: Source, joints: Sequence[int]) -> dict[str, Float[np.ndarray, "nv"]]:
    """Return the bristle friction of each joint, by the parameter names of `lugre`; NaN if the file has none."""
    model, motors = source.model, dict[int, list[int]]()
    for joint in joints:
        indices = [index for index in list_at(model, joint) if is_dc_motor(model, index)]
        motors[joint] = [index for index in indices if model.actuator_gear[index, 0] and not _is_disabled(model, index)]
    return read_bristles(source, motors)


def list_at(model: mujoco.MjModel, joint: int) -> list[int]:
    """Return the indices of a joint's actuators."""
    at_joint = np.isin(model.actuator_trntype, list(AT_JOINT)) & (model.actuator_trnid[:, 0] == joint)
    return [int(index) for index in np.flatnonzero(at_joint)]


def _is_disabled(model: mujoco.MjModel, index: int) -> bool:
    group = int(model.actuator_group[index])
    return 0 <= group < 31 and bool((model.opt.disableactuator >> group) & 1)


def read_armature(source: Source, joints: Sequence[int]) -> Float[np.ndarray, "nv"]:
    """Return the armature of each joint, including its actuators' armature [kg m^2 or kg]."""
    model = source.model
    return np.array([model.dof_armature[source.dof(j)] + _reflected(model, j, model.actuator_armature) for j in joints])


def read_damping(source: Source, joints: Sequence[int]) -> Float[np.ndarray, "nv"]:
    """Return the damping of each joint, including its actuators' [N m s/rad or N s/m]; nonlinear damping is noted."""
    model = source.model
    nonlinear = [j for j in joints if model.dof_dampingpoly[source.dof(j)].any()]
    nonlinear += [j for j in joints if model.actuator_dampingpoly[list_at(model, j)].any()]
    names = [source.name("joint", joint) for joint in nonlinear]
    source.note("nonlinear damping of joint {}: only the coefficient of qvel is kept", names)
    damping = [model.dof_damping[source.dof(j)] + _reflected(model, j, model.actuator_damping) for j in joints]
    motors = [[index for index in list_at(model, joint) if is_dc_motor(model, index)] for joint in joints]
    back_emf = [
        sum(read_back_emf(model, index) for index in indices if _why_not(model, index) is None) for indices in motors
    ]
    return np.array(damping) + back_emf


def _reflected(model: mujoco.MjModel, joint: int, ofactuators: np.ndarray) -> float:
    return float(sum(model.actuator_gear[index, 0] ** 2 * ofactuators[index] for index in list_at(model, joint)))


def _read_joint(source: Source, joint: int) -> ReadActuator | None:
    model, readable = source.model, list[ReadActuator]()
    for index in list_at(model, joint):
        reason, name = _why_not(model, index), source.name("actuator", index)
        if reason:
            source.note(f"actuator {name} of joint {source.name('joint', joint)} is left out: {reason}")
            continue
        if model.actuator_ctrlnum[index] == 0:
            continue  # a DC motor without a command; its bristles and back-EMF count as the joint's friction
        if is_dc_motor(model, index):
            how = "its command is a voltage, and its back-EMF is taken as damping of the joint"
            source.note(f"actuator {name} is a DC motor: {how}")
        if int(model.actuator_dyntype[index]) in _FILTERS:
            constant, lag = model.actuator_dynprm[index, 0], _lag(model, index)
            instead = "left out, commands act at once; a bench delay can replace it"
            instead = f"taken as a delay of {lag:g} s" if lag else instead
            source.note(f"actuator {name}: its filter of {constant:g} s is {instead}")
        readable.append(_read(source, index))
    return combine(source, source.name("joint", joint), readable)


def _why_not(model: mujoco.MjModel, index: int) -> str | None:
    """Return the reason why an actuator is not affine in command, position and velocity, or None if it is."""
    dynamics = int(model.actuator_dyntype[index])
    if model.actuator_plugin[index] >= 0:
        return "it is a plugin"
    if _is_disabled(model, index):
        return "actuatorgroupdisable"
    if is_dc_motor(model, index):
        return why_not_linear(model, index)
    if dynamics != mujoco.mjtDyn.mjDYN_NONE and dynamics not in _FILTERS:
        return f"its activation ({_said(mujoco.mjtDyn(dynamics))}) is not an instantaneous response to commands"
    gain, bias = mujoco.mjtGain(model.actuator_gaintype[index]), mujoco.mjtBias(model.actuator_biastype[index])
    if gain == mujoco.mjtGain.mjGAIN_PID:
        has_position = int(model.actuator_ctrlspec[index]) & mujoco.mjtCtrlInput.mjINPUT_POS
        return None if has_position else "its commands have no position; it is held at 0"
    affine = gain == mujoco.mjtGain.mjGAIN_AFFINE and not model.actuator_gainprm[index, 1:3].any()
    if gain != mujoco.mjtGain.mjGAIN_FIXED and not affine:
        return f"its gain ({_said(gain)}) is not constant"
    if bias not in (mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE):
        return f"its bias ({_said(bias)}) is not affine"
    return None


def _read(source: Source, index: int) -> ReadActuator:
    model = source.model
    gear = float(model.actuator_gear[index, 0])
    affine = model.actuator_biastype[index] == mujoco.mjtBias.mjBIAS_AFFINE
    bias0, bias1, bias2 = map(float, model.actuator_biasprm[index, :3] if affine else np.zeros(3))
    is_pid = model.actuator_gaintype[index] == mujoco.mjtGain.mjGAIN_PID
    gain = -bias1 if is_pid else float(model.actuator_gainprm[index, 0])
    gain = torque_per_volt(model, index) if is_dc_motor(model, index) else gain
    kind = _kind(gain, bias0, bias1, bias2)
    low, high = range_of(model.actuator_forcerange[index], model.actuator_forcelimited[index])
    forcerange = (low * gear, high * gear) if gear >= 0 else (high * gear, low * gear)
    commands, name = tuple(_commands(model, index, kind)), source.name("actuator", index)
    ranged = [command.signal for command in commands[1:] if not np.isnan(ctrlrange(model, command.index)).all()]
    source.note(f"ranges of {{}} of actuator {name} are left out", ranged)
    return ReadActuator(
        name,
        kind,
        gear * gain,
        gear * bias0,
        gear**2 * bias1,
        gear**2 * bias2,
        gear,
        ctrlrange(model, commands[0].index),
        forcerange,
        _delay(source, index),
        commands,
    )


def _kind(gain: float, bias0: float, bias1: float, bias2: float) -> str:
    if bias0 != 0 or gain == 0:
        return "general"
    if bias1 == -gain:
        return "position"
    return {(0.0, 0.0): "motor", (0.0, -gain): "velocity"}.get((bias1, bias2), "general")


def _commands(model: mujoco.MjModel, index: int, kind: str) -> Iterator[Command]:
    first, gear = int(model.actuator_ctrladr[index]), float(model.actuator_gear[index, 0])
    yield Command(first, "ctrl", 1 / gear if kind in ("position", "velocity") and gear else 1.0)
    if model.actuator_gaintype[index] != mujoco.mjtGain.mjGAIN_PID:
        return
    inputs = {mujoco.mjtCtrlInput.mjINPUT_VEL: ("ctrl_velocity", 1 / gear if gear else 1.0)}
    inputs |= {mujoco.mjtCtrlInput.mjINPUT_FF: ("ctrl_torque", gear)}
    signals = [pair for bit, pair in inputs.items() if int(model.actuator_ctrlspec[index]) & bit]
    for ctrl, (signal, factor) in enumerate(signals, first + 1):
        yield Command(ctrl, signal, factor)


def _delay(source: Source, index: int) -> float:
    """Return the effective delay of commands in MuJoCo's steps [s]; note differences from the file."""
    model = source.model
    delay, step = float(model.actuator_delay[index]), float(model.opt.timestep)
    if delay == 0:
        return _lag(model, index)
    samples, interpolation = map(int, model.actuator_history[index])
    steps = max(delay / step, 1.0) if interpolation else float(np.ceil(delay / step - _ROUNDING))
    effective = min(steps, samples) * step
    name = source.name("actuator", index)
    if abs(effective - delay) > _ROUNDING * step:
        steps_of = f"MuJoCo's steps of {step:g} s with nsample={samples}"
        source.note(f"delay of actuator {name}, {delay:g} s: {effective:g} s, as it acts in {steps_of}")
    if interpolation > 1 and steps % 1 > _ROUNDING:
        source.note(f"delay of actuator {name}: interpolated linearly, not by a cubic")
    return effective


def _lag(model: mujoco.MjModel, index: int) -> float:
    """Return the lag [s] of a filter that `write_delay` may have written, shorter than a step; 0 for other filters."""
    constant, step = float(model.actuator_dynprm[index, 0]), float(model.opt.timestep)
    filters = int(model.actuator_dyntype[index]) == mujoco.mjtDyn.mjDYN_FILTEREXACT and model.actuator_actearly[index]
    lag = read_filter(constant, step) if filters and constant > 0 else 0.0
    return lag if lag < step else 0.0


def _said(kind: mujoco.mjtDyn | mujoco.mjtGain | mujoco.mjtBias) -> str:
    return kind.name.split("_", 1)[1].lower()
