"""Target `actuator_net`: the actuator network that Isaac Lab, mjlab and Newton load."""

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import mujoco
import numpy as np
import torch
from jaxtyping import Float

from frictionzoo import __version__
from frictionzoo.core.errors import ExportError
from frictionzoo.core.state import Signals
from frictionzoo.export.base import Export, Target, match_joint, measure, register_target
from frictionzoo.export.drive_network import DriveNetwork, History, Recurrence, RecurrentDriveNetwork
from frictionzoo.export.module import render
from frictionzoo.export.motor import INPUTS, Motor, aim, list_lacks, motors, read_inputs, say_common
from frictionzoo.export.nearest import Nearest
from frictionzoo.export.onnx import run_onnx, to_proto
from frictionzoo.export.simulate import commands_before, simulate
from frictionzoo.export.torchscript import load_script, to_script
from frictionzoo.models.actuator_lstm import ActuatorLSTM
from frictionzoo.models.actuator_network import ActuatorModel
from frictionzoo.result.fitted_drive import FittedDrive

CONFIGS = {
    "isaaclab_actuator_net.py": ("Isaac Lab 2.3", "isaaclab.actuators", "ActuatorNetMLPCfg"),
    "mjlab_actuator_net.py": ("mjlab 1.6", "mjlab.actuator", "LearnedMlpActuatorCfg"),
    "newton_actuator_net.py": ("Newton 1.8", "", ""),
}
"""Python files: program, module and class of the configuration."""
RECURRENT = "ActuatorNetLSTMCfg"
"""Isaac Lab's class of a recurrent network."""
SCALE, ORDER = 1.0, "pos_vel"
UNREACHED = 1e6
"""Limits of the programs' own torque-speed line, out of reach; the drive's limits are in the network file."""
HELD = ("delay", "torque_offset")
"""Parameters of the bench in the network file."""
MOST_ROWS = 10_000
"""Largest number of steps in which the two network files are compared."""
ONE_PROGRAM = (
    "Only Isaac Lab's files are written: mjlab loads no recurrent network, and Newton's DriveNeuralLSTM another format."
)
LIMITS = (
    "None of the programs was run: the difference comes from the TorchScript file, evaluated in 32 bits in each step, "
    "with the file's armature, frictionloss and damping in MuJoCo C.",
    "The network file holds controller, motor, command delay and network, the Python files armature, frictionloss and "
    "damping. Do not add gains, limits or delays.",
)


@dataclass(frozen=True)
class NetworkFile:
    """Network of some joints, and the first part of its files' names."""

    name: str
    network: DriveNetwork | RecurrentDriveNetwork
    joints: tuple[int, ...]


@register_target("actuator_net")
class ActuatorNet(Target):
    """Actuator network for Isaac Lab's `ActuatorNetMLP`, mjlab's `LearnedMlpActuator` and Newton's `DriveNeuralMLP`.

    A recurrent network, `actuator_lstm`, is for Isaac Lab's `ActuatorNetLSTM` alone.

    Source: source code of Isaac Lab 2.3 and 3.0, mjlab 1.6 and Newton 1.8.
    """

    options: ClassVar[Mapping[str, str]] = INPUTS
    packages: ClassVar[tuple[str, ...]] = ("mujoco", "torch", "onnx", "onnxscript", "onnxruntime")

    def write(self, fitted: FittedDrive, folder: Path, options: Mapping[str, str]) -> Export:
        """See `Target.write`."""
        nearest, inputs = take_friction(fitted), read_inputs(fitted, options)
        drives = motors(fitted, inputs)
        files = group_joints(fitted, drives)
        recurrent = any(isinstance(file.network, RecurrentDriveNetwork) for file in files)
        endings, configs = (("pt",), tuple(CONFIGS)[:1]) if recurrent else (("pt", "onnx"), tuple(CONFIGS))
        for file in files:
            write_network(fitted, folder, file, endings)
        for name in configs:
            write_config(fitted, folder, name, nearest, files)
        loaded = [load(folder, file) for file in files]
        qpos, rows = roll(fitted, nearest, drives, files, loaded)
        reason = ", ".join(list_lacks(fitted, nearest, HELD)) or "a different history before the rollout"
        differences = [measure("qpos", fitted, qpos, fitted.rollout()[0], reason=reason)]
        for file, run, states in () if recurrent else zip(files, loaded, rows, strict=True):
            (came,) = run_onnx(folder / f"{file.name}.onnx", {"x": states})
            over = f"{len(states)} states of {file.name}.onnx in ONNX Runtime"
            torque = run(states).double().numpy()
            differences.append(measure("torque", fitted, came.astype(np.float64), torque, over))
        step = f"The network is valid for simulation steps of {fitted.timestep:g} s, as in its training."
        limits = (*LIMITS, step, *([ONE_PROGRAM] if recurrent else []), *say_common(fitted, nearest, inputs, HELD))
        names = [f"{file.name}.{ending}" for file in files for ending in endings]
        return Export((*names, *configs), tuple(differences), limits)


