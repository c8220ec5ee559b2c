"""The actuator network of simulators: what its files hold, and what each program makes of them."""

import json
import runpy
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.drawn import draw, fit, write

import frictionzoo as fz
from frictionzoo.core.errors import ConfigError, ExportError
from frictionzoo.core.state import DriveState
from frictionzoo.export.base import REGISTRY as TARGETS
from frictionzoo.export.drive_network import DriveNetwork, RecurrentDriveNetwork
from frictionzoo.export.motor import Motor, motors
from frictionzoo.export.torchscript import load_script, to_script
from frictionzoo.models import ActuatorLSTM, ActuatorNetwork, FrictionModel
from frictionzoo.models.registry import REGISTRY as MODELS

STEP = 0.005  # s
SIZE = {"init": 0.1, "low": 1e-4, "high": 10.0, "scale": "log", "identify": True}


def make_law(kind: type[ActuatorLSTM | ActuatorNetwork], **options: Any) -> Any:
    """A network whose torque is as large as the motor's."""
    law = kind(1, [16, 16], 1.0, params={"frictionloss": SIZE, "damping": SIZE}, **options)
    law.prepare(DriveState(*np.random.default_rng(0).normal(1.0, 3.0, size=(5, 500, 1))))
    with torch.no_grad():
        law.layers[-1].weight.mul_(100.0)
    return law


