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
from conftest import trace_nothing
from omegaconf import OmegaConf
from test_levels import imports

from frictionzoo.api.identified import Identified
from frictionzoo.bench import Bench, Robot
from frictionzoo.cli.finished import export as main
from frictionzoo.core.build import build
from frictionzoo.core.config import compose_config
from frictionzoo.core.errors import ConfigError, ExportError, FrictionzooError
from frictionzoo.core.log import Payload
from frictionzoo.core.manifest import MANIFEST
from frictionzoo.core.segments import Segments
from frictionzoo.core.state import DriveState, FrictionTerms, Signals
from frictionzoo.export.base import Written, get_target, target_names
from frictionzoo.export.bench import Mjcf, write_bench
from frictionzoo.export.mjx_module import Mjx
from frictionzoo.export.module import load_module, write_module
from frictionzoo.export.mujoco_c import MujocoC, run_native, write_native
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
URDF = """<robot name="leg"><link name="base"/>
  <link name="shank"><inertial><mass value="1"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="knee" type="revolute"><parent link="base"/><child link="shank"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="2" velocity="3"/></joint></robot>"""


class Rubbing(FrictionModel):
    """All terms at once, each of the state, and a spring that slips."""

    name = "rubbing"
    constraint = True
    memory = 1

    def terms(self, xp, values, state):
        """Every term."""
        pressed = 0.1 + 0.05 * xp.abs(state.external_torque) + 0.05 * xp.tanh(state.qpos) ** 2
        turning = 0.02 + 0.01 * xp.tanh(state.motor_torque) ** 2
        return FrictionTerms(torque=0.03 * xp.tanh(state.qvel), frictionloss=pressed, damping=turning)

    def advance(self, xp, values, state, memory, timestep):
        """Every term, and the spring."""
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
    inputs |= {
        "kp": 20 + np.cos(9 * time),
        "kd": 1.0,
        "ctrl_velocity": np.cos(30 * time),
        "ctrl_torque": np.sin(9 * time),
    }
    recorded = {name: np.full_like(swings, inputs[name]) for name in bench.inputs}
    states = np.random.default_rng(0).normal(scale=0.2, size=(2, 2, steps + 1, bench.nv))
    load = None if bench.payload is None else np.stack(2 * [bench.load(PAYLOAD)])
    observed = {name: recorded.pop(name) for name in law.inputs}
    segments = Segments(*states, Signals(swings, recorded, observed), interval, load)
    values = {"bench": bench.initial_values(), "friction": {k: v.detach().numpy() for k, v in law.state_dict().items()}}
    result = {"settings": compose(*overrides), "model": law.name, "metrics": {"test": {"position_mae": 0.01}}}
    sampling = bench.sampling(interval)
    return Identified(Path("run"), result, bench, law, {}, values, segments, sampling, trace_nothing(segments))


def known(size):
    return {"init": size, "low": 1e-6, "high": 10.0, "scale": "log", "identify": True}


FRICTION = {"frictionloss": known(0.2), "damping": known(0.03)}
RUBBING = Rubbing(1).double()
LATE = "bench.params.delay={init: 0.0034, low: 0.0, high: 0.02, scale: 0.01, identify: true}"
STIFF = "bench.solreffriction=[0.01,1.0]"
NETWORK = ("history_network",)  # it remembers
SERVO = ("temperature_linear", "bench=xl330")  # with a payload, at a temperature
LIMIT = "{init: 6.0, low: 1.0, high: 9.0, scale: log, identify: false}"
JOINT = ("mujoco_default", LATE, "bench.actuator._target_=frictionzoo.bench.JointPD")
LIMITED = (*JOINT, f"+bench.actuator.params.torque_limit={LIMIT}")


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


@pytest.mark.parametrize(
    ("target", "drive"),
    [
        *((MujocoC, NETWORK), (MujocoC, SERVO), (MujocoC, LIMITED), (Mjcf, JOINT)),
        *(pytest.param(Mjx, drive, marks=pytest.mark.slow) for drive in (SERVO, LIMITED)),
    ],
    ids=["mujoco-network", "mujoco-servo", "mujoco-joint", "mjcf-joint", "mjx-servo", "mjx-joint"],
)
def test_a_module_moves_the_bench_as_it_was_fitted(target, drive, tmp_path):
    fitted = make_fitted(*drive)
    export = target().write(fitted, tmp_path, {})
    assert {path.name for path in tmp_path.iterdir() if path.is_file()} == set(export.files)
    assert np.ptp(fitted.rollout()[0]) > 0.1
    assert export.differences[0].largest < EXACT


