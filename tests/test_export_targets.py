"""What export targets write, run in the programs that it is for, against the fitted drive."""

import ast
import functools
import json
import shutil
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest
import torch
from conftest import make_run, slow_but, trace_nothing
from helpers.imports import imports
from omegaconf import OmegaConf

from frictionzoo.api.identified import Identified
from frictionzoo.bench import Bench, Robot
from frictionzoo.cli.finished import export as main
from frictionzoo.core.build import build
from frictionzoo.core.config import compose_config
from frictionzoo.core.errors import BenchError, ConfigError, ExportError
from frictionzoo.core.log import Payload
from frictionzoo.core.manifest import MANIFEST
from frictionzoo.core.segments import Segments
from frictionzoo.core.state import DriveState, FrictionTerms, Signals
from frictionzoo.export.base import Written, get_target, target_names
from frictionzoo.export.bench import write_bench
from frictionzoo.export.mjcf import Mjcf
from frictionzoo.export.module import load_module, write_module
from frictionzoo.export.motor import motors, read_inputs
from frictionzoo.export.mujoco_c import MujocoC, list_bristles, run_native, write_native
from frictionzoo.export.nearest import find_nearest
from frictionzoo.export.sdf import Sdf
from frictionzoo.export.simulate import run_loaded
from frictionzoo.export.skeleton import DRAKE
from frictionzoo.export.urdf import Urdf
from frictionzoo.export.write import summarise_exports, write_exports
from frictionzoo.models import FrictionModel, MujocoDefault, model_names
from frictionzoo.models.base import sliding_torque
from frictionzoo.models.by_name import complete_laws
from frictionzoo.models.network import NetworkModel
from frictionzoo.result.fitted_drive import FittedDrive

PAYLOAD = Payload(0.1, (0.0, 0.0, -0.05), (1e-4, 1e-4, 1e-5))
ROOT = Path(__file__).parent.parent
EXACT = 1e-9  # promised, rad; rounding of some hundred steps stays far below
ROBOT = """<mujoco>
  <!-- mine -->
  <compiler angle="radian"/>
  <option timestep="0.002"/>
  <default><joint damping="0.5"/><general gear="3"/></default>
  <worldbody>
    <body name="thigh"><geom size="0.1" mass="0.33333333333333331"/><joint name="hip" axis="0 1 0"/>
      <body name="shank" pos="0 0 -0.3"><geom size="0.05"/><joint name="knee" axis="0 1 0"/></body>
    </body>
  </worldbody>
  <actuator><position name="servo" joint="knee" kp="3" ctrlrange="-9 9" ctrllimited="true"/></actuator>
</mujoco>"""


class Rubbing(FrictionModel):
    """All terms at once, each of the state, and a spring that slips."""

    name = "rubbing"
    constraint = True
    memory = 1

    def terms(self, xp, values, state):
        pressed = 0.1 + 0.05 * xp.abs(state.external_torque) + 0.05 * xp.tanh(state.qpos) ** 2
        turning = 0.02 + 0.01 * xp.tanh(state.motor_torque) ** 2
        return FrictionTerms(torque=0.03 * xp.tanh(state.qvel), frictionloss=pressed, damping=turning)

    def advance(self, xp, values, state, memory, timestep):
        torque, frictionloss, damping = self.terms(xp, values, state)
        bent = xp.clip(memory[..., 0] + timestep * state.qvel, -0.02, 0.02)
        return FrictionTerms(torque + 2 * memory[..., 0], frictionloss, damping), bent[..., None]


@functools.cache
def compose(*overrides: str) -> dict:
    return OmegaConf.to_container(compose_config("data=twin", *overrides), resolve=True)


@functools.cache
def make_law(name: str, *overrides: str) -> FrictionModel:
    """A law as if identified; the usual configurations of all are composed at once."""
    names = [name] if overrides else model_names()
    config = compose(*(f"+model@laws.{name}={name}" for name in names), *overrides)
    law = build(complete_laws(config["laws"][name], config), nv=1)
    with torch.no_grad():  # so that it matters
        if isinstance(law, NetworkModel):
            law.layers[-1].weight.mul_(100.0)
        for name, param in law.params.items():
            if param.init == 0:
                law.get_parameter(name).fill_(0.3 * param.high)
    return law.double()


