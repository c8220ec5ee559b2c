"""An identified drive put into the joints of a user's own robot, MJCF or URDF."""

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from frictionzoo.core.errors import ConfigError, ExportError, closest
from frictionzoo.core.state import DriveState
from frictionzoo.export.base import measure
from frictionzoo.export.nearest import Nearest
from frictionzoo.export.written import Difference
from frictionzoo.result.identified import Identified

_JOINT = ("armature", "solreffriction", "frictionloss", "damping")
_KEPT = ("name", "group", "ctrlrange", "ctrllimited", "forcerange", "forcelimited")  # of an actuator that is replaced
_PLAIN = {"dyntype": "none", "gaintype": "fixed", "gear": "1 0 0 0 0 0"}  # whatever the robot's defaults are
_STATES = 200  # recorded states in which torques are compared
ACTUATORS = ("identified", "keep")


@dataclass(frozen=True)
class Robot:
    """A robot's description with identified joints.

    Attributes:
        text: The file.
        urdf: Whether it is URDF, else MJCF.
        joints: Names of the joints that were identified.
        column: Column of the drive's values of each of them.
        model: The description, compiled.
    """

    text: str
    urdf: bool
    joints: tuple[str, ...]
    column: tuple[int, ...]
    model: mujoco.MjModel


def put_into(
    path: Path, joints: Sequence[str], actuators: str, fitted: Identified, nearest: Nearest, bench: str
) -> Robot:
    """The user's robot with the drive in some of its joints; all else stays as it is, to the last digit.

    Args:
        path: Of the robot, MJCF or URDF.
        joints: Names of its joints. A drive of one joint is put into each of them, one of several into as many.
        actuators: `identified` to replace the joints' actuators, or add them, or `keep` to leave them.
        fitted: The drive.
        nearest: What MuJoCo's joints can hold of it.
        bench: The bench's MJCF with these values.

    Raises:
        ConfigError: The file or a joint does not exist, or an option makes no sense.
        ExportError: MuJoCo does not compile the robot, or a joint is of another type.
    """
    if actuators not in ACTUATORS:
        raise ConfigError(f"actuator={actuators}: expected {' or '.join(ACTUATORS)}")
    root, urdf = _read(path)
    found = {str(element.get("name")): element for element in root.iter("joint") if element.get("name")}
    columns = _match(path, joints, found, fitted)
    before = _compile(ET.tostring(root, encoding="unicode"), path)
    _refuse_other_types(before, path, joints, fitted.bench.joint_type)
    for name, column in zip(joints, columns, strict=True):
        if urdf:
            _write_dynamics(found[name], nearest, fitted.bench.own_damping, column)
        else:
            _write_joint(root, found[name], bench, column, actuators, before.opt.timestep)
    text = ('<?xml version="1.0"?>\n' if urdf else "") + ET.tostring(root, encoding="unicode") + "\n"
    return Robot(text, urdf, tuple(joints), columns, _compile(text, path))


def compare_torque(robot: Robot, fitted: Identified, nearest: Nearest, actuators: bool) -> Difference:
    """The robot's own actuator and damping in MuJoCo C, at recorded states, against those that were identified.

    Without the identified `actuators`, the damping alone.
    """
    states = _pick_states(fitted)
    data, column = mujoco.MjData(robot.model), list(robot.column)
    expected = -(nearest.damping + fitted.bench.own_damping) * states.qvel + (states.motor_torque if actuators else 0.0)
    rows = [states.map(lambda signal, row=row: signal[row, column]) for row in range(len(expected))]
    came = [_torque_in(robot, data, state, actuators) for state in rows]
    what = "actuator and damping" if actuators else "damping"
    over = f"{what} of {', '.join(robot.joints)} in {len(expected)} recorded states"
    return measure("torque", fitted, np.array(came), expected[:, column], over)


