"""A robot's joints under desired positions, velocities, feed-forward torques and gains, against loops in MuJoCo C."""

import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

import frictionzoo as fz
from frictionzoo.bench import Actuator, Bench
from frictionzoo.core.errors import BenchError, ConfigError
from frictionzoo.core.log import Dataset, Log
from frictionzoo.core.segments import Sampling, Segments, cut_segments
from frictionzoo.core.state import Signals
from frictionzoo.diagnostics.recordings import check_up
from frictionzoo.fit import Objective, Space, fit_reference
from frictionzoo.models import FrictionModel
from frictionzoo.simulation import friction_of, make_engine
from frictionzoo.simulation.proof import TOLERANCE, Recorded, initial_values, prove
from frictionzoo.simulation.rollout import make_rollout

pytestmark = pytest.mark.usefixtures("in_haste", "x64")

LEG = """<mujoco><compiler angle="radian"/><option timestep="0.001" integrator="{}"><flag contact="disable"/></option>
  <worldbody><body><joint name="hip" axis="0 1 0"/><geom type="capsule" size=".03" fromto="0 0 0 0 0 -.2" mass="1.2"/>
    <body pos="0 0 -.2"><joint name="knee" axis="0 1 0"/><geom type="capsule" size=".02" fromto="0 0 0 0 0 -.2"
      mass=".3"/></body></body></worldbody></mujoco>"""
LINK = """<mujoco><option timestep="0.001" integrator="{}"/><worldbody><body><joint name="hip" axis="0 1 0"/>
  <geom type="capsule" size=".03" fromto="0 0 0 0 0 -.2" mass="1.2"/></body></worldbody></mujoco>"""
STEP, SUBSTEPS, LATE = 0.001, 5, 13  # s; simulation steps in a sample; and by which commands act late
GAINS = {"kp": 20.0, "kd": 1.0}
LIMIT = 5.0  # N m
TRUTH = {"armature": (0.012, 0.02), "frictionloss": (0.2, 0.3), "damping": (0.05, 0.1)}
LATER = {"delay": {"init": 0.004, "low": 0.0, "high": 0.04, "scale": 0.01, "identify": True}}
SIZES = {"torque_gain": 0.9, "torque_saturation": 8.0, "torque_limit": 5.0}


