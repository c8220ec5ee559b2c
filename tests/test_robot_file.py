"""Robots' own files: what is read of them moves as MuJoCo C moves the file itself, and everything else has its line."""

import importlib.util
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
import pytest
from conftest import DATA, ROOT, needs_data

from frictionzoo.bench.robot_file import RobotFile, read_robot
from frictionzoo.core.errors import BenchError, ConfigError

SAME = 1e-10  # of a step, as a share of the state
LEG = """<mujoco model="leg"><compiler angle="degree"/><option timestep="0.004" gravity="0 1 -9.7"/>
<default><joint damping="0.3" frictionloss="0.2"/>
<default class="knee"><joint axis="0 1 0.1" armature="0.03"/></default></default>
<asset><mesh name="shell" file="not/there.stl"/><texture name="t" type="2d" file="no.png"/>
<material name="m" texture="t"/><hfield name="hills" file="no.png" size="1 1 1 1"/></asset>
<worldbody><geom type="hfield" hfield="hills"/><body name="trunk" pos="0 0 0.7" euler="10 20 0"><freejoint name="root"/>
<geom type="mesh" mesh="shell" material="m"/><site name="imu" material="m"/>
<frame euler="0 0 30"><body name="thigh" pos="0.1 0 0" euler="0 40 0">
<joint name="hip" axis="1 0.2 0" range="-40 90" ref="7"/><geom type="capsule" size="0.03 0.1" density="400"/>
<geom type="mesh" mesh="shell" mass="0" contype="0" conaffinity="0"/>
<body name="pad" pos="0.02 0 0" quat="1 0.2 0 0"><geom type="box" size="0.03 0.02 0.01"/></body>
<body name="shin" pos="0 0 -0.2"><joint name="knee" class="knee" stiffness="4" springref="20" pos="0.01 0 0"/>
<inertial pos="0 0.01 -0.1" mass="0.4" fullinertia="0.004 0.005 0.003 0.0002 -0.0003 0.0001"/>
<geom type="mesh" mesh="shell"/>
<body name="foot" pos="0 0 -0.2" gravcomp="0.5"><geom size="0.02" mass="0.05"/>
<body name="toe"><joint name="toe" axis="0 1 0" ref="15"/><geom size="0.01" mass="0.02" pos="0.03 0 0"/></body></body>
</body></body></frame></body></worldbody>
<sensor><accelerometer site="imu"/></sensor><keyframe><key qpos="0 0 1 1 0 0 0 0 0 0"/></keyframe>
<actuator><motor name="hip" joint="hip" gear="6" ctrlrange="-2 2" forcerange="-1.5 1" armature="0.001" damping="0.002"/>
<position name="knee" joint="knee" kp="30" kv="0.4" gear="-1"/>
<velocity name="toe" joint="toe" kv="1"/></actuator></mujoco>"""
ARM = """<robot name="arm"><link name="base"><visual><geometry><mesh filename="package://arm/base.dae"/></geometry></visual>
<collision><geometry><mesh filename="package://arm/base.dae"/></geometry></collision></link>
<link name="upper"><inertial><origin xyz="0 0.1 0.2" rpy="0.1 0.2 0.3"/><mass value="2"/>
<inertia ixx="0.02" iyy="0.021" izz="0.01" ixy="0.001" ixz="0" iyz="0"/></inertial>
<collision><geometry><mesh filename="package://arm/upper.stl"/></geometry></collision></link>
<link name="lower"><inertial><mass value="1"/>
<inertia ixx="0.01" iyy="0.01" izz="0.002" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="tool"><inertial><origin xyz="0 0 0.1"/><mass value="0.3"/>
<inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="shoulder" type="revolute"><origin xyz="0 0 0.3" rpy="0 0.1 0"/><origin xyz="9 9 9"/><parent link="base"/>
<child link="upper"/><axis xyz="0 1 0"/><limit effort="40" lower="-2" upper="1" velocity="3"/>
<dynamics damping="0.7" friction="0.4"/></joint>
<joint name="elbow" type="continuous"><origin xyz="0 0 0.4"/><parent link="upper"/>
<child link="lower"/><axis xyz="0 1 1"/></joint>
<joint name="flange" type="fixed"><origin xyz="0 0 0.3" rpy="1 0 0"/><parent link="lower"/><child link="tool"/></joint>
<transmission name="t1"/><gazebo reference="upper"/></robot>"""
FINGERS = """<link name="{0}"><inertial><mass value="0.1"/>
<inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="{0}" type="prismatic"><parent link="tool"/><child link="{0}"/><axis xyz="0 1 0"/>
<limit effort="9" lower="0" upper="0.1" velocity="1"/>{1}</joint>"""
GRIPPER = ARM.replace(
    "</robot>",
    FINGERS.format("left", "")
    + FINGERS.format("right", '<mimic joint="left" multiplier="-1" offset="0.01"/>')
    + "</robot>",
)