@functools.cache  # so that each is compiled once
def make_fitted(model: str | FrictionModel, *overrides: str, steps: int = 150) -> Identified:
    """A drive as if identified, and two rollouts of it; a command each that swings it back and forth."""
    law = model if isinstance(model, FrictionModel) else make_law(model, *overrides)
    bench: Bench = build(compose(*overrides)["bench"]).observing(law.inputs)
    interval = bench.timestep
    history = bench.sampling(interval).history
    time = interval * np.arange(-history, steps)[:, None]
    swings = np.stack([0.5 * np.sin(30 * time + phase + np.arange(bench.nv)) for phase in (0.3, 2.0)])
    inputs = {"gain": 20.0, "supply": 48.0, "enable": 1.0, "temperature": 40 + 10 * np.sin(20 * time)}
    inputs |= {"kp": 20 + np.cos(9 * time), "kd": 1.0}
    inputs |= {"ctrl_velocity": np.cos(30 * time), "ctrl_torque": np.sin(9 * time)}
    recorded = {name: np.full_like(swings, inputs[name]) for name in bench.inputs}
    states = np.random.default_rng(0).normal(scale=0.2, size=(2, 2, steps + 1, bench.nv))
    load = None if bench.payload is None else np.stack(2 * [bench.load(PAYLOAD)])
    observed = {name: recorded.pop(name) for name in law.inputs}
    segments = Segments(*states, Signals(swings, recorded, observed), interval, load)
    values = {"bench": bench.initial_values(), "friction": {k: v.detach().numpy() for k, v in law.state_dict().items()}}
    if bench.nv > 1:
        differing = {"armature": np.array([0.02, 0.05]), "delay": np.array([0.0034, 0.0012])}
        values["bench"] |= {name: value for name, value in differing.items() if name in values["bench"]}
    result = make_run(0, law.name, bench.nv).result
    result.settings, result.metrics.test.position_mae, result.parameters = compose(*overrides), 0.01, []
    sampling = bench.sampling(interval)
    return Identified(Path("run"), result, bench, law, {}, values, segments, sampling, trace_nothing(segments))


def known(size):
    return {"init": size, "low": 1e-6, "high": 10.0, "scale": "log", "identify": True}


FRICTION = {"frictionloss": known(0.2), "damping": known(0.03)}
RUBBING, TWO_RUBBING = (Rubbing(nv).double() for nv in (1, 2))
LATE = "bench.params.delay={init: 0.0034, low: 0.0, high: 0.02, scale: 0.01, identify: true}"
STIFF = "bench.solreffriction=[0.01,1.0]"
KNEE = ("mujoco_default", LATE, STIFF)
SERVO = ("temperature_linear", "bench=xl330")  # with a payload, at a temperature
LIMIT = "{init: 6.0, low: 1.0, high: 9.0, scale: log, identify: false}"
JOINT = ("mujoco_default", LATE, "bench.actuator._target_=frictionzoo.bench.JointPD")
LIMITED = (*JOINT, f"+bench.actuator.params.torque_limit={LIMIT}")
LATE_SERVO = ("mujoco_default", "bench=xl330", LATE)
SLIDE = ("mujoco_default", "bench=emps")
JOINTS = "bench.joint=[shoulder,elbow]"
ARM = """<mujoco><compiler angle="radian"/><option timestep="0.001"><flag contact="disable"/></option>
  <worldbody><body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.01"/>
    <inertial pos="0 0 -0.15" mass="0.5" diaginertia="0.004 0.004 0.001"/>
    <body name="lower" pos="0 0 -0.3"><joint name="elbow" axis="0 1 0"/>
      <inertial pos="0 0 -0.1" mass="0.2" diaginertia="0.001 0.001 0.0005"/></body></body></worldbody></mujoco>"""
# Turned links, a joint beside its body's frame, a link that does not move.
LEANING = """<mujoco><compiler angle="radian"/><option timestep="0.001" gravity="1 0 -9"/>
  <option><flag contact="disable"/></option><worldbody>
  <body name="foot" pos="0 0.1 0.2" euler="0.3 0.2 0"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
    <body name="upper" pos="0 0.1 0" euler="0.4 -0.5 0.6"><joint name="shoulder" axis="0 1 0.5" pos="0.01 0.02 0.3"/>
      <inertial pos="0 0.1 -0.15" euler="0.1 0.7 0.2" mass="0.5" diaginertia="0.004 0.003 0.002"/>
      <body name="lower" pos="0 0 -0.3" euler="0 0 1"><joint name="elbow" axis="1 1 0" damping="0.01"/>
        <inertial pos="0 0 -0.1" mass="0.2" diaginertia="0.001 0.001 0.0005"/></body></body></body></worldbody>
</mujoco>"""


@pytest.fixture(scope="module")
def benches(tmp_path_factory):
    folder = tmp_path_factory.mktemp("benches")
    for name, text in {"arm": ARM, "leaning": LEANING}.items():
        (folder / f"{name}.xml").write_text(text)
    return folder


def two_joints(benches, law, bench, *more):
    """A drive of two joints that differ."""
    return make_fitted(law, f"bench.mjcf={benches / bench}.xml", JOINTS, *more)


def write_drive(law, folder, target):
    """The module alone, imported."""
    name, more = f"{target}_drive.py", {"example_install": "", "late_remark": ""}
    assert name in write_module(make_fitted(law), folder, f"{name}.jinja", name, **more)
    return load_module(folder / name)


