"""A robot's file on the test stand of its recordings: parts that the bench leaves out are fixed or disabled."""

import copy
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from frictionzoo.bench import Robot
from frictionzoo.bench.inertia import inertial_parameters, put_parameters
from frictionzoo.bench.robot_file.source import load
from frictionzoo.export.nearest import Nearest
from frictionzoo.export.robot import Equipped, describe_law, offset_of
from frictionzoo.export.simulate import Place
from frictionzoo.result.fitted_drive import FittedDrive

_AT_JOINT = {mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT}
_OFF = mujoco.mjtDisableBit


def mount(
    robot: Equipped, fitted: FittedDrive, nearest: Nearest, path: Path, bench: str
) -> tuple[mujoco.MjModel, Place]:
    """Put a robot's file with the drive on the test stand of the recordings; return the model and its joint indices.

    Time step, integrator, solver, joints and actuators are the file's. As in the bench, the base and the joints that
    were not identified are fixed, and contacts and limits act only if the bench has them. A URDF gets the options,
    armatures and actuators of the bench's MJCF, which it cannot hold. Meshes are relative to `path`.
    """
    stand = fitted.bench
    assert isinstance(stand, Robot)

    def prepare(spec: mujoco.MjSpec) -> None:
        if robot.urdf:
            _equip(spec, fitted, nearest, bench)
        _hold_others(spec, robot.joints)

    model = load(str(path), robot.content, prepare).model
    for choice, flag in (("contacts", _OFF.mjDSBL_CONTACT), ("limits", _OFF.mjDSBL_LIMIT)):
        if stand.choices[choice] == "leave_out":
            model.opt.disableflags |= int(flag)
    joints = np.array([model.joint(name).id for name in robot.joints])
    actuators = np.array([_actuator_of(model, int(joint)) for joint in joints])
    dof, payload, bench_model = model.jnt_dofadr[joints], stand.payload, stand.compile(constraint=False)
    name = None if payload is None else bench_model.body(payload).name
    carried = None if name is None else inertial_parameters(model, [model.body(name).id])[0]

    def put_load(model: mujoco.MjModel, load: Float[np.ndarray, "load"]) -> None:
        if payload is None or name is None or carried is None or not len(load):
            return
        loaded = copy.copy(bench_model)
        stand.put_load(loaded, load)
        added = inertial_parameters(loaded, [payload]) - inertial_parameters(bench_model, [payload])
        put_parameters(model, model.body(name).id, carried + added[0])

    indices = model.jnt_qposadr[joints], dof, model.actuator_ctrladr[actuators], actuators
    return model, Place(*indices, offset_of(fitted), put_load)


def _actuator_of(model: mujoco.MjModel, joint: int) -> int:
    at_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    return int(np.flatnonzero(at_joint & (model.actuator_trnid[:, 0] == joint))[0])


def list_coupled(robot: Equipped) -> list[str]:
    """Name the joints that were not identified and act on a tendon."""
    pulling = robot.model.wrap_objid[robot.model.wrap_type == mujoco.mjtWrap.mjWRAP_JOINT]
    names = (robot.model.joint(joint).name for joint in np.unique(pulling).tolist())
    return [name for name in names if name not in robot.joints]


def _hold_others(spec: mujoco.MjSpec, joints: Sequence[str]) -> None:
    """Fix all other joints at their reference positions, and remove their actuators and joint equalities."""
    others = [joint for joint in spec.joints if joint.name not in joints]
    fixed = {joint.name for joint in others}
    acting = [item for item in spec.actuators if item.target in fixed and item.trntype in _AT_JOINT]
    tied = [item for item in spec.equalities if item.type == mujoco.mjtEq.mjEQ_JOINT and item.name1 in fixed]
    for element in (*acting, *tied):
        spec.delete(element)
    for joint in others:
        spec.delete(joint)


def _equip(spec: mujoco.MjSpec, fitted: FittedDrive, nearest: Nearest, bench: str) -> None:
    spec.option = mujoco.MjSpec.from_string(bench).option
    template = ET.fromstring(bench)
    attributes = {element.get("name", ""): element.attrib for element in template.iter("joint")}
    for column, general in enumerate(template.iterfind("./actuator/general")):
        law, joint = (
            describe_law(fitted, nearest, column, general, fitted.timestep),
            spec.joint(general.attrib["joint"]),
        )
        joint.armature = float(attributes[joint.name]["armature"])
        joint.solref_friction = _read(attributes[joint.name]["solreffriction"])
        actuator = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.gainprm[0], actuator.biastype = float(law["gainprm"]), mujoco.mjtBias.mjBIAS_AFFINE
        actuator.biasprm[:3] = _read(law["biasprm"])
        if "forcerange" in law:
            actuator.forcelimited, actuator.forcerange = True, _read(law["forcerange"])
        if "delay" in law:
            actuator.delay, actuator.nsample, actuator.interp = float(law["delay"]), int(law["nsample"]), 1  # linear
        if "dynprm" in law:
            actuator.dyntype, actuator.actearly = mujoco.mjtDyn.mjDYN_FILTEREXACT, True
            actuator.dynprm[0] = float(law["dynprm"])


def _read(numbers: str) -> list[float]:
    return [float(number) for number in numbers.split()]
