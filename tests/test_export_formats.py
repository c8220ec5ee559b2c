"""Targets for other programs: what they write is read again and compared with the fitted drive."""

import io
import json
import zipfile
from collections.abc import Callable
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from frictionzoo.errors import ConfigError, ExportError
from frictionzoo.export.base import Export, get_target
from frictionzoo.export.fitted import Fitted
from frictionzoo.export.isaaclab import read_isaaclab
from frictionzoo.export.mjlab import read_mjlab
from frictionzoo.export.motor import Motor
from frictionzoo.export.onnx import export_onnx
from frictionzoo.export.read_bam import LAWS, read_bam
from frictionzoo.export.targets import __all__ as _registered  # noqa: F401 - importing it registers them
from frictionzoo.models import FrictionModel
from frictionzoo.types import DriveState, Payload, Segments

SIGNALS = ["qpos", "qvel", "ctrl", "motor_torque", "external_torque"]
PAYLOAD = Payload(0.5, (0.0, 0.0, -0.1), (1e-4, 1e-4, 1e-4))
MODELS = [
    *(
        "mujoco_default",
        "coulomb_stribeck",
        "asymmetric",
        "polynomial_viscous",
        "ripple",
        "stribeck",
        "directional",
        "harmonic_drive",
    ),
    *("neural_friction", "dissipative_network", "odd_network", "residual_network"),
    *("temperature_linear", "temperature_arrhenius"),
]


@pytest.fixture(scope="module")
def fit(make: Callable[..., Any]) -> Callable[..., Fitted]:
    """A drive with the configuration's initial values, two rollouts of half a second, and overrides."""

    @cache  # with what a drive has compiled
    def fit(*overrides: str) -> Fitted:
        model = make("model", *overrides, nv=1)
        bench = make("bench", *overrides).observing(model.inputs)
        rng, interval = np.random.default_rng(0), 0.01
        sampling = bench.sampling(interval)
        samples = sampling.history + 50
        phase = 5 * interval * np.arange(samples)[:, None] + np.arange(2)[:, None, None]
        extras = [np.full((2, samples, 1), value) for value in (16.0, 12.0, 1.0)[: len(bench.actuator.inputs)]]
        observed = [value + 10 * np.cos(phase) for value in model.inputs.values()]
        ctrl = np.concatenate([0.5 * np.sin(phase), *extras, *observed], axis=2)
        qpos, qvel = rng.normal(size=(2, 2, 51, 1))
        load = None if bench.payload is None else np.stack(2 * [bench.load(PAYLOAD)])
        model.prepare(DriveState(*rng.normal(size=(5, 100, 1))))
        values = {"bench": bench.initial_values(), "friction": state(model)}
        segments = Segments(qpos, qvel, ctrl, interval, load, sampling.history, len(observed))
        return Fitted(Path("run"), {"model": model.name}, bench, model.double(), values, segments, sampling)

    return fit


def state(model: FrictionModel) -> dict[str, np.ndarray]:
    return {name: value.detach().double().numpy() for name, value in model.state_dict().items()}


def write(target: str, fitted: Fitted, folder: Path, **options: str) -> Export:
    export = get_target(target)().write(fitted, folder, options)
    assert {path.name for path in folder.iterdir()} == set(export.files)
    assert export.limits
    return export


@pytest.mark.parametrize("target", ["onnx", "torchscript"])
@pytest.mark.parametrize("model", MODELS)
def test_a_graph_gives_the_laws_torque(fit: Callable[..., Fitted], tmp_path: Path, target: str, model: str) -> None:
    (difference,) = write(target, fit(f"model={model}"), tmp_path).differences
    assert (difference.quantity, difference.unit) == ("torque", "N m")
    # The same operations on the same numbers, but for the order in which a runtime sums. ONNX Runtime's exponential is
    # good to 3e-13 of its value, and here it weighs loads of tens of N m.
    assert difference.largest < (1e-11 if model in ("directional", "harmonic_drive") else 1e-12)


