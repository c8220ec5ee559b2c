"""Robots' own files: what is read of them moves as MuJoCo C moves the file itself."""

import importlib
import re
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from types import ModuleType

import mujoco
import numpy as np
import pytest
from conftest import DATA, ROOT, needs_data
from helpers.robot_texts import ARM, GRIPPER, LEG, TENDON, TWO, body, changed, compiled, read, save

from frictionzoo.bench.robot_file import RobotFile, read_robot
from frictionzoo.core.errors import BenchError

SAME = 1e-10  # of a step, as a share of the state


@pytest.fixture(scope="module")
def makers() -> Iterator[ModuleType]:
    """The benchmark that compares with MuJoCo C."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "benchmarks")
        yield importlib.import_module("robot_files")


GEOMS = ('<geom type="mesh" mesh="shell"/>', '<geom size="0.05" group="1"/><geom size="1" group="3"/>')
FROM_GEOMS = ('angle="degree"', 'angle="degree" inertiafromgeom="true" inertiagrouprange="0 1"')
ROUND = ('type="mesh" mesh="shell" material="m"', 'size=".1"')
WEIGHTLESS = ('9.7"/>', '9.7"><flag gravity="disable"/></option>')
CASES = {
    "a leg, all joints": (LEG, None),
    "a leg, one joint": (LEG, "knee"),
    "a leg, by pattern": (LEG, "hip|knee"),
    "an arm": (ARM, None),
    "an arm, its elbow": (ARM, ["elbow"]),
    "a gripper whose fingers move together": (GRIPPER, None),
    "geoms before <inertial>": (changed(LEG, GEOMS, FROM_GEOMS), None),
    "a mass in all": (changed(LEG, ('"degree"', '"degree" settotalmass="7"'), ROUND), None),
    "a tendon with a spring": (changed(LEG, ("<sensor>", TENDON + "<sensor>")), ["hip", "toe"]),
    "without gravity": (changed(LEG, ("<option", '<option integrator="implicitfast"'), WEIGHTLESS), None),
}


@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass'")
@pytest.mark.parametrize("case", CASES)
def test_a_step_is_that_of_the_makers_file(case: str, tmp_path: Path, makers: ModuleType) -> None:
    text, joint = CASES[case]
    robot = read(tmp_path, text, joint)
    path = tmp_path / ("robot.urdf" if text.startswith("<robot") else "robot.xml")
    reference = makers.reference(path, robot)
    assert reference.nv == len(robot.joints)
    assert makers.difference(reference, makers.written(robot, reference), states=30) < SAME


def test_what_a_file_says_of_a_joint_is_read_at_the_joint(tmp_path: Path) -> None:
    robot = read(tmp_path, LEG)
    assert robot.joints == ("hip", "knee", "toe")
    np.testing.assert_allclose(robot.values["armature"], [36 * 0.001, 0.03, 0], rtol=1e-15)
    np.testing.assert_allclose(robot.values["damping"], [0.3 + 36 * 0.002, 0.3, 0.3], rtol=1e-15)
    np.testing.assert_array_equal(robot.values["frictionloss"], [0.2, 0.2, 0.2])
    hip, knee, toe = robot.actuators
    assert hip is not None and knee is not None and toe is not None
    assert (hip.kind, hip.gain, hip.bias1, hip.bias2) == ("motor", 6, 0, 0)
    assert (hip.ctrlrange, hip.forcerange) == ((-2, 2), (-9, 6))
    assert (knee.kind, knee.gain, knee.bias1, knee.bias2) == ("position", -30, -30, -0.4)
    assert (toe.kind, toe.gain, toe.bias2) == ("velocity", 1, -1)
    np.testing.assert_allclose(robot.ranges, np.deg2rad([[-40, 90], [np.nan, np.nan], [np.nan, np.nan]]), rtol=1e-15)
    np.testing.assert_array_equal(robot.forceranges, [[-9, 6], [np.nan, np.nan], [np.nan, np.nan]])


MOTOR = '<dcmotor name="{}" joint="hinge" motorconst="0.5" resistance="2" gear="{}" {}/>'
BRISTLES = 'lugre="80 0.7 0.1 0.2 0.05"'


def torque_of(model: mujoco.MjModel, ctrl: float, qvel: float, bend: float) -> float:
    """What the actuators of one joint give, in MuJoCo C."""
    data = mujoco.MjData(model)
    data.ctrl[:], data.act[:], data.qvel[:] = ctrl, bend, qvel
    mujoco.mj_forward(model, data)
    return float(data.qfrc_actuator[0])


@pytest.mark.parametrize("gear", [1, -3])
def test_a_dc_motor_is_bristles_and_a_torque_less_back_emf(gear: int, tmp_path: Path) -> None:
    text = body("", f"<actuator>{MOTOR.format('m', gear, BRISTLES)}</actuator>")
    makers, robot = mujoco.MjModel.from_xml_string(text), read(tmp_path, text)
    (motor,) = robot.actuators
    assert motor is not None and (motor.kind, motor.bias2) == ("motor", 0)
    own = " ".join(str(robot.bristles[name][0]) for name in robot.bristles)
    alone = f'<dcmotor joint="hinge" motorconst="1e-9" resistance="1" input="none" lugre="{own}"/>'
    bristles = mujoco.MjModel.from_xml_string(body("", f"<actuator>{alone}</actuator>"))
    for ctrl, qvel, bend in ((0.0, 0.03, 0.001), (2.0, -0.2, 0.002), (-1.0, 0.0, -0.001)):
        expected = torque_of(makers, ctrl, qvel, gear * bend)
        torque = motor.gain * ctrl - robot.values["damping"][0] * qvel + torque_of(bristles, 0.0, qvel, bend)
        assert torque == pytest.approx(expected, rel=1e-12)
    told = " ".join(robot.notes)
    assert "bristles of <dcmotor> at joint hinge: left out, model=lugre begins with them" in told
    assert "actuator m is a DC motor: its command is a voltage" in told


def test_a_dc_motor_without_a_command_is_friction_beside_an_actuator(tmp_path: Path) -> None:
    """Whatever the order: an actuator's number is not that of its command."""
    without = MOTOR.format("rub", 1, 'input="none" lugre="80 0 0.1 0.1 0.05"')
    text = body("", f'<actuator>{without}<position joint="hinge" name="p" kp="9" ctrlrange="-2 1"/></actuator>')
    robot = read(tmp_path, text)
    (position,) = robot.actuators
    assert position is not None and (position.name, position.kind, position.ctrlrange) == ("p", "position", (-2, 1))
    assert robot.values["damping"][0] == 0.5**2 / 2 and compiled(robot).na == 0
    assert "bristles of <dcmotor> at joint hinge: left out, model=dahl begins with them" in robot.notes
    none = read(tmp_path, text.replace('"80 0 0.1 0.1 0.05"', '"80 0 0.1 0.2 0"'))  # MuJoCo then has no Stribeck effect
    assert none.bristles["static_torque"][0] == none.bristles["kinetic_torque"][0] == 0.1


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        ('controller="5" input="pos"', "a controller of its own"),
        ('inductance="0.01"', "a winding with inductance, heat or a limit of voltage"),
        ('thermal="1 2 0.1"', "a winding with inductance, heat or a limit of voltage"),
        ('cogging="0.1 6 0"', "cogging"),
    ],
)
def test_a_dc_motor_that_is_no_line_is_left_out_and_its_bristles_are_not(more, reason, tmp_path):
    robot = read(tmp_path, body("", f"<actuator>{MOTOR.format('m', 1, f'{BRISTLES} {more}')}</actuator>"))
    assert robot.actuators == (None,) and robot.values["damping"][0] == 0
    assert any(note.startswith("actuator m of joint hinge is left out: its DC motor has") for note in robot.notes)
    assert reason in " ".join(robot.notes)
    assert [robot.bristles[name][0] for name in robot.bristles] == [80, 0.7, 0.1, 0.2, 0.05]