def put_into_robot(tmp_path, text, name="robot.xml", **options):
    """The export's folder, what was written and the robot's compiled model."""
    robot = tmp_path / name
    robot.write_text(text)
    folder = tmp_path / "export"
    folder.mkdir()
    export = Mjcf().write(make_fitted("mujoco_default", LATE, STIFF), folder, {"into": str(robot), **options})
    return folder / name, export, mujoco.MjModel.from_xml_path(str(folder / name))


def test_a_robots_joint_gets_the_drive_and_nothing_else_changes(tmp_path):
    path, export, model = put_into_robot(tmp_path, ROBOT)
    before = mujoco.MjModel.from_xml_string(ROBOT)
    values = make_fitted("mujoco_default", LATE, STIFF).values
    knee, hip = model.joint("knee"), model.joint("hip")
    assert knee.armature == values["bench"]["armature"]
    assert knee.frictionloss == values["friction"]["frictionloss"]
    assert knee.damping[0] == values["friction"]["damping"]
    assert hip.damping[0] == 0.5 and hip.frictionloss == 0 and hip.armature == 0
    np.testing.assert_array_equal(model.body_mass, before.body_mass)  # to the last digit
    assert "<!-- mine -->" in path.read_text()
    servo = model.actuator("servo")  # keeps its name, and its range for a joint that moves without gear
    assert servo.gainprm[0] == 20 and servo.gear[0] == 1
    np.testing.assert_array_equal(servo.ctrlrange, [-3, 3])
    assert export.differences[1].quantity == "torque"
    assert export.differences[1].largest < EXACT
    assert any("time step is 0.002 s" in limit for limit in export.limits)


def test_a_drive_goes_into_several_joints_and_adds_their_actuators(tmp_path):
    path, export, model = put_into_robot(tmp_path, ROBOT, joint="hip,knee")
    armature = make_fitted("mujoco_default", LATE, STIFF).values["bench"]["armature"]
    np.testing.assert_array_equal(model.dof_armature, np.repeat(armature, 2))
    assert model.nu == 2
    np.testing.assert_array_equal(model.actuator_delay, [0.0034, 0.0034])
    own = mujoco.MjModel.from_xml_path(str(path.with_name("bench.xml")))
    np.testing.assert_array_equal(model.dof_solref, np.repeat(own.dof_solref, 2, axis=0))
    assert "nsample" in path.with_name("bench.xml").read_text()  # late there, too
    assert max(difference.largest for difference in export.differences) < EXACT


def test_a_robots_actuators_can_stay(tmp_path):
    _, export, model = put_into_robot(tmp_path, ROBOT, actuator="keep")
    assert model.nu == 1 and model.actuator("servo").gainprm[0] == 3
    assert export.differences[1].largest == 0


def test_urdf_gets_friction_and_damping_and_says_what_it_lacks(tmp_path):
    path, export, model = put_into_robot(tmp_path, URDF, name="leg.urdf")
    values = make_fitted("mujoco_default", LATE, STIFF).values
    assert model.dof_frictionloss == values["friction"]["frictionloss"]
    assert model.dof_damping == values["friction"]["damping"]
    armature = float(values["bench"]["armature"][0])
    assert f"armature {armature!r}" in path.read_text()
    assert any("no armature" in limit and f"{armature:.6g}" in limit for limit in export.limits)


