"""Payloads: a recording's own mass on the bench, in both engines, in a fit over several recordings, and refused."""

import json
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest
from conftest import slow_but
from test_specialised import BODIES, KNOWN, chain, law, random_cases, step_of

from frictionzoo.bench import Bench, PositionPD
from frictionzoo.bench.base import NO_PAYLOAD
from frictionzoo.engine import MjxEngine, SpecialisedEngine
from frictionzoo.errors import BenchError, ConfigError
from frictionzoo.logs.payloads import choose_payloads
from frictionzoo.logs.recording import Recording
from frictionzoo.types import Log, Payload

PAYLOADS = [
    Payload(0.7, (0.02, -0.01, -0.2), (0.001, 0.002, 0.0015)),
    Payload(1.5, (0.0, 0.05, -0.1), (0.004, 0.003, 0.002)),
    NO_PAYLOAD,
]
TRUTH = {"armature": 0.03, "frictionloss": 0.2, "damping": 0.1}


@pytest.fixture
def x64() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


def make_bench(
    tmp_path: Path, body: str, joints: int, payload: str | None = "carrier", armature: float = 0.02
) -> Bench:
    path = tmp_path / "bench.xml"
    path.write_text(
        '<mujoco><option timestep="0.001" tolerance="0" iterations="200"><flag contact="disable"/></option>'
        f"<worldbody>{body}</worldbody></mujoco>"
    )
    actuator = PositionPD({"kp": {"init": 20.0, **KNOWN}, "kd": {"init": 1.0, **KNOWN}})
    names = [f"j{index}" for index in range(joints)]
    return Bench(str(path), names, actuator, {"armature": {"init": armature, **KNOWN}}, [0.02, 1.0], payload, None)


def welded(bench: Bench, payload: Payload, constraint: bool, case: dict[str, np.ndarray]) -> mujoco.MjModel:
    """The bench with the payload as a body of its own without a joint, compiled by MuJoCo C."""
    values = bench.initial_values() | {"armature": case["armature"]}
    spec = mujoco.MjSpec.from_string(bench.mjcf(values, case["frictionloss"] if constraint else None, case["damping"]))
    if payload.mass:
        body = spec.body("carrier").add_body(name="payload", mass=payload.mass, ipos=payload.position)
        body.inertia, body.explicitinertial = payload.inertia, True
    return spec.compile()


def test_a_load_does_not_know_where_the_armature_begins(tmp_path: Path) -> None:
    """To the last bit: runs are compared where their rollouts, and the loads in them, have the same hash."""
    body = chain(2).replace("<body", '<body name="carrier"', 1)
    benches = [make_bench(tmp_path, body, 2, armature=armature) for armature in (0.02, 0.3, 0.00107)]
    loads = [[bench.load(payload) for payload in PAYLOADS] for bench in benches]
    np.testing.assert_array_equal(loads, np.broadcast_to(loads[0], np.shape(loads)))


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(
    ("body", "constraint"),
    slow_but([("chain", False), ("simple slide", True)], product([*BODIES, "simple slide", "chain"], [False, True])),
)
def test_a_step_with_a_payload_is_that_of_a_welded_body(tmp_path: Path, body: str, constraint: bool) -> None:
    joints = 2 if body == "chain" else 1
    simple = '<joint name="j0" type="slide"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
    text = chain(2) if body == "chain" else f"<body>{BODIES.get(body, simple)}</body>"
    at = text.rindex("<body") + len("<body")
    bench = make_bench(tmp_path, f'{text[:at]} name="carrier"{text[at:]}', joints)
    cases = random_cases(30, joints)
    cases["load"] = np.stack([bench.load(PAYLOADS[index % 3]) for index in range(30)])
    expected = []
    for index in range(30):
        case = {name: value[index] for name, value in cases.items()}
        model = welded(bench, PAYLOADS[index % 3], constraint, case)
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = case["qpos"], case["qvel"], case["ctrl"]
        data.qfrc_applied[:] = -case["torque"]
        mujoco.mj_step(model, data)
        expected.append([data.qpos.copy(), data.qvel.copy()])
    tolerance = 1e-8 if constraint and joints > 1 else 1e-12
    for kind in (SpecialisedEngine, MjxEngine):
        step = jax.jit(jax.vmap(step_of(kind(bench, law(constraint), constraint), bench)))
        np.testing.assert_allclose(step(cases), expected, rtol=0, atol=tolerance, err_msg=kind.__name__)


@pytest.mark.usefixtures("x64")
def test_no_payload_is_the_bench_itself(tmp_path: Path) -> None:
    body = BODIES["inclined axis, off-axis mass"]
    carrying = make_bench(tmp_path, f'<body name="carrier">{body}</body>', 1)
    cases = random_cases(20, 1)
    loaded = cases | {"load": np.tile(carrying.load(NO_PAYLOAD), (20, 1))}
    plain = make_bench(tmp_path, f'<body name="carrier">{body}</body>', 1, None)
    ours, bare = (
        jax.vmap(step_of(SpecialisedEngine(bench, law(True), True), bench))(given)
        for bench, given in ((carrying, loaded), (plain, cases))
    )
    np.testing.assert_allclose(ours, bare, rtol=1e-12, atol=1e-14)
    assert plain.load(NO_PAYLOAD).shape == (0,)


