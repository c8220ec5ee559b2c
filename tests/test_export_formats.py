"""Targets for other programs: what they write is read again and compared with the fitted drive."""

import io
import itertools
import json
import os
import sys
import warnings
import zipfile
from collections.abc import Iterable
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from conftest import slow_but
from helpers.drawn import MODELS, draw, fit, write
from helpers.isaaclab import load_recorded, read_signatures, stub_configurations

from frictionzoo import __version__
from frictionzoo.api.identified import Identified
from frictionzoo.bench.read_bam import DUTY, LAWS, read_bam
from frictionzoo.core.errors import ConfigError, ExportError
from frictionzoo.export.isaaclab import IsaacLab
from frictionzoo.export.mjlab import Mjlab
from frictionzoo.export.module import load_module
from frictionzoo.export.motor import lag, motors, read_inputs
from frictionzoo.export.nearest import Nearest

SIGNALS = ["qpos", "qvel", "ctrl", "motor_torque", "external_torque"]
ROOT = Path(__file__).parent.parent
SITES = "FRICTIONZOO_ISAACLAB"  # site-packages folders, with os.pathsep between them
GRAPHS = list(itertools.product(MODELS, ("torchscript", "onnx")))
KINDS = ("neural_friction", "temperature_arrhenius")  # of laws: ONNX's exporter takes seconds for each


@pytest.mark.parametrize(
    ("model", "target"),
    slow_but([*((model, "torchscript") for model in MODELS), *((model, "onnx") for model in KINDS)], GRAPHS),
)
def test_a_graph_gives_the_laws_torque(tmp_path: Path, target: str, model: str) -> None:
    (difference,) = write(target, draw(model), tmp_path).differences
    assert (difference.quantity, difference.unit) == ("torque", "N m")
    # The same operations on the same numbers, but for the order in which a runtime sums. ONNX Runtime's exponential is
    # good to 3e-13 of its value, and here it weighs loads of tens of N m.
    assert difference.largest < (1e-11 if model in ("directional", "harmonic_drive") else 1e-12)
    if model == "neural_friction" and target == "onnx":
        judge_onnx((tmp_path / "friction.onnx").read_bytes())
    if model == "temperature_arrhenius":
        judge_facts(*READ_FACTS[target](tmp_path), (path.read_bytes() for path in tmp_path.iterdir()))


def read_onnx(folder: Path) -> tuple[dict[str, str], dict[str, str]]:
    import onnx

    model = onnx.load(folder / "friction.onnx")
    assert (model.producer_name, model.producer_version) == ("frictionzoo", __version__)
    assert "temperature_arrhenius" in model.doc_string
    signals = [*model.graph.input, *model.graph.output]
    return {fact.key: fact.value for fact in model.metadata_props}, {one.name: one.doc_string for one in signals}


def read_torchscript(folder: Path) -> tuple[dict[str, str], dict[str, str]]:
    extra = {"frictionzoo.json": ""}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"`torch\.jit", DeprecationWarning)
        torch.jit.load(folder / "friction.pt", _extra_files=extra)
    facts = json.loads(extra["frictionzoo.json"])
    return facts, json.loads(facts["inputs"]) | json.loads(facts["outputs"])


READ_FACTS = {"onnx": read_onnx, "torchscript": read_torchscript}


def judge_facts(facts: dict[str, str], units: dict[str, str], contents: Iterable[bytes]) -> None:
    """A file says what it is, and nothing of the machine that wrote it."""
    assert facts["producer"] == f"frictionzoo {__version__}" and facts["law"] == "temperature_arrhenius"
    assert json.loads(facts["joints"]) == ["knee"] and "steps of 0.001 s" in facts["sampling"]
    states = dict(zip(SIGNALS, ("rad", "rad/s", "as it was recorded", "N m", "N m"), strict=True))
    assert units == {
        **{**states, "temperature": "degC"},
        **{"torque": "N m", "frictionloss": "N m", "damping": "N m s/rad"},
    }
    assert json.loads(facts["inputs"]) == {name: units[name] for name in (*SIGNALS, "temperature")}
    for content in contents:
        names = zipfile.ZipFile(io.BytesIO(content)).namelist() if zipfile.is_zipfile(io.BytesIO(content)) else []
        assert not any(name.endswith(".debug_pkl") for name in names)
        assert str(ROOT).encode() not in content and b"site-packages" not in content