def test_another_law_is_refitted_and_says_what_that_costs(tmp_path):
    fitted = make_fitted("lugre")
    (limit,) = Mjcf().write(fitted, tmp_path, {}).limits
    after, before = (float(text.split()[-1].lstrip("(")) for text in limit.split(" rad")[:2])
    assert "no lugre" in limit
    assert 0 < after < before  # the refit is no worse than truncation
    written = Written("mjcf", tmp_path, Mjcf().write(fitted, tmp_path, {}), error=after)
    (row,) = [line for line in summarise_exports([written]).splitlines() if "far from the drive" in line]
    assert row.startswith("mjcf") and row.endswith("of its own error: frictionloss and damping are no lugre")
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
    with pytest.raises(ExportError, match="law=native: MuJoCo has no coulomb_stribeck, expected lugre or dahl"):
        MujocoC().write(make_fitted("coulomb_stribeck"), tmp_path, {"law": "native"})
    with pytest.raises(ConfigError, match="law=own; expected module or native"):
        MujocoC().write(fitted, tmp_path, {"law": "own"})


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


@pytest.mark.parametrize("target", ["onnx", "torchscript"])
def test_a_law_that_remembers_is_no_function_of_an_instant(target, tmp_path, monkeypatch):
    monkeypatch.setattr(FittedDrive, "load", lambda folder: make_fitted("lugre"))
    with pytest.raises(ExportError, match=f"target={target}: lugre remembers what was before, expected"):
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

    name = "hidden"

    def terms(self, xp, values, state):
        """Asks an object."""
        return FrictionTerms(torque=self.table * state.qvel)


def test_a_law_that_cannot_be_written_down_says_why(tmp_path):
    law = Hidden(1)
    law.table = np.ones(1)
    with pytest.raises(ExportError, match=r"Hidden: table is a ndarray, expected a number"):
        MujocoC().write(make_fitted(law), tmp_path, {})


