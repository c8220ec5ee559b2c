"""Torque of `target=actuator_net` in each program's own class: `python benchmarks/load_actuator_net.py EXPORT PROGRAM`.

Runs with the program's Python, on the CPU. The class loads the exported configuration and computes its torque in random
states of some environments, which is compared with the network file's, evaluated on the same history.
"""

import argparse
import importlib.util
import io
import json
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import distribution
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import torch

ENVIRONMENTS, STEPS = 5, 60
Torque = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Torque of a class, from targets, positions and velocities of one step, each of shape (environments,)."""


def main() -> None:
    """Print the largest difference of each joint's torque."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("export", type=Path, metavar="EXPORT", help="folder that target=actuator_net wrote")
    parser.add_argument("program", choices=PROGRAMS)
    arguments = parser.parse_args()
    open_program, fills = PROGRAMS[arguments.program]
    rng = np.random.default_rng(0)
    for joint, file, torque in open_program(arguments.export.resolve()):
        qpos, targets, qvel = rng.normal(size=(3, STEPS, ENVIRONMENTS)).astype(np.float32)
        came = np.stack([torque(*rows) for rows in zip(targets, qpos, qvel, strict=True)])
        expected = evaluate(Path(file).with_suffix(".pt"), targets - qpos, qvel, fills)
        print(f"{joint}: differs by {np.abs(came - expected).max():.2g} of {np.abs(expected).max():.3g}")


def evaluate(file: Path, errors: np.ndarray, qvel: np.ndarray, fills: bool) -> np.ndarray:
    """Return a network file's torque in each step; `fills` if the first step fills the history, which else is zero."""
    extra = {"frictionzoo.json": ""}
    network = torch.jit.load(file, _extra_files=extra)
    if hasattr(network, "lstm"):
        state = 2 * (torch.zeros(1, errors.shape[1], network.lstm.state_dict()["weight_hh_l0"].shape[1]),)
        found = []
        for row in np.stack([errors, qvel], -1):
            torque, state = network(torch.tensor(row)[:, None], state)
            found.append(torque.numpy()[:, 0])
        return np.stack(found)
    count = len(json.loads(json.loads(extra["frictionzoo.json"])["input_idx"]))
    before = [np.repeat(part[:1], count - 1, axis=0) * fills for part in (errors, qvel)]
    rows = [np.concatenate(pair) for pair in zip(before, (errors, qvel), strict=True)]
    windows = (np.concatenate([row[now : now + count][::-1] for row in rows]).T for now in range(len(errors)))
    return np.stack([network(torch.tensor(window)).numpy()[:, 0] for window in windows])


