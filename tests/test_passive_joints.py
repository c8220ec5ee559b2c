"""Robots whose joints have actuators of different kinds, or none: what the file states is simulated, or refused."""

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
import pytest
from helpers.makers_actuators import compare_in_c, values_of

import frictionzoo as fz
from frictionzoo.bench.given import build_open
from frictionzoo.core.config import compose_settings
from frictionzoo.core.errors import BenchError, LogError
from frictionzoo.core.log import Dataset
from frictionzoo.diagnostics.recordings import check_up
from frictionzoo.models.mujoco_default import MujocoDefault
from frictionzoo.simulation.proof import TOLERANCE, Recorded, prove

pytestmark = pytest.mark.usefixtures("x64")

STEP, NAMES = 0.002, ("waist", "shoulder", "elbow", "wrist")
KNOWN = {"armature": {"identify": False}}
ACTUATORS = {
    "position": '<position name="{0}_p" joint="{0}" kp="{1}" kv="0.2"/>',
    "stiff": '<position name="{0}_p" joint="{0}" kp="{1}" ctrlrange="-1 0.8"/>',
    "velocity": '<velocity name="{0}_v" joint="{0}" kv="0.{1}" ctrlrange="-2 3"/>',
    "motor": '<motor name="{0}_m" joint="{0}" gear="{1}"/>',
    "none": "",
}
OF_PD = ("position", "stiff", "velocity", "none")


def write(folder: Path, kinds: Sequence[str], rest: str = "", seed: int = 0) -> str:
    """A chain of joints with these actuators, of random size."""
    rng, bodies = np.random.default_rng(seed), ""
    for name, _ in zip(NAMES, kinds, strict=False):
        axis = " ".join(map(str, rng.permutation([1, 0, 0])))
        armature, loss, damping = rng.uniform(0.01, 0.1, 3)
        bodies += f'<body pos="0 0 -0.2"><joint name="{name}" axis="{axis}" armature="{armature}" damping="{damping}"'
        bodies += f' frictionloss="{loss}"/><inertial pos="0.01 0 -0.1" mass="0.5" diaginertia=".01 .01 .01"/>'
    own = "".join(ACTUATORS[kind].format(name, rng.integers(3, 9)) for name, kind in zip(NAMES, kinds, strict=False))
    text = f'<mujoco><compiler angle="radian"/><option timestep="{STEP}"/><worldbody>{bodies}'
    text += f"{'</body>' * len(kinds)}</worldbody>{rest}<actuator>{own}</actuator></mujoco>"
    text = text.replace("</actuator><actuator>", "")
    (folder / "arm.xml").write_text(text)
    return str(folder / "arm.xml")


def draw_kinds(seed: int, of: Sequence[str]) -> list[str]:
    """Kinds for all joints, among them an actuator and a joint without one."""
    rng = np.random.default_rng(seed)
    kinds = [of[0], "none", *rng.choice(of, 2)]
    return [kinds[place] for place in rng.permutation(4)]


def record(joints: int, commands: int, seed: int = 0) -> dict[str, np.ndarray]:
    time, rng = STEP * np.arange(2000), np.random.default_rng(seed)
    rates = rng.uniform(2, 6, joints)
    qpos, qvel = np.sin(np.outer(time, rates)), rates * np.cos(np.outer(time, rates))
    return {"time": time, "qpos": qpos, "qvel": qvel, "ctrl": rng.normal(size=(2000, commands))}


@pytest.mark.parametrize("of", [OF_PD, ("motor", "none")], ids=["controllers", "motors"])
@pytest.mark.parametrize("seed", range(4))
def test_joints_with_and_without_actuators_move_as_in_the_makers_file(seed, of, tmp_path):
    kinds = draw_kinds(seed, of)
    path = write(tmp_path, kinds, seed=seed)
    robot = fz.Robot(path, params=KNOWN)
    assert robot.passive == tuple(name for name, kind in zip(NAMES, kinds, strict=True) if kind == "none")
    assert any(note.startswith("joints without an actuator") for note in robot.notes)
    assert any(note.startswith("velocity servos") for note in robot.notes) == ("velocity" in kinds)
    assert compare_in_c(robot, mujoco.MjModel.from_xml_path(path)) < 1e-9
    driven = [place for place, kind in enumerate(kinds) if kind != "none"]
    columns = record(4, len(driven), seed)
    (log,) = fz.read(columns)
    for accepted in (robot.accept(log), robot.accept(robot.accept(log))):
        np.testing.assert_array_equal(accepted.ctrl[:, driven], columns["ctrl"])
        assert accepted.ctrl.shape == (2000, 4) and not np.delete(accepted.ctrl, driven, axis=1).any()
    data = Dataset("arm", (accepted,), (accepted,))
    silent = {*robot.passive, *(name for name, kind in zip(NAMES, kinds, strict=True) if kind == "velocity")}
    assert not [one for one in check_up(data, robot, "warn") if one.joint in silent and "ctrl" in one.text]
    with pytest.raises((BenchError, LogError), match="ctrl"):
        robot.accept(next(iter(fz.read(record(4, 5)))))