@pytest.mark.parametrize(
    ("options", "message"),
    {
        "no such file": ({"into": "nowhere.xml"}, r"into=nowhere.xml: No such file"),
        "no such joint": ({"into": "robot.xml", "joint": "kneee"}, r"joint=kneee: no such joint .*did you mean knee"),
        "twice": ({"into": "robot.xml", "joint": "knee,knee"}, r"expected each joint once"),
        "no robot": ({"into": "notes.xml"}, r"into=notes.xml: <notes>, expected <mujoco>"),
        "broken": ({"into": "broken.xml"}, r"into=broken.xml: not XML"),
        "uncompiled": ({"into": "empty.xml"}, r"empty.xml: MuJoCo does not take it"),
        "slide": ({"into": "slide.xml"}, r"joint=knee: another type of joint .*expected a hinge"),
        "actuator": ({"into": "robot.xml", "actuator": "mine"}, r"actuator=mine: expected identified or keep"),
        "include": ({"into": "parts.xml"}, r"into=parts.xml: it has an <include>"),
        "two actuators": ({"into": "twice.xml"}, r"joint=knee: 2 actuators, expected one at most"),
        "joint alone": ({"joint": "knee"}, r"joint=knee without into"),
    }.values(),
)
def test_a_robot_that_cannot_take_the_drive_is_refused(options, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    texts = {
        "robot": ROBOT,
        "notes": "<notes/>",
        "broken": "<mujoco",
        "parts": ROBOT.replace("<actuator>", '<include file="a.xml"/><actuator>'),
        "twice": ROBOT.replace("</actuator>", '<motor joint="knee"/></actuator>'),
        "slide": ROBOT.replace('name="knee"', 'name="knee" type="slide"'),
    }
    texts["empty"] = '<mujoco><worldbody><body><joint name="knee" mass="1"/></body></worldbody></mujoco>'
    for name, text in texts.items():
        Path(f"{name}.xml").write_text(text)
    with pytest.raises(FrictionzooError, match=message) as caught:
        Mjcf().write(make_fitted("mujoco_default", LATE, STIFF), tmp_path, options)
    assert "\n" not in str(caught.value)


def test_a_longer_step_keeps_every_other_sample_and_its_history():
    fitted = make_fitted("mujoco_default", LATE, STIFF)
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
        (["target=mjcf", "timestep=fast"], "timestep=fast; expected a number"),
        (["target=mjcf", "timestep=-1"], "timestep=-1; expected steps"),
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


ARM = """<mujoco><compiler angle="radian"/><option timestep="0.001"><flag contact="disable"/></option>
  <worldbody><body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.01"/>
    <inertial pos="0 0 -0.15" mass="0.5" diaginertia="0.004 0.004 0.001"/>
    <body name="lower" pos="0 0 -0.3"><joint name="elbow" axis="0 1 0"/>
      <inertial pos="0 0 -0.1" mass="0.2" diaginertia="0.001 0.001 0.0005"/></body></body></worldbody></mujoco>"""


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """Overrides of the bench of an arm."""
    path = tmp_path_factory.mktemp("arm") / "arm.xml"
    path.write_text(ARM)
    return f"bench.mjcf={path}", "bench.joint=[shoulder,elbow]"


LEANING = """<mujoco><compiler angle="radian"/><option timestep="0.001" gravity="1 0 -9"/>
  <option><flag contact="disable"/></option><worldbody>
  <body name="foot" pos="0 0.1 0.2" euler="0.3 0.2 0"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
    <body name="upper" pos="0 0.1 0" euler="0.4 -0.5 0.6"><joint name="shoulder" axis="0 1 0.5" pos="0.01 0.02 0.3"/>
      <inertial pos="0 0.1 -0.15" euler="0.1 0.7 0.2" mass="0.5" diaginertia="0.004 0.003 0.002"/>
      <body name="lower" pos="0 0 -0.3" euler="0 0 1"><joint name="elbow" axis="1 1 0" damping="0.01"/>
        <inertial pos="0 0 -0.1" mass="0.2" diaginertia="0.001 0.001 0.0005"/></body></body></body></worldbody>
</mujoco>"""


def export_leaning(target, tmp_path):
    """Turned links, a joint beside its body's frame, a link that does not move; what MuJoCo's reader lacks is given."""
    (tmp_path / "leaning.xml").write_text(LEANING)
    arm = f"bench.mjcf={tmp_path / 'leaning.xml'}", "bench.joint=[shoulder,elbow]"
    fitted = make_fitted(MujocoDefault(2, FRICTION), *arm)
    fitted.values["bench"]["armature"][:] = [0.02, 0.05]
    folder = tmp_path / "export"
    folder.mkdir()
    export = target().write(fitted, folder, {})
    assert export.differences[0].largest < EXACT and np.ptp(fitted.rollout()[0], axis=(0, 1)).min() > 0.1
    (file,) = export.files
    (armature,) = [limit for limit in export.limits if "Only Drake reads the armature, 0.02, 0.05 kg m^2" in limit]
    assert armature.endswith("set it where a program has one. Gazebo has none.")
    return fitted, ET.parse(folder / file).getroot()


def test_a_urdf_moves_as_the_bench_with_the_armature_that_drake_reads(tmp_path):
    fitted, robot = export_leaning(Urdf, tmp_path)
    assert [float(tag.get("value")) for tag in robot.iter(f"{{{DRAKE}}}rotor_inertia")] == [0.02, 0.05]
    joints = robot.findall("ros2_control/joint")
    assert [joint.get("name") for joint in joints] == ["shoulder", "elbow"]
    assert [joint.find("command_interface").get("name") for joint in joints] == 2 * ["position"]
    gains = {param.get("name"): float(param.text) for param in joints[0].findall("param")}
    assert gains == {"stiffness": fitted.values["bench"]["kp"][0], "damping": fitted.values["bench"]["kd"][0]}


@pytest.mark.parametrize("target", [Urdf, Sdf], ids=lambda target: target.name)
def test_links_of_a_late_servo_with_a_payload_move_as_its_bench(target, tmp_path):
    fitted = make_fitted("mujoco_default", "bench=xl330", LATE)
    export = target().write(fitted, tmp_path, {"supply": "7.4"} if "supply" in target.options else {})
    assert export.differences[0].largest < EXACT
    assert any("supply 7.4" in limit for limit in export.limits) == ("supply" in target.options)


def test_an_sdf_moves_as_the_bench_and_has_its_friction(tmp_path):
    fitted, root = export_leaning(Sdf, tmp_path)
    bench = mujoco.MjModel.from_xml_string(write_bench(fitted, find_nearest(fitted)))
    masses = [float(mass.text) for mass in root.iter("mass")]
    assert masses == bench.body_mass[1:].tolist()
    poses = [link.find("pose").get("relative_to") for link in root.iter("link")]
    assert poses == [None, "foot", "upper"]
    joints = {joint.get("name"): joint for joint in root.iter("joint")}
    assert [joint.get("type") for joint in joints.values()] == ["fixed", "revolute", "revolute"]
    for index, name in enumerate(fitted.bench.joints):
        numbers = {tag.tag: tag.text for tag in joints[name].iter()}
        assert [float(word) for word in numbers["xyz"].split()] == bench.joint(name).axis.tolist()
        assert float(numbers["damping"]) == bench.dof_damping[index]
        assert float(numbers["friction"]) == bench.dof_frictionloss[index]
        assert float(numbers[f"{{{DRAKE}}}rotor_inertia"]) == fitted.values["bench"]["armature"][index]
        assert numbers[f"{{{DRAKE}}}gear_ratio"] == "1"


def test_an_sdf_has_one_name_for_one_thing(tmp_path):
    """The carriage slides on a joint of its name."""
    fitted = make_fitted("mujoco_default", "bench=emps")
    export = Sdf().write(fitted, tmp_path, {})
    assert export.differences[0].largest < EXACT
    root = ET.parse(tmp_path / "bench.sdf").getroot()
    (link,), (joint,) = root.iter("link"), root.iter("joint")
    assert (link.get("name"), joint.get("name"), joint.get("type")) == ("carriage_link", "carriage", "prismatic")
    inertia = {tag.tag: float(tag.text) for tag in link.find("inertial/inertia")}
    assert inertia == {"ixx": 1e-6, "iyy": 1e-6, "izz": 1e-6, "ixy": 0, "ixz": 0, "iyz": 0}


@pytest.mark.parametrize("options", [("data=twin",), ("bench=emps",)], ids=["hinge", "slide"])
def test_links_of_an_sdf_can_have_the_armature(options, tmp_path):
    """For programs whose joints have none: no rotor, and an inertia that is one of a body."""
    fitted = make_fitted("mujoco_default", *options)
    export = Sdf().write(fitted, tmp_path, {"armature": "links"})
    assert export.differences[0].largest < EXACT and any("in the links" in limit for limit in export.limits)
    root = ET.parse(tmp_path / "bench.sdf").getroot()
    inertia = {tag.tag: float(tag.text) for tag in root.find(".//inertia")}
    assert root.find(f".//{{{DRAKE}}}rotor_inertia") is None
    assert inertia["ixx"] + inertia["izz"] > inertia["iyy"]


@pytest.mark.parametrize(
    ("options", "place", "line"),
    [
        (("bench=xl330",), "links", "its payload is that of a link"),
        (("bench=emps", "+bench.gravity=[9.81,0,0]"), "links", "gravity acts along the slide carriage"),
        (("bench=emps",), "rotor", "armature=rotor: expected joints or links"),
    ],
)
def test_an_armature_that_links_cannot_have_is_refused(options, place, line, tmp_path):
    with pytest.raises(FrictionzooError, match=line):
        Sdf().write(make_fitted("mujoco_default", *options), tmp_path, {"armature": place})


TWO_RUBBING = Rubbing(2).double()


@pytest.mark.parametrize(
    "target", [pytest.param(Mjcf, marks=pytest.mark.slow), MujocoC, Mjx], ids=lambda target: target.name
)
def test_a_drive_of_several_joints(target, arm, tmp_path):
    """All terms, a memory and late commands, in modules; in MJCF, its own friction."""
    fitted = make_fitted(MujocoDefault(2, FRICTION) if target is Mjcf else TWO_RUBBING, *arm, LATE)
    fitted.values["bench"]["armature"][:] = [0.02, 0.05]
    fitted.values["bench"]["delay"][:] = [0.0034, 0.0012]
    assert target().write(fitted, tmp_path, {}).differences[0].largest < EXACT
    assert np.ptp(fitted.rollout()[0], axis=(0, 1)).min() > 0.1


@pytest.mark.slow
@pytest.mark.usefixtures("in_haste")
def test_a_law_of_several_joints_is_refitted_joint_by_joint(arm):
    fitted = make_fitted(Rubbing(2), *arm)
    fitted.values["bench"]["armature"][:] = [0.02, 0.05]
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