@pytest.mark.parametrize("law", [*model_names(), RUBBING], ids=lambda law: getattr(law, "name", law))
def test_a_modules_law_is_the_fitted_one(law, tmp_path):
    """In random states, one after the other where it remembers, in numpy; both modules hold the same text."""
    model, memory, rng = make_fitted(law).model, None, np.random.default_rng(0)
    modules = [write_drive(law, tmp_path, target) for target in ("mujoco", "mjx")]
    for _ in range(3):
        observed = {name: value + 10 * rng.normal(size=(20, 1)) for name, value in model.inputs.items()}
        state = DriveState(*rng.normal(size=(5, 20, 1)), **observed)
        tensors, values = state.map(torch.tensor), dict(model.state_dict())
        memory = model.settle(torch, values, tensors) if memory is None else memory
        before = memory.detach().numpy()
        expected, memory = model.advance(torch, values, tensors, memory, 0.001)
        for module in modules:
            given = module.VALUES, module.DriveState(**state.given())
            if not model.memory:
                came = module.Law().terms(np, *given)
            else:
                np.testing.assert_allclose(module.Law().settle(np, *given), model.settle(torch, values, tensors))
                came, after = module.Law().advance(np, *given, before, 0.001)
                np.testing.assert_allclose(after, memory.detach(), rtol=1e-10, atol=1e-14)
            for one, other in zip(came, expected, strict=True):
                assert (one is None) == (other is None)
                if one is not None:
                    np.testing.assert_allclose(one, other.detach(), rtol=1e-10, atol=1e-14)


MOVES = [  # target and options, drive
    ("mujoco", ("history_network",)),  # it remembers
    *(("mujoco", drive) for drive in (SERVO, LIMITED)),
    *(("mjx", drive) for drive in (SERVO, LIMITED)),
    ("mjcf", JOINT),
    *((target, ("arm", TWO_RUBBING, LATE)) for target in ("mujoco", "mjx")),  # all terms, a memory, late commands
    ("mjcf", ("arm", MujocoDefault(2, FRICTION), LATE)),
    *((target, LATE_SERVO) for target in ("urdf", "sdf")),
    *(("sdf armature=links", drive) for drive in (("mujoco_default",), SLIDE)),
]
SLOW = [("mjx", SERVO), ("mjx", LIMITED), MOVES[8]]


@pytest.mark.parametrize(("target", "drive"), slow_but([case for case in MOVES if case not in SLOW], MOVES))
def test_files_move_as_the_drive(target, drive, benches, tmp_path):
    bench, *others = drive
    fitted = two_joints(benches, others[0], bench, *others[1:]) if bench == "arm" else make_fitted(*drive)
    name, *options = target.split()
    export = get_target(name)().write(fitted, tmp_path, dict(option.split("=") for option in options))
    assert {path.name for path in tmp_path.iterdir() if path.is_file()} == set(export.files)
    assert drive == SLIDE or np.ptp(fitted.rollout()[0], axis=(0, 1)).min() > 0.1
    assert export.differences[0].largest < EXACT


def put_into_robot(tmp_path, **options):
    """The written file, the export, its compiled model and the drive's values."""
    (tmp_path / "robot.xml").write_text(ROBOT)
    folder, fitted = tmp_path / "export", make_fitted(*KNEE)
    folder.mkdir()
    export = Mjcf().write(fitted, folder, {"into": str(tmp_path / "robot.xml"), **options})
    model = mujoco.MjModel.from_xml_path(str(folder / "robot.xml"))
    return folder / "robot.xml", export, model, {**fitted.values["bench"], **fitted.values["friction"]}


def test_a_robots_joint_gets_the_drive_and_nothing_else_changes(tmp_path):
    path, export, model, values = put_into_robot(tmp_path)
    before, knee, hip = mujoco.MjModel.from_xml_string(ROBOT), model.joint("knee"), model.joint("hip")
    assert knee.armature == values["armature"]
    assert (knee.frictionloss, knee.damping[0]) == (values["frictionloss"], values["damping"])
    assert hip.damping[0] == 0.5 and hip.frictionloss == 0 and hip.armature == 0
    np.testing.assert_array_equal(model.body_mass, before.body_mass)  # to the last digit
    assert "<!-- mine -->" in path.read_text()
    servo = model.actuator("servo")  # keeps its name, and its range for a joint that moves without gear
    assert servo.gainprm[0] == 20 and servo.gear[0] == 1
    np.testing.assert_array_equal(servo.ctrlrange, [-3, 3])
    assert export.differences[1].quantity == "torque"
    assert export.differences[1].largest < EXACT
    assert any("timestep is 0.002 s" in limit for limit in export.limits)