@pytest.mark.parametrize("target", ["onnx", "torchscript"])
def test_a_graph_in_float32_is_as_exact_as_that(fit: Callable[..., Fitted], tmp_path: Path, target: str) -> None:
    (difference,) = write(target, fit(), tmp_path, dtype="float32").differences
    assert 0 < difference.largest < 1e-6


def test_an_unknown_dtype_is_refused(fit: Callable[..., Fitted], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="dtype=float16"):
        write("onnx", fit(), tmp_path, dtype="float16")


def test_an_onnx_file_stands_alone(fit: Callable[..., Fitted]) -> None:
    """No file beside it, no path of the machine that wrote it, any batch size, the law's three terms."""
    import onnx
    import onnxruntime

    content = export_onnx(fit("model=neural_friction").model, "float64")
    onnx.checker.check_model(onnx.load_from_string(content), full_check=True)
    assert b".py" not in content
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    assert [given.name for given in session.get_inputs()] == SIGNALS
    for batch in (1, 7):
        terms = session.run(None, {name: np.ones((batch, 1)) for name in SIGNALS})
        assert [term.shape for term in terms] == 3 * [(batch, 1)]


@pytest.mark.filterwarnings(r"ignore:`torch\.jit:DeprecationWarning")
def test_a_torchscript_file_needs_no_frictionzoo(fit: Callable[..., Fitted], tmp_path: Path) -> None:
    """libtorch reads it: it holds code and numbers, and constants of its own type."""
    write("torchscript", fit("model=mujoco_default"), tmp_path, dtype="float32")
    content = (tmp_path / "friction.pt").read_bytes()
    loaded = torch.jit.load(io.BytesIO(content))
    torque, frictionloss, damping = loaded(*torch.zeros(5, 3, 1))
    assert (torque == 0).all() and (frictionloss > 0).all() and (damping > 0).all()
    assert frictionloss.dtype == torch.float32
    assert any(name.endswith(".py") for name in zipfile.ZipFile(io.BytesIO(content)).namelist())


STS3215 = ("bench=sts3215", "bench.timestep=0.001")


def read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())


def test_bam_holds_mujocos_friction_exactly(fit: Callable[..., Fitted], tmp_path: Path) -> None:
    fitted = fit("model=mujoco_default", *STS3215)
    torque, qpos = write("bam", fitted, tmp_path).differences
    assert torque.largest < 1e-12
    # BAM limits the duty cycle to 0.97; the drive to 1, which these commands reach.
    assert qpos.largest < 0.05
    drive, values = read_bam(tmp_path / "m1.json"), fitted.values
    assert drive.friction == pytest.approx({name: float(value[0]) for name, value in values["friction"].items()})
    again = {name: float(value[0]) for name, value in values["bench"].items()}
    assert drive.bench == pytest.approx(again | {"duty_limit": 0.97}, rel=1e-12)


@pytest.mark.parametrize("model", ["m3", "m4", "m6"])
def test_bam_holds_its_own_laws_exactly(fit: Callable[..., Fitted], tmp_path: Path, model: str) -> None:
    law, _ = LAWS[model]
    limit = "bench.actuator.params.duty_limit={init:0.97,low:0.1,high:1.0,scale:1.0,identify:false}"  # BAM's
    fitted = fit(f"model={law}", *STS3215, limit)
    torque, qpos = write("bam", fitted, tmp_path).differences
    assert torque.largest < 1e-12
    assert qpos.largest < 1e-3  # BAM takes the motor's torque of the step before
    drive = read_bam(tmp_path / f"{model}.json")
    assert drive.model == law
    assert drive.friction == pytest.approx({name: float(value[0]) for name, value in fitted.values["friction"].items()})


