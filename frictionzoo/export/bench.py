"""The target `mjcf`: the bench as a model that MuJoCo loads as it is."""

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import ClassVar

import mujoco
import numpy as np
from jaxtyping import Float

from frictionzoo.bench import Robot
from frictionzoo.core.errors import ConfigError, FrictionzooError
from frictionzoo.core.params import UNITS
from frictionzoo.export.base import Target, list_values, measure, register_target
from frictionzoo.export.nearest import Nearest, find_nearest, say_exact
from frictionzoo.export.robot import ACTUATORS, Equipped, compare_torque, put_into, say_whole
from frictionzoo.export.simulate import PAYLOADS, commands_before, simulate, step_with_control
from frictionzoo.export.written import Export
from frictionzoo.result.identified import Identified

_log = logging.getLogger(__name__)
FILE = "bench.xml"
IDENTIFIED = "identified"


@register_target("mjcf")
class Mjcf(Target):
    """The bench with its identified values as MJCF, or a robot; friction as the nearest that MuJoCo's joints have."""

    options: ClassVar[Mapping[str, str]] = {
        "into": "a robot's MJCF or URDF, of which a copy gets the drive",
        "joint": "its joint, or several with commas between",
        "actuator": "identified, to replace or add the joints' actuators, or keep",
    }
    packages: ClassVar[tuple[str, ...]] = ("mujoco",)

    def write(self, fitted: Identified, folder: Path, options: Mapping[str, str]) -> Export:
        """See `Target.write`."""
        own = isinstance(fitted.bench, Robot)
        for name in ("joint", "actuator"):
            if name in options and "into" not in options and not own:
                raise ConfigError(f"{name}={options[name]} without into; give into=ROBOT.xml too")
        nearest = find_nearest(fitted)
        text = write_bench(fitted, nearest)
        (folder / FILE).write_text(text)
        model = mujoco.MjModel.from_xml_path(str(folder / FILE))
        difference = measure("qpos", fitted, run_bench(model, fitted), fitted.rollout()[0], reason=nearest.lacks)
        limits = say_limits(fitted, nearest)
        if "into" not in options and not own:
            return Export((FILE,), (difference,), limits)
        path, actuators = Path(options.get("into", fitted.bench.source)), options.get("actuator", ACTUATORS[0])
        joints = options["joint"].split(",") if "joint" in options else fitted.bench.joints
        try:
            robot = put_into(path, joints, actuators, fitted, nearest, text)
            whole = say_whole(path, robot)
        except FrictionzooError as error:
            if options.keys() & {"into", "joint", "actuator"}:
                raise
            return Export((FILE,), (difference,), (*limits, f"The robot's own file is not written: {error}."))
        name = path.name if path.name != FILE else f"robot_{FILE}"
        name = name if "into" in options else _name(robot)
        (folder / name).write_bytes(robot.content)
        torque, cut = compare_torque(robot, fitted, nearest, actuators == "identified" and not robot.urdf)
        said = _say_robot(robot, fitted, nearest, actuators)
        return Export((FILE, name), (difference, torque), (*limits, *whole, *robot.notes, *cut, *said))


def write_identified(fitted: Identified) -> dict[str, bytes]:
    """What a run leaves behind for MuJoCo, by the file's name.

    That is the bench; of a robot's own file, the bench that was simulated, and that file with the drive in it. Where it
    cannot hold the drive, a line of the log says why.
    """
    nearest = find_nearest(fitted)
    text = write_bench(fitted, nearest)
    if not isinstance(fitted.bench, Robot):
        return {f"{IDENTIFIED}.xml": text.encode()}
    path = Path(fitted.bench.source)
    try:
        robot = put_into(path, fitted.bench.joints, ACTUATORS[0], fitted, nearest, text)
    except FrictionzooError as error:
        _log.warning("%s.xml is the bench alone, not the robot: %s", IDENTIFIED, error)
        return {FILE: text.encode(), f"{IDENTIFIED}.xml": text.encode()}
    return {FILE: text.encode(), _name(robot): robot.content}