def test_a_drive_goes_into_several_joints_and_adds_their_actuators(tmp_path):
    path, export, model, values = put_into_robot(tmp_path, joint="hip,knee")
    np.testing.assert_array_equal(model.dof_armature, np.repeat(values["armature"], 2))
    assert model.nu == 2
    np.testing.assert_array_equal(model.actuator_delay, [0.0034, 0.0034])
    own = mujoco.MjModel.from_xml_path(str(path.with_name("bench.xml")))
    np.testing.assert_array_equal(model.dof_solref, np.repeat(own.dof_solref, 2, axis=0))
    assert "nsample" in path.with_name("bench.xml").read_text()  # late there, too
    assert max(difference.largest for difference in export.differences) < EXACT


def test_a_robots_actuators_can_stay(tmp_path):
    _, export, model, _ = put_into_robot(tmp_path, actuator="keep")
    assert model.nu == 1 and model.actuator("servo").gainprm[0] == 3
    assert export.differences[1].largest == 0


def test_another_law_is_refitted_and_says_what_that_costs(tmp_path):
    fitted = make_fitted("lugre")
    (limit,) = Mjcf().write(fitted, tmp_path, {}).limits
    after, before = (float(text.split()[-1].lstrip("(")) for text in limit.split(" rad")[:2])
    assert "cannot represent lugre" in limit
    assert 0 < after < before  # the refit is no worse than truncation
    written = Written("mjcf", tmp_path, Mjcf().write(fitted, tmp_path, {}), error=after)
    (row,) = [line for line in summarise_exports([written]).splitlines() if "far from the drive" in line]
    assert row.startswith("mjcf") and row.endswith("of the test error: frictionloss and damping cannot represent lugre")
    assert "far from the drive" not in summarise_exports([replace(written, error=100 * before)])
    came = run_loaded(mujoco.MjModel.from_xml_path(str(tmp_path / "bench.xml")), fitted)
    rms = np.sqrt(np.mean(np.square(came - fitted.rollout()[0])))
    assert rms == pytest.approx(after, rel=1e-2)  # three digits are printed


def test_bristles_are_mujocos_own_as_steps_get_short(tmp_path):
    """The equations are one, so that half the step halves the difference; the numbers are all in the file."""
    fitted, largest = make_fitted("lugre"), []
    for drive in (fitted, fitted.at(0.0005)):
        (difference,) = MujocoC().write(drive, tmp_path, {"law": "native"}).differences
        assert "step's beginning" in difference.reason
        largest.append(difference.largest)
    assert 1e-6 < largest[1] < 0.6 * largest[0] < 1e-3
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "bench.xml"))
    friction = {name: float(value[0]) for name, value in fitted.values["friction"].items()}
    bias, bristles = model.actuator("knee_friction").biasprm, model.actuator("knee_friction").dynprm
    assert bias[3:6].tolist() == [friction[n] for n in ("kinetic_torque", "static_torque", "stribeck_velocity")]
    assert bristles[5:7].tolist() == [friction["stiffness"], friction["micro_damping"]]
    assert model.dof_damping == friction["viscous_coefficient"] and model.na == 1


@pytest.mark.parametrize("law", ["dahl", "torque_proportional", "maxwell_slip"])
@pytest.mark.parametrize("target", ["mujoco", "mjx"])
def test_springs_of_a_drive_in_continuous_time_are_written_as_they_act(law, target, tmp_path):
    fitted = make_fitted(law, "bench.second_order=true").at(0.002)
    (difference,) = get_target(target)().write(fitted, tmp_path, {}).differences
    assert fitted.is_simulated and difference.largest < 1e-12