def commands(samples: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Desired positions with their own velocities, which a leg follows, and torques beside."""
    rng, time = np.random.default_rng(seed), STEP * SUBSTEPS * np.arange(samples)[:, None, None]
    rate, phase = 2 * np.pi * rng.uniform(0.5, 3, (3, 2)), rng.uniform(0, 6, (3, 2))
    size = rng.uniform(0.2, 0.5, (3, 2))
    angle = rate * time + phase
    told = {"ctrl": (size * np.sin(angle)).sum(1), "ctrl_velocity": (size * rate * np.cos(angle)).sum(1)}
    return told | {"ctrl_torque": 0.5 * np.sin(2 * angle).sum(1)}


def move(told: Mapping[str, np.ndarray], gains: Mapping[str, float], mjcf: str = LEG) -> dict[str, np.ndarray]:
    """What the encoders tell: MuJoCo C with the controller in the loop, all of its commands late."""
    spec = mujoco.MjSpec.from_string(mjcf.format("Euler"))
    for index, joint in enumerate(spec.joints):
        joint.armature, joint.frictionloss = TRUTH["armature"][index], TRUTH["frictionloss"][index]
        joint.damping = [TRUTH["damping"][index], 0, 0]
    model, states = spec.compile(), []
    data = mujoco.MjData(model)
    told = {**told, **{name: np.broadcast_to(gain, told["ctrl"].shape) for name, gain in gains.items()}}
    for step in range(len(told["ctrl"]) * SUBSTEPS):
        if step % SUBSTEPS == 0:
            states.append((data.qpos.copy(), data.qvel.copy()))
        now = {name: values[max(0, step - LATE) // SUBSTEPS] for name, values in told.items()}
        torque = now["kp"] * (now["ctrl"] - data.qpos) + now["kd"] * (now["ctrl_velocity"] - data.qvel)
        data.qfrc_applied[:] = np.clip(torque + now["ctrl_torque"], -LIMIT, LIMIT)
        mujoco.mj_step(model, data)
    qpos, qvel = np.moveaxis(np.array(states), 1, 0)
    return {"time": STEP * SUBSTEPS * np.arange(len(qpos)), "qpos": qpos, "qvel": qvel, **told}


@pytest.fixture
def leg(tmp_path: Path) -> Any:
    """Benches of the leg, or of another MJCF, under a law."""

    def make(law: Actuator, mjcf: str = LEG.format("Euler"), **more: Any) -> Bench:
        (tmp_path / "leg.xml").write_text(mjcf)
        joints = ["hip", "knee"] if "knee" in mjcf else "hip"
        return Bench(str(tmp_path / "leg.xml"), joints, actuator=law, params={"armature": {}, **more})

    return make


def read(columns: Mapping[str, np.ndarray]) -> Log:
    return next(iter(fz.read(columns)))


@pytest.mark.parametrize("law", [fz.JointPD, fz.RecordedPD])
@pytest.mark.parametrize("limits", [(), ("torque_limit",), ("torque_saturation", "torque_limit")])
def test_the_torque_is_the_equations(law: type[Actuator], limits: tuple[str, ...]) -> None:
    rng = np.random.default_rng(0)
    q, v, ctrl, velocity, torque = rng.normal(size=(5, 30, 2))
    kp, kd = rng.uniform(1, 30, (2, 2))
    sizes = {name: SIZES[name] for name in ("torque_gain", *limits)}
    known = {"kp": 20.0, "kd": 1.0} if law is fz.JointPD else {}
    made = law(**known, **sizes)
    assert set(made.params) == {*known, *sizes}  # a limit that is not there has no parameter
    values = {name: np.full(2, size) for name, size in sizes.items()} | {"kp": kp, "kd": kd}
    inputs = {"kp": kp, "kd": kd, "ctrl_velocity": velocity, "ctrl_torque": torque}
    wanted = kp * (ctrl - q) + kd * (velocity - v) + torque
    if "torque_saturation" in limits:
        wanted = 8.0 * np.tanh(wanted / 8.0)
    wanted = np.clip(wanted, -5.0, 5.0) if limits else wanted
    assert np.abs(wanted).max() == 5.0 or not limits
    affine = made.affine(values)
    got = made.control(np, values, q, v, ctrl, inputs)
    given = affine.gain * got + affine.bias0 + affine.bias1 * q + affine.bias2 * v
    np.testing.assert_allclose(given, 0.9 * wanted, rtol=0, atol=1e-12)
    if law is fz.JointPD and not limits:  # MuJoCo's position actuator gets a position, whatever the state
        np.testing.assert_array_equal(got, made.control(np, values, 0 * q, 0 * v, ctrl, inputs))
    parts = {name: torch.tensor(part) for name, part in {**values, **inputs}.items()}
    in_torch = made.control(torch, parts, *map(torch.tensor, (q, v, ctrl)), parts)
    np.testing.assert_allclose(in_torch, got, rtol=1e-13, atol=1e-13)


def test_a_force_is_the_command_unless_something_is_said() -> None:
    plain, limited = fz.Force(), fz.Force(force_gain=2.0, force_offset=0.5, torque_limit=3.0)
    ctrl, values = np.linspace(-5, 5, 11), {"force_gain": np.ones(1), "force_offset": np.zeros(1)}
    assert not plain.has_controller and limited.has_controller
    assert {name: param.init for name, param in plain.params.items()} == {"force_gain": 1, "force_offset": 0}
    assert plain.control(np, values, 0, 0, ctrl, {}) is ctrl and plain.affine(values).gain == 1
    values = {"force_gain": 2.0, "force_offset": 0.5, "torque_limit": 3.0}
    affine, got = limited.affine(values), limited.control(np, values, 0, 0, ctrl, {})
    np.testing.assert_allclose(affine.gain * got + affine.bias0, np.clip(2 * ctrl + 0.5, -3, 3), atol=1e-14)


def test_a_joint_without_stiffness_takes_velocities() -> None:
    """With kp = 0 the command is the desired velocity; with kp = kd = 0 the joint has no torque but ctrl_torque."""
    rng = np.random.default_rng(0)
    q, v, ctrl, velocity, torque = rng.normal(size=(5, 30, 3))
    kp, kd = np.array([20.0, 0.0, 0.0]), np.array([1.0, 2.0, 0.0])
    inputs = {"ctrl_velocity": velocity, "ctrl_torque": torque}
    wanted = kp * (ctrl - q) + kd * (velocity - v) + torque + np.array([0, 2, 0]) * ctrl
    for limits in ({}, {"torque_limit": 3.0}):
        law = fz.JointPD(kp=kp.tolist(), kd=kd.tolist(), **limits)
        values = {"kp": kp, "kd": kd, "torque_gain": np.ones(3)} | {n: np.full(3, of) for n, of in limits.items()}
        affine, got = law.affine(values), law.control(np, values, q, v, ctrl, inputs)
        given = affine.gain * got + affine.bias0 + affine.bias1 * q + affine.bias2 * v
        np.testing.assert_allclose(given, np.clip(wanted, -3, 3) if limits else wanted, rtol=0, atol=1e-12)
        parts = {name: torch.tensor(part) for name, part in {**values, **inputs}.items()}
        in_torch = law.control(torch, parts, *map(torch.tensor, (q, v, ctrl)), parts)
        np.testing.assert_allclose(in_torch, got, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("gains", [{"kp": 0, "kd": 0}, {"kp": [0, 0], "kd": 0}, {"kp": -1, "kd": 1}])
def test_a_controller_needs_a_gain(gains: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=r"^JointPD: kp="):
        fz.JointPD(**gains)


@pytest.mark.parametrize(
    ("law", "integrator"),
    [
        (fz.JointPD(**GAINS, **SIZES), "Euler"),
        (fz.JointPD(**GAINS), "implicitfast"),
        (fz.RecordedPD(torque_limit=LIMIT), "Euler"),
    ],
    ids=["limited", "implicit", "recorded"],
)
def test_it_moves_as_in_mujoco_c(leg: Any, make: Any, law: Actuator, integrator: str) -> None:
    bench, told = leg(law, LINK.format(integrator)), {name: of[:, :1] for name, of in commands(100).items()}
    friction: FrictionModel = make("model", "model=mujoco_default", nv=1)
    named = {**told, "kp": 20 + 5 * told["ctrl"], "kd": 0 * told["ctrl"] + 1}
    inputs = {name: named[name] for name in law.inputs}
    signals = Signals(told["ctrl"], inputs)
    recorded = Recorded(0.7 * told["ctrl"], 0.7 * told["ctrl_velocity"], signals, np.zeros((100, 0)))
    proof = prove(bench, friction, "specialised", initial_values(bench, friction), recorded)
    assert 0 < proof.step <= proof.rollout < 1e-2 * TOLERANCE


@pytest.mark.parametrize("law", [fz.JointPD, fz.RecordedPD, fz.Force])
@pytest.mark.parametrize("name", ["torque_limit", "torque_saturation"])
def test_a_limit_leaves_a_torque(law: type[Actuator], name: str) -> None:
    """What is 0 altogether and known is not there; 0 as a beginning, in one joint of several, or less is refused."""
    gains: Any = GAINS if law is fz.JointPD else {}
    assert name not in law(**gains, **{name: 0.0}).params
    begun = {"init": 0.0, "low": 0.0, "high": 10.0, "scale": 1.0, "identify": True}
    for wrong in (-3.0, [5.0, 0.0], begun, begun | {"init": {"hip": 5.0, "knee": 0.0}}):
        with pytest.raises(ConfigError, match=rf"^{law.__name__}: {name}=.+; expected above 0; leave it out where"):
            law(**gains, **{name: wrong})


def test_a_hidden_saturation_is_found(leg: Any, make: Any) -> None:
    """What the motor lacks of large torques alone, beside the armature and friction of a joint that swings a load."""
    hidden = {"init": 20.0, "low": 1.0, "high": 100.0, "scale": "log", "identify": True}
    bench: Bench = leg(fz.JointPD(**GAINS, torque_saturation=hidden), LINK.format("Euler"))
    law: FrictionModel = make("model", "model=mujoco_default", nv=1)
    rollout = make_rollout(make_engine("specialised", bench, friction_of(law), True), Sampling(STEP, 1, 0))
    truth = {name: np.array(of[:1]) for name, of in TRUTH.items()} | {"torque_saturation": np.array([LIMIT])}
    friction = {name: truth[name] for name in law.params}
    values = {"bench": bench.initial_values() | truth, "friction": friction}
    told = {name: 2.0 * np.stack([commands(200, seed)[name][:, :1] for seed in range(4)]) for name in commands(1)}
    signals, still = Signals(told["ctrl"], {n: told[n] for n in told if n != "ctrl"}), np.zeros((4, 1))
    moved = [np.concatenate([still[:, None], of], axis=1) for of in rollout.compiled(values, still, still, signals)]
    segments = Segments(*moved, signals, STEP)
    assert np.abs(GAINS["kp"] * (told["ctrl"] - moved[0][:, :-1])).max() > 2 * LIMIT
    found = fit_reference(Objective(Space(bench, law, "float64"), rollout, segments, 1.0, 0.01, "none", 1.0, False))
    identified = {**found["bench"], **found["friction"]}
    assert {name: identified[name].item() for name in truth} == pytest.approx(
        {name: of.item() for name, of in truth.items()}, rel=1e-4
    )


def test_a_hidden_delay_of_all_commands_is_found(leg: Any, make: Any) -> None:
    """13 ms, 2.6 samples; desired velocities and torques are late as positions are, and the torque has its limit."""
    bench: Bench = leg(fz.JointPD(**GAINS, torque_limit=LIMIT), LINK.format("Euler"), **LATER)
    sampling = bench.sampling(STEP * SUBSTEPS)
    assert sampling == Sampling(STEP * SUBSTEPS, SUBSTEPS, 8, ("ctrl_velocity", "ctrl_torque"))
    columns = move({name: of[:, :1] for name, of in commands(300).items()}, GAINS, LINK)
    assert (np.abs(columns["ctrl"] - columns["qpos"]) > LIMIT / GAINS["kp"]).any()
    log = bench.accept(read({name: values for name, values in columns.items() if name not in GAINS}))
    segments = cut_segments([log], count=None, length=50, history=sampling.history)
    law: FrictionModel = make("model", "model=mujoco_default", nv=1)
    rollout = make_rollout(make_engine("specialised", bench, friction_of(law), True), sampling)
    values = fit_reference(Objective(Space(bench, law, "float64"), rollout, segments, 1.0, 0.01, "none", 1.0, False))
    found = {**values["bench"], **values["friction"]}
    np.testing.assert_allclose(found["delay"], LATE * STEP, rtol=0, atol=1e-6)
    for name, truth in TRUTH.items():
        np.testing.assert_allclose(found[name], truth[:1], rtol=1e-3, err_msg=name)


def test_what_a_log_lacks_is_zero_and_said(leg: Any, caplog: pytest.LogCaptureFixture) -> None:
    bench: Bench = leg(fz.JointPD(**GAINS))
    columns = {
        "time": STEP * SUBSTEPS * np.arange(50),
        **{name: commands(50)["ctrl"] for name in ("qpos", "qvel", "ctrl")},
    }
    plain, told = read(columns), read(columns | {"ctrl_velocity": commands(50)["ctrl_velocity"]})
    with caplog.at_level(logging.INFO):
        (log,) = bench.accept_all(Dataset("robot", (plain,), (plain,))).train
    assert "robot: no ctrl_torque recorded; the actuator uses 0" in caplog.text
    assert {name: of.shape for name, of in log.inputs.items()} == dict.fromkeys(bench.inputs, (50, 2))
    assert not any(of.any() for of in log.inputs.values())
    with pytest.raises(BenchError, match=r"no ctrl_velocity, which .* has and the actuator uses; map a column"):
        bench.accept_all(Dataset("robot", (plain,), (told,)))
    assert bench.accept(told).inputs["ctrl_velocity"] is not None
    with pytest.raises(BenchError, match=r"no kp, which RecordedPD needs; map a column \(data\.columns\.kp\)"):
        leg(fz.RecordedPD()).accept(plain)


def test_one_column_serves_all_joints(leg: Any) -> None:
    told = commands(50)
    columns = {"time": STEP * SUBSTEPS * np.arange(50), "qpos": told["ctrl"], **told}
    log = leg(fz.RecordedPD()).accept(read(columns | {"kp": np.full(50, 20.0), "kd": np.ones((50, 2))}))
    np.testing.assert_array_equal(log.inputs["kp"], np.full((50, 2), 20.0))
    np.testing.assert_array_equal(log.inputs["ctrl_velocity"], told["ctrl_velocity"])
    with pytest.raises(ConfigError, match=r"sign\.kp"):
        fz.read(columns, sign={"kp": -1})


def test_doubts_look_at_all_commands(leg: Any) -> None:
    """A drive by feed-forward torque alone moves, and a torque of the wrong sign is refused."""
    told = commands(600)
    still = {"ctrl": 0 * told["ctrl"], "ctrl_velocity": 0 * told["ctrl"], "ctrl_torque": 3 * told["ctrl_torque"]}
    for law, gains in ((fz.RecordedPD(), {"kp": 0.0, "kd": 0.05}), (fz.JointPD(**GAINS), GAINS)):
        bench: Bench = leg(law)
        log = bench.accept(read(move(still, gains)))
        data = Dataset("robot", (log,), (log,))
        assert check_up(data, bench, "strict") == []
        turned = replace(log, extras={**log.extras, "ctrl_torque": -9 * log.extras["ctrl_torque"]})
        turned = bench.accept(turned)
        told_of = check_up(Dataset("robot", (turned,), (turned,)), bench, "warn")
        assert any("takes energy from the drive" in doubt.text for doubt in told_of)
    follows = bench.accept(read(move(told, GAINS)))
    assert check_up(Dataset("robot", (follows,), (follows,)), bench, "strict") == []
    # A knee that stands still is a fault only if it is commanded to move; no torque explains its motion.
    resting = {name: getattr(follows, name) * [1, 0] for name in ("qpos", "qvel")}
    for ctrl, severe in ((follows.ctrl * [1, 0], set()), (follows.ctrl, {"still"})):
        extras = {**follows.extras, "ctrl_velocity": 0 * ctrl, "ctrl_torque": 0 * ctrl, "torque": follows.ctrl}
        log = bench.accept(replace(follows, **resting, ctrl=ctrl, extras=extras))
        found = check_up(Dataset("robot", (follows, log), (follows,)), bench, "warn")
        assert {one.title for one in found if one.state == "bad"} == severe