def take_friction(fitted: FittedDrive) -> Nearest:
    """Return the drive with its MuJoCo joint friction, without the network.

    Raises:
        ExportError: A joint's model is no actuator network, or belongs to another simulation step.
    """
    model, values = fitted.model, fitted.values["friction"]
    friction = []
    for joint in range(fitted.bench.nv):
        law, index, prefix = model.of_joint(joint)
        if not isinstance(law, ActuatorModel):
            raise ExportError(
                f"target=actuator_net: {law.name} is no actuator network; identify with model=actuator_network or "
                "actuator_lstm, or distil this run with frictionzoo distill RUN model=actuator_network"
            )
        friction.append([values[f"{prefix}{name}"][index] for name in ("frictionloss", "damping")])
    if fitted.origin is not None and not np.isclose(fitted.origin.timestep, fitted.timestep, rtol=1e-6):
        raise ExportError(
            f"timestep={fitted.timestep:g}: the network was trained in steps of {fitted.origin.timestep:g} s, expected "
            f"the same; leave timestep out, or identify with bench.timestep={fitted.timestep:g}"
        )
    return Nearest(dict(fitted.values["bench"]), *np.array(friction).T)


def group_joints(fitted: FittedDrive, drives: Sequence[Motor]) -> list[NetworkFile]:
    """Return a network for each group of joints with the same motor, delay and weights."""
    bench, groups = fitted.values["bench"], dict[Any, list[int]]()
    for joint, drive in enumerate(drives):
        delay, offset = (float(bench[name][joint]) if name in bench else 0.0 for name in HELD)
        groups.setdefault((drive, fitted.model.of_joint(joint)[2], delay, offset), []).append(joint)
    files = []
    for number, ((motor, _, delay, offset), joints) in enumerate(groups.items()):
        law = fitted.model.of_joint(joints[0])[0]
        assert isinstance(law, ActuatorModel)
        name = "actuator_net" if len(groups) == 1 else f"actuator_net_{number}"
        network = DriveNetwork(motor, law, fitted.timestep, delay, offset)
        if isinstance(law, ActuatorLSTM):
            network = RecurrentDriveNetwork(network, law)
        files.append(NetworkFile(name, network, tuple(joints)))
    return files


def load(folder: Path, file: NetworkFile) -> Callable[[torch.Tensor], torch.Tensor]:
    """Load the TorchScript of a network, as a function of `file.network.steps` errors and velocities."""
    run = load_script(folder / f"{file.name}.pt")
    return Recurrence(run, file.network) if isinstance(file.network, RecurrentDriveNetwork) else run


def write_network(fitted: FittedDrive, folder: Path, file: NetworkFile, endings: Collection[str]) -> None:
    """Write a network as TorchScript and, if `endings` contains it, as ONNX, with the metadata that Newton reads."""
    facts = {
        "producer": f"frictionzoo {__version__}",
        "joints": json.dumps([fitted.bench.joints[joint] for joint in file.joints]),
        "timestep": json.dumps(fitted.timestep),
        **dict.fromkeys(("pos_scale", "vel_scale", "effort_scale"), json.dumps(SCALE)),
        "input_order": ORDER,
        "input_idx": json.dumps(list(range(file.network.steps))),
    }
    example = file.network.example
    (folder / f"{file.name}.pt").write_bytes(to_script(file.network, example, facts))
    if "onnx" in endings:
        proto = to_proto(file.network, example, ("torque",), facts)
        (folder / f"{file.name}.onnx").write_bytes(proto.SerializeToString())


