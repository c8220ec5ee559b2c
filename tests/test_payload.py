"""Payloads: a recording's own mass on the bench, in both engines, in a fit over several recordings, and refused."""

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
import pytest
from conftest import slow_but
from helpers.engine_cases import BODIES, KNOWN, chain, law, random_cases, step_of
from omegaconf import OmegaConf

from frictionzoo.bench import Bench, PositionPD
from frictionzoo.bench.compiled import NO_PAYLOAD
from frictionzoo.core.errors import BenchError, ConfigError
from frictionzoo.core.log import Log, Payload
from frictionzoo.data.recording import Recording
from frictionzoo.data.select import choose_payloads
from frictionzoo.fit.chunk import search
from frictionzoo.result.evaluate import Evaluator, predict
from frictionzoo.result.record import describe_data
from frictionzoo.simulation import MjxEngine, SpecialisedEngine

PAYLOADS = [
    Payload(0.7, (0.02, -0.01, -0.2), (0.001, 0.002, 0.0015)),
    Payload(1.5, (0.0, 0.05, -0.1), (0.004, 0.003, 0.002)),
    NO_PAYLOAD,
]
TRUTH = {"armature": 0.03, "frictionloss": 0.2, "damping": 0.1}


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
    return Bench(str(path), names, actuator=actuator, params={"armature": {"init": armature, **KNOWN}}, payload=payload)


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


@pytest.mark.usefixtures("in_haste", "x64")
@pytest.mark.parametrize(
    ("body", "constraint", "kind"),
    slow_but(
        [
            *(("chain", False, SpecialisedEngine), ("inclined axis, off-axis mass", True, SpecialisedEngine)),
            ("simple slide", True, SpecialisedEngine),
        ],
        [
            *product(["inclined axis, off-axis mass", "simple slide"], [True], [SpecialisedEngine, MjxEngine]),
            *(("chain", False, SpecialisedEngine), ("chain", True, MjxEngine)),
        ],
    ),
)
def test_a_step_with_a_payload_is_that_of_a_welded_body(tmp_path, body, constraint, kind):
    """Or, for one of three, that of the bench itself."""
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
    step = jax.jit(step_of(kind(bench, law(constraint), constraint), bench))  # of one case: a batch compiles longer
    found = [step({name: value[index] for name, value in cases.items()}) for index in range(30)]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8 if constraint and joints > 1 else 1e-12)


def record(path: Path, bench: Bench, payload: Payload, seed: int) -> None:
    truth = {name: np.array([value]) for name, value in TRUTH.items()}
    model = welded(bench, payload, True, truth)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(seed)
    time = 1e-3 * np.arange(1500)
    ctrl = sum(a * np.sin(w * time + p) for a, w, p in rng.uniform([0.1, 2, 0], [0.4, 12, 6], (3, 3)))
    rows = []
    for index in range(len(time)):
        rows.append([time[index], data.qpos[0], data.qvel[0], ctrl[index]])
        data.ctrl[:] = ctrl[index]
        mujoco.mj_step(model, data)
    np.savetxt(path, rows, fmt="%.12g", delimiter=",", header="time,qpos,qvel,ctrl", comments="")


def test_one_drive_is_found_from_recordings_with_different_payloads(compose, pose_problem, tmp_path):
    body = BODIES["hinge with gravity"]
    bench = make_bench(tmp_path, f'<body name="carrier">{body}</body>', 1)
    for index, payload in enumerate(PAYLOADS):
        record(tmp_path / f"{index}.csv", bench, payload, index)
    numbers = [[payload.mass, *payload.position, *payload.inertia] for payload in PAYLOADS]
    listed = ",".join(f"[{','.join(map(str, row))}]" for row in numbers)
    files = [str(tmp_path / f"{index}.csv") for index in range(3)]
    shared = "model=mujoco_default data=files bench=knee recipe=given fit=lm dtype=float64 compilation_cache=null"
    config = compose(
        *shared.split(),
        *(f"data.train=[{files[0]},{files[1]}]", f"data.test=[{files[2]}]", f"data.payload=[{listed}]"),
        *(f"bench.mjcf={bench.source}", "bench.joint=j0", "bench.payload=carrier", "segments.length=10"),
        *("evaluation.horizons=[0.5]", "evaluation.trajectory=1.0"),
    )
    settings: Any = OmegaConf.to_container(config, resolve=True)
    problem = pose_problem(settings)
    progress, _ = search(problem.fit, problem.objective)
    values = jax.tree.map(np.asarray, problem.objective.space.values(progress.best))
    found = values["bench"] | values["friction"]
    for name, value in TRUTH.items():
        assert found[name] == pytest.approx(value, rel=1e-5), name
    tests = problem.evaluation.trajectories
    predicted = predict(problem.drive.rollout.compiled, values, tests)
    assert np.abs(predicted.qpos - tests.qpos[:, 1:]).max() < 1e-7
    assert [log["payload"] for log in describe_data(problem.dataset)["logs"]] == numbers
    test = problem.dataset.test[0]
    heavier = replace(problem.dataset, test=(problem.bench.accept(replace(test, payload=PAYLOADS[0])),))
    assert Evaluator(heavier, "hinge", **settings["evaluation"]).sha256 != problem.evaluation.sha256


def test_a_payload_needs_a_body_that_is_there(tmp_path: Path, knee: Bench) -> None:
    assert knee.load(NO_PAYLOAD).shape == (0,)
    zeros = np.zeros((10, 1))
    log = Log("a.csv", np.arange(10) * 1e-3, zeros, zeros, zeros, "", False, PAYLOADS[0])
    with pytest.raises(BenchError, match=r"a\.csv: .*bench\.payload=null"):
        knee.accept(log)
    with pytest.raises(BenchError, match=r"no body carier; did you mean carrier\?"):
        make_bench(tmp_path, f'<body name="carrier">{BODIES["hinge with gravity"]}</body>', 1, "carier")


def test_a_body_without_mass_may_carry_a_payload_but_one_without_a_joint_not(tmp_path: Path) -> None:
    hinge = BODIES["hinge with gravity"]
    bench = make_bench(tmp_path, f'<body>{hinge}<body name="carrier" pos="0 0 -0.2"/></body>', 1)
    bare, loaded = bench.load(NO_PAYLOAD), bench.load(PAYLOADS[0])
    assert np.isfinite(bare).all() and loaded[0] == PAYLOADS[0].mass
    assert loaded[-1] > bare[-1] > 0
    stand = '<body name="carrier"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>'
    with pytest.raises(BenchError, match="no joint moves body carrier"):
        make_bench(tmp_path, f"{stand}<body>{hinge}</body>", 1)


@pytest.mark.parametrize(
    ("payload", "line"),
    [
        ([[1.0] * 7], r"data\.payload has 1 entries, expected 2"),
        ([[1.0] * 7, [1.0] * 6], r"data\.payload of b\.csv"),
        ([[1.0] * 7, [float("nan")] * 7], "7 numbers"),
        ([[1.0] * 7, 3.0], "7 numbers"),
        ([[1.0, 0, 0, 0, 1, 0, 0], [0.0] * 7], "inertia"),
        ([[-1.0, 0, 0, 0, 0, 0, 0], [0.0] * 7], "mass"),
    ],
)
def test_a_payload_that_makes_no_sense_is_refused(payload: list, line: str) -> None:
    recordings = [Recording(name, np.zeros(1), {}) for name in ("a.csv", "b.csv")]
    with pytest.raises(ConfigError, match=line):
        choose_payloads(payload, recordings)
