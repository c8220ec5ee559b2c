"""Target `mjcf`: the bench or a robot as MJCF."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import mujoco
import numpy as np

from frictionzoo.bench import Robot
from frictionzoo.core.errors import ConfigError, FrictionzooError
from frictionzoo.core.telling import say_percent
from frictionzoo.export.base import Deviation, Export, Target, list_values, measure, read_choice, register_target
from frictionzoo.export.bench import list_lacks, say_limits, write_bench
from frictionzoo.export.nearest import Nearest, find_nearest
from frictionzoo.export.robot import ACTUATORS, Equipped, put_into, say_whole
from frictionzoo.export.simulate import Indices, run_loaded
from frictionzoo.export.stand import compare_torque, list_coupled, mount
from frictionzoo.result.evaluate import Prediction
from frictionzoo.result.fitted_drive import FittedDrive
from frictionzoo.result.names import name_some
from frictionzoo.result.section_types import WrittenModel
from frictionzoo.result.simulator import RK4

_log = logging.getLogger(__name__)
FILE = "bench.xml"
IDENTIFIED = "identified"
EXACT = 1e-9
"""Largest position difference that counts as rounding [rad or m]."""


@dataclass(frozen=True)
class ModelFile:
    """A model file with the drive.

    Attributes:
        timestep: Time step of the loaded model [s].
        difference: Position difference from the identified drive; None if the file was not run, see `limits`.
        limits: Limits of the file and remarks for users, a sentence each.
        notes: Remarks that hold only on this machine, a sentence each; the file and `result.json` do not have them.
    """

    name: str
    content: bytes
    timestep: float
    difference: Deviation | None
    limits: tuple[str, ...]
    notes: tuple[str, ...] = ()

    def describe(self, fitted: FittedDrive) -> WrittenModel:
        """Return its entry in `result.json`."""
        difference, error = self.difference, fitted.result.metrics.test.position_mae
        unit: Any = fitted.units["position"]
        return WrittenModel(
            file=self.name,
            timestep=self.timestep,
            mean=difference and difference.mean,
            largest=difference and difference.largest,
            unit=unit,
            share=difference.mean / error if difference and error else None,
            exact=difference is not None and difference.largest <= EXACT,
            over=difference.over if difference else "",
            reason=difference.reason if difference else "",
            limits=list(self.limits),
        )


@register_target("mjcf")
class Mjcf(Target):
    """MJCF of the bench or a robot with identified values; friction as MuJoCo's nearest frictionloss and damping."""

    options: ClassVar[Mapping[str, str]] = {
        "into": "a robot's MJCF or URDF, copied, and the copy gets the drive",
        "joint": "its joint, or several with commas between",
        "actuator": "identified, to replace or add the joints' actuators, or keep",
    }
    integrators: ClassVar[Sequence[str]] = (*Target.integrators, RK4)
    packages: ClassVar[tuple[str, ...]] = ("mujoco",)

    def write(self, fitted: FittedDrive, folder: Path, options: Mapping[str, str]) -> Export:
        """See `Target.write`."""
        is_robot = isinstance(fitted.bench, Robot)
        for name in ("joint", "actuator"):
            if name in options and "into" not in options and not is_robot:
                raise ConfigError(f"{name}={options[name]} without into; give into=ROBOT.xml too")
        joints = options["joint"].split(",") if "joint" in options else fitted.bench.joints
        path = Path(options.get("into", fitted.bench.source)) if "into" in options or is_robot else None
        robot = None if path is None else _Robot(path, tuple(joints), read_choice(options, "actuator", ACTUATORS))
        asked = bool(options.keys() & {"into", "joint", "actuator"})
        files, torque = _write_models(fitted, robot, asked)
        if "into" in options and path is not None:
            files[1] = replace(files[1], name=path.name if path.name != FILE else f"robot_{FILE}")
        for file in files:
            (folder / file.name).write_bytes(file.content)
        limits = dict.fromkeys(limit for file in files for limit in (*file.limits, *file.notes))
        differences = (file.difference for file in files if file.difference)
        return Export(tuple(file.name for file in files), (*differences, *torque), tuple(limits))


class _Robot(NamedTuple):
    path: Path
    joints: tuple[str, ...]
    actuators: str = ACTUATORS[0]


