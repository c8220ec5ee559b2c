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
from jaxtyping import Float

import frictionzoo as fz
from frictionzoo.models import MujocoDefault
from frictionzoo.result.identified import Identified
from frictionzoo.show.terminal import summarise

EXACT = 1e-9  # rad; rounding of some hundred steps stays far below
STEP, SUBSTEPS = 0.004, 2  # of the robots' files [s], and in a sample
KP, KD, GAIN, LATE = 20.0, 1.0, 0.9, 2.4 * STEP
PAYLOADS = [[0.3, 0.01, 0.02, -0.03, 2e-4, 3e-4, 2.5e-4], [0.0] * 7, [0.2, 0.0, 0.0, -0.02, 1e-4, 1e-4, 1e-4]]


def leg(name: str, joints: int = 3, at: str = "0 0 0") -> str:
    """Links of a leg, the last with a foot."""
    foot = '<inertial pos="0 0 0" mass="0.05" diaginertia="2e-5 2e-5 2e-5"/>'
    text = f'<body name="{name}_foot" pos="0 0 -0.2">{foot}</body>'
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
QUADRUPED = robot(
    "".join(
        leg(f"{x}{y}", at=f"{0.2 * i} {0.1 * j} 0") for x, i in (("F", 1), ("R", -1)) for y, j in (("L", 1), ("R", -1))
    ),
    floating=True,
)


def load(text: str, payload: list[float] | None = None, foot: str = "", **joints: float) -> mujoco.MjModel:
    """A model file with its base held, a payload welded to the foot, and values of all joints where they are given."""
    spec = mujoco.MjSpec.from_string(text)
    for joint in [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]:
        spec.delete(joint)
    if payload and payload[0]:
        body = spec.body(foot).add_body(mass=payload[0], ipos=payload[1:4], inertia=payload[4:], explicitinertial=True)
        body.name = "payload"
    for joint in spec.joints if joints else ():
        joint.armature, joint.frictionloss = joints["armature"], joints["frictionloss"]
        joint.damping = [joints["damping"], 0, 0]
    return spec.compile()


def record(
    text: str, foot: str, encoders: np.ndarray, pulls: np.ndarray, payload: list[float]
) -> dict[str, np.ndarray]:
    """A recording with the controller in the loop, fine steps, and friction that is larger than what is known of it."""
    fine, seconds = 4, 1.6
    model = load(
        re.sub("<actuator>.*</actuator>", "", text), payload, foot, armature=0.02, frictionloss=0.12, damping=0.06
    )
    model.opt.timestep = STEP / fine
    data, rng = mujoco.MjData(model), np.random.default_rng(len(encoders) + round(10 * payload[0]))
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
    logs = [fz.read(record(text, foot, encoders, pulls, payload), payload=[payload]) for payload in PAYLOADS]
    law = MujocoDefault(
        count,
        {
            name: {"init": 0.1, "low": 1e-3, "high": 1.0, "identify": False, "scale": "log"}
            for name in ("frictionloss", "damping")
        },
    )
    bench = fz.Robot(
        str(path),
        actuator=fz.JointPD(kp=KP, kd=KD, torque_gain=GAIN, torque_offset=pulls.tolist()),
        params={"armature": 0.02, "delay": LATE, "position_offset": encoders.tolist()},
        payload=foot,
    )
    how: dict[str, Any] = {
        "method": "known",
        "recipe": "given",
        "dtype": "float64",
        "checkup": "warn",
        "discretisation": False,
    }
    judging = {"horizons": [0.4], "rollouts": 4, "places": 1, "trajectory": 0.4, "window": 0.02}
    logs = [next(iter(log)) for log in logs]
    return fz.identify(
        bench,
        law,
        logs,
        test=0.4,
        evaluation=judging,
        segments={"count": 20, "length": 5},
        loop={"progress": False},
        **how,
    )


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
    for sample in range(segments.length):
        data.ctrl[:] = command[history + sample]
        mujoco.mj_step(model, data, nstep=per_sample)
        found.append(data.qpos.copy())
    return np.array(found) - offset


def judge(text: str, drive: Identified, foot: str = "", own: bool = False) -> tuple[float, float]:
    """Mean and largest distance of a file from the identified drive; a robot's own joints have true positions."""
    expected, found = drive.rollout()[0], []
    offset = drive.values["bench"].get("position_offset", np.zeros(drive.bench.nv)) if own else np.zeros(drive.bench.nv)
    for rollout in range(drive.segments.count):
        payload = None
        if drive.segments.load is not None:
            (payload,) = (
                each
                for each in PAYLOADS
                if np.allclose(drive.segments.load[rollout], drive.bench.load(as_payload(each)))
            )
        found.append(play(load(text, payload, foot), drive, rollout, offset))
    distance = np.abs(np.array(found) - expected)
    return float(distance.mean()), float(distance.max())


def as_payload(numbers: list[float]) -> Any:
    return fz.Payload(numbers[0], tuple(numbers[1:4]), tuple(numbers[4:]))


def check_run(drive: Identified, folder: Path, foot: str) -> None:
    """The numbers of `result.json`, of the printed text and of the files' comments are the judge's."""
    result = drive.save(folder)
    assert json.loads((folder / "result.json").read_text())["written"] == result["written"]
    assert [row["file"] for row in result["written"]] == ["bench.xml", "identified.xml"]
    said, error = summarise(result, folder), result["metrics"]["test"]["position_mae"]
    assert error and error > 1e-3
    for row in result["written"]:
        text = (folder / row["file"]).read_text()
        mean, largest = judge(text, drive, foot, own=row["file"] == "identified.xml")
        assert (row["mean"], row["largest"]) == pytest.approx((mean, largest), abs=EXACT)
        assert row["share"] == pytest.approx(mean / error, abs=1e-6) and row["share"] < 0.1
        assert row["exact"] and "represented exactly" in text
        assert row["file"] in said and any("Payloads" in limit for limit in row["limits"])


def test_a_leg_leaves_a_file_that_moves_as_it(tmp_path: Path) -> None:
    check_run(identify(tmp_path, LEG, "knee_foot"), tmp_path / "run", "knee_foot")


@pytest.mark.slow
def test_a_quadruped_leaves_a_file_that_moves_as_it(tmp_path: Path) -> None:
    check_run(identify(tmp_path, QUADRUPED, "FL_foot"), tmp_path / "run", "FL_foot")
