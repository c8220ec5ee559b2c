"""What a robot's file says of the actuator of each joint."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import mujoco
import numpy as np
from jaxtyping import Float

from frictionzoo.bench.robot_file.dc_motors import (
    has_input,
    is_dc_motor,
    read_back_emf,
    read_bristles,
    torque_per_volt,
    why_not_linear,
)
from frictionzoo.bench.robot_file.source import Source, listed

_AT_JOINT = {int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)}
_FILTERS = {int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT)}
_ACTING = {  # how else than at a joint, in words
    int(mujoco.mjtTrn.mjTRN_SLIDERCRANK): "a slider-crank",
    int(mujoco.mjtTrn.mjTRN_TENDON): "a tendon",
    int(mujoco.mjtTrn.mjTRN_SITE): "a site",
    int(mujoco.mjtTrn.mjTRN_BODY): "a body",
}


@dataclass(frozen=True)
class ReadActuator:
    """An actuator as the file has it, in joint space: torque = gain ctrl + bias0 + bias1 qpos + bias2 qvel.

    Attributes:
        name: In the file; empty where it has none.
        kind: `motor`, `position`, `velocity` by what its law comes down to, or `general`.
        gain: Factor of the command; the gear is in it.
        bias0: Constant torque [N m or N].
        bias1: Factor of the position.
        bias2: Factor of the velocity.
        gear: As in the file.
        ctrlrange: Ends of the command's range, in the command's unit; NaN where it has none.
        forcerange: Ends of the torque's range at the joint [N m or N]; NaN where it has none.
        delay: By which commands act late [s].
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


def read_actuators(source: Source, joints: Sequence[int]) -> tuple[ReadActuator | None, ...]:
    """The actuator of each of these joints, None where it has none that can be read; what cannot is noted."""
    source.notes += _say_others(source, joints)
    return tuple(_read_first(source, joint, _list_at(source.model, joint)) for joint in joints)


def read_friction(source: Source, joints: Sequence[int]) -> dict[str, Float[np.ndarray, "nv"]]:
    """Bristles of each joint, by the names of parameters of `lugre`; NaN where the file has none."""
    model, motors = source.model, dict[int, list[int]]()
    for joint in joints:
        found = [index for index in _list_at(model, joint) if is_dc_motor(model, index)]
        motors[joint] = [index for index in found if model.actuator_gear[index, 0] and not _is_disabled(model, index)]
    return read_bristles(source, motors)


def _list_at(model: mujoco.MjModel, joint: int) -> list[int]:
    """Indices of the actuators that act at a joint."""
    at_joint = np.isin(model.actuator_trntype, list(_AT_JOINT)) & (model.actuator_trnid[:, 0] == joint)
    return [int(index) for index in np.flatnonzero(at_joint)]


def _is_disabled(model: mujoco.MjModel, index: int) -> bool:
    group = int(model.actuator_group[index])
    return 0 <= group < 31 and bool((model.opt.disableactuator >> group) & 1)


def read_armature(source: Source, joints: Sequence[int]) -> Float[np.ndarray, "nv"]:
    """Armature of each joint with that of its actuator [kg m^2 or kg]."""
    model = source.model
    return np.array([model.dof_armature[source.dof(j)] + _reflected(model, j, model.actuator_armature) for j in joints])


def read_damping(source: Source, joints: Sequence[int]) -> Float[np.ndarray, "nv"]:
    """Damping of each joint with that of its actuator [N m s/rad or N s/m]; what is no straight line is noted."""
    model = source.model
    bent = [j for j in joints if model.dof_dampingpoly[source.dof(j)].any()]
    bent += [
        j for j in joints if model.jnt_actuatorid[j] >= 0 and model.actuator_dampingpoly[model.jnt_actuatorid[j]].any()
    ]
    if bent:
        names = listed([model.joint(joint).name for joint in bent])
        source.notes.append(f"damping that is no straight line: of joint {names} only the coefficient of qvel is kept")
    own = [model.dof_damping[source.dof(j)] + _reflected(model, j, model.actuator_damping) for j in joints]
    return np.array(own) + [sum(map(partial(read_back_emf, model), _list_windings(model, joint))) for joint in joints]


def _list_windings(model: mujoco.MjModel, joint: int) -> list[int]:
    """DC motors of a joint whose back-EMF is nothing but a damping."""
    motors = [index for index in _list_at(model, joint) if is_dc_motor(model, index)]
    return [index for index in motors if _why_not(model, index) is None]


def _reflected(model: mujoco.MjModel, joint: int, ofactuators: np.ndarray) -> float:
    """An actuator's own armature or damping, as its joint feels it through the gear."""
    actuator = model.jnt_actuatorid[joint]
    return 0.0 if actuator < 0 else float(model.actuator_gear[actuator, 0] ** 2 * ofactuators[actuator])