@pytest.mark.parametrize("law", ["lugre", "dahl"])
def test_a_drive_of_bristles_comes_back_from_mujocos_own(law, tmp_path):
    """Written, read as a robot's file, and written again, it is the same drive: in MuJoCo C, and in this simulator."""
    made = make_fitted(law)
    friction = {n: v if n == "rest_velocity" else 1.07 * v for n, v in made.values["friction"].items()}
    fitted = replace(
        made, values={"bench": made.values["bench"] | {"armature": np.array([0.0123])}, "friction": friction}
    )
    text = write_native(fitted)
    (tmp_path / "robot.xml").write_text(text)
    robot = Robot(str(tmp_path / "robot.xml"))
    read = robot.initial_friction(fitted.model.params)
    assert read.keys() == friction.keys() - {"rest_velocity"}
    for name, value in read.items():
        np.testing.assert_allclose(value, friction[name], rtol=1e-15)
    signals = fitted.segments.signals
    signals = signals._replace(inputs={name: np.zeros_like(signals.ctrl) for name in robot.inputs})
    values = {"bench": robot.initial_values(), "friction": friction | read}
    back = replace(fitted, bench=robot, values=values, segments=replace(fitted.segments, signals=signals))
    again = write_native(back)
    np.testing.assert_allclose(run_native(again, back), run_native(text, fitted), rtol=0, atol=1e-13)
    np.testing.assert_allclose(back.rollout()[0], fitted.rollout()[0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("law", ["lugre", "dahl"])
def test_mjlab_gets_the_bristles_in_a_motor(law, tmp_path):
    fitted = make_fitted(law)
    export = get_target("mjlab")().write(fitted, tmp_path, {})
    tree = ast.parse((tmp_path / "mjlab_actuators.py").read_text())
    (outer,) = [node.value for node in tree.body if isinstance(node, ast.Assign)]
    (call,) = outer.elts
    (physical,) = [k.value for k in call.keywords if isinstance(k.value, ast.Call)]
    of = {k.arg: ast.literal_eval(k.value) for k in call.keywords if not isinstance(k.value, ast.Call)}
    constants = {k.arg: ast.literal_eval(k.value) for k in physical.keywords}
    assert [list(of["lugre"])] == list_bristles(fitted) and of["armature"] == fitted.values["bench"]["armature"]
    (motor,) = motors(fitted, read_inputs(fitted, {}))
    for ctrl, qpos, qvel in np.random.default_rng(0).uniform(-3, 3, size=(50, 3)):  # MuJoCo 3.11's dcmotor
        volts = of["stiffness"] * (ctrl - qpos) - of["damping"] * qvel
        volts = np.clip(volts, -of["voltage_limit"], of["voltage_limit"])
        torque = constants["kt"] * (volts - constants["ke"] * qvel) / constants["resistance"]
        assert torque == pytest.approx(motor.torque(ctrl, qpos, qvel), abs=1e-7)
    assert export.differences[0].largest < 0.01  # rad; bristles begin without load


@pytest.mark.parametrize("target", ["onnx", "torchscript"])
def test_a_law_that_remembers_is_no_function_of_an_instant(target, tmp_path, monkeypatch):
    monkeypatch.setattr(FittedDrive, "load", lambda folder: make_fitted("lugre"))
    with pytest.raises(ExportError, match=f"target={target}: lugre has memory, expected"):
        write_exports(tmp_path, {"target": target, "output": str(tmp_path / "drive")})
    assert list(tmp_path.iterdir()) == []


def test_a_module_remembers_steps_and_not_calls(tmp_path):
    """Installed, it acts in mj_step.

    mj_forward between steps changes nothing; a reset, by MuJoCo or by hand, begins as the first step does.
    """
    fitted = make_fitted("lugre")
    MujocoC().write(fitted, tmp_path, {})
    module = load_module(tmp_path / "drive.py")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "bench.xml"))
    data, drive = mujoco.MjData(model), module.Drive(model)
    commands, expected = fitted.segments.acting.ctrl[0], fitted.rollout()[0][0]

    def run(forward: bool) -> np.ndarray:
        data.qpos[:], data.qvel[:] = fitted.segments.qpos[0, 0], fitted.segments.qvel[0, 0]
        found = []
        for command in commands:
            data.ctrl[:] = command
            if forward:
                mujoco.mj_forward(model, data)
            mujoco.mj_step(model, data)
            found.append(data.qpos.copy())
        return np.array(found)

    drive.install()
    try:
        runs = {"plain": run(False)}
        mujoco.mj_resetData(model, data)
        runs["forward"] = run(True)
        drive.reset()
        runs["reset by hand"] = run(False)
        runs["no reset"] = run(False)
    finally:
        mujoco.set_mjcb_control(None)
    distance = {name: np.abs(qpos - expected).max() for name, qpos in runs.items()}
    assert max(distance[name] for name in ("plain", "forward", "reset by hand")) < EXACT
    assert distance["no reset"] > 1e-6  # the bristles are still bent


@pytest.mark.parametrize("target", ["mujoco", "mjx"])
def test_a_module_needs_nothing_of_this_package(target, tmp_path):
    module = write_drive("history_network", tmp_path, target)
    assert sorted(path.name for path in tmp_path.iterdir() if path.is_file()) == [f"{target}_drive.py", "weights.npz"]
    imported = {name.split(".")[0] for name in imports(ast.parse(Path(module.__file__).read_text()))}
    assert not imported & {"frictionzoo", "torch", "hydra"}


def test_friction_torque_over_jax_is_the_laws(tmp_path):
    samples = DriveState(*np.random.default_rng(0).normal(size=(5, 20, 1)))
    with jax.enable_x64(True):
        torque = np.asarray(write_drive(RUBBING, tmp_path, "mjx").friction_torque(**samples.given()))
    expected = sliding_torque(np, RUBBING.terms(np, {}, samples), samples.qvel)
    np.testing.assert_allclose(torque, expected, rtol=1e-12)