def test_a_template_has_none_of_what_is_identified(tmp_path: Path) -> None:
    model = compiled(read(tmp_path, LEG))
    assert not model.dof_armature.any() and not model.dof_frictionloss.any() and not model.dof_damping.any()
    assert (model.nu, model.nsensor, model.nkey, model.ngeom, model.nmesh) == (0, 0, 0, 0, 0)
    assert not model.jnt_limited.any()


def bodies_of(robot: RobotFile) -> list[str]:
    model = compiled(robot)
    return [model.body(index).name for index in range(1, model.nbody)]


def test_bodies_that_move_as_one_become_one(tmp_path: Path) -> None:
    robot = read(tmp_path, LEG, ["hip", "knee"])
    assert bodies_of(robot) == ["thigh", "shin", "foot", "toe"]  # gravity acts differently on the foot
    mass = 1000 * 8 * 0.03 * 0.02 * 0.01 + 400 * np.pi * 0.03**2 * (0.2 + 0.04)
    assert compiled(robot).body("thigh").mass == pytest.approx(mass)
    kept = read(tmp_path, LEG, ["hip", "knee"], keep=["toe", "pad"])
    assert bodies_of(kept) == ["thigh", "pad", "shin", "foot", "toe"]
    with pytest.raises(BenchError, match=r"no body tow; did you mean toe\?"):
        read(tmp_path, LEG, keep=["tow"])


