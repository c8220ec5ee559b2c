"""Model files that a run leaves behind move as the identified drive where they are loaded, or say how far they do not.

The judge here knows nothing of the program: it loads the file with `mujoco`, sets `data.ctrl` to the recorded command,
steps, and compares positions with those of the identified drive.
"""

import json
import re
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from helpers.fitted import fit
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Float

import frictionzoo as fz
from frictionzoo.api.identified import Identified
from frictionzoo.bench import Bench, JointPD, PositionPD
from frictionzoo.bench.delay import is_filtered, read_filter, write_delay
from frictionzoo.core.log import Payload
from frictionzoo.core.output import to_json
from frictionzoo.export.mjcf import write_identified
from frictionzoo.models import MujocoDefault
from frictionzoo.report.terminal import summarise

EXACT = 1e-9  # rad; rounding of some hundred steps stays far below
STEP, SUBSTEPS = 0.004, 2  # of the robots' files [s], and in a sample
KP, KD, GAIN, LATE = 20.0, 1.0, 0.9, 2.4 * STEP
PAYLOADS = [  # at the foot
    Payload(0.3, (0.01, 0.02, -0.03), (2e-4, 3e-4, 2.5e-4)),
    Payload(0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    Payload(0.2, (0.0, 0.0, -0.02), (1e-4, 1e-4, 1e-4)),
]


def leg(name: str, joints: int = 3, at: str = "0 0 0") -> str:
    """Links of a leg, the last with a foot."""
    inertial = '<inertial pos="0 0 0" mass="0.05" diaginertia="2e-5 2e-5 2e-5"/>'
    text = f'<body name="{name}_foot" pos="0 0 -0.2">{inertial}</body>'
    for number in reversed(range(joints)):
        axis, place = ("1 0.1 0", at) if number == 0 else ("0 1 0", "0.01 0.02 -0.2")
        inertial = '<inertial pos="0.01 0 -0.1" mass="0.5" diaginertia="0.003 0.003 0.0006"/>'
        joint = f'<joint name="{name}{number}" axis="{axis}"/>'
        text = f'<body name="{name}_link{number}" pos="{place}">{joint}{inertial}{text}</body>'
    return text


def robot(legs: str, floating: bool) -> str:
    """A robot's own file, with its maker's actuators."""
    base = '<freejoint name="root"/><inertial pos="0 0 0" mass="5" diaginertia="0.1 0.1 0.1"/>' if floating else ""
    joints = re.findall(r'joint name="(\w+\d)"', legs)
    servos = "".join(f'<position name="{name}" joint="{name}" kp="7" kv="0.3"/>' for name in joints)
    return (
        f'<mujoco model="robot"><compiler angle="radian"/><option timestep="{STEP}"/><worldbody>'
        f'<body name="trunk" pos="0 0 0.6">{base}{legs}</body></worldbody><actuator>{servos}</actuator></mujoco>'
    )


LEG = robot(leg("knee"), floating=False)
BIPED = robot(leg("left", 2, "0.2 0.1 0") + leg("right", 2, "0.2 -0.1 0"), floating=True)


def load(text: str, payload: Payload | None = None, foot: str = "", **joints: float) -> mujoco.MjModel:
    """A model file with its base held, a payload welded to the foot, and values of all joints where they are given."""
    spec = mujoco.MjSpec.from_string(text)
    for joint in [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]:
        spec.delete(joint)
    if payload and payload.mass:
        options = {"mass": payload.mass, "ipos": payload.position, "inertia": payload.inertia}
        spec.body(foot).add_body(**options, explicitinertial=True).name = "payload"
    for joint in spec.joints if joints else ():
        joint.armature, joint.frictionloss = joints["armature"], joints["frictionloss"]
        joint.damping = [joints["damping"], 0, 0]
    return spec.compile()


def record(text: str, foot: str, encoders: np.ndarray, pulls: np.ndarray, payload: Payload) -> dict[str, np.ndarray]:
    """A recording with the controller in the loop, fine steps, and friction that is larger than what is known of it."""
    fine, seconds, bare = 4, 1.6, re.sub("<actuator>.*</actuator>", "", text)
    model = load(bare, payload, foot, armature=0.02, frictionloss=0.12, damping=0.06)
    model.opt.timestep = STEP / fine
    data, rng = mujoco.MjData(model), np.random.default_rng(len(encoders) + round(10 * payload.mass))
    times = STEP * SUBSTEPS * np.arange(round(seconds / STEP / SUBSTEPS))
    rates, phases = rng.uniform(4, 14, (2, model.nv))
    ctrl = 0.4 * np.sin(rates * times[:, None] + phases)
    states = []
    for number in range(len(ctrl) * SUBSTEPS * fine):
        measured = data.qpos - encoders
        if number % (SUBSTEPS * fine) == 0:
            states.append(np.concatenate([measured, data.qvel]))
        command = ctrl[max(0, number - round(LATE / STEP * fine)) // (SUBSTEPS * fine)]
        data.qfrc_applied[:] = GAIN * (KP * (command - measured) - KD * data.qvel) + pulls
        mujoco.mj_step(model, data)
    qpos, qvel = np.split(np.array(states) + rng.normal(scale=1e-4, size=(len(ctrl), 2 * model.nv)), 2, axis=1)
    return {"time": times, "qpos": qpos, "qvel": qvel, "ctrl": ctrl}


def identify(folder: Path, text: str, foot: str) -> Identified:
    """A run with known values, which are not quite those of the recordings."""
    path = folder / "robot.xml"
    path.write_text(text)
    count = load(text).nv
    encoders, pulls = 0.03 * np.sin(1 + np.arange(count)), 0.2 * np.cos(np.arange(count))
    read = [
        fz.read(record(text, foot, encoders, pulls, load), payload=[[load.mass, *load.position, *load.inertia]])
        for load in PAYLOADS
    ]
    size = {"init": 0.1, "low": 1e-3, "high": 1.0, "identify": False, "scale": "log"}
    bench = fz.Robot(
        str(path),
        actuator=fz.JointPD(kp=KP, kd=KD, torque_gain=GAIN),
        params={"armature": 0.02, "delay": LATE, "position_offset": encoders.tolist(), "torque_offset": pulls.tolist()},
        payload=foot,
    )
    how: dict[str, Any] = {
        **{"method": "known", "recipe": "given", "dtype": "float64", "checkup": "warn", "discretisation": False},
        "evaluation": {"horizons": [0.4], "rollouts": 4, "places": 1, "trajectory": 0.4, "window": 0.02},
        "segments": {"count": 20, "length": 5},
        "loop": {"progress": False},
    }
    law = MujocoDefault(count, {"frictionloss": size, "damping": size})
    return fz.identify(bench, law, [next(iter(logs)) for logs in read], test=fz.Split(test_share=0.5, gap=0.05), **how)


def play(model: mujoco.MjModel, drive: Identified, rollout: int, offset: np.ndarray) -> Float[np.ndarray, "time nv"]:
    """Positions after each sample: `data.ctrl` is the recorded command, and nothing else is done."""
    segments = drive.segments
    command, history = segments.signals.ctrl[rollout], segments.history
    per_sample = round(segments.timestep / model.opt.timestep)
    data, found = mujoco.MjData(model), []
    data.qpos[:], data.qvel[:] = segments.qpos[rollout, 0] + offset, segments.qvel[rollout, 0]
    for actuator in range(model.nu):
        if count := int(model.actuator_history[actuator, 0]):
            steps = np.arange(-count, 0)
            past = command[np.maximum(history + np.floor_divide(steps, per_sample), 0), actuator]
            mujoco.mj_initCtrlHistory(model, data, actuator, model.opt.timestep * steps, past)
    if model.na:  # filters, which lag by less than a step
        data.act[:] = command[max(history - 1, 0), model.actuator_actnum > 0]
    for sample in range(segments.length):
        data.ctrl[:] = command[history + sample]
        mujoco.mj_step(model, data, nstep=per_sample)
        found.append(data.qpos.copy())
    return np.array(found) - offset


def judge(text: str, drive: Identified, foot: str, own: bool) -> tuple[float, float]:
    """Mean and largest distance of a file from the identified drive; a robot's own joints have true positions."""
    expected, found = drive.rollout()[0], []
    offset = drive.values["bench"].get("position_offset", np.zeros(drive.bench.nv)) if own else np.zeros(drive.bench.nv)
    loads: Any = drive.segments.load
    for rollout in range(drive.segments.count):
        carried = [each for each in PAYLOADS if foot and np.array_equal(loads[rollout], drive.bench.load(each))]
        found.append(play(load(text, *carried, foot=foot), drive, rollout, offset))
    distance = np.abs(np.array(found) - expected)
    return float(distance.mean()), float(distance.max())


def check(row: Any, text: str, drive: Identified, foot: str = "") -> None:
    """An entry of `result.json` has the judge's numbers, and the file's comment says what they are."""
    mean, largest = judge(text, drive, foot, own=row["file"] == "identified.xml" and isinstance(drive.bench, fz.Robot))
    assert (row["mean"], row["largest"]) == pytest.approx((mean, largest), abs=EXACT)
    error = drive.result["metrics"]["test"]["position_mae"]
    assert error and row["share"] == pytest.approx(mean / error, abs=1e-6)
    assert row["exact"] == (largest < EXACT) == ("represented exactly" in text)
    assert row["exact"] or f"{mean:.3g} rad on average" in text


@pytest.mark.slow
@pytest.mark.usefixtures("in_haste")
def test_a_robots_run_leaves_files_that_move_as_it(tmp_path: Path) -> None:
    """What a run says of a robot's files is so, in its `result.json` and where it is printed."""
    drive, folder, foot = identify(tmp_path, BIPED, "left_foot"), tmp_path / "run", "left_foot"
    result = drive.save(folder)
    assert json.loads((folder / "result.json").read_text())["written"] == to_json(result["written"])
    assert [row["file"] for row in result["written"]] == ["bench.xml", "identified.xml"]
    for row in result["written"]:
        check(row, (folder / row["file"]).read_text(), drive, foot)
        assert row["exact"] and float(row["share"] or 0) < 0.1
        assert any("Payloads" in limit for limit in row["limits"])
    assert "bench.xml, identified.xml: the identified drive, represented exactly" in summarise(result, folder)


@pytest.mark.parametrize("name", ["mujoco_default", "coulomb_stribeck"])
def test_a_run_says_how_far_its_file_is_from_the_drive(finished_run: Any, name: str) -> None:
    folder, finished = finished_run(name)
    drive = Identified.load(folder)
    (row,) = drive.result["written"]
    check(row, (folder / row["file"]).read_text(), drive)
    assert re.search(rf"^identified.xml +{row['mean']:.4g} ", finished.out, re.MULTILINE)


def describe(drive: Identified) -> list[tuple[Any, str]]:
    """Each file's entry in `result.json`, and the file."""
    return [(file.describe(drive), file.content.decode()) for file in write_identified(drive)]


@pytest.mark.parametrize("steps", [0.0, 0.3, 0.8, 1.0, 2.4])
@pytest.mark.parametrize("substeps", [1, 2])
def test_a_single_joint_is_late_by_any_delay(steps: float, substeps: int) -> None:
    late = {"init": steps * 1e-3, "low": 0.0, "high": 0.01, "identify": True, "scale": 0.01}
    options: dict[str, Any] = {"actuator": PositionPD(kp=20.0, kd=1.0), "params": {"armature": 0.01, "delay": late}}
    drive = fit("knee_rod.xml", kind=Bench, length=200, substeps=substeps, **options)
    ((row, text),) = describe(drive)
    check(row, text, drive)
    assert row["exact"] == (steps in (0, 1, 2.4))
    filtered = f"delay of {steps * 1e-3:g} s is a filter with the same lag in steps of 0.001 s"
    for said in (text, " ".join(row["limits"])):
        assert (filtered in said) == (not row["exact"])


@pytest.mark.parametrize(("floating", "limit"), [(False, None), (True, None), (False, 2.0)])
def test_a_leg_has_delay_offsets_gain_payload_and_limit(floating: bool, limit: float | None, tmp_path: Path) -> None:
    (tmp_path / "leg.xml").write_text(robot(leg("knee", 2), floating))
    params = {"armature": 0.02, "delay": LATE, "position_offset": [0.03, -0.05], "torque_offset": [0.3, -0.2]}
    actuator = JointPD(kp=KP, kd=KD, torque_gain=GAIN, **({"torque_limit": limit} if limit else {}))
    options: dict[str, Any] = {"params": params, "payload": "knee_foot", "load": PAYLOADS[:2]}
    drive = fit(tmp_path / "leg.xml", actuator=actuator, length=60, **options)
    for row, text in describe(drive):
        check(row, text, drive, "knee_foot")
        assert row["exact"] and ('forcerange="-1.5 2.1"' in text) == bool(limit)


def test_a_file_in_longer_steps_says_so(tmp_path: Path) -> None:
    (tmp_path / "leg.xml").write_text(LEG)
    drive = fit(tmp_path / "leg.xml", timestep=STEP / 4, substeps=6, length=40, params={"delay": STEP / 2})
    (_, _), (row, text) = describe(drive)
    assert row["timestep"] == STEP
    assert row["mean"] > EXACT and "steps of 0.004 s instead of 0.001 s" in row["reason"] and row["reason"] in text
    assert any("0.002 s is a filter with the same lag in steps of 0.004 s" in limit for limit in row["limits"])


def test_a_file_that_cannot_be_played_says_why(tmp_path: Path) -> None:
    """Joints that stand still may be tied to each other, and not by a tendon to one that moves."""
    pair = '<joint joint="knee0" coef="1"/><joint joint="knee1" coef="1"/>'
    tendon = f'<tendon><fixed name="t" stiffness="0">{pair}</fixed></tendon><actuator>'
    tie = '<equality><joint joint1="knee0" joint2="knee1"/></equality><actuator>'
    for coupled, joints, played in ((tie, "knee2", True), (tendon, ["knee1", "knee2"], False)):
        (tmp_path / "leg.xml").write_text(LEG.replace("<actuator>", coupled))
        _, (row, text) = describe(fit(tmp_path / "leg.xml", joints))
        assert row["exact"] == played == ("represented exactly" in text)
        if not played:
            assert row["mean"] is row["largest"] is row["share"] is None
            assert any("not simulated: a tendon connects knee0" in limit and limit in text for limit in row["limits"])


def test_the_makers_range_of_commands_is_named(tmp_path: Path) -> None:
    (tmp_path / "leg.xml").write_text(LEG.replace('kv="0.3"', 'kv="0.3" ctrlrange="-0.5 0.5"'))
    for ranges in ("keep", "leave_out"):
        drive = fit(tmp_path / "leg.xml", length=60, ranges=ranges)
        _, (row, text) = describe(drive)
        check(row, text, drive)
        assert row["exact"] == (ranges == "keep")
    assert "ctrlrange" in row["reason"] and row["reason"] in text


@given(st.floats(0, 0.1), st.floats(1e-4, 0.02))
@settings(max_examples=200, deadline=None)
def test_a_delay_is_that_of_mujocos_actuator(delay: float, timestep: float) -> None:
    """In MuJoCo itself: a command that rises steadily acts as it was a delay ago, in the end."""
    attributes = " ".join(f'{name}="{value}"' for name, value in write_delay(delay, timestep).items())
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{timestep!r}"/><worldbody><body><joint name="j"/><geom size="1"/></body>'
        f'</worldbody><actuator><general joint="j" {attributes}/></actuator></mujoco>'
    )
    data, steps = mujoco.MjData(model), int(np.ceil(delay / timestep)) + 60
    if steps > 300:
        return
    for step in range(steps):
        data.ctrl[0] = step
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(steps - 1 - data.actuator_force[0], delay / timestep, atol=1e-6)
    if is_filtered(delay, timestep):
        assert read_filter(model.actuator_dynprm[0, 0], timestep) == pytest.approx(delay)