def write_identified(fitted: FittedDrive) -> list[ModelFile]:
    """Write a run's model files for MuJoCo: bench and, for a robot, its file; warn if that cannot hold the drive."""
    fitted = fitted.at() if fitted.bench.second_order and fitted.origin is None else fitted
    is_robot = isinstance(fitted.bench, Robot)
    robot = _Robot(Path(fitted.bench.source), fitted.bench.joints) if is_robot else None
    (bench, *others), _ = _write_models(fitted, robot, asked=False)
    if is_robot and not others:
        _log.warning("%s.xml is the bench alone, not the robot: %s", IDENTIFIED, bench.limits[-1])
    return [*([bench] if is_robot else []), *(others or [replace(bench, name=f"{IDENTIFIED}.xml")])]


def _write_models(
    fitted: FittedDrive, robot: _Robot | None, asked: bool
) -> tuple[list[ModelFile], tuple[Deviation, ...]]:
    """Write the bench and any robot file, with its torque difference; unless `asked`, a failure becomes a limit."""
    nearest, step = find_nearest(fitted), fitted.timestep
    expected = fitted.predict_origin() if fitted.is_simulated else Prediction(*fitted.rollout())
    model = mujoco.MjModel.from_xml_string(write_bench(fitted, nearest))
    difference, play_limits = play(model, fitted, expected, list_lacks(fitted, nearest, step))
    limits = (*say_limits(fitted, nearest), *play_limits)
    content = write_bench(fitted, nearest, _list_remarks(fitted, nearest, difference, limits)).encode()
    bench = ModelFile(FILE, content, step, difference, limits)
    if robot is None:
        return [bench], ()
    try:
        file, torque = _write_robot_file(fitted, nearest, expected, robot)
    except FrictionzooError as error:
        if asked:
            raise
        return [replace(bench, limits=(*limits, f"The robot's own file is not written: {error}."))], ()
    return [bench, file], (torque,)


def _write_robot_file(
    fitted: FittedDrive, nearest: Nearest, expected: Prediction, asked: _Robot
) -> tuple[ModelFile, Deviation]:
    """Write a robot file, and run it if it is the recorded robot; also return its torque difference."""
    text, (path, joints, actuators) = write_bench(fitted, nearest), asked
    robot = put_into(path, joints, actuators, fitted, nearest, text)
    timestep = fitted.timestep if robot.urdf else float(robot.model.opt.timestep)
    torque, clipping = compare_torque(robot, fitted, nearest, actuators == "identified" and not robot.urdf)
    difference, play_limits = None, ()
    if isinstance(fitted.bench, Robot) and asked == _Robot(Path(fitted.bench.source), fitted.bench.joints):
        reasons = list_lacks(fitted, nearest, timestep) + (["limits of the robot's own actuators"] if clipping else [])
        difference, play_limits = _play_robot(robot, fitted, nearest, expected, path, text, reasons)
    limits = [*say_limits(fitted, nearest, timestep), *robot.notes, *clipping]
    limits = tuple(dict.fromkeys([*limits, *_say_robot(robot, fitted, nearest, actuators), *play_limits]))
    content = robot.commented(*_list_remarks(fitted, nearest, difference, limits)).content
    name = f"{IDENTIFIED}.urdf" if robot.urdf else f"{IDENTIFIED}.xml"
    return ModelFile(name, content, timestep, difference, limits, say_whole(path, robot)), torque


def _play_robot(
    robot: Equipped, fitted: FittedDrive, nearest: Nearest, expected: Prediction, path: Path, bench: str, why: list[str]
) -> tuple[Deviation | None, tuple[str, ...]]:
    if robot.unknown:
        reason = f"MuJoCo rejects the inertia of {name_some(robot.unknown)}, or does not find its mesh"
        return None, (f"It is not simulated: {reason}.",)
    if coupled := list_coupled(robot):
        return None, (f"It is not simulated: a tendon connects {name_some(coupled)}, which were not identified.",)
    model, place = mount(robot, fitted, nearest, path, bench)
    if _is_clipped(model, fitted, place):
        why = [*why, "ctrlrange of the robot's own actuators"]
    difference, failure = play(model, fitted, expected, why, place)
    suffix = ", the robot's own file on the bench's stand"
    return difference and replace(difference, over=f"{difference.over}{suffix}"), failure