def judge_onnx(content: bytes) -> None:
    """It stands alone: no file beside it, no path of the machine that wrote it, any batch size, the law's terms."""
    import onnx
    import onnxruntime

    onnx.checker.check_model(onnx.load_from_string(content), full_check=True)
    assert b".py" not in content
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    assert [given.name for given in session.get_inputs()] == SIGNALS
    for batch in (1, 7):
        terms = session.run(None, {name: np.ones((batch, 1)) for name in SIGNALS})
        assert [term.shape for term in terms] == 3 * [(batch, 1)]


@pytest.mark.parametrize("target", ["onnx", "torchscript"])
def test_a_graph_in_float32_is_as_exact_as_that(tmp_path: Path, target: str) -> None:
    (difference,) = write(target, draw("coulomb_stribeck"), tmp_path, dtype="float32").differences
    assert 0 < difference.largest < 1e-6


@pytest.mark.filterwarnings(r"ignore:`torch\.jit:DeprecationWarning")
def test_a_torchscript_file_needs_no_frictionzoo(tmp_path: Path) -> None:
    """libtorch reads it: it holds code and numbers, and constants of its own type."""
    write("torchscript", draw("mujoco_default"), tmp_path, dtype="float32")
    content = (tmp_path / "friction.pt").read_bytes()
    loaded = torch.jit.load(io.BytesIO(content))
    torque, frictionloss, damping = loaded(*torch.zeros(5, 3, 1))
    assert (torque == 0).all() and (frictionloss > 0).all() and (damping > 0).all()
    assert frictionloss.dtype == torch.float32
    assert any(name.endswith(".py") for name in zipfile.ZipFile(io.BytesIO(content)).namelist())


STS3215 = ("bench=sts3215", "bench.timestep=0.001")
OWN_DAMPING = 0.3  # N m s/rad, damping of the template itself: files replace the robot's


@pytest.fixture(scope="module")
def damped(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, ...]:
    """Overrides of a bench with a servo and a template that has a damping of its own."""
    path = tmp_path_factory.mktemp("bench") / "damped.xml"
    template = (files("frictionzoo.bench") / "assets" / "servo_pendulum.xml").read_text()
    path.write_text(template.replace('type="hinge"', f'type="hinge" damping="{OWN_DAMPING}"'))
    return (*STS3215, f"bench.mjcf={path}")


def read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())


def test_bam_holds_mujocos_friction_exactly(damped: tuple[str, ...], tmp_path: Path) -> None:
    fitted = fit("mujoco_default", *damped)
    torque, qpos = write("bam", fitted, tmp_path).differences
    assert torque.largest < 1e-12
    # BAM limits the duty cycle to 0.97; the drive to 1, which these commands reach.
    assert qpos.largest < 0.05
    drive, bench = read_bam(tmp_path / "m1.json"), numbers(fitted, "bench")
    own = numbers(fitted, "friction")
    assert drive.friction == pytest.approx({**own, "damping": own["damping"] + OWN_DAMPING})
    assert drive.bench == pytest.approx(bench | {"duty_limit": 0.97}, rel=1e-12)


def numbers(fitted: Identified, owner: str) -> dict[str, float]:
    return {name: float(value[0]) for name, value in fitted.values[owner].items()}


