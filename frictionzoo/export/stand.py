"""A robot's file on the test stand of its recordings, without the parts that the bench leaves out; and its torque."""

import copy
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from frictionzoo.bench import Robot
from frictionzoo.bench.inertia import inertial_parameters, put_parameters
from frictionzoo.bench.robot_file.actuators import AT_JOINT, list_at
from frictionzoo.bench.robot_file.source import load
from frictionzoo.core.state import DriveState
from frictionzoo.export.base import Deviation, measure
from frictionzoo.export.nearest import Nearest
from frictionzoo.export.robot import Equipped, meant, offset_of, say_joints
from frictionzoo.export.simulate import Indices, equip
from frictionzoo.result.fitted_drive import FittedDrive

_STATES = 200  # number of recorded states for the torque comparison
_ROUNDING = 1e-9  # tolerance of a torque limit, as a share of the limit
_OFF = mujoco.mjtDisableBit


def mount(
    robot: Equipped, fitted: FittedDrive, nearest: Nearest, path: Path, bench: str
) -> tuple[mujoco.MjModel, Indices]:
    """Put a robot's file with the drive on the test stand of the recordings; return the model and its joint indices.

    Time step, integrator, solver, joints and actuators are the file's. As in the bench, the base and the joints that
    were not identified are fixed, and contacts and limits act only if the bench has them. A URDF gets the options,
    armatures and actuators of the bench's MJCF, which it cannot hold. Meshes are relative to `path`.
    """
    stand = fitted.bench
    assert isinstance(stand, Robot)

    def prepare(spec: mujoco.MjSpec) -> None:
        if robot.urdf:
            bias0 = meant(fitted, nearest).bias0.tolist()
            equip(spec, bench, nearest.bench["armature"].tolist(), bias0, late=True)
        _hold_others(spec, robot.joints)

    model = load(str(path), robot.content, prepare).model
    for choice, flag in (("contacts", _OFF.mjDSBL_CONTACT), ("limits", _OFF.mjDSBL_LIMIT)):
        if stand.choices[choice] == "leave_out":
            model.opt.disableflags |= int(flag)
    joints = np.array([model.joint(name).id for name in robot.joints])
    actuators = np.array([list_at(model, int(joint))[0] for joint in joints])
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
    return model, Indices(*indices, offset_of(fitted), put_load)


def list_coupled(robot: Equipped) -> list[str]:
    """Name the joints that were not identified and act on a tendon."""
    pulling = robot.model.wrap_objid[robot.model.wrap_type == mujoco.mjtWrap.mjWRAP_JOINT]
    names = (robot.model.joint(joint).name for joint in np.unique(pulling).tolist())
    return [name for name in names if name not in robot.joints]


def _hold_others(spec: mujoco.MjSpec, joints: Sequence[str]) -> None:
    """Fix all other joints at their reference positions, and remove their actuators and joint equalities."""
    others = [joint for joint in spec.joints if joint.name not in joints]
    fixed = {joint.name for joint in others}
    acting = [item for item in spec.actuators if item.target in fixed and int(item.trntype) in AT_JOINT]
    tied = [item for item in spec.equalities if item.type == mujoco.mjtEq.mjEQ_JOINT and item.name1 in fixed]
    for element in (*acting, *tied):
        spec.delete(element)
    for joint in others:
        spec.delete(joint)


def compare_torque(
    robot: Equipped, fitted: FittedDrive, nearest: Nearest, actuators: bool
) -> tuple[Deviation, tuple[str, ...]]:
    """Compare the torque of the file's actuators and damping with the drive's, in MuJoCo C at recorded states.

    Without identified `actuators`, compare only the damping. Also return a sentence if limits of the robot contribute.
    """
    states = _pick_states(fitted)
    data, column = mujoco.MjData(robot.model), list(robot.column)
    expected = -(nearest.damping + fitted.bench.own_damping) * states.qvel + (states.motor_torque if actuators else 0.0)
    rows = [states.map(lambda signal, row=row: signal[row, column]) for row in range(len(expected))]
    rows = [state._replace(qpos=state.qpos + offset_of(fitted)[column]) for state in rows]
    torque = [_torque_in(robot, data, state, actuators) for state in rows]
    parts = "actuator and damping" if actuators else "damping"
    over = f"{parts} of {say_joints(robot.joints)} in {len(expected)} recorded states"
    clipping = _say_cut(robot, states.motor_torque[:, column]) if actuators else ()
    return measure("torque", fitted, np.array(torque), expected[:, column], over), clipping


def _say_cut(robot: Equipped, torque: Float[np.ndarray, "states joints"]) -> tuple[str, ...]:
    """Count the states in which force limits of the robot act; the bench has none."""
    model, cut = robot.model, np.zeros(len(torque), bool)
    ids = [model.joint(name).id for name in robot.joints]
    limits = [(model.jnt_actfrcrange[ids], model.jnt_actfrclimited[ids], ids)]
    limits += [(model.actuator_forcerange, model.actuator_forcelimited, model.actuator_trnid[:, 0])]
    for ranges, limited, owners in limits:
        for (low, high), acts, joint in zip(ranges, limited, owners, strict=True):
            if acts and joint in ids:
                joint_torque = torque[:, ids.index(joint)]
                cut |= (joint_torque < low - _ROUNDING * abs(low)) | (joint_torque > high + _ROUNDING * abs(high))
    limits_text = "the robot's own limits of force, which bench.xml has not"
    return (f"In {cut.sum()} of {len(cut)} recorded states {limits_text}, cut the torque.",) if cut.any() else ()


def _pick_states(fitted: FittedDrive) -> DriveState:
    """Pick some recorded states, with the `ctrl` of MuJoCo's actuators."""
    bench, samples = fitted.bench, fitted.samples
    signals = fitted.acting().map(lambda signal: signal[:, :, 0].reshape(-1, bench.nv))
    state = samples.qpos, samples.qvel
    ctrl = bench.actuator.control(np, fitted.values["bench"], *state, signals.ctrl, signals.inputs)
    stride = max(1, len(samples.qpos) // _STATES)
    return samples._replace(ctrl=ctrl).map(lambda signal: np.asarray(signal)[::stride])


def _torque_in(robot: Equipped, data: mujoco.MjData, state: DriveState, actuators: bool) -> Float[np.ndarray, "joints"]:
    model = robot.model
    ids = [model.joint(name).id for name in robot.joints]
    dof = model.jnt_dofadr[ids]
    mujoco.mj_resetData(model, data)
    data.qpos[model.jnt_qposadr[ids]], data.qvel[dof] = state.qpos, state.qvel
    for joint, ctrl in zip(ids, state.ctrl, strict=True):
        for actuator in list_at(model, joint) if actuators else ():
            data.ctrl[model.actuator_ctrladr[actuator]] = ctrl
            if count := int(model.actuator_history[actuator, 0]):
                times = model.opt.timestep * np.arange(-count, 0)
                mujoco.mj_initCtrlHistory(model, data, actuator, times, np.full(count, ctrl))
            if model.actuator_actnum[actuator]:  # a delay below one step, as a filter
                data.act[model.actuator_actadr[actuator]] = ctrl
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fwdVelocity(model, data)
    mujoco.mj_fwdActuation(model, data)
    return data.qfrc_damper[dof] + (data.qfrc_actuator[dof] if actuators else 0.0)