def write_config(fitted: FittedDrive, folder: Path, name: str, nearest: Nearest, files: Sequence[NetworkFile]) -> None:
    """Write a program's Python file with `ACTUATORS`, by joint or a tuple."""
    program, module, cls = CONFIGS[name]
    damping, joints = nearest.damping + fitted.bench.own_damping, []
    of_joint = {joint: file for file in files for joint in file.joints}
    for joint, file in sorted(of_joint.items()):
        numbers = nearest.bench["armature"], nearest.frictionloss, damping
        named = zip(("armature", "frictionloss", "damping"), (float(number[joint]) for number in numbers), strict=True)
        label = fitted.bench.joints[joint]
        steps = list(range(file.network.steps))
        joint_cls = RECURRENT if isinstance(file.network, RecurrentDriveNetwork) else cls
        about = {"name": label, "pattern": match_joint(label), "cls": joint_cls, "file": file.name, "steps": steps}
        joints.append({**about, **dict(named)})
    text = render(
        "actuator_net.py.jinja",
        **{"program": program, "module": module, "joints": joints, "units": fitted.units},
        **{"cls": ", ".join(sorted({joint["cls"] for joint in joints})), "recurrent": RECURRENT},
        **{"timestep": f"{fitted.timestep:g}", "scale": SCALE, "order": ORDER, "unreached": UNREACHED},
    )
    (folder / name).write_text(text, encoding="utf-8")


def roll(
    fitted: FittedDrive,
    nearest: Nearest,
    drives: Sequence[Motor],
    files: Sequence[NetworkFile],
    loaded: Sequence[Callable[[torch.Tensor], torch.Tensor]],
) -> tuple[Float[np.ndarray, "batch time nv"], list[torch.Tensor]]:
    """Simulate the long test rollouts in MuJoCo C with loaded networks; also return some inputs of each network."""
    bench = {name: value for name, value in nearest.bench.items() if name != "delay"}
    loss = nearest.frictionloss
    model = mujoco.MjModel.from_xml_string(fitted.bench.mjcf(bench, loss, nearest.damping))
    model.actuator_gainprm[:, 0], model.actuator_biasprm[:] = 1, 0  # `ctrl` is the torque
    aims_of, steps = aim(fitted, drives, shifted=False), max(file.network.steps for file in files)
    kept: list[list[torch.Tensor]] = [[] for _ in files]
    history = History(np.zeros((1, fitted.bench.nv)), np.zeros((1, fitted.bench.nv)))

    def begin(data: mujoco.MjData, rollout: int) -> None:
        nonlocal history
        for run in loaded:
            if isinstance(run, Recurrence):
                run.state = None
        before = aims_of(commands_before(fitted, rollout))[::-1]
        before = np.concatenate([before, np.repeat(before[-1:], max(0, steps - len(before)), axis=0)])[:steps]
        passed = fitted.timestep * np.arange(1, steps + 1)[:, None]
        history = History(before - data.qpos + passed * data.qvel, np.repeat(data.qvel[None], steps, axis=0))

    def step(data: mujoco.MjData, signals: Signals) -> None:
        history.push(aims_of(signals) - data.qpos, data.qvel)
        for file, run, rows in zip(files, loaded, kept, strict=True):
            inputs = history.read(file.network.steps, file.joints)
            data.ctrl[list(file.joints)] = run(inputs)[:, 0].numpy()
            if len(rows) < MOST_ROWS:
                rows.append(inputs)
        mujoco.mj_step(model, data)

    qpos = simulate(model, fitted, step, begin, late=False)
    return qpos, [torch.cat(rows) for rows in kept]