class Hidden(FrictionModel):
    """A law that keeps what cannot be written down."""

    name, table = "hidden", np.ones(1)

    def terms(self, xp, values, state):
        return FrictionTerms(torque=self.table * state.qvel)


STS3215 = ("mujoco_default", "bench=sts3215", "bench.timestep=0.001")
UPRIGHT = (*SLIDE, "+bench.gravity=[9.81,0,0]")
REFUSED = [  # drive, target and options, error, what it names
    *((("coulomb_stribeck",), "mujoco law=native", ExportError, "law=native"),),
    *((("lugre",), "mujoco law=own", ConfigError, "law=own"), ((Hidden(1),), "mujoco", ExportError, "Hidden: table")),
    *((("coulomb_stribeck",), "onnx dtype=float16", ConfigError, "dtype=float16"),),
    *((KNEE, "bam", ExportError, "PositionPD"), (STS3215, "bam servo=sts321", ConfigError, "did you mean sts3215")),
    *((SLIDE, target, ExportError, "Force") for target in ("mjlab", "isaaclab")),
    (("mujoco_default", "bench=xl330"), "sdf armature=links", ExportError, "payload"),
    (UPRIGHT, "sdf armature=links", ExportError, "gravity acts along the slide carriage"),
    (SLIDE, "sdf armature=rotor", ConfigError, "armature=rotor"),
    (KNEE, "mjcf into=nowhere.xml", ConfigError, "into=nowhere.xml: No such file"),
    (KNEE, "mjcf into=robot.xml joint=kneee", ConfigError, "joint=kneee: .*did you mean knee"),
    (KNEE, "mjcf into=robot.xml joint=knee,knee", ConfigError, "joint=knee,knee"),
    (KNEE, "mjcf into=notes.xml", ConfigError, "into=notes.xml: <notes>"),
    (KNEE, "mjcf into=broken.xml", ConfigError, "into=broken.xml: not XML"),
    (KNEE, "mjcf into=empty.xml", BenchError, "empty.xml"),
    (KNEE, "mjcf into=slide.xml", ExportError, "joint=knee: .*expected a hinge"),
    (KNEE, "mjcf into=robot.xml actuator=mine", ConfigError, "actuator=mine"),
    (KNEE, "mjcf into=parts.xml", ConfigError, "into=parts.xml: .*<include>"),
    (KNEE, "mjcf into=twice.xml", ConfigError, "joint=knee: 2 actuators"),
    (KNEE, "mjcf joint=knee", ConfigError, "joint=knee without into"),
]