@pytest.mark.parametrize("model", ["m3", "m4", "m6"])
def test_bam_holds_its_own_laws_exactly(tmp_path: Path, model: str) -> None:
    law, _ = LAWS[model]
    limit = "bench.actuator.params.duty_limit={init:0.97,low:0.1,high:1.0,scale:1.0,identify:false}"  # BAM's
    fitted = (fit if model == "m6" else draw)(law, *STS3215, limit)  # the others are parts of m6
    torque, qpos = write("bam", fitted, tmp_path).differences
    assert torque.largest < 1e-12
    if model == "m6":
        assert qpos.largest < 1e-3  # BAM takes the motor's torque of the step before
    drive = read_bam(tmp_path / f"{model}.json")
    assert drive.model == law and drive.friction == pytest.approx(numbers(fitted, "friction"))


@pytest.mark.parametrize(
    ("model", "steepness"),
    [
        ("coulomb_stribeck", "smoothing_velocity={init:0.002,low:1e-3,high:1.0,scale:log,identify:false}"),
        ("coulomb_smooth", "smoothing={init:50,low:1,high:100,scale:log,identify:false}"),
    ],
    ids=["m2", "m1"],
)
def test_bam_holds_a_smooth_law(tmp_path: Path, model: str, steepness: str) -> None:
    fitted = draw(model, *STS3215, f"laws.{model}.params.{steepness}")
    export = write("bam", fitted, tmp_path, servo="sts3215")
    static = float(fitted.values["friction"]["static_torque"][0])
    if model == "coulomb_stribeck":
        assert read(tmp_path / "m2.json")["friction_stribeck"] == pytest.approx(0.08)
    assert export.differences[0].mean < 1e-3 * static  # beside each other near rest only
    assert "sticks" in " ".join(export.limits)


BAM_LIMIT = "bench.actuator.params.duty_limit={init:0.9,low:0.1,high:1.0,scale:1.0,identify:false}"


@pytest.mark.parametrize("model", [pytest.param("quadratic", marks=pytest.mark.slow), "directional"])
def test_mjlab_gets_bams_actuator_for_bams_friction(tmp_path: Path, model: str) -> None:
    fitted = (fit if model == "quadratic" else draw)(model, *STS3215, BAM_LIMIT)
    export = write("mjlab", fitted, tmp_path, gain="16", supply="12")
    file, parameters = export.files
    assert "friction=" not in (text := (tmp_path / file).read_text()) and "BamActuatorCfg(" in text
    calls = []
    stubs = {
        "bam.mjlab": {"BamActuatorCfg": lambda **values: calls.append(values), "bam_init": None},
        "mjlab.managers.event_manager": {"EventTermCfg": SimpleNamespace},
    }
    run_with(tmp_path / file, stubs)
    (values,) = calls
    assert values["json_path"] == str(tmp_path / parameters) and values["delay_max_lag"] == 20
    assert {*values} <= {*BAM_FIELDS}
    # The voltages are the servo's, also where the duty cycle ends.
    bench = fitted.values["bench"]
    error_gain, limit = DUTY[read(tmp_path / parameters)["actuator"]]
    assert values["vin"] * limit == pytest.approx(12 * 0.9)
    assert values["vin"] * values["kp_fw"] * error_gain == pytest.approx(12 * 16 * bench["duty_gain"][0])
    drive = read_bam(tmp_path / parameters)
    assert drive.model == model and drive.friction == pytest.approx(numbers(fitted, "friction"))
    qpos, torque = export.differences
    assert torque.largest < 1e-12
    if model == "quadratic":
        assert qpos.largest < 1e-3  # BAM takes the motor's torque of the step before


# Of better-actuator-models 1.0.2 on mjlab 1.6.0: the arguments of BamActuatorCfg that are used.
BAM_FIELDS = [
    *("json_path", "vin", "kp_fw", "stiff_frictionloss"),
    *("target_names_expr", "delay_min_lag", "delay_max_lag"),
]