def load_actuators(path: Path) -> Any:
    """Return `ACTUATORS` of a Python file."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.ACTUATORS


def column(values: np.ndarray) -> torch.Tensor:
    """Return the values of one joint, of shape (environments, 1)."""
    return torch.tensor(values)[:, None]


def open_isaaclab(folder: Path) -> Iterator[tuple[str, str, Torque]]:
    """Yield each joint's `ActuatorNetMLP` or `ActuatorNetLSTM`; a module reads local files for Isaac Sim's server."""
    installed = distribution("isaaclab")
    inner = Path(str(installed.locate_file("isaaclab/source/isaaclab")))
    sys.path.insert(0, str(inner if (inner / "isaaclab" / "actuators").exists() else installed.locate_file("")))
    assets: Any = ModuleType("isaaclab.utils.assets")
    assets.read_file = lambda path: io.BytesIO(Path(path).read_bytes())
    sys.modules[assets.__name__] = assets
    for joint, config in load_actuators(folder / "isaaclab_actuator_net.py").items():
        from isaaclab.actuators import actuator_net  # pyright: ignore[reportMissingImports]
        from isaaclab.utils.types import ArticulationActions  # pyright: ignore[reportMissingImports]

        kind = getattr(actuator_net, type(config).__name__.removesuffix("Cfg"))
        actuator = kind(config.copy(), [joint], torch.tensor([0]), ENVIRONMENTS, "cpu")
        none = torch.zeros(ENVIRONMENTS, 1)

        def torque(targets: Any, qpos: Any, qvel: Any, actuator: Any = actuator, none: Any = none) -> np.ndarray:
            wanted = ArticulationActions(column(targets), none, none, torch.tensor([0]))
            return actuator.compute(wanted, column(qpos), column(qvel)).joint_efforts.numpy()[:, 0].copy()

        yield joint, config.network_file, torque


def open_mjlab(folder: Path) -> Iterator[tuple[str, str, Torque]]:
    """Yield `LearnedMlpActuator` of each joint, with the buffers that `initialize` makes, but without a simulation."""
    from mjlab.actuator.actuator import ActuatorCmd  # pyright: ignore[reportMissingImports]
    from mjlab.actuator.learned_actuator import LearnedMlpActuator  # pyright: ignore[reportMissingImports]
    from mjlab.utils.buffers import CircularBuffer  # pyright: ignore[reportMissingImports]

    for config in load_actuators(folder / "mjlab_actuator_net.py"):
        actuator: Any = LearnedMlpActuator.__new__(LearnedMlpActuator)
        actuator.cfg, actuator.network = config, torch.jit.load(config.network_file).eval()
        for name in ("_pos_error_history", "_vel_history"):
            setattr(actuator, name, CircularBuffer(config.history_length, ENVIRONMENTS, "cpu"))
        full = torch.ones(ENVIRONMENTS, 1)
        actuator._joint_vel_clipped, actuator.force_limit = 0 * full, config.effort_limit * full
        actuator.saturation_effort = config.saturation_effort * full
        actuator.velocity_limit_motor = config.velocity_limit * full

        def torque(targets: Any, qpos: Any, qvel: Any, actuator: Any = actuator) -> np.ndarray:
            signals = {"position_target": column(targets), "pos": column(qpos), "vel": column(qvel)}
            none = {name: torch.zeros(ENVIRONMENTS, 1) for name in ("velocity_target", "effort_target")}
            return actuator.compute(ActuatorCmd(**signals, **none)).numpy()[:, 0].copy()

        yield config.target_names_expr[0], config.network_file, torque


def open_newton(folder: Path) -> Iterator[tuple[str, str, Torque]]:
    """Yield `DriveNeuralMLP` of each joint."""
    import warp as wp  # pyright: ignore[reportMissingImports]
    from newton.actuators import Actuator, DriveNeuralMLP  # pyright: ignore[reportMissingImports]

    for joint, config in load_actuators(folder / "newton_actuator_net.py").items():
        indices = wp.array(np.arange(ENVIRONMENTS), dtype=wp.uint32, device="cpu")
        actuator = Actuator(indices, DriveNeuralMLP(config["model_path"]), control_feedforward_attr=None)
        states = [actuator.state(), actuator.state()]

        def torque(targets: Any, qpos: Any, qvel: Any, actuator: Any = actuator, states: Any = states) -> np.ndarray:
            target, position, velocity = (
                wp.array(part, dtype=wp.float32, device="cpu") for part in (targets, qpos, qvel)
            )
            state = SimpleNamespace(joint_q=position, joint_qd=velocity)
            control = SimpleNamespace(joint_target_q=target, joint_target_qd=velocity)
            control.joint_f = wp.zeros(ENVIRONMENTS, dtype=wp.float32, device="cpu")
            actuator.step(state, control, *states, dt=0.0)
            states.reverse()
            return control.joint_f.numpy()

        yield joint, config["model_path"], torque


PROGRAMS = {"isaaclab": (open_isaaclab, False), "mjlab": (open_mjlab, True), "newton": (open_newton, False)}
"""Function that opens the joints' classes, and whether the first step fills the history."""

if __name__ == "__main__":
    main()