def test_bam_holds_a_stribeck_law(fit: Callable[..., Fitted], tmp_path: Path) -> None:
    fitted = fit("model=coulomb_stribeck", "model.params.smoothing_velocity.init=0.0021", *STS3215)
    export = write("bam", fitted, tmp_path, servo="sts3215")
    assert read(tmp_path / "m2.json")["friction_stribeck"] == pytest.approx(0.08)
    torque, qpos = export.differences
    assert torque.mean < 1e-3 * float(fitted.values["friction"]["static_torque"][0])  # beside each other near rest only
    assert qpos.largest < 0.05
    assert "sticks" in " ".join(export.limits)


def test_bam_gets_the_nearest_of_another_law(fit: Callable[..., Fitted], tmp_path: Path) -> None:
    export = write("bam", fit("model=neural_friction", *STS3215), tmp_path)
    law = read(tmp_path / "m3.json")
    assert min(law["friction_base"], law["load_friction_base"], law["friction_viscous"]) >= 0
    assert "leaves" in export.limits[0] and "neural_friction" in export.limits[0]


def test_bam_needs_a_voltage_servo_that_it_knows(fit: Callable[..., Fitted], tmp_path: Path) -> None:
    with pytest.raises(ExportError, match="PositionPD"):
        write("bam", fit(), tmp_path)
    with pytest.raises(ConfigError, match="did you mean sts3215"):
        write("bam", fit(*STS3215), tmp_path, servo="sts321")
    assert "xl330" in " ".join(write("bam", fit("bench=xl330", "model=mujoco_default"), tmp_path).limits)


DC_MOTOR = (
    "bench.actuator._target_=frictionzoo.bench.DcMotorPD",
    *(
        f"+bench.actuator.params.{name}={{init:{value},low:0.1,high:100,scale:log,identify:false}}"
        for name, value in (("stall_torque", 3.0), ("no_load_velocity", 8.0), ("torque_limit", 2.0))
    ),
)
CLASSES = {
    "mjlab": ("BuiltinPositionActuatorCfg", "DcMotorActuatorCfg", "DcMotorActuatorCfg"),
    "isaaclab": ("ImplicitActuatorCfg", "DCMotorCfg", "DCMotorCfg"),
}
READERS = {"mjlab": read_mjlab, "isaaclab": read_isaaclab}


@pytest.mark.parametrize(("target", "drive"), [("mjlab", 0), ("isaaclab", 1), ("mjlab", 2)])
def test_a_configuration_moves_as_the_drive(
    fit: Callable[..., Fitted], tmp_path: Path, target: str, drive: int
) -> None:
    fitted = fit("model=mujoco_default", *((), DC_MOTOR, STS3215)[drive])
    export = write(target, fitted, tmp_path)
    text = (tmp_path / export.files[0]).read_text()
    compile(text, export.files[0], "exec")
    assert f"{CLASSES[target][drive]}(" in text
    (qpos,) = export.differences
    # The numbers are exact; MuJoCo C and MJX round apart. A DC motor driven faster than it runs free brakes here and
    # gives nothing in our law; these motions hardly reach that.
    assert qpos.largest < (1e-6, 0.02, 1e-6)[drive]
    assert "not run" in " ".join(export.limits)


@pytest.mark.parametrize("target", ["mjlab", "isaaclab"])
def test_a_configuration_holds_friction_of_another_law(fit: Callable[..., Fitted], tmp_path: Path, target: str) -> None:
    fitted = fit("model=coulomb_stribeck", *STS3215)
    export = write(target, fitted, tmp_path)
    (joint,) = READERS[target]((tmp_path / export.files[0]).read_text())
    assert joint.lag == (20 if target == "mjlab" else 0)  # of 1 ms
    assert "coulomb_stribeck" in " ".join(export.limits) and "20 for 0.02 s" in " ".join(export.limits)
    assert export.differences[0].mean < 0.05
    if target == "isaaclab":
        at_rest = float((tmp_path / "isaaclab_actuators.py").read_text().split(" friction=")[1].split(",")[0])
        assert at_rest > joint.frictionloss