def test_a_urdf_says_friction_and_torque(tmp_path: Path) -> None:
    robot = read(tmp_path, ARM)
    np.testing.assert_array_equal(robot.values["damping"], [0.7, 0])
    np.testing.assert_array_equal(robot.values["frictionloss"], [0.4, 0])
    np.testing.assert_array_equal(robot.forceranges, [[-40, 40], [np.nan, np.nan]])
    assert robot.actuators == (None, None)
    assert bodies_of(robot) == ["upper", "lower"]
    assert "a second <origin> of <joint shoulder> is left out" in robot.notes
    assert "left out, because MuJoCo does not read them in a URDF: 1 <transmission>, 1 <gazebo>" in robot.notes
    np.testing.assert_array_equal(compiled(robot).body_pos[1], [0, 0, 0.3])


def test_patterns_come_in_the_order_of_the_file(tmp_path: Path) -> None:
    assert read(tmp_path, LEG, ["toe", "h.*"]).joints == ("hip", "toe")
    assert read(tmp_path, LEG, "[hk].*").joints == ("hip", "knee")


def test_limits_and_contacts_are_kept_on_request(tmp_path: Path) -> None:
    """Two links that fall onto the floor and each other, and swing to their limits."""
    geom = '<geom name="{}" type="capsule" size="0.05" fromto="0 0 0 0 0 0.2" priority="1" friction="0.3"/>'
    tip = changed(
        TWO, ('axis="0 1 0"', 'axis="0 1 0" limited="true" range="-60 60"'), ("</body>", geom.format("tip") + "</body>")
    )
    text = body(
        geom.format("link") + f'<body name="fixed" pos="0.1 0 0"><geom name="knob" size="0.05"/>{tip}</body>',
        '<contact><exclude body1="link" body2="tip"/>'
        '<pair geom1="knob" geom2="floor" friction="0.1 0.1 0.01 0.01 0.01"/></contact>',
    ).replace(
        "<worldbody>",
        '<option cone="elliptic" impratio="3"/><worldbody>'
        '<geom name="floor" type="plane" size="1 1 1" pos="0 0 -0.2"/>',
    )
    makers = mujoco.MjModel.from_xml_path(save(tmp_path, text))
    ours = compiled(read_robot(str(tmp_path / "robot.xml"), contacts="keep", limits="keep"))
    touched, limited = 0, 0
    rng = np.random.default_rng(0)
    for _ in range(100):
        states = rng.uniform(-3, 3, (2, 2))
        reached = []
        for model in (makers, ours):
            data = mujoco.MjData(model)
            data.qpos[:], data.qvel[:] = states
            mujoco.mj_step(model, data)
            reached.append(data.qvel.copy())
        touched, limited = touched + data.ncon, limited + data.nl
        np.testing.assert_allclose(reached[1], reached[0], rtol=1e-8, atol=1e-8)  # the solver stops at its tolerance
    assert touched > 20 and limited > 20


def test_a_still_joint_has_its_part_in_a_tendon(tmp_path: Path) -> None:
    text = changed(
        LEG,
        ("<sensor>", TENDON + "<sensor>"),
        ('<geom type="hfield" hfield="hills"/>', ""),
        ('<geom type="mesh" mesh="shell" material="m"/>', '<geom size="0.1"/>'),
        ('<geom type="mesh" mesh="shell" mass="0" contype="0" conaffinity="0"/>', ""),
        ('<geom type="mesh" mesh="shell"/>', ""),
        (' material="m"', ""),
    )
    ours = compiled(read(tmp_path, text, "hip"))
    makers = mujoco.MjModel.from_xml_string(re.sub("<asset>.*</asset>", "", text, flags=re.S))
    data, whole = mujoco.MjData(ours), mujoco.MjData(makers)
    data.qpos[0], whole.qpos[7] = 0.4, 0.4
    mujoco.mj_forward(ours, data)
    mujoco.mj_forward(makers, whole)
    assert data.qfrc_spring[0] == pytest.approx(whole.qfrc_spring[6], rel=1e-12)
    assert data.qfrc_spring[0] != 0