@pytest.fixture(scope="module")
def makers() -> Iterator[ModuleType]:
    """The benchmark that compares with MuJoCo C."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "benchmarks")
        spec = importlib.util.spec_from_file_location("robot_files", ROOT / "benchmarks" / "robot_files.py")
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        yield module


def save(folder: Path, text: str) -> str:
    path = folder / ("robot.urdf" if text.startswith("<robot") else "robot.xml")
    path.write_text(text)
    return str(path)


def read(folder: Path, text: str, joint: Any = None, **options: Any) -> RobotFile:
    return read_robot(save(folder, text), joint, **options)


def compiled(robot: RobotFile) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ET.tostring(robot.root, encoding="unicode"))


def body(inside: str, outside: str = "") -> str:
    """An MJCF of one link on a hinge."""
    inertial = '<inertial pos="0 0 0.1" mass="1" diaginertia="0.02 0.02 0.01"/>'
    link = f'<body name="link"><joint name="hinge" axis="0 1 0"/>{inertial}{inside}</body>'
    return f"<mujoco><worldbody>{link}</worldbody>{outside}</mujoco>"


def changed(text: str, *pairs: tuple[str, str]) -> str:
    """The text with each first of a pair replaced by its second."""
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new)
    return text


TENDON = """<tendon><fixed name="t" stiffness="9" damping="0.1" springlength="0.3"><joint joint="hip" coef="2"/>
<joint joint="toe" coef="-1"/></fixed></tendon>"""
CASES = {
    "a leg, all joints": (LEG, None),
    "a leg, one joint": (LEG, "knee"),
    "a leg, by pattern": (LEG, "hip|knee"),
    "an arm": (ARM, None),
    "an arm, its elbow": (ARM, ["elbow"]),
    "a gripper whose fingers move together": (GRIPPER, None),
    "geoms before <inertial>": (
        changed(
            LEG,
            ('<geom type="mesh" mesh="shell"/>', '<geom size="0.05" group="1"/><geom size="1" group="3"/>'),
            ('angle="degree"', 'angle="degree" inertiafromgeom="true" inertiagrouprange="0 1"'),
        ),
        None,
    ),
    "a mass in all": (
        changed(LEG, ('"degree"', '"degree" settotalmass="7"'), ('type="mesh" mesh="shell" material="m"', 'size=".1"')),
        None,
    ),
    "a tendon with a spring": (changed(LEG, ("<sensor>", TENDON + "<sensor>")), ["hip", "toe"]),
    "without gravity": (
        changed(
            LEG, ("<option", '<option integrator="implicitfast"'), ('9.7"/>', '9.7"><flag gravity="disable"/></option>')
        ),
        None,
    ),
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


def test_a_template_has_none_of_what_is_identified(tmp_path: Path) -> None:
    model = compiled(read(tmp_path, LEG))
    assert not model.dof_armature.any() and not model.dof_frictionloss.any() and not model.dof_damping.any()
    assert (model.nu, model.nsensor, model.nkey, model.ngeom, model.nmesh) == (0, 0, 0, 0, 0)
    assert not model.jnt_limited.any()


def test_bodies_that_move_as_one_become_one(tmp_path: Path) -> None:
    robot = read(tmp_path, LEG, ["hip", "knee"])
    assert [(link.name, link.fused) for link in robot.links] == [
        ("thigh", ("thigh", "pad")),
        ("shin", ("shin",)),
        ("foot", ("foot",)),  # gravity acts otherwise on it
        ("toe", ("toe",)),
    ]
    assert robot.links[0].mass == pytest.approx(1000 * 8 * 0.03 * 0.02 * 0.01 + 400 * np.pi * 0.03**2 * (0.2 + 0.04))
    kept = read(tmp_path, LEG, ["hip", "knee"], keep=["toe", "pad"])
    assert [link.name for link in kept.links] == ["thigh", "pad", "shin", "foot", "toe"]
    with pytest.raises(BenchError, match=r"robot\.xml: no body tow; did you mean toe\?"):
        read(tmp_path, LEG, keep=["tow"])


def test_a_urdf_says_friction_and_torque(tmp_path: Path) -> None:
    robot = read(tmp_path, ARM)
    np.testing.assert_array_equal(robot.values["damping"], [0.7, 0])
    np.testing.assert_array_equal(robot.values["frictionloss"], [0.4, 0])
    np.testing.assert_array_equal(robot.forceranges, [[-40, 40], [np.nan, np.nan]])
    assert robot.actuators == (None, None)
    assert [link.fused for link in robot.links] == [("upper",), ("lower", "tool")]
    assert "a second <origin> of <joint shoulder> is left out" in robot.notes
    assert "left out, for MuJoCo does not read them in a URDF: 1 <transmission>, 1 <gazebo>" in robot.notes
    np.testing.assert_array_equal(compiled(robot).body_pos[1], [0, 0, 0.3])


@pytest.mark.parametrize(
    ("joint", "message"),
    [
        ("hop", r"robot\.xml: no joint hop; did you mean hip\? \(expected one of hip, knee, toe\); set bench\.joint"),
        (["hip", "k.*x"], r"no joint k\.\*x; "),
        ("(", r"no joint \(; "),
        ("root", r"joint root is a free joint, expected a hinge or a slide"),
        (["knee", "hip"], r"bench\.joint=\[knee, hip\]: expected each joint once in the order of .*, \[hip, knee\]"),
        ([], r"no hinge and no slide is chosen"),
    ],
)
def test_joints_that_are_not_there(joint: Any, message: str, tmp_path: Path) -> None:
    with pytest.raises(BenchError, match=message):
        read(tmp_path, LEG, joint)


def test_patterns_come_in_the_order_of_the_file(tmp_path: Path) -> None:
    assert read(tmp_path, LEG, ["toe", "h.*"]).joints == ("hip", "toe")
    assert read(tmp_path, LEG, "[hk].*").joints == ("hip", "knee")


SPRUNG = body("", '<option integrator="RK4" iterations="3"/>')
LINES = {
    "free joint": (LEG, r"floating base: body trunk is held where the file puts it"),
    "other joints": (LEG, r"2 joints are not chosen and stand at their reference position: hip, toe"),
    "other actuators": (LEG, r"left out: 2 actuators of joints that are not chosen, hip, toe"),
    "sensors": (LEG, r"left out, for they move no joint: 1 sensors, 1 keys, 1 textures, 1 materials"),
    "contacts": (LEG, r"contacts are left out: right for .* bench\.contacts=keep"),
    "integrator": (SPRUNG, r"integrator RK4: Euler instead"),
    "solver": (SPRUNG, r"options of the solver left out \(iterations=3\)"),
    "velocity": (ARM, r"velocity limits of 1 joints"),
    "limits": (ARM, r"limits of 1 joints are left out: right where the recorded motion is within"),
    "cone": (body("", '<option cone="elliptic"/>'), r"options left out, for they concern contacts: cone"),
    "wind": (body("", '<option wind="1 0 0"/>'), r"option wind left out"),
    "flags": (body("", '<option><flag energy="enable"/></option>'), r"flags left out: energy"),
    "no actuation": (body("", '<option><flag actuation="disable"/></option>'), r"flag actuation=disable left out"),
    "no constraint": (body("", '<option><flag constraint="disable"/></option>'), r"flags constraint=disable: "),
    "solreffriction": (
        changed(body(""), ("axis", 'solreffriction="0.01 1" axis')),
        r"solreffriction of joint hinge \(0\.01 1\)",
    ),
    "bent spring": (
        changed(body(""), ("axis", 'stiffness="1 2" axis')),
        r"springs that are no straight line: of joint hinge",
    ),
    "bent damper": (
        changed(body(""), ("axis", 'damping="1 2" axis')),
        r"damping that is no straight line: of joint hinge",
    ),
    "negative": (
        changed(ARM, ('friction="0.4"', 'friction="-0.4"')),
        r"frictionloss below 0 .* of joint shoulder \(-0\.4\)",
    ),
    "filter": (
        body("", '<actuator><general name="a" joint="hinge" dyntype="filter" dynprm="0.02"/></actuator>'),
        r"actuator a: its filter of 0\.02 s is left out",
    ),
    "integrating": (
        body("", '<actuator><intvelocity name="a" joint="hinge" kp="2" actrange="-1 1"/></actuator>'),
        r"actuator a of joint hinge is left out: its activation \(integrator\)",
    ),
    "muscle": (
        body("", '<actuator><muscle name="a" joint="hinge" lengthrange="0 1"/></actuator>'),
        r"actuator a of joint hinge is left out: its activation \(muscle\)",
    ),
    "damper": (
        body("", '<actuator><damper name="a" joint="hinge" kv="1" ctrlrange="0 1"/></actuator>'),
        r"actuator a of joint hinge is left out: its gain \(affine\) is no constant",
    ),
    "two actuators": (
        body("", '<actuator><motor name="a" joint="hinge"/><velocity name="b" joint="hinge"/></actuator>'),
        r"joint hinge has 2 actuators, of which a is read and b left out",
    ),
    "group": (
        body("", '<option actuatorgroupdisable="2"/><actuator><motor name="a" joint="hinge" group="2"/></actuator>'),
        r"actuator a of joint hinge is left out: actuatorgroupdisable",
    ),
    "tendon's actuator": (
        body(
            "",
            '<tendon><fixed name="t"><joint joint="hinge" coef="1"/></fixed></tendon>'
            '<actuator><motor tendon="t"/></actuator>',
        ),
        r"left out: 1 actuators that act by a tendon, number 0",
    ),
    "idle tendon": (
        body("", '<tendon><fixed name="t"><joint joint="hinge" coef="1"/></fixed></tendon>'),
        r"left out: 1 tendons that pull at no chosen joint by themselves, t",
    ),
    "massless": (
        body('<body name="end"><joint name="spin"/></body>'),
        r"1 moving links have no mass or no inertia \(end\)",
    ),
    "unphysical": (
        changed(ARM, ('izz="0.01" ixy', 'izz="0.09" ixy')),
        r"the inertia of link upper is that of no body of matter",
    ),
    "a URDF's shapes": (
        changed(
            ARM,
            (
                "<transmission",
                '<link name="box"><collision><geometry><box size="1 1 1"/></geometry></collision></link>'
                '<joint name="b" type="fixed"><parent link="tool"/><child link="box"/></joint><transmission',
            ),
        ),
        r"links without <inertial>: MuJoCo takes mass from their collision shapes, box \(1e\+03 kg\)",
    ),
    "mimic of no joint": (
        changed(GRIPPER, ('<mimic joint="left"', '<mimic joint="nobody"')),
        r"MuJoCo warns: <mimic> on joint right ignored",
    ),
    "medium": (body("", '<option density="1.2"/>'), r"kept: a medium of 1\.2 kg/m\^3"),
    "tied": (GRIPPER, r"kept: 1 equality constraints between chosen joints"),
}


@pytest.mark.parametrize("case", LINES)
def test_everything_left_out_or_changed_has_its_line(case: str, tmp_path: Path) -> None:
    text, line = LINES[case]
    joint = "knee" if case in ("other joints", "other actuators") else None
    robot = read(tmp_path, text, joint)
    assert any(re.match(line, note) for note in robot.notes), robot.notes
    assert all("\n" not in note for note in robot.notes)
    compiled(robot)


TWO = """<body name="tip" pos="0 0 0.2"><joint name="tip" axis="0 1 0"/>
<inertial pos="0 0 0.1" mass="1" diaginertia="1 1 1"/></body>"""
REFUSED = {
    "no file": (None, {}, r"nowhere\.xml: cannot be read \(No such file or directory\); set bench\.file"),
    "no XML": ("<mujoco>", {}, r"robot\.xml: not XML"),
    "another XML": ("<sdf/>", {}, r"<sdf>, expected <mujoco> of an MJCF or <robot> of a URDF"),
    "macros": (
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:arm/></robot>',
        {},
        r"xacro macros, expected a plain URDF; expand it first",
    ),
    "MuJoCo's own": (
        "<mujoco><worldbody><hinge/></worldbody></mujoco>",
        {},
        r"MuJoCo does not take it \(XML Error: .*hinge",
    ),
    "floats": (LEG, {"base": "as_is"}, r"bench\.base=as_is: body trunk floats"),
    "others": (LEG, {"joint": "hip", "others": "as_is"}, r"bench\.others=as_is: 2 joints are not chosen \(knee, toe\)"),
    "mesh": (
        changed(LEG, ('<body name="pad"', '<geom type="mesh" mesh="shell"/><body name="pad"')),
        {},
        r"the inertia of body thigh would come from the mesh not/there\.stl, which is not there",
    ),
    "one finger": (GRIPPER, {"joint": "left"}, r"equality constraint .* ties joint right to left .*only one is chosen"),
    "a loop": (
        body(TWO, '<equality><connect name="c" body1="tip" anchor="0 0 0.1"/></equality>'),
        {},
        r"equality constraint c closes a loop of bodies",
    ),
    "a tendon in space": (
        body(
            '<site name="a"/>',
            '<tendon><spatial name="t" stiffness="1"><site site="a"/><site site="b"/></spatial></tendon>',
        ).replace("<worldbody>", '<worldbody><site name="b" pos="1 0 0"/>'),
        {},
        r"tendon t runs in space and pulls at a chosen joint",
    ),
    "total mass": (
        changed(LEG, ('"degree"', '"degree" settotalmass="7"')),
        {},
        r"settotalmass, but without a usable inertia of trunk",
    ),
    "fluid shape": (
        body('<geom size="1" fluidshape="ellipsoid"/>', '<option density="1"/>'),
        {},
        r"fluidshape of geoms, which is not supported",
    ),
    "unnamed": (changed(body(""), ('name="hinge"', "")), {}, r"it has joints without a name"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_left_out_is_refused_in_one_line(case: str, tmp_path: Path) -> None:
    text, options, message = REFUSED[case]
    source = str(tmp_path / "nowhere.xml") if text is None else save(tmp_path, text)
    with pytest.raises(BenchError, match=message) as refused:
        read_robot(source, **options)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("option", ["base", "others", "contacts", "limits"])
def test_an_option_has_few_values(option: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=rf"bench\.{option}=free: no such choice"):
        read(tmp_path, LEG, **{option: "free"})


def test_the_step_can_be_another(tmp_path: Path) -> None:
    assert compiled(read(tmp_path, LEG)).opt.timestep == 0.004
    assert compiled(read(tmp_path, LEG, timestep=0.001)).opt.timestep == 0.001
    with pytest.raises(ConfigError, match=r"bench\.timestep=0\.0; expected a positive number"):
        read(tmp_path, LEG, timestep=0.0)


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
    "go2/go2.xml": 12,
    "go2/go2_published.xml": 12,
    "kuka_lwr4/kuka_lwr4.urdf": 7,
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
    assert sum("no body of matter" in note for note in kuka.notes) == 7
    assert kuka.links[0].inertia[2, 2] == pytest.approx(1.198399e-06)
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