def test_mjlab_gets_mujocos_friction_where_it_is_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fitted = draw("quadratic", *STS3215)
    nearest = Nearest(fitted.values["bench"], *np.full((2, 1), 0.1))
    monkeypatch.setattr("frictionzoo.export.configclass.find_nearest", lambda _: nearest)
    (file,) = write("mjlab", fitted, tmp_path, friction="mujoco").files
    assert "DcMotorActuatorCfg(" in (tmp_path / file).read_text()
    with pytest.raises(ConfigError, match="friction=viscous"):
        write("mjlab", fitted, tmp_path, friction="viscous")
    with pytest.raises(ExportError, match="friction=lugre"):
        write("mjlab", fitted, tmp_path, friction="lugre")
    with pytest.raises(ExportError, match="friction=bam"):
        write("mjlab", draw("coulomb_stribeck"), tmp_path, friction="bam")


def run_with(path: Path, stubs: dict[str, dict[str, Any]]) -> Any:
    """Import a written file where these modules are what it imports."""
    with pytest.MonkeyPatch.context() as patch:
        for name, content in stubs.items():
            module = ModuleType(name)
            module.__dict__.update(content)
            patch.setitem(sys.modules, name, module)
        return load_module(path)


def test_bam_gets_the_nearest_of_another_law_for_the_servo_with_its_gain(tmp_path: Path) -> None:
    export = write("bam", draw("neural_friction", *STS3215), tmp_path)
    law = read(tmp_path / "m3.json")
    assert min(law["friction_base"], law["load_friction_base"], law["friction_viscous"]) >= 0
    assert "RMS residual" in export.limits[0] and "neural_friction" in export.limits[0]
    (tmp_path / "other").mkdir()
    assert "xl330" in " ".join(write("bam", draw("mujoco_default", "bench=xl330"), tmp_path / "other").limits)


def test_bam_gets_the_law_of_each_joint(tmp_path: Path) -> None:
    fitted = draw("by_joint", *STS3215)
    assert write("bam", fitted, tmp_path).differences[0].largest < 1e-12
    base = fitted.values["friction"]["mujoco_default.frictionloss"]
    assert read(tmp_path / "m1.json")["friction_base"] == base[0]


DC_MOTOR = (
    "bench.actuator._target_=frictionzoo.bench.DcMotorPD",
    *(
        f"+bench.actuator.params.{name}={{init:{value},low:0.1,high:100,scale:log,identify:false}}"
        for name, value in (("stall_torque", 3.0), ("no_load_velocity", 8.0), ("torque_limit", 2.0))
    ),
)
LATE = "+bench.params.delay={init:0.012,low:0,high:0.05,scale:1.0,identify:false}"
SIZE = "{{init: {}, low: 0.1, high: 100, scale: log, identify: false}}"
ROBOT = (
    "bench.actuator._target_=frictionzoo.bench.JointPD",
    *(f"+bench.actuator.params.torque_{name}={SIZE.format(size)}" for name, size in (("gain", 0.8), ("limit", 4.0))),
)
RECORDED = (
    "bench.actuator._target_=frictionzoo.bench.RecordedPD",
    *(f"~bench.actuator.params.{name}" for name in ("kp", "kd")),
    f"+bench.actuator.params.torque_saturation={SIZE.format(5.0)}",
)


@pytest.mark.parametrize("major", ["2", "3"])
@pytest.mark.parametrize("drive", [(), (LATE,), DC_MOTOR, STS3215], ids=["ideal", "late", "dc motor", "servo"])
def test_isaac_labs_file_has_the_names_of_each_version(tmp_path: Path, major: str, drive: tuple[str, ...]) -> None:
    fitted = draw("mujoco_default", *drive)
    for physics in ("physx", "newton"):
        folder = tmp_path / physics
        folder.mkdir()
        (file,) = write("isaaclab", fitted, folder, physics=physics).files
        (config,) = run_with(folder / file, {"isaaclab.actuators": vars(stub_configurations(major))}).ACTUATORS.values()
        friction = fitted.values["friction"]["frictionloss"]
        assert config.friction == friction and config.dynamic_friction == (friction if physics == "physx" else None)
        if drive == DC_MOTOR:
            named = {name: getattr(config, name, None) for name in LIMITS_OF_VERSIONS["3"] + LIMITS_OF_VERSIONS["2"]}
            assert {name: value for name, value in named.items() if value is not None} == dict(
                zip(LIMITS_OF_VERSIONS[major], (8.0, 2.0, 2.0), strict=False)
            )
    with pytest.raises(ConfigError, match="physics=mujoco"):
        write("isaaclab", fitted, tmp_path, physics="mujoco")