def _say_others(source: Source, joints: Sequence[int]) -> Iterator[str]:
    model = source.model
    for kind, words in _ACTING.items():
        names = [_name(model, index) for index in range(model.nactuator) if int(model.actuator_trntype[index]) == kind]
        if names:
            yield f"left out: {len(names)} actuators that act by {words}, {listed(names)}"
    elsewhere = [
        _name(model, index)
        for index in range(model.nactuator)
        if int(model.actuator_trntype[index]) in _AT_JOINT and int(model.actuator_trnid[index, 0]) not in joints
    ]
    if elsewhere:
        yield f"left out: {len(elsewhere)} actuators of joints that are not chosen, {listed(elsewhere)}"


def _read_first(source: Source, joint: int, actuators: Sequence[int]) -> ReadActuator | None:
    model, readable = source.model, list[ReadActuator]()
    for index in actuators:
        reason = _why_not(model, index)
        if reason:
            name = model.joint(joint).name
            source.notes.append(f"actuator {_name(model, index)} of joint {name} is left out: {reason}")
            continue
        if not has_input(model, index):
            continue  # of a DC motor, whose bristles and back-EMF are friction of the joint
        if is_dc_motor(model, index):
            source.notes.append(
                f"actuator {_name(model, index)} is a DC motor: its command is a voltage, and its back-EMF is taken as "
                "damping of the joint"
            )
        if int(model.actuator_dyntype[index]) in _FILTERS:
            constant = model.actuator_dynprm[index, 0]
            source.notes.append(
                f"actuator {_name(model, index)}: its filter of {constant:g} s is left out, commands act at once; a "
                "delay of the bench may stand for it"
            )
        readable.append(_read(model, index))
    if len(readable) > 1:
        source.notes.append(
            f"joint {model.joint(joint).name} has {len(readable)} actuators, of which {readable[0].name} is read and "
            f"{listed([actuator.name for actuator in readable[1:]])} left out"
        )
    return readable[0] if readable else None


def _why_not(model: mujoco.MjModel, index: int) -> str | None:
    """Why an actuator is no affine law of command, position and velocity."""
    dynamics = int(model.actuator_dyntype[index])
    if model.actuator_plugin[index] >= 0:
        return "it is a plugin"
    if _is_disabled(model, index):
        return "actuatorgroupdisable"
    if is_dc_motor(model, index):
        return why_not_linear(model, index)
    if dynamics != mujoco.mjtDyn.mjDYN_NONE and dynamics not in _FILTERS:
        return f"its activation ({_said(mujoco.mjtDyn(dynamics))}) is none that commands give at once"
    gain, bias = mujoco.mjtGain(model.actuator_gaintype[index]), mujoco.mjtBias(model.actuator_biastype[index])
    affine = gain == mujoco.mjtGain.mjGAIN_AFFINE and not model.actuator_gainprm[index, 1:3].any()
    if gain != mujoco.mjtGain.mjGAIN_FIXED and not affine:
        return f"its gain ({_said(gain)}) is no constant"
    if bias not in (mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE):
        return f"its bias ({_said(bias)}) is not affine"
    return None


def _read(model: mujoco.MjModel, index: int) -> ReadActuator:
    gear = float(model.actuator_gear[index, 0])
    gain = torque_per_volt(model, index) if is_dc_motor(model, index) else float(model.actuator_gainprm[index, 0])
    affine = model.actuator_biastype[index] == mujoco.mjtBias.mjBIAS_AFFINE
    bias0, bias1, bias2 = map(float, model.actuator_biasprm[index, :3] if affine else np.zeros(3))
    kind = "general"
    if bias0 == 0 and gain != 0:
        kind = {(0.0, 0.0): "motor", (-gain, 0.0): "position", (0.0, -gain): "velocity"}.get((bias1, bias2), kind)
        kind = "position" if bias1 == -gain else kind  # with kv
    clamps = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
    ctrl = int(model.actuator_ctrladr[index])  # an actuator may have several commands, or none
    ctrlrange = _range(model.actuator_ctrlrange[ctrl], bool(model.actuator_ctrllimited[ctrl]) and clamps)
    low, high = _range(model.actuator_forcerange[index], bool(model.actuator_forcelimited[index]))
    forcerange = (low * gear, high * gear) if gear >= 0 else (high * gear, low * gear)
    return ReadActuator(
        model.actuator(index).name,
        kind,
        gear * gain,
        gear * bias0,
        gear**2 * bias1,
        gear**2 * bias2,
        gear,
        ctrlrange,
        forcerange,
        float(model.actuator_delay[index]),
    )


def _range(ends: np.ndarray, limited: bool) -> tuple[float, float]:
    return (float(ends[0]), float(ends[1])) if limited else (np.nan, np.nan)


def _name(model: mujoco.MjModel, index: int) -> str:
    return model.actuator(index).name or f"number {index}"


def _said(kind: mujoco.mjtDyn | mujoco.mjtGain | mujoco.mjtBias) -> str:
    return kind.name.split("_", 1)[1].lower()