@pytest.mark.parametrize(("drive", "target", "error", "named"), REFUSED, ids=[f"{c[1]}-{c[3]}" for c in REFUSED])
def test_what_a_target_cannot_write_is_refused_in_a_line(drive, target, error, named, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    texts = {
        "robot": ROBOT,
        "notes": "<notes/>",
        "broken": "<mujoco",
        "parts": ROBOT.replace("<actuator>", '<include file="a.xml"/><actuator>'),
        "twice": ROBOT.replace("</actuator>", '<motor joint="knee"/></actuator>'),
        "slide": ROBOT.replace('name="knee"', 'name="knee" type="slide"'),
        "empty": '<mujoco><worldbody><body><joint name="knee" mass="1"/></body></worldbody></mujoco>',
    }
    for name, text in texts.items():
        Path(f"{name}.xml").write_text(text)
    name, *options = target.split()
    with pytest.raises(error, match=named) as caught:
        get_target(name)().write(make_fitted(*drive), tmp_path, dict(option.split("=") for option in options))
    assert "\n" not in str(caught.value)


def test_a_longer_step_keeps_every_other_sample_and_its_history():
    fitted = make_fitted(*KNEE)
    slower = fitted.at(0.002)
    assert slower.timestep == 0.002 and slower.segments.length == fitted.segments.length // 2
    np.testing.assert_array_equal(slower.segments.qpos, fitted.segments.qpos[:, ::2])
    np.testing.assert_array_equal(slower.segments.acting.ctrl, fitted.segments.acting.ctrl[:, ::2])
    assert slower.segments.history == slower.sampling.history == 10
    np.testing.assert_array_equal(slower.segments.signals.ctrl, fitted.segments.signals.ctrl[:, ::2])
    faster = fitted.at(0.0005)
    assert faster.timestep == 0.0005 and faster.segments.length == fitted.segments.length
    assert faster.sampling.substeps == 2 and faster.sampling.history == fitted.sampling.history
    with pytest.raises(ConfigError, match=r"timestep=0\.00137; expected"):
        fitted.at(0.00137)


@pytest.fixture
def run_folder(finished_run):
    return finished_run("mujoco_default")[0]


def export(capsys, *arguments):
    status = 0
    try:
        main([str(argument) for argument in arguments])
    except SystemExit as end:
        status = end.code
    written = capsys.readouterr()
    return status, written.out, written.err


def test_the_command_writes_a_run_and_a_note(run_folder, tmp_path, capsys):
    place = tmp_path / "here"
    for _ in range(2):  # an older export is replaced
        status, out, err = export(capsys, run_folder, "target=mjcf", f"output={place}")
        assert (status, err) == (0, "")
    assert "mjcf" in out and "qpos [rad]" in out and str(place) in out
    assert sorted(path.name for path in place.iterdir()) == [MANIFEST, "bench.xml", "export.json"]
    note = json.loads((place / "export.json").read_text())
    assert note["target"] == "mjcf" and note["files"] == ["bench.xml"] and note["timestep"] == 0.001
    assert note["versions"]["mujoco"] == mujoco.__version__
    (difference,) = note["differences"]
    assert difference["largest"] < EXACT and difference["mark"] == difference["reason"] == ""
    assert note["error"] == Identified.load(run_folder).result["metrics"]["test"]["position_mae"]
    # A run keeps what was exported, to its last digit.
    values, model = Identified.load(run_folder).values, mujoco.MjModel.from_xml_path(str(place / "bench.xml"))
    assert model.dof_frictionloss == values["friction"]["frictionloss"]


def test_another_time_step_says_what_it_changes(run_folder, tmp_path, capsys):
    status, out, _ = export(capsys, run_folder, "target=mjcf", "timestep=0.0005", f"output={tmp_path / 'fine'}")
    assert status == 0
    moved = out.split("In steps of 0.0005 s the drive moves differently")[1]
    assert 0 < float(moved.split(" rad")[1].split()[-1]) < 0.01  # both converge to one motion
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "fine" / "bench.xml")).opt.timestep == 0.0005
    (difference,) = json.loads((tmp_path / "fine" / "export.json").read_text())["differences"]
    assert difference["largest"] < EXACT


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["target=mjc"], "target=mjc: no such target; did you mean mjcf?"),
        ([], "target is missing"),
        (["mjcf"], "mjcf: expected KEY=VALUE"),
        (["target=mjcf", "target=mjx"], "target=mjx: target is given twice"),
        (["target=mujoco", "into=robot.xml"], "into: unknown option of target=mujoco"),
        (["target=mjcf", "timestep=fast"], "timestep=fast: expected a number"),
        (["target=mjcf", "timestep=-1"], "timestep=-1; expected a step"),
        (["target=mjcf", "output=taken"], "taken/export.json: not written by this program"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_a_mistake_is_one_line_and_leaves_nothing(run_folder, tmp_path, capsys, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    Path("taken").mkdir()
    Path("taken/export.json").write_text("years")
    before = sorted(path.name for path in run_folder.iterdir())
    status, out, err = export(capsys, run_folder, *arguments)
    assert (status, out) == (2, "") and err.startswith(f"frictionzoo: {message}") and err.count("\n") == 1
    assert sorted(path.name for path in run_folder.iterdir()) == before
    assert Path("taken/export.json").read_text() == "years"


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("result.json", None, "expected the folder of a finished run"),
        ("result.json", b"{", "not JSON"),
        ("friction.safetensors", None, "No such file"),
        ("friction.safetensors", b"\x80\x04K\x00.", "expected the values of mujoco_default"),
        ("curves.safetensors", b"", "expected the file that this version writes"),
    ],
)
def test_a_damaged_run_is_one_line(run_folder, tmp_path, capsys, file, content, message):
    damaged = tmp_path / "run"
    shutil.copytree(run_folder, damaged)
    (damaged / file).unlink() if content is None else (damaged / file).write_bytes(content)
    status, _, err = export(capsys, damaged, "target=mjcf")
    assert status == 2 and message in err and err.count("\n") == 1
    assert not (damaged / "export").exists()


def test_targets_are_those_of_the_guide():
    guide = (ROOT / "docs" / "export.md").read_text()
    assert {"mjcf", "mjx", "mujoco"} <= set(target_names())
    for name in ("mjcf", "mjx", "mujoco"):
        assert f"`{name}`" in guide
        for option in get_target(name).options:
            assert f"`{option}=" in guide, option