def test_a_position_drive_that_acts_late_is_delayed(fit: Callable[..., Fitted], tmp_path: Path) -> None:
    late = "+bench.params.delay={init:0.0123,low:0,high:0.05,scale:1.0,identify:false}"
    fitted = fit("model=mujoco_default", late)
    (qpos,) = write("isaaclab", fitted, tmp_path).differences
    assert "DelayedPDActuatorCfg" in (tmp_path / "isaaclab_actuators.py").read_text()
    assert read_isaaclab((tmp_path / "isaaclab_actuators.py").read_text())[0].lag == 12
    assert qpos.largest < 0.01  # a third of a step's delay


def test_a_voltage_servo_is_a_dc_motor_with_gains(fit: Callable[..., Fitted], tmp_path: Path) -> None:
    """At a given supply and gain: limited voltage and back-EMF are a torque-speed line."""
    fitted = fit("model=mujoco_default", *STS3215)
    write("mjlab", fitted, tmp_path, gain="8", supply="7")
    (joint,) = read_mjlab((tmp_path / "mjlab_actuators.py").read_text())
    law, values = fitted.bench.actuator, fitted.values["bench"]
    affine = law.affine(values)
    given = {"gain": 8.0, "supply": 7.0, "enable": 1.0}
    fastest = 2 * joint.motor.velocity_limit
    for ctrl, qpos, speed in np.random.default_rng(0).uniform(-1, 1, size=(50, 3)):
        volts = law.control(np, values, qpos, fastest * speed, 3 * ctrl, given)
        torque = affine.gain * volts + affine.bias0 + affine.bias1 * qpos + affine.bias2 * fastest * speed
        assert joint.motor.torque(3 * ctrl, qpos, fastest * speed) == pytest.approx(torque[0], abs=1e-12)


def test_a_motors_torque_line() -> None:
    motor = Motor(100.0, 1.0, saturation_effort=3.0, velocity_limit=6.0, effort_limit=2.0)
    assert motor.torque(1.0, 0.0, 0.0) == 2.0
    assert motor.torque(1.0, 0.0, 4.0) == 1.0
    assert motor.torque(-1.0, 0.0, 4.0) == -2.0
    assert motor.torque(0.01, 0.0, 0.0) == 1.0


@pytest.mark.parametrize("target", ["mjlab", "isaaclab"])
def test_a_force_drive_is_refused(fit: Callable[..., Fitted], tmp_path: Path, target: str) -> None:
    with pytest.raises(ExportError, match="Force"):
        write(target, fit("bench=emps", "model=mujoco_default"), tmp_path)


def test_a_templates_own_damping_is_in_the_files(fit: Callable[..., Fitted], tmp_path: Path) -> None:
    """They replace the robot's."""
    template = (files("frictionzoo.bench") / "assets" / "servo_pendulum.xml").read_text()
    (tmp_path / "damped.xml").write_text(template.replace('type="hinge"', 'type="hinge" damping="0.3"'))
    fitted = fit("model=mujoco_default", *STS3215, f"bench.mjcf={tmp_path / 'damped.xml'}")
    damping = 0.3 + float(fitted.values["friction"]["damping"][0])
    for target, limit in (("mjlab", 1e-6), ("bam", 0.05)):
        (tmp_path / target).mkdir()
        export = write(target, fitted, tmp_path / target)
        assert export.differences[-1].largest < limit
    assert read_mjlab((tmp_path / "mjlab" / "mjlab_actuators.py").read_text())[0].damping == pytest.approx(damping)
    assert read(tmp_path / "bam" / "m1.json")["friction_viscous"] == pytest.approx(damping)


def test_gain_and_supply_are_options(fit: Callable[..., Fitted], tmp_path: Path) -> None:
    fitted = fit("model=mujoco_default", *STS3215)
    write("mjlab", fitted, tmp_path, gain="32", supply="6")
    (joint,) = read_mjlab((tmp_path / "mjlab_actuators.py").read_text())
    values = {name: float(value[0]) for name, value in fitted.values["bench"].items()}
    assert joint.motor.stiffness == pytest.approx(6 * 32 * values["kt_over_r"] * values["duty_gain"])