def _name(robot: Equipped) -> str:
    """Of the file of a robot that was itself the bench."""
    return f"{IDENTIFIED}.urdf" if robot.urdf else f"{IDENTIFIED}.xml"


def _say_robot(robot: Equipped, fitted: Identified, nearest: Nearest, actuators: str) -> list[str]:
    """What the robot's file leaves out."""
    units, armature = UNITS[fitted.bench.joint_type], ", ".join(f"{value:.6g}" for value in nearest.bench["armature"])
    limits, timestep = [], robot.model.opt.timestep
    if robot.urdf:
        limits.append(f"URDF has no armature: set {armature} {units['inertia']} where the robot is loaded.")
        limits.append("URDF has no actuators and no solreffriction; both are in bench.xml.")
    elif actuators == "keep":
        said = "The robot's own actuators are kept; armature and friction were identified with that in bench.xml."
        limits.append(said)
    if "position_offset" in fitted.bench.params:
        offset = list_values(fitted.values["bench"]["position_offset"])
        limits.append(f"The recorded positions lack {offset} {units['position']}, which the robot's joints do not.")
    if not robot.urdf and not np.isclose(timestep, fitted.timestep, rtol=1e-6):
        limits.append(
            f"The robot's time step is {timestep:g} s, that of the differences {fitted.timestep:g} s; export with "
            f"timestep={timestep:g} to see what it changes."
        )
    if b"file=" in robot.content or b"filename=" in robot.content:
        limits.append("It refers to files (meshes) as the original does: put it where that lies.")
    return limits


def write_bench(fitted: Identified, nearest: Nearest) -> str:
    """The bench's MJCF with these values, in steps of the drive's length."""
    loss = nearest.frictionloss if nearest.frictionloss.any() else None  # 0 would be a constraint without effect
    remark = nearest.remark or say_exact(fitted.model)
    return fitted.bench.mjcf(nearest.bench, loss, nearest.damping, (remark,))


def run_bench(
    model: mujoco.MjModel, fitted: Identified, begin: Callable[[mujoco.MjData, int], None] = lambda *_: None
) -> Float[np.ndarray, "batch time nv"]:
    """Positions of the long test rollouts in MuJoCo C, the actuator law's controller computed by the caller.

    Where the compiled bench delays the commands itself, it gets them as recorded. `begin` is called with a rollout's
    number before it begins.
    """

    def fill_history(model: mujoco.MjModel, data: mujoco.MjData, rollout: int) -> None:
        """Put the commands before the first state where MuJoCo's late actuators look for them."""
        begin(data, rollout)
        held = commands_before(fitted, rollout).ctrl
        for actuator in range(model.nu):
            if count := int(model.actuator_history[actuator, 0]):
                steps = np.arange(-count, 0)
                known = held[np.maximum(len(held) + steps, 0), actuator]
                mujoco.mj_initCtrlHistory(model, data, actuator, model.opt.timestep * steps, known)

    return simulate(model, fitted, step_with_control(fitted), fill_history, late=not model.nhistory)


def say_limits(fitted: Identified, nearest: Nearest) -> tuple[str, ...]:
    """What a user of the bench's MJCF has to know."""
    law, limits = fitted.bench.actuator, [nearest.remark] if nearest.remark else []
    if law.has_controller:
        late = (
            f", from commands that are {list_values(fitted.values['bench']['delay'])} s late"
            if "delay" in fitted.bench.params
            else ""
        )
        limits.append(
            f"MuJoCo's actuator has no {type(law).__name__}: `ctrl` is what the law's controller makes of the command, "
            f"and the caller computes it in each step{late}, as for the difference above; target=mujoco writes it."
        )
    if fitted.bench.payload is not None:
        limits.append(PAYLOADS)
    return tuple(limits)