def test_includes_and_meshes_lie_beside_the_file(tmp_path: Path) -> None:
    """A body whose inertia comes from a mesh that is there, in a file that includes another."""
    corners = np.array([[0, 0, 0], [0.3, 0, 0], [0, 0.2, 0], [0, 0, 0.1]])
    faces = ["1 3 2", "1 2 4", "1 4 3", "2 3 4"]
    (tmp_path / "meshes").mkdir()
    lines = [*(f"v {' '.join(map(str, corner))}" for corner in corners), *(f"f {face}" for face in faces)]
    (tmp_path / "meshes" / "wedge.obj").write_text("\n".join(lines))
    (tmp_path / "joint.xml").write_text('<mujocoinclude><joint name="hinge" axis="0 1 0"/></mujocoinclude>')
    text = (
        '<mujoco><compiler meshdir="meshes"/><asset><mesh file="wedge.obj"/></asset><worldbody><body name="wedge">'
        '<include file="joint.xml"/><geom type="mesh" mesh="wedge"/></body></worldbody></mujoco>'
    )
    makers = mujoco.MjModel.from_xml_path(save(tmp_path, text))
    ours = compiled(read_robot(str(tmp_path / "robot.xml")))
    np.testing.assert_array_equal(ours.body_inertia, makers.body_inertia)
    np.testing.assert_array_equal(ours.body_ipos, makers.body_ipos)
    assert ours.body_mass[1] == pytest.approx(1000 * 0.3 * 0.2 * 0.1 / 6)


PUBLISHED = {
    **{"go2/go2.xml": 12, "go2/go2_published.xml": 12, "kuka_lwr4/kuka_lwr4.urdf": 7},
    "kuka_lwr4/kuka_lwr4_cogimon.urdf": 7,
}


@needs_data
@pytest.mark.parametrize("file", PUBLISHED)
def test_robots_of_the_recordings(file: str, makers: ModuleType) -> None:
    row = makers.describe(Path(str(DATA)) / file, None)
    assert row["joints"] == PUBLISHED[file]
    assert row["difference"] < SAME


@needs_data
def test_robots_that_mujoco_alone_refuses() -> None:
    """A last link without inertia, and inertias of no body of matter."""
    folder = Path(str(DATA))
    tx40 = read_robot(str(folder / "tx40" / "tx40.urdf"))
    assert compiled(tx40).nv == 6
    np.testing.assert_array_equal(tx40.forceranges[0], [-131.84, 131.84])
    kuka = read_robot(str(folder / "kuka_lwr4" / "kuka_lwr4_identified.urdf"))
    assert compiled(kuka).nv == 7
    assert sum("is not physical" in note for note in kuka.notes) == 7
    assert kuka.values["frictionloss"].min() == 0


PACKAGES = {  # name: where in it the models of robots lie
    "example-robot-data": "cmeel.prefix/share/example-robot-data/robots/*/*/*.urdf",
    "robosuite": "robosuite/models/assets/robots/*/robot.xml",
    "robosuite-models": "robosuite_models/assets/robots/*/robot.xml",
}


@pytest.mark.slow
@pytest.mark.parametrize("package", PACKAGES)
def test_robots_of_packages(package: str, makers: ModuleType) -> None:
    """All are taken, and move as MuJoCo C moves them where it takes them by itself."""
    try:
        files = sorted(Path(str(distribution(package).locate_file(""))).glob(PACKAGES[package]))
    except PackageNotFoundError:
        pytest.skip(f"{package} is not installed")
    rows = [makers.describe(path, None) for path in files]
    differences = [row["difference"] for row in rows if row["difference"] is not None]
    assert len(differences) >= 10 and max(differences) < SAME
    for row in rows:
        assert row["answer"].startswith(("taken", "no hinge and no slide is chosen")), row