def run_law(law: FrictionModel, motor: Motor, lag: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position errors, velocities and drive torque in a random motion from rest, with a memory of zeros, in 64 bits."""
    rng, steps, whole = np.random.default_rng(seed), 80, int(np.ceil(lag))
    qvel, command = 3 * rng.normal(size=steps), np.pad(rng.normal(size=steps), (whole, 0))
    qpos, torques = np.cumsum(STEP * qvel), []  # as MuJoCo's and PhysX's steps
    memory, values = torch.zeros(1, law.memory, dtype=torch.float64), law.state_dict()
    for now in range(steps):
        late = command[now] + (whole - lag) * (command[now + 1] - command[now] if lag else 0)
        torque = torch.tensor([motor.torque(late, qpos[now], qvel[now]) + 0.25])
        none = torch.zeros(1, dtype=torch.float64)
        state = DriveState(none, torch.tensor([qvel[now]]), none, torque, none)
        terms, memory = law.advance(torch, values, state, memory, STEP)
        torques.append(float(torque - terms.torque))
    return command[whole:] - qpos, qvel, np.array(torques)


def test_a_run_suggests_a_target_that_exists() -> None:
    suggested = {name: MODELS.get(name).export_target for name in MODELS.names()}
    assert {*suggested.values()} <= {*TARGETS.names()}
    exact = {name for name, target in suggested.items() if target == "mjcf"}
    both = fz.law("by_joint", nv=2, laws={".*1": "baseline", ".*": "mujoco_default"})
    both.bind(["joint1", "joint2"])
    assert both.export_target == "mjcf"
    assert exact == {"baseline", "mujoco_default"} and suggested["stribeck"] == "mujoco"
    assert suggested["actuator_network"] == suggested["actuator_lstm"] == "actuator_net"


MOTORS = pytest.mark.parametrize("motor", [Motor(20.0, 0.5), Motor(20.0, 0.5, 6.0, 12.0, 8.0)], ids=["pd", "dc"])
LAGS = pytest.mark.parametrize("lag", [0.0, 0.3, 2.0, 6.28])


@MOTORS
@LAGS
def test_the_network_is_delay_controller_motor_and_model(lag: float, motor: Motor) -> None:
    """Of position errors and velocities alone, in 32 bits."""
    law = make_law(ActuatorNetwork, history=[0, 1, 4])
    network, found = DriveNetwork(motor, law, STEP, lag * STEP, 0.25), []
    errors, qvel, expected = run_law(law, motor, lag, 1)
    for now in range(len(qvel)):
        past = [np.resize(np.pad(signal[now::-1], (0, network.steps)), network.steps) for signal in (errors, qvel)]
        found.append(float(network(torch.tensor(np.concatenate(past), dtype=torch.float32)[None])))
    known = law.history[-1]  # steps with a complete history
    np.testing.assert_allclose(found[known:], expected[known:], atol=2e-5)
    assert np.ptp(expected) > 5


def run_isaaclab_lstm(file: Path, errors: np.ndarray, velocities: np.ndarray) -> np.ndarray:
    """What `ActuatorNetLSTM` of Isaac Lab 2.3.2 and 3.0.0 computes from its reset on, of shape (steps, joints)."""
    network = load_script(file)
    weights, count = network.lstm.state_dict(), errors.shape[1]
    sea_input = torch.zeros(count, 1, 2)
    shape = len(weights) // 4, count, weights["weight_hh_l0"].shape[1]
    hidden, cell, found = torch.zeros(shape), torch.zeros(shape), []
    for error, velocity in zip(torch.tensor(errors), torch.tensor(velocities), strict=True):
        sea_input[:, 0, 0], sea_input[:, 0, 1] = error, velocity
        with torch.inference_mode():
            torques, (hidden[:], cell[:]) = network(sea_input, (hidden, cell))
        found.append(torques.reshape(1, count)[0].numpy())
    return np.array(found)


@MOTORS
@LAGS
def test_isaac_lab_gives_the_torque_of_a_recurrent_law(tmp_path: Path, lag: float, motor: Motor) -> None:
    """From a reset, in 32 bits, for several joints at once."""
    law = make_law(ActuatorLSTM)
    with torch.no_grad():
        law.layers[0].weight[:, : law.units].mul_(10.0)  # of the memory
    network = RecurrentDriveNetwork(DriveNetwork(motor, law, STEP, lag * STEP, 0.25), law)
    (file := tmp_path / "actuator_net.pt").write_bytes(to_script(network, network.example, {}))
    errors, qvel, expected = np.stack([run_law(law, motor, lag, seed) for seed in range(3)], -1)
    found = run_isaaclab_lstm(file, errors, qvel)
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())
    recent = run_isaaclab_lstm(file, errors[-8:], qvel[-8:])[-1]  # more steps than the delay
    assert np.abs(recent - expected[-1]).max() > 1e-3 * np.ptp(expected), "it forgets within 8 steps"


OVERRIDES = {
    "sts3215": ("bench=sts3215", "bench.params.torque_offset.init=0.1"),
    "knee": ("bench.params.delay.init=0.0123",),
    "robot": ("bench.actuator._target_=frictionzoo.bench.JointPD", "+bench.actuator.params.torque_limit.init=1.5"),
}
SMALL = "laws.actuator_network.hidden=[8]"
LARGE = "laws.actuator_lstm.residual_limit=50.0"  # of a network that is nearly 0


@pytest.mark.slow
@pytest.mark.parametrize("bench", OVERRIDES)
def test_the_files_move_like_the_drive(tmp_path: Path, bench: str) -> None:
    """In MuJoCo C, with controllers of all kinds; ONNX Runtime gives the torque of TorchScript."""
    drive = fit("actuator_network", SMALL, *OVERRIDES[bench])
    position, torque = write("actuator_net", drive, tmp_path).differences
    assert (position.quantity, torque.quantity) == ("qpos", "torque")
    assert position.mean < 1e-3 and torque.largest < 1e-5 * max(1.0, drive.model.torque_scale.item())


@pytest.mark.slow
def test_a_recurrent_file_moves_like_the_drive(tmp_path: Path) -> None:
    (position,) = write("actuator_net", fit("actuator_lstm", LARGE, *OVERRIDES["knee"]), tmp_path).differences
    assert position.quantity == "qpos" and position.mean < 1e-3


def test_a_recurrent_network_is_written_for_isaac_lab_alone(tmp_path: Path) -> None:
    drive = draw("actuator_lstm", LARGE, "bench.params.delay.init=0.0035", "bench.params.delay.high=0.01")
    export = write("actuator_net", drive, tmp_path)
    assert {*export.files} == {"actuator_net.pt", "isaaclab_actuator_net.py"}
    assert any("mjlab" in limit and "Newton" in limit for limit in export.limits)
    config = read_config(tmp_path, "isaaclab_actuator_net.py", "isaaclab.actuators", "ActuatorNetLSTMCfg")
    assert {*vars(config)} == {
        *("joint_names_expr", "network_file", "saturation_effort", "effort_limit", "velocity_limit"),
        *("armature", "friction", "dynamic_friction", "viscous_friction"),
    }
    assert config.armature == drive.values["bench"]["armature"][0]
    rng = np.random.default_rng(0)
    torque = run_isaaclab_lstm(Path(config.network_file), *rng.normal(size=(2, 40, 5)))
    assert np.isfinite(torque).all() and np.ptp(torque) > 1


@pytest.mark.slow
def test_a_recurrent_network_learns_a_drive(finished_run: Callable, tmp_path: Path) -> None:
    drive = fz.load(finished_run("actuator_lstm")[0])
    assert drive.metrics["test"].position_mae < 0.2 * drive.metrics["baseline"].position_mae
    export = drive.export("actuator_net", tmp_path / "files").export
    assert export and export.differences[0].mean < 0.1 * drive.metrics["test"].position_mae


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    folder = tmp_path_factory.mktemp("actuator_net")
    drive = draw("actuator_network", SMALL, "bench.params.delay.init=0.0035", "bench.params.delay.high=0.01")
    write("actuator_net", drive, folder)
    return folder, drive


def read_config(folder: Path, name: str, module: str, cls: str) -> Any:
    """The configuration of the only joint; its class keeps the keywords, as the program's dataclass does."""
    names = [module.rpartition(".")[0], module] if module else []
    fakes: dict[str, Any] = {name: ModuleType(name) for name in names}
    if module:
        setattr(fakes[module], cls, SimpleNamespace)
    with pytest.MonkeyPatch.context() as patch:
        for name_of, fake in fakes.items():
            patch.setitem(sys.modules, name_of, fake)
        actuators = runpy.run_path(str(folder / name))["ACTUATORS"]
    (config,) = actuators.values() if isinstance(actuators, dict) else actuators
    return config


def run_isaaclab(config: Any, errors: Any, velocities: Any, network: Any) -> Any:
    """What `ActuatorNetMLP.compute` of Isaac Lab 2.3.2 and 3.0.0 does in its last step, from a history of zeros."""
    assert config.input_order == "pos_vel"
    picked = [np.pad(signal[::-1], (0, 99))[config.input_idx] for signal in (errors, velocities)]
    row = np.concatenate([picked[0] * config.pos_scale, picked[1] * config.vel_scale])
    torque = config.torque_scale * network(torch.tensor(row, dtype=torch.float32)[None])[0, 0]
    return clip_dc(config, torque, velocities[-1])


def run_mjlab(config: Any, errors: Any, velocities: Any, network: Any) -> Any:
    """What `LearnedMlpActuator.compute` of mjlab 1.6.0 does: a history filled with the first step."""
    assert config.input_order == "pos_vel"
    rows = [np.pad(signal[::-1], (0, 99), "edge")[: config.history_length] for signal in (errors, velocities)]
    row = np.concatenate([rows[0] * config.pos_scale, rows[1] * config.vel_scale])
    torque = config.torque_scale * network(torch.tensor(row, dtype=torch.float32)[None])[0, 0]
    return clip_dc(config, torque, velocities[-1])


def clip_dc(config: Any, torque: Any, velocity: float) -> Any:
    line = [config.saturation_effort * (sign - velocity / config.velocity_limit) for sign in (-1, 1)]
    return torch.clamp(torque, max(line[0], -config.effort_limit), min(line[1], config.effort_limit))


@pytest.mark.parametrize(
    ("name", "module", "cls", "run"),
    [
        ("isaaclab_actuator_net.py", "isaaclab.actuators", "ActuatorNetMLPCfg", run_isaaclab),
        ("mjlab_actuator_net.py", "mjlab.actuator", "LearnedMlpActuatorCfg", run_mjlab),
    ],
)
def test_a_programs_class_gives_the_torque_of_the_network(exported: Any, name: str, module: str, cls: str, run) -> None:
    folder, drive = exported
    config, rng = read_config(folder, name, module, cls), np.random.default_rng(0)
    network, errors, velocities = load_script(Path(config.network_file)), *rng.normal(size=(2, 40))
    (motor,) = motors(drive, {})
    ours = DriveNetwork(motor, drive.model, drive.timestep, 0.0035, 0.0)
    row = np.concatenate([signal[::-1][: ours.steps] for signal in (errors, velocities)])
    expected = ours(torch.tensor(row, dtype=torch.float32)[None]).item()
    assert run(config, errors, velocities, network).item() == pytest.approx(expected, rel=1e-6, abs=1e-6)
    assert config.armature == drive.values["bench"]["armature"][0]
    friction = {drive.values["friction"][name].item() for name in ("frictionloss", "damping")}
    assert friction <= {value for value in vars(config).values() if isinstance(value, float)}


def test_newton_reads_scales_and_steps_from_the_onnx_file(exported: Any) -> None:
    import onnx

    folder, drive = exported
    config = read_config(folder, "newton_actuator_net.py", "", "")
    model = onnx.load(config["model_path"])
    facts = {fact.key: fact.value for fact in model.metadata_props}
    steps = json.loads(facts["input_idx"])
    assert (facts["input_order"], steps) == ("pos_vel", [*range(2 + 4 + 1)])  # the history, the delay and the present
    assert [json.loads(facts[f"{name}_scale"]) for name in ("pos", "vel", "effort")] == [1.0, 1.0, 1.0]
    (tensor,) = model.graph.input
    assert tensor.type.tensor_type.shape.dim[1].dim_value == 2 * len(steps)
    known = {"Add", "Clip", "Constant", "Gemm", "MatMul", "Mul", "Relu", "Sub", "Tanh"}  # of warp-nn 0.4
    assert {node.op_type for node in model.graph.node} <= known
    assert config["friction"] == drive.values["friction"]["frictionloss"].item()


def test_what_cannot_be_an_actuator_network_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match="model=actuator_network"):
        write("actuator_net", draw("mujoco_default"), tmp_path)
    drive = draw("actuator_network", SMALL)
    moved = replace(drive, origin=draw("actuator_network", SMALL, "bench.timestep=0.002"))
    with pytest.raises(ExportError, match=r"timestep=0\.001.*bench\.timestep=0\.001"):
        write("actuator_net", moved, tmp_path)
    with pytest.raises(ExportError, match="Force"):
        write("actuator_net", draw("actuator_network", SMALL, "bench=emps"), tmp_path)


@pytest.mark.parametrize("history", [[0], [1, 2], [0, 2, 1], [0, 1, 1], [0, 10**9], []])
def test_a_history_that_does_not_ascend_from_0_is_refused(history: list[int]) -> None:
    with pytest.raises(ConfigError, match=r"model\.history="):
        ActuatorNetwork(1, [4], 1.0, history, 0, {"frictionloss": SIZE, "damping": SIZE})