def record(path: Path, bench: Bench, payload: Payload, seed: int) -> None:
    truth = {name: np.array([value]) for name, value in TRUTH.items()}
    model = welded(bench, payload, True, truth)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(seed)
    time = 1e-3 * np.arange(3000)
    ctrl = sum(a * np.sin(w * time + p) for a, w, p in rng.uniform([0.1, 2, 0], [0.4, 12, 6], (3, 3)))
    rows = []
    for index in range(len(time)):
        rows.append([time[index], data.qpos[0], data.qvel[0], ctrl[index]])
        data.ctrl[:] = ctrl[index]
        mujoco.mj_step(model, data)
    np.savetxt(path, rows, fmt="%.12g", delimiter=",", header="time,qpos,qvel,ctrl", comments="")


def test_one_drive_is_found_from_recordings_with_different_payloads(call: Callable, tmp_path: Path) -> None:
    body = BODIES["hinge with gravity"]
    bench = make_bench(tmp_path, f'<body name="carrier">{body}</body>', 1)
    for index, payload in enumerate(PAYLOADS):
        record(tmp_path / f"{index}.csv", bench, payload, index)
    numbers = [[payload.mass, *payload.position, *payload.inertia] for payload in PAYLOADS]
    listed = ",".join(f"[{','.join(map(str, row))}]" for row in numbers)
    finished = call(
        *("model=mujoco_default", "fit=lm", "data=files", "dtype=float64", "loop.progress=false"),
        *("data.train=[0.csv,1.csv]", "data.test=[2.csv]", f"data.payload=[{listed}]", "segments.length=10"),
        *("bench.mjcf=bench.xml", "bench.joint=j0", "bench.payload=carrier", "evaluation.horizons=[0.5]"),
        *("evaluation.trajectory=1.0", "hydra.run.dir=run"),
    )
    assert finished.status == 0, finished.err
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    found = {item["name"]: item["value"] for item in result["parameters"] if item["identified"]}
    for name, value in TRUTH.items():
        assert found[name] == pytest.approx(value, rel=1e-5), name
    assert result["metrics"]["test"]["position_rmse"] < 1e-7
    assert [log["payload"] for log in result["data"]["logs"]] == numbers


def test_a_payload_needs_a_body_that_is_there(tmp_path: Path, knee: Bench) -> None:
    zeros = np.zeros((10, 1))
    log = Log("a.csv", np.arange(10) * 1e-3, zeros, zeros, zeros, "", False, PAYLOADS[0])
    with pytest.raises(BenchError, match=r"a\.csv: a payload of 0\.7 kg, but bench\.payload=null; name the body"):
        knee.accept(log)
    with pytest.raises(BenchError, match=r"no body carier; did you mean carrier\?"):
        make_bench(tmp_path, f'<body name="carrier">{BODIES["hinge with gravity"]}</body>', 1, "carier")


def test_a_body_without_mass_may_carry_a_payload_or_none(tmp_path: Path) -> None:
    body = f'<body>{BODIES["hinge with gravity"]}<body name="carrier" pos="0 0 -0.2"/></body>'
    bench = make_bench(tmp_path, body, 1)
    bare, loaded = bench.load(NO_PAYLOAD), bench.load(PAYLOADS[0])
    assert np.isfinite(bare).all() and loaded[0] == PAYLOADS[0].mass
    assert loaded[-1] > bare[-1] > 0


def test_a_body_that_no_joint_moves_carries_none(tmp_path: Path) -> None:
    stand = '<body name="carrier"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>'
    body = f"{stand}<body>{BODIES['hinge with gravity']}</body>"
    with pytest.raises(BenchError, match="no joint moves body carrier"):
        make_bench(tmp_path, body, 1)


@pytest.mark.parametrize(
    ("payload", "line"),
    [
        ([[1.0] * 7], r"data\.payload has 1 entries, expected 2, one a recording, train first"),
        ([[1.0] * 7, [1.0] * 6], r"data\.payload of b\.csv is .*; expected 7 numbers"),
        ([[1.0] * 7, [float("nan")] * 7], "expected 7 numbers"),
        ([[1.0] * 7, 3.0], "expected 7 numbers"),
        ([[1.0, 0, 0, 0, 1, 0, 0], [0.0] * 7], "no inertia above the sum of the other two"),
        ([[-1.0, 0, 0, 0, 0, 0, 0], [0.0] * 7], "expected mass and inertia of at least 0"),
    ],
)
def test_a_payload_that_makes_no_sense_is_refused(payload: list, line: str) -> None:
    recordings = [Recording(name, np.zeros(1), {}) for name in ("a.csv", "b.csv")]
    with pytest.raises(ConfigError, match=line):
        choose_payloads(payload, recordings)