def _list_remarks(
    fitted: FittedDrive, nearest: Nearest, difference: Deviation | None, limits: tuple[str, ...]
) -> list[str]:
    """List the sentences of a file's comment, except the one on the friction model."""
    remarks = [f"Its parameters are valid for steps of {fitted.timestep:g} s with the integrator {fitted.integrator}."]
    if difference:
        prefix = f"Simulated unchanged in MuJoCo with held-out commands ({difference.over}):"
        unit, error = difference.unit, fitted.result.metrics.test.position_mae
        share = f" ({say_percent(difference.mean / error)} of the drive's own test error)" if error else ""
        reason = difference.reason and f": {difference.reason}"
        remarks.append(
            f"{prefix} the identified drive is represented exactly, positions within {EXACT:g} {unit}."
            if difference.largest <= EXACT
            else f"{prefix} its positions differ from the identified drive's by {difference.mean:.3g} {unit} on "
            f"average{share} and {difference.largest:.3g} {unit} at most{reason}."
        )
    return remarks + [limit for limit in limits if limit != nearest.remark]


def _say_robot(robot: Equipped, fitted: FittedDrive, nearest: Nearest, actuators: str) -> list[str]:
    units, armature = fitted.units, ", ".join(f"{value:.6g}" for value in nearest.bench["armature"])
    limits, timestep = [], robot.model.opt.timestep
    if robot.urdf:
        limits.append(f"URDF has no armature: set {armature} {units['inertia']} where the robot is loaded.")
        limits.append("URDF has no actuators and no solreffriction; both are in bench.xml.")
    elif actuators == "keep":
        limits.append(
            "The robot's own actuators are kept; armature and friction were identified with those in bench.xml."
        )
    if "position_offset" in fitted.bench.params:
        offset = list_values(fitted.values["bench"]["position_offset"])
        limits.append(f"The robot's joint positions are the recorded positions plus {offset} {units['position']}.")
        if actuators == "identified" and not robot.urdf:
            limits.append("The actuators' bias corrects this: `ctrl` is the recorded command.")
    if not robot.urdf and not np.isclose(timestep, fitted.timestep, rtol=1e-6):
        limits.append(f"The robot's timestep is {timestep:g} s, the drive was identified with {fitted.timestep:g} s.")
    if b"file=" in robot.content or b"filename=" in robot.content:
        limits.append("It refers to the original's files (meshes): put it in the original's folder.")
    return limits


def play(
    model: mujoco.MjModel, fitted: FittedDrive, expected: Prediction, why: list[str], place: Indices | None = None
) -> tuple[Deviation | None, tuple[str, ...]]:
    """Run a loaded model over the long test rollouts, and compare it with the drive's rollouts.

    Payloads are added to `model`. `why` lists reasons for a difference. Without `place`, the model is the bench's MJCF.

    Returns:
        The position difference; or None, and a sentence with the reason.
    """
    stable = ~expected.diverged
    if not stable.any():
        return None, (f"It is not compared with the fitted drive, which diverges in all of its {fitted.over}.",)
    qpos = run_loaded(model, fitted, place)
    diverged = stable & ~np.isfinite(qpos).all(axis=(1, 2))
    if diverged.any():
        return None, (f"It diverges in {diverged.sum()} of {fitted.over}: do not use it.",)
    over = None if stable.all() else f"{stable.sum()} of {fitted.over}, in which the drive does not diverge"
    return measure("qpos", fitted, qpos[stable], expected.qpos[stable], over, ", ".join(why)), ()


def _is_clipped(model: mujoco.MjModel, fitted: FittedDrive, place: Indices) -> bool:
    """Return whether the model's actuators clip the recorded commands."""
    actuator, signals = fitted.bench.actuator, fitted.segments.signals
    if actuator.needs_state:
        return False
    command = actuator.combine(fitted.values["bench"], signals.ctrl, signals.inputs)
    low, high = model.actuator_ctrlrange[place.actuator].T
    return bool((model.actuator_ctrllimited[place.actuator] & ((command < low) | (command > high))).any())
