"""Parameters from torque alone: motions whose torque MuJoCo C gives, and the equation that balances it."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from conftest import job_settings, needs_data, run_main
from helpers.robots import JOINTS, TRUTH, arm
from helpers.torque_logs import STEP, log_of, move, needed

from frictionzoo.bench import Bench, Force
from frictionzoo.bench.base_parameters import find_base_parameters
from frictionzoo.bench.inertia import SYMBOLS, LogCholesky, inertial_parameters, is_consistent, put_parameters
from frictionzoo.bench.regressor import inertial_regressor, inverse_torque
from frictionzoo.core.build import build
from frictionzoo.core.described import describe
from frictionzoo.core.errors import BenchError, ConfigError, LogError
from frictionzoo.core.log import Log
from frictionzoo.core.state import DriveState
from frictionzoo.fit import InverseDynamics, Space
from frictionzoo.fit.motion import Decimation, Filtering, Recordings
from frictionzoo.fit.torque_balance import FreeLinks, balance
from frictionzoo.fit.torque_equation import TorqueEquation
from frictionzoo.models import FrictionModel
from frictionzoo.models.base import sliding_torque
from frictionzoo.models.registry import get_model

pytestmark = pytest.mark.usefixtures("x64")

FILTERING = Filtering(bandwidth=20.0)
SECTION = {"init": 0.5, "low": 1e-4, "high": 50.0, "scale": "log", "identify": True}
SPREAD = np.repeat([0.2, 0.03, 0.3], [1, 3, 6])


@pytest.fixture(scope="module")
def arm_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("arm") / "arm.xml"
    path.write_text(arm())
    return path


def bench_of(path: Path, **params: Any) -> Bench:
    return Bench(str(path), JOINTS, actuator=Force(), params={"armature": SECTION | {"low": 1e-4}} | params)


def law_of(name: str, nv: int, **changes: Any) -> FrictionModel:
    """A law whose parameters are all identified, from the same start."""
    dimensions = get_model(name).dimensions
    return get_model(name)(nv, {parameter: SECTION | changes.get(parameter, {}) for parameter in dimensions})


def equation_of(bench: Bench, law: FrictionModel, *logs: Log, held: bool = False) -> TorqueEquation:
    accepted = tuple(map(bench.accept, logs))
    return TorqueEquation(Space(bench, law, "float64"), Recordings(bench, law, accepted), FILTERING, held)


def solve(equation: TorqueEquation) -> dict[str, np.ndarray]:
    """Physical values of what was identified."""
    found = balance(equation)
    return equation._space.physical(found.vector)


def test_decimation_is_the_same_for_every_part_of_a_sum_and_keeps_logs_apart() -> None:
    rng, decimate = np.random.default_rng(0), Decimation(10, (300, 200), 20)
    one, other = rng.normal(size=(2, 500, 2))
    np.testing.assert_allclose(decimate(one + 2 * other), decimate(one) + 2 * decimate(other), atol=1e-12)
    np.testing.assert_allclose(decimate(np.ones((500, 1))), 1.0, rtol=1e-9)
    apart = [Decimation(10, (len(part),), 20)(part) for part in (one[:300], one[300:])]
    np.testing.assert_array_equal(decimate(one), np.concatenate(apart))


def test_motion_is_without_phase_lag() -> None:
    motion = move(3)
    found = FILTERING.motion(log_of(motion[0], motion[0]))
    inner = slice(100, -100)
    for came, true in zip(found, motion, strict=True):
        np.testing.assert_allclose(came[inner], true[inner], atol=1e-3 * np.abs(true).max())


def test_the_arm_is_found_again_from_positions_and_torque(arm_file: Path) -> None:
    bench, motion = bench_of(arm_file), move(5)
    torque = needed(bench.compile(constraint=False), motion)
    found = solve(equation_of(bench, law_of("mujoco_default", 5), log_of(motion[0], torque)))
    np.testing.assert_allclose(found["bench.armature"], TRUTH["armature"], rtol=5e-3)
    np.testing.assert_allclose(found["friction.frictionloss"], TRUTH["frictionloss"], rtol=5e-3)
    np.testing.assert_allclose(found["friction.damping"], TRUTH["damping"], rtol=5e-3)


def test_two_logs_noise_and_shared_values(arm_file: Path) -> None:
    bench = bench_of(arm_file)
    model, rng, logs = bench.compile(constraint=False), np.random.default_rng(1), []
    for seed in (0, 1):
        motion = move(5, seed=seed)
        torque = needed(model, motion) + 0.2 * rng.normal(size=motion[0].shape)
        logs.append(log_of(motion[0] + 1e-5 * rng.normal(size=motion[0].shape), torque, str(seed)))
    equation = equation_of(bench, law_of("mujoco_default", 5, damping={"tie": {"wrist": "joint[34]"}}), *logs)
    found = balance(equation)
    values = equation._space.physical(found.vector)
    np.testing.assert_allclose(values["bench.armature"], TRUTH["armature"], rtol=0.03)
    assert values["friction.damping"][3] == values["friction.damping"][4]
    white = 0.2 * np.sqrt(20 * 2 * STEP)  # of 0.2 N m at 500 samples/s, of which 20 Hz pass
    assert ((white < found.sigma[:3]) & (found.sigma[:3] < 2 * white)).all()
    off = np.log(values["bench.armature"] / TRUTH["armature"])
    assert (np.abs(off) < 4 * found.errors[:5]).all()


def test_a_delay_an_offset_and_a_gain_are_found_along(arm_file: Path) -> None:
    delay = {"init": 0.005, "low": 0.0, "high": 0.05, "scale": 0.01, "identify": True}
    offset = {"init": 1.0, "low": -5.0, "high": 5.0, "scale": 1.0, "identify": True}
    actuator, params = Force({"force_offset": offset}), {"armature": SECTION, "delay": delay}
    bench = Bench(str(arm_file), JOINTS, actuator=actuator, params=params)
    motion = move(5)
    late = [0.0043, 0.0080, 0.0125, 0.0200, 0.0310]
    torque = needed(bench.compile(constraint=False), motion) - 0.7
    time = STEP * np.arange(len(torque))
    ctrl = np.stack([np.interp(time + by, time, column) for by, column in zip(late, torque.T, strict=True)], axis=1)
    found = solve(equation_of(bench, law_of("mujoco_default", 5), log_of(motion[0], ctrl)))
    np.testing.assert_allclose(found["bench.delay"], late, atol=3e-4)
    np.testing.assert_allclose(found["bench.force_offset"], 0.7, atol=0.02)
    np.testing.assert_allclose(found["bench.armature"], TRUTH["armature"], rtol=0.03)


def test_a_held_command_counts_half_a_sample_later(arm_file: Path) -> None:
    bench, motion, law = bench_of(arm_file), move(5), law_of("mujoco_default", 5)
    torque = needed(bench.compile(constraint=False), motion)
    held, sampled = (equation_of(bench, law, log_of(motion[0], torque), held=held) for held in (True, False))
    vector = sampled.box.start
    mean = np.concatenate([torque[:1], (torque[1:] + torque[:-1]) / 2])
    expected = sampled.lack(vector) + sampled.decimate(mean - torque)
    np.testing.assert_allclose(held.lack(vector), expected, atol=1e-9)


LAWS = ("coulomb_stribeck", "asymmetric", "load_dependent")


def friction_of(law: FrictionModel, truth: dict[str, np.ndarray], state: DriveState) -> np.ndarray:
    """The torque of a law with these values."""
    values = {name: torch.from_numpy(value) for name, value in truth.items()}
    seen = state.map(torch.from_numpy)
    return sliding_torque(torch, law.terms(torch, values, seen), seen.qvel).numpy()


@pytest.mark.parametrize("name", LAWS)
def test_a_law_is_found_by_its_formula_under_a_controller(name: str, leg: Callable[..., Bench]) -> None:
    rng, bench = np.random.default_rng(4), leg(params={"armature": SECTION})
    truth = {parameter: rng.uniform(0.2, 0.9, 2) for parameter in get_model(name).dimensions}
    truth |= {n: v / 4 for n, v in truth.items() if n in ("smoothing_velocity", "load_friction")}
    law = law_of(name, 2, **{n: {"init": list(map(float, 0.8 * v))} for n, v in truth.items()})
    law.bind(bench.joints)
    qpos, qvel, qacc = move(2)
    model = bench.compile(constraint=False)
    links, external = inverse_torque(model, qpos, qvel, qacc), -inverse_torque(model, qpos, qvel, 0 * qacc)
    motor = links
    for _ in range(50):  # friction depends on the motor's torque, if by a part of it
        friction = friction_of(law, truth, DriveState(qpos, qvel, qpos, motor, external))
        motor = links + 0.3 * qacc + friction
    found = solve(equation_of(bench, law, log_of(qpos, qpos + (motor + qvel) / 20.0)))
    np.testing.assert_allclose(found["bench.armature"], 0.3, rtol=0.01)
    for parameter, value in truth.items():
        np.testing.assert_allclose(found[f"friction.{parameter}"], value, rtol=0.1, err_msg=parameter)


def test_an_encoder_bias_is_found_along(arm_file: Path) -> None:
    free = {"joint[13]": True, ".*": False}  # those with a horizontal axis
    section = {"init": 0.0, "low": -0.5, "high": 0.5, "scale": 0.1, "identify": free}
    bench, motion = bench_of(arm_file, position_offset=section), move(5, seconds=5.0)
    torque = needed(bench.compile(constraint=False), motion)
    bias = np.array([0.0, 0.05, 0.0, 0.1, 0.0])
    found = solve(equation_of(bench, law_of("mujoco_default", 5), log_of(motion[0] - bias, torque)))
    np.testing.assert_allclose(found["bench.position_offset"][[1, 3]], bias[[1, 3]], atol=2e-3)


def wrong_links(model: mujoco.MjModel, bodies: list[int]) -> np.ndarray:
    """Parameters of bodies 10 to 30 % off in mass, with other centres and sizes; put into the model."""
    rng = np.random.default_rng(5)
    off = rng.normal(size=(len(bodies), 10)) * np.repeat([0.0, 0.01, 0.05], [1, 3, 6])
    off[:, 0] = np.log1p(rng.choice([-1, 1], len(bodies)) * rng.uniform(0.1, 0.3, len(bodies)))
    around = LogCholesky.around(inertial_parameters(model, bodies), [str(body) for body in bodies])
    truth = around.parameters(off)
    for body, own in zip(bodies, truth, strict=True):
        put_parameters(model, body, own)
    return truth


def test_link_inertia_is_found_as_far_as_the_data_tell(arm_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench, bodies, seen = bench_of(arm_file), [1, 2, 3, 4, 5], []
    model = bench.compile(constraint=False)
    truth = wrong_links(model, bodies)
    rng, logs = np.random.default_rng(6), []
    for seed in (0, 1):
        motion = move(5, seed=seed)
        noise = 2e-6 * rng.normal(size=motion[0].shape)
        logs.append(log_of(motion[0] + noise, needed(model, motion), str(seed)))
    equation = equation_of(bench, law_of("mujoco_default", 5), *logs)
    links = FreeLinks.of(equation, bodies, SPREAD)
    look = FreeLinks.prior
    monkeypatch.setattr(FreeLinks, "prior", lambda self, parameters: seen.append(parameters) or look(self, parameters))
    found = balance(equation, links)
    assert len(seen) > 10 and all(is_consistent(parameters).all() for parameters in seen)

    # Of all that acts on torque linearly, combinations count; armatures first, for they are what is looked for.
    motion = np.random.default_rng(7).normal(size=(3, 300, 5))
    armature = (np.eye(5) * motion[2][:, :, None]).reshape(-1, 5)
    regressor = inertial_regressor(model, bodies, *motion).reshape(len(armature), -1)
    names = [f"armature {joint}" for joint in JOINTS] + [f"{symbol} {body}" for body in bodies for symbol in SYMBOLS]
    base = find_base_parameters(np.hstack([armature, regressor]), names)
    rows = np.concatenate([equation._space.split(np.arange(15))["bench.armature"], np.arange(15, 65)])
    at = np.exp(found.vector[rows[:5]])
    scale = np.concatenate([at, np.ones(50)])
    information = found.information[np.ix_(rows, rows)] / np.outer(scale, scale)
    errors = np.sqrt(np.diag(np.linalg.inv(information[np.ix_(base.leading, base.leading)])))
    came = base.matrix @ np.concatenate([at, found.bodies.ravel()])
    true = base.matrix @ np.concatenate([TRUTH["armature"], truth.ravel()])
    determined = errors < 0.01 * np.abs(true)
    assert determined.sum() > 15
    np.testing.assert_allclose(came[determined], true[determined], rtol=0.02)
    values = equation._space.physical(found.vector)
    np.testing.assert_allclose(values["friction.frictionloss"], TRUTH["frictionloss"], rtol=0.02)
    np.testing.assert_allclose(values["friction.damping"], TRUTH["damping"], rtol=0.02)
    # What nothing sees stays the maker's.
    maker = inertial_parameters(bench.compile(constraint=False), bodies)
    assert not base.matrix[:, base.names.index("m 1")].any()
    np.testing.assert_allclose(found.bodies[0, 0], maker[0, 0], rtol=1e-6)


def test_a_short_log_is_refused(arm_file: Path) -> None:
    qpos = move(5, seconds=0.2)[0]
    with pytest.raises(LogError, match=r"a: 100 samples, expected at least 150 with fit.bandwidth"):
        equation_of(bench_of(arm_file), law_of("mujoco_default", 5), log_of(qpos, qpos))


def test_links_take_the_place_of_the_files_and_a_record_tells_them(arm_file: Path) -> None:
    name, bench = "link2", bench_of(name_links(arm_file))
    model = bench.compile(constraint=False)
    body = model.body(name).id
    other = LogCholesky.around(inertial_parameters(model, [body]), [name]).parameters(np.full((1, 10), 0.05))
    changed = bench.with_inertia({name: other[0].tolist()})
    for again in (changed, build(describe(changed))):
        np.testing.assert_allclose(inertial_parameters(again.compile(False), [body]), other, rtol=1e-9)
    np.testing.assert_array_equal(inertial_parameters(bench.compile(False), [body]), inertial_parameters(model, [body]))
    for inertia in ({"lnk2": other[0].tolist()}, {name: [1, 2]}):
        with pytest.raises(BenchError, match=r"did you mean link2|bench\.inertia\.link2"):
            bench.with_inertia(inertia)


def name_links(arm_file: Path) -> Path:
    """The arm with names for its bodies, link1 to link5."""
    named, text = arm_file.with_name("links.xml"), arm_file.read_text()
    for number in range(1, 6):
        text = text.replace("<body pos", f'<body name="link{number}" pos', 1)
    named.write_text(text)
    return named


def test_what_is_only_the_prior_is_told(arm_file: Path) -> None:
    bench, law, motion = bench_of(name_links(arm_file)), law_of("mujoco_default", 5), move(5)
    model = bench.compile(constraint=False)
    wrong_links(model, [1, 2, 3, 4, 5])
    rng = np.random.default_rng(8)
    torque = needed(model, motion) + 4.0 * rng.normal(size=motion[0].shape)
    recordings = Recordings(bench, law, (bench.accept(log_of(motion[0], torque)),))
    fit = InverseDynamics(held=False, links="link.*", prior={"mass": 0.2, "centre": 0.03, "size": 0.3})
    found = fit.revise(recordings)
    assert found is not None and found.bodies == tuple(f"link{number}" for number in range(1, 6))
    assert is_consistent(found.found).all()
    assert {"m link1", "Ixx link1"} <= set(found.prior_only) and "mx link2" not in found.prior_only
    lines = dict(zip(found.base.describe(), found.determined, strict=True))
    assert lines["mx link2"] and all(told for text, told in lines.items() if text.startswith("friction.damping"))
    assert next(iter(found.lines())).startswith("link link1: 4 kg, the model file's 4; centre moved by")
    assert not found.determined.all()
    revised = bench.with_inertia(found.inertia)
    left, before = (balance_rms(equation_of(drive, law, log_of(motion[0], torque))) for drive in (revised, bench))
    assert left.sum() < 0.8 * before.sum()


@pytest.mark.parametrize("links", ["link.*", ()])
def test_a_base_that_stands_askew_is_told_by_its_vertical_joint(arm_file: Path, links: Any) -> None:
    bench, law, motion = bench_of(name_links(arm_file)), law_of("mujoco_default", 5), move(5)
    model, gravity = bench.compile(constraint=False), np.array([0.25, -0.4, 0.0])
    gravity[2] = -np.sqrt(9.81**2 - gravity @ gravity)
    if links:
        wrong_links(model, [1, 2, 3, 4, 5])
    model.opt.gravity[:] = gravity
    torque = needed(model, motion) + 0.1 * np.random.default_rng(8).normal(size=motion[0].shape)
    recordings = Recordings(bench, law, (bench.accept(log_of(motion[0], torque)),))
    fit = InverseDynamics(held=False, links=links, prior={"mass": 0.2, "centre": 0.03, "size": 0.3}, tilt=True)
    found = fit.revise(recordings)
    assert found is not None and found.tilt is not None
    off = np.abs(found.tilt.gravity - gravity)[:2] / 9.81
    assert (off < 3 * found.tilt.errors).all() and (found.tilt.errors < 1e-3).all()
    told = dict(zip(found.base.describe(), found.determined, strict=True))
    assert told["gravity along x"] and told["gravity along y"]
    assert any(line.startswith("gravity is 2.75 +- 0.0") for line in found.lines())
    level = bench.with_inertia(found.inertia)
    upright, leaning = (
        equation_of(drive, law, log_of(motion[0], torque))
        for drive in (level, build(describe(level.with_gravity(found.tilt.gravity.tolist()))))
    )
    left = [np.std(balance(e).residual[:, 0]) for e in (upright, leaning)]
    assert left[1] < 0.5 * left[0]


def balance_rms(equation: TorqueEquation) -> np.ndarray:
    """Torque that is left of each joint at the best coordinates."""
    found = balance(equation)
    left, driving = equation.lack(found.vector), equation.driving(found.vector)
    rms, torque = (np.sqrt(np.mean(np.square(part), axis=0)) for part in (left, driving))
    assert (rms < torque).all()
    return rms[1:4]


def test_a_gear_that_couples_two_joints_is_told(arm_file: Path) -> None:
    bench, law, motion = bench_of(arm_file), law_of("mujoco_default", 5), move(5)
    torque = needed(bench.compile(constraint=False), motion)
    assert equation_of(bench, law, log_of(motion[0], torque)).couplings(np.zeros(15)) == {}
    both = motion[:, :, 3] + motion[:, :, 4]
    torque[:, 3:] += (0.3 * both[2] + 0.5 * np.sign(both[1]) + 0.4 * both[1])[:, None]
    equation = equation_of(bench, law, log_of(motion[0], torque))
    found = balance(equation)
    assert list(equation.couplings(found.vector)) == [(3, 4)]


@pytest.mark.parametrize(
    ("options", "option"),
    [
        ({"links": "("}, r"fit\.links: \("),
        ({"links": "hand"}, r"fit\.links: hand"),
        ({"prior": {"mass": 0.1}}, r"fit\.prior\.centre"),
        ({"prior": {"mass": 0.0, "centre": 1.0, "size": 1.0}}, r"fit\.prior\.mass"),
        ({"tilt": True}, r"fit\.tilt"),
    ],
)
def test_links_and_gravity_that_cannot_be_are_refused(options: dict[str, Any], option: str, arm_file: Path) -> None:
    bench, motion = bench_of(arm_file).with_gravity([0, 0, 0]), move(5, seconds=2.0)
    recordings = Recordings(bench, law_of("mujoco_default", 5), (bench.accept(log_of(motion[0], motion[0])),))
    with pytest.raises(ConfigError, match=f"^{option}"):
        InverseDynamics(**options).revise(recordings)
    with pytest.raises(ConfigError, match=r"^bench\.gravity"):
        bench.with_gravity([0, 1])


@pytest.mark.usefixtures("unrendered")
def test_a_job_finds_a_servo_by_its_torque(tiny, compilation_cache, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with job_settings(compilation_cache):
        done = run_main(*tiny, "model=mujoco_default", "fit=inverse_dynamics", f"hydra.run.dir={tmp_path / 'run'}")
    assert done.status == 0, done.err
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert result["fit"]["method"] == "inverse_dynamics" and result["fit"]["stopped"] == "converged"
    found = {row["name"]: row for row in result["parameters"] if row["identified"]}
    assert all(row["interval"][0] < row["value"] < row["interval"][1] for row in found.values())


@needs_data
def test_emps_is_found_as_published(make: Callable[..., Any]) -> None:
    """A. Janot, M. Gautier, M. Brunot, 2019: 95.109 kg, 203.503 N s/m, 20.394 N, -3.165 N, by the same method."""
    choices = ("data=emps", "model=mujoco_default")
    bench, law, data = make("bench", *choices), make("model", *choices, nv=1), make("data", *choices).load()
    law.bind(bench.joints)
    found = solve(equation_of(bench, law, *data.train, held=True))
    assert found["bench.armature"][0] == pytest.approx(95.109, rel=0.01)
    assert found["bench.force_offset"][0] == pytest.approx(3.165, abs=0.2)
    assert found["friction.frictionloss"][0] == pytest.approx(20.394, rel=0.02)
    assert found["friction.damping"][0] == pytest.approx(203.503, rel=0.02)