def _pick_states(fitted: Identified) -> DriveState:
    """Some of the recorded states, with what MuJoCo's actuators get in them as `ctrl`."""
    bench, samples = fitted.bench, fitted.samples
    signals = fitted.acting().map(lambda signal: signal[:, :, 0].reshape(-1, bench.nv))
    state = samples.qpos, samples.qvel
    ctrl = bench.actuator.control(np, fitted.values["bench"], *state, signals.ctrl, signals.inputs)
    every = max(1, len(samples.qpos) // _STATES)
    return samples._replace(ctrl=ctrl).map(lambda signal: np.asarray(signal)[::every])


def _torque_in(robot: Robot, data: mujoco.MjData, state: DriveState, actuators: bool) -> Float[np.ndarray, "joints"]:
    """Of the identified joints' actuators and dampers in one state."""
    model = robot.model
    ids = [model.joint(name).id for name in robot.joints]
    dof = model.jnt_dofadr[ids]
    mujoco.mj_resetData(model, data)
    data.qpos[model.jnt_qposadr[ids]], data.qvel[dof] = state.qpos, state.qvel
    for joint, ctrl in zip(ids, state.ctrl, strict=True):
        of_joint = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (model.actuator_trnid[:, 0] == joint)
        for actuator in np.flatnonzero(of_joint) if actuators else ():
            data.ctrl[actuator] = ctrl
            if count := int(model.actuator_history[actuator, 0]):
                times = model.opt.timestep * np.arange(-count, 0)
                mujoco.mj_initCtrlHistory(model, data, actuator, times, np.full(count, ctrl))
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fwdVelocity(model, data)
    mujoco.mj_fwdActuation(model, data)
    return data.qfrc_damper[dof] + (data.qfrc_actuator[dof] if actuators else 0.0)


def _read(path: Path) -> tuple[ET.Element, bool]:
    try:
        root = ET.fromstring(path.read_bytes(), ET.XMLParser(target=ET.TreeBuilder(insert_comments=True)))
    except (OSError, ET.ParseError) as error:
        why = error.strerror if isinstance(error, OSError) else f"not XML ({error})"
        raise ConfigError(f"into={path}: {why}; expected an MJCF or URDF file; name one") from None
    if root.tag not in ("mujoco", "robot"):
        raise ConfigError(f"into={path}: <{root.tag}>, expected <mujoco> (MJCF) or <robot> (URDF); name such a file")
    if root.find(".//include") is not None:
        raise ConfigError(f"into={path}: it has an <include>, expected one self-contained file; flatten it first")
    return root, root.tag == "robot"


def _match(path: Path, joints: Sequence[str], found: Mapping[str, ET.Element], fitted: Identified) -> tuple[int, ...]:
    """Column of the drive's values for each joint."""
    for name in joints:
        if name not in found:
            raise ConfigError(f"joint={name}: no such joint in {path}; {closest(name, found)}")
    if len(set(joints)) < len(joints):
        raise ConfigError(f"joint={','.join(joints)}: expected each joint once; change it")
    if fitted.bench.nv == 1:
        return (0,) * len(joints)
    if len(joints) != fitted.bench.nv:
        raise ConfigError(
            f"joint={','.join(joints)}: {len(joints)} joints, expected {fitted.bench.nv} in the order of "
            f"{', '.join(fitted.bench.joints)}; name as many"
        )
    return tuple(range(fitted.bench.nv))


def _compile(text: str, path: Path) -> mujoco.MjModel:
    """The model, with files that it refers to looked for where the original lies."""
    try:
        spec = mujoco.MjSpec.from_string(text)
        spec.modelfiledir = str(path.resolve().parent)
        return spec.compile()
    except ValueError as error:
        said = " ".join(str(error).split())
        raise ExportError(f"into={path}: MuJoCo does not compile it ({said}); mend it") from None


def _refuse_other_types(model: mujoco.MjModel, path: Path, joints: Sequence[str], kind: str) -> None:
    for name in joints:
        if model.joint(name).type[0] != getattr(mujoco.mjtJoint, f"mjJNT_{kind.upper()}"):
            raise ExportError(
                f"joint={name}: another type of joint in {path}, expected a {kind} as the drive's; name another"
            )


def _write_dynamics(joint: ET.Element, nearest: Nearest, own_damping: np.ndarray, column: int) -> None:
    """URDF: friction and damping; the armature as a comment, which is all that URDF has for it."""
    dynamics = joint.find("dynamics")
    dynamics = ET.SubElement(joint, "dynamics") if dynamics is None else dynamics
    dynamics.set("damping", repr(float(nearest.damping[column] + own_damping[column])))
    dynamics.set("friction", repr(float(nearest.frictionloss[column])))
    joint.append(ET.Comment(f" armature {float(nearest.bench['armature'][column])!r}: URDF has no place for it "))


def _write_joint(root: ET.Element, joint: ET.Element, bench: str, column: int, actuators: str, timestep: float) -> None:
    """MJCF: the joint's attributes, and its actuator, as the bench has them."""
    template = ET.fromstring(bench)
    general = template.findall("./actuator/general")[column]
    source = next(element for element in template.iter("joint") if element.get("name") == general.get("joint"))
    for name in _JOINT:
        joint.set(name, source.get(name, "0"))
    if actuators == "identified":
        _write_actuator(root, str(joint.get("name")), general, timestep)


def _write_actuator(root: ET.Element, joint: str, general: ET.Element, timestep: float) -> None:
    section = root.find("actuator")
    section = ET.SubElement(root, "actuator") if section is None else section
    old = [element for element in section if element.get("joint") == joint]
    if len(old) > 1:
        raise ConfigError(f"joint={joint}: {len(old)} actuators, expected one at most; set actuator=keep")
    kept = {key: old[0].attrib[key] for key in _KEPT if key in old[0].attrib} if old else {"name": joint}
    attributes = {key: value for key, value in general.attrib.items() if key not in ("name", "joint")}
    if "delay" in attributes:
        attributes["nsample"] = str(int(np.ceil(float(attributes["delay"]) / timestep)) + 2)
    new = old[0] if old else ET.SubElement(section, "general")
    tail = new.tail
    new.clear()
    new.tag, new.tail, new.attrib = "general", tail, {**kept, "joint": joint, **_PLAIN, **attributes}