def test_the_engine_simulates_a_mixture(tmp_path: Path) -> None:
    robot = fz.Robot(
        write(tmp_path, ("velocity", "none", "stiff")),
        actuator=fz.JointPD({"kp": {"init": None}, "kd": {"init": None}}, torque_limit=1.5),
        params=KNOWN,
    )
    (log,) = fz.read(record(3, 2))
    law = MujocoDefault(3, {"frictionloss": 0.1, "damping": 0.1})
    proof = prove(robot, law, "specialised", values_of(robot), Recorded.of([robot.accept(log)]))
    assert 0 < proof.step <= proof.rollout < 1e-2 * TOLERANCE


def test_a_velocity_servo_takes_the_desired_velocity(tmp_path: Path) -> None:
    """Where recordings have positions and velocities of a trajectory, each servo gets its own."""
    robot = fz.Robot(write(tmp_path, ("velocity", "position")))
    columns = record(2, 2) | {"ctrl_velocity": record(2, 2, seed=1)["ctrl"]}
    log = robot.accept(next(iter(fz.read(columns))))
    np.testing.assert_array_equal(log.ctrl[:, 0], columns["ctrl_velocity"][:, 0])
    np.testing.assert_array_equal(log.ctrl[:, 1], columns["ctrl"][:, 1])
    assert not log.inputs["ctrl_velocity"][:, 0].any()
    np.testing.assert_array_equal(log.inputs["ctrl_velocity"][:, 1], columns["ctrl_velocity"][:, 1])


TENDONS = {
    "position": '<position name="pull" tendon="t" kp="3"/>',
    "velocity": '<velocity name="pull" tendon="t" kv="0.1"/>',
    "motor": '<motor name="pull" tendon="t"/>',
}


@pytest.mark.parametrize("kind", TENDONS)
def test_one_actuator_of_several_joints_is_refused_by_its_name(kind: str, tmp_path: Path) -> None:
    coupled = '<tendon><fixed name="t"><joint joint="shoulder" coef="1"/><joint joint="elbow" coef="-2"/></fixed>'
    path = write(tmp_path, (kind, "none", "none"), f"{coupled}</tendon><actuator>{TENDONS[kind]}</actuator>")
    laws = [
        None,
        fz.Force({"force_gain": {"init": None}})
        if kind == "motor"
        else fz.JointPD({"kp": {"init": None}, "kd": {"init": None}}),
    ]
    for law in laws:
        with pytest.raises(BenchError, match=r"actuator pull moves 2 joints, shoulder, elbow.*bench\.joint") as refused:
            fz.Robot(path, actuator=law)
        assert "\n" not in str(refused.value)
    assert fz.Robot(path, "waist").passive == ()  # the others do not move
    stated = fz.Force() if kind == "motor" else fz.JointPD(kp=5, kd=1)
    assert fz.Robot(path, actuator=stated).passive == ()


@pytest.mark.parametrize("kinds", [("stiff",), ("velocity", "stiff"), ("stiff", "none"), ("velocity",)])
def test_known_values_of_the_file_need_no_bounds(kinds: Sequence[str], tmp_path: Path) -> None:
    """Through the options of bench=robot: kp and kd that the file has as 0 lie outside the bounds of a fit."""
    given = {"bench": {"mjcf": write(tmp_path, kinds)}}
    settings = compose_settings(given, "bench=robot", "data=files", "model=mujoco_default", "recipe=given")
    bench, missing = build_open(settings["bench"])
    assert missing is None and bench.joints == NAMES[: len(kinds)]
    assert [value == 0 for value in bench.initial_values()["kp"]] == [kind != "stiff" for kind in kinds]
    assert [value == 0 for value in bench.initial_values()["kd"]] == [kind != "velocity" for kind in kinds]


def test_a_gain_of_zero_stays_where_others_are_identified(tmp_path: Path) -> None:
    free = {"init": None, "low": 1e-3, "high": 1e3, "scale": "log", "identify": True}
    robot = fz.Robot(write(tmp_path, ("stiff", "velocity", "none")), actuator=fz.JointPD({"kp": free, "kd": free}))
    assert robot.params["kp"].identify == (True, False, False) and robot.params["kd"].identify == (True, True, False)
    values = robot.initial_values()
    assert values["kp"][1:].tolist() == [0, 0] and values["kd"][2] == 0 and values["kd"][0] > 0


def test_joints_of_several_types_are_named(tmp_path: Path) -> None:
    path = Path(write(tmp_path, ("stiff", "none", "velocity")))
    path.write_text(path.read_text().replace('name="elbow" axis', 'name="elbow" type="slide" axis'))
    with pytest.raises(BenchError, match=r"waist \(hinge\), shoulder \(hinge\), elbow \(slide\).*bench\.joint"):
        fz.Robot(str(path))
    assert fz.Robot(str(path), "elbow").joint_type == "slide"


def test_another_model_is_fitted_on_joints_without_armature(tmp_path: Path) -> None:
    robot = fz.Robot(write(tmp_path, ("stiff", "none", "velocity")))
    values = robot.initial_values() | {"armature": np.array([0.02, 0.0, 0.05])}
    again = robot.restarted(values)
    assert again.params["armature"].identify == (True, False, True)
    assert again.initial_values()["armature"].tolist() == [0.02, 0.0, 0.05]