LIMITS_OF_VERSIONS = {
    "2": ["velocity_limit", "effort_limit"],
    "3": ["actuator_velocity_limit", "actuator_effort_limit", "joint_effort_limit"],
}


def test_isaac_labs_file_for_newton_has_the_friction_of_motion(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fitted = draw("coulomb_stribeck")
    nearest = Nearest(fitted.values["bench"], np.array([0.02]), np.array([0.03]))
    monkeypatch.setattr("frictionzoo.export.configclass.find_nearest", lambda _: nearest)
    (file,) = write("isaaclab", fitted, tmp_path, physics="newton").files
    (config,) = run_with(tmp_path / file, {"isaaclab.actuators": vars(stub_configurations("3"))}).ACTUATORS.values()
    assert (config.friction, config.dynamic_friction, config.viscous_friction) == (0.02, None, 0.03)


@pytest.mark.skipif(SITES not in os.environ, reason=f"{SITES} names no site-packages with Isaac Lab")
def test_recorded_names_of_isaac_lab_are_those_of_the_package() -> None:
    for site in os.environ[SITES].split(os.pathsep):
        major, signatures = read_signatures(Path(site))
        assert signatures == load_recorded()[major]


READERS = {"mjlab": Mjlab().read, "isaaclab": IsaacLab().read}
CONFIGURED = [
    *(("mjlab", "BuiltinPositionActuatorCfg", (LATE,)), ("isaaclab", "DelayedPDActuatorCfg", (LATE,))),
    *(("isaaclab", "IdealPDActuatorCfg", ()), ("isaaclab", "DCMotorCfg", DC_MOTOR)),
    *(("mjlab", "DcMotorActuatorCfg", STS3215), ("isaaclab", "IdealPDActuatorCfg", ROBOT)),
    ("mjlab", "BuiltinPositionActuatorCfg", RECORDED),
]


@pytest.mark.parametrize(("target", "cls", "drive"), CONFIGURED, ids=[f"{case[0]}-{case[1]}" for case in CONFIGURED])
def test_a_configuration_moves_as_the_drive(damped, tmp_path, target, cls, drive):
    """Some move; of the others the file is read."""
    moves = drive in ((LATE,), STS3215, ROBOT)
    fitted = (fit if moves else draw)("mujoco_default", *(damped if drive == STS3215 else drive))
    export = write(target, fitted, tmp_path)
    text = (tmp_path / export.files[0]).read_text()
    compile(text, export.files[0], "exec")
    assert f"{cls}(" in text
    (joint,) = READERS[target](text)
    law, values = fitted.values["friction"], fitted.values["bench"]
    assert (joint.armature, joint.frictionloss) == (values["armature"], law["frictionloss"])
    assert joint.damping == pytest.approx(law["damping"][0] + (OWN_DAMPING if drive == STS3215 else 0.0))
    assert joint.lag == {LATE: 12, STS3215[0]: 20}.get((*drive, "")[0], 0)  # steps of 1 ms
    if moves:  # the numbers are exact; MuJoCo C and MJX round apart
        assert export.differences[0].largest < 1e-6
    assert "not run" in " ".join(export.limits)


def test_a_configuration_holds_the_nearest_friction_of_another_law(tmp_path, monkeypatch):
    fitted = draw("coulomb_stribeck", *STS3215)
    armature, loss, damping = (np.array([value]) for value in (0.04, 0.02, 0.03))
    nearest = Nearest(fitted.values["bench"] | {"armature": armature}, loss, damping, "so far off")
    for target, read_joints in READERS.items():
        (tmp_path / target).mkdir()
        monkeypatch.setattr("frictionzoo.export.configclass.find_nearest", lambda _: nearest)
        export = write(target, fitted, tmp_path / target)
        text = (tmp_path / target / export.files[0]).read_text()
        (joint,) = read_joints(text)
        assert joint[1:4] == (0.04, 0.02, 0.03)
        assert joint.lag == (20 if target == "mjlab" else 0)  # of 1 ms
        assert ("delay_max_lag=20" in text) == (target == "mjlab")
        assert "so far off" in export.limits and "20 for 0.02 s" in " ".join(export.limits)
    # Isaac Lab's files hold what sticks, too.
    assert float(text.split(" friction=")[1].split(",")[0]) == fitted.values["friction"]["static_torque"]
    assert fitted.values["friction"]["static_torque"] > joint.frictionloss


def test_a_delay_is_rounded_to_whole_steps() -> None:
    fitted = draw("mujoco_default", LATE)
    for delay, steps in ((0.0123, 12), (0.0127, 13), (0.5, fitted.sampling.history * fitted.sampling.substeps)):
        late = replace(fitted, values=fitted.values | {"bench": {"delay": np.array([delay])}})
        assert lag(late, 0) == steps


@pytest.mark.parametrize("drive", [(), DC_MOTOR, STS3215, ROBOT], ids=["position", "dc motor", "servo", "robot"])
def test_a_motor_is_the_actuator_law(drive: tuple[str, ...]) -> None:
    """At a given supply and gain, limited voltage and back-EMF are a torque-speed line."""
    fitted, given = draw("mujoco_default", *drive), {"gain": 8.0, "supply": 7.0, "enable": 1.0}
    given |= {"ctrl_velocity": 0.0, "ctrl_torque": 0.0}
    law, values = fitted.bench.actuator, fitted.values["bench"]
    (motor,) = motors(fitted, read_inputs(fitted, {"gain": "8", "supply": "7"}))
    affine = law.affine(values)
    # Driven faster than it runs free, a DC motor brakes here and gives nothing in our law.
    fastest = {(): 10.0, ROBOT: 10.0, DC_MOTOR: 8.0}.get(drive, 2 * motor.velocity_limit)
    for ctrl, qpos, speed in np.random.default_rng(0).uniform(-1, 1, size=(50, 3)):
        volts = law.control(np, values, qpos, fastest * speed, 3 * ctrl, given)
        torque = affine.gain * volts + affine.bias0 + affine.bias1 * qpos + affine.bias2 * fastest * speed
        assert motor.torque(3 * ctrl, qpos, fastest * speed) == pytest.approx(torque[0], abs=1e-12)


def test_what_a_configuration_lacks_of_a_robots_commands_is_told(tmp_path: Path) -> None:
    said = " ".join(write("mjlab", draw("mujoco_default", *ROBOT), tmp_path).limits)
    assert "have ctrl_velocity and ctrl_torque: give ctrl + (kd ctrl_velocity + ctrl_torque) / kp as position" in said
    assert "times torque_gain, 0.8." in said and "saturation" not in said
    fitted = draw("mujoco_default", *RECORDED)
    assert "no smooth saturation" in " ".join(write("mjlab", fitted, tmp_path).limits)
    segments = fitted.segments
    inputs = segments.signals.inputs | {"kp": segments.signals.inputs["kp"] + segments.signals.ctrl**2}
    changing = replace(fitted, segments=replace(segments, signals=segments.signals._replace(inputs=inputs)))
    with pytest.raises(ExportError, match=r"^kp of \w+ is 20 to 20\.\d+ in the recordings, expected one gain above 0"):
        write("mjlab", changing, tmp_path)