@pytest.mark.parametrize("target", ["urdf", "sdf"])
def test_links_have_friction_and_the_armature_that_drake_reads(target, benches, tmp_path):
    fitted = two_joints(benches, MujocoDefault(2, FRICTION), "leaning")
    export = get_target(target)().write(fitted, tmp_path, {})
    assert export.differences[0].largest < EXACT and np.ptp(fitted.rollout()[0], axis=(0, 1)).min() > 0.1
    assert any("0.02, 0.05 kg m^2" in limit for limit in export.limits)
    (file,), bench = export.files, mujoco.MjModel.from_xml_string(write_bench(fitted, find_nearest(fitted)))
    root = ET.parse(tmp_path / file).getroot()
    joints = {joint.get("name"): joint for joint in root.iter("joint") if joint.get("type")}
    kinds = ["fixed", *2 * ["revolute" if target == "sdf" else "continuous"]]
    assert [joint.get("type") for joint in joints.values()] == kinds
    assert [float(of(tag)) for tag in root.iter("mass")] == bench.body_mass[1:].tolist()
    armatures = [float(of(tag)) for tag in root.iter(f"{{{DRAKE}}}rotor_inertia")]
    assert armatures == fitted.values["bench"]["armature"].tolist()
    for index, name in enumerate(fitted.bench.joints):
        axis, dynamics = joints[name].find("axis"), joints[name].find(".//dynamics")
        text = axis.get("xyz") or axis.findtext("xyz")
        assert [float(word) for word in text.split()] == bench.joint(name).axis.tolist()
        own = {"damping": bench.dof_damping[index], "friction": bench.dof_frictionloss[index]}
        assert {key: float(dynamics.get(key) or dynamics.findtext(key)) for key in own} == own
    if target == "urdf":
        controlled = root.findall("ros2_control/joint")
        assert [joint.find("command_interface").get("name") for joint in controlled] == 2 * ["position"]
        gains = {param.get("name"): float(param.text) for param in controlled[0].findall("param")}
        assert gains == {"stiffness": fitted.values["bench"]["kp"][0], "damping": fitted.values["bench"]["kd"][0]}


def of(tag):
    """The value of an element: its attribute in URDF, its text in SDFormat."""
    return tag.get("value") or tag.text


def test_a_servos_gains_are_those_at_the_given_supply(tmp_path):
    export = Urdf().write(make_fitted(*LATE_SERVO), tmp_path, {"supply": "7.4"})
    assert any("supply 7.4" in limit for limit in export.limits)


def test_an_sdf_has_one_name_for_one_thing(tmp_path):
    """The carriage slides on a joint of its name."""
    fitted = make_fitted(*SLIDE)
    assert Sdf().write(fitted, tmp_path, {}).differences[0].largest < EXACT
    root = ET.parse(tmp_path / "bench.sdf").getroot()
    (link,), (joint,) = root.iter("link"), root.iter("joint")
    assert (link.get("name"), joint.get("name"), joint.get("type")) == ("carriage_link", "carriage", "prismatic")
    inertia = {tag.tag: float(tag.text) for tag in link.find("inertial/inertia")}
    assert inertia == {"ixx": 1e-6, "iyy": 1e-6, "izz": 1e-6, "ixy": 0, "ixz": 0, "iyz": 0}


@pytest.mark.parametrize("drive", [("mujoco_default",), SLIDE], ids=["hinge", "slide"])
def test_links_with_the_armature_are_bodies_without_rotors(drive, tmp_path):
    export = Sdf().write(make_fitted(*drive), tmp_path, {"armature": "links"})
    assert any("in the links" in limit for limit in export.limits)
    root = ET.parse(tmp_path / "bench.sdf").getroot()
    inertia = {tag.tag: float(tag.text) for tag in root.find(".//inertia")}
    assert root.find(f".//{{{DRAKE}}}rotor_inertia") is None
    assert inertia["ixx"] + inertia["izz"] > inertia["iyy"]


@pytest.mark.slow
@pytest.mark.usefixtures("in_haste")
def test_a_law_of_several_joints_is_refitted_joint_by_joint(benches):
    fitted = two_joints(benches, Rubbing(2), "arm")
    nearest = find_nearest(fitted)
    # The law lies between 0.1 and 0.2 N m, and its armatures are not confused.
    assert ((nearest.frictionloss > 0.05) & (nearest.frictionloss < 0.4)).all()
    np.testing.assert_allclose(nearest.bench["armature"], [0.02, 0.05], rtol=0.5)
    np.testing.assert_array_equal(nearest.bench["kp"], fitted.values["bench"]["kp"])


def test_a_module_refuses_a_model_that_it_would_simulate_wrongly(tmp_path):
    MujocoC().write(make_fitted("coulomb_stribeck"), tmp_path, {})
    drive, bench = load_module(tmp_path / "drive.py").Drive, (tmp_path / "bench.xml").read_text()
    cases = {
        "integrator RK4, expected": bench.replace('integrator="Euler"', 'integrator="RK4"'),
        "knee: frictionloss in the model, expected none": bench.replace(
            'name="knee"', 'name="knee" frictionloss="1"', 1
        ),
        "knee: 0 actuators, expected one": bench[: bench.index("<actuator>")] + "</mujoco>",
    }
    for message, text in cases.items():
        with pytest.raises(ValueError, match=message):
            drive(mujoco.MjModel.from_xml_string(text))
