"""Robots' own files: everything that is left out or changed has its line, and what cannot be is refused in one."""

import contextlib
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
from robot_texts import ARM, GRIPPER, LEG, TWO, body, changed, compiled, read, save

from frictionzoo.bench.robot_file import read_robot
from frictionzoo.core.errors import BenchError, ConfigError

SPRUNG = body("", '<option integrator="RK4" iterations="3"/>')
LINES = {
    "free joint": (LEG, r"floating base: body trunk is fixed"),
    "other joints": (LEG, r"2 joints are not chosen and stand at their reference position: hip, toe"),
    "other actuators": (LEG, r"left out: 2 actuators of joints that are not chosen, hip, toe"),
    "sensors": (LEG, r"left out, because they move no joint: 1 sensors, 1 keys, 1 textures, 1 materials"),
    "contacts": (LEG, r"contacts are left out: correct if .* bench\.contacts=keep"),
    "integrator": (SPRUNG, r"integrator RK4: Euler instead"),
    "solver": (SPRUNG, r"options of the solver left out \(iterations=3\)"),
    "velocity": (ARM, r"velocity limits of 1 joints"),
    "limits": (ARM, r"limits of 1 joints are left out: correct if the recorded motion is within"),
    "cone": (body("", '<option cone="elliptic"/>'), r"contact options left out: cone"),
    "wind": (body("", '<option wind="1 0 0"/>'), r"option wind left out"),
    "flags": (body("", '<option><flag energy="enable"/></option>'), r"flags left out: energy"),
    "no actuation": (body("", '<option><flag actuation="disable"/></option>'), r"flag actuation=disable left out"),
    "no constraint": (body("", '<option><flag constraint="disable"/></option>'), r"flags constraint=disable: "),
    "solreffriction": (
        changed(body(""), ("axis", 'solreffriction="0.01 1" axis')),
        r"solreffriction of joint hinge \(0\.01 1\)",
    ),
    "bent spring": (changed(body(""), ("axis", 'stiffness="1 2" axis')), r"nonlinear springs of joint hinge"),
    "bent damper": (changed(body(""), ("axis", 'damping="1 2" axis')), r"nonlinear damping of joint hinge"),
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
        r"actuator a of joint hinge is left out: its gain \(affine\) is not constant",
    ),
    "two actuators": (
        body("", '<actuator><motor name="a" joint="hinge"/><velocity name="b" joint="hinge"/></actuator>'),
        r"joint hinge has 2 actuators: a is read, and b left out",
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
    "unphysical": (changed(ARM, ('izz="0.01" ixy', 'izz="0.09" ixy')), r"the inertia of link upper is not physical"),
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


REFUSED = {
    "no file": (None, {}, r"nowhere\.xml: cannot be read \(No such file or directory\); set bench\.mjcf"),
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
    "a loop to a body that others move": (
        body(
            '<body name="tip" pos="0 0 0.2"/>',
            '<equality><connect name="c" body1="tip" body2="hand" anchor="0 0 0"/></equality>',
        ).replace("<worldbody>", '<worldbody><body name="hand" mocap="true"/>'),
        {},
        r"equality constraint c closes a loop of bodies, or pulls at one from outside",
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


NUMBER = re.compile(r'(?<=[" ])-?\d+(\.\d+)?(e-?\d+)?(?=[" ])')
DRIVEN = body(
    "", '<actuator><position joint="hinge" kp="1" kv="2" forcerange="-1 1" delay="1" nsample="5"/></actuator>'
)
BROKEN = [(text, match.span()) for text in (ARM, LEG, DRIVEN) for match in NUMBER.finditer(text)]


@hypothesis.given(broken=st.sampled_from(BROKEN), word=st.sampled_from(["nan", "inf", "-inf", "1e400"]))
@hypothesis.settings(max_examples=60, deadline=None)
def test_a_number_that_is_none_is_refused(
    broken: tuple[str, tuple[int, int]], word: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Or does not matter: then all that was read is finite."""
    text, (first, last) = broken
    with contextlib.suppress(BenchError):
        robot = read(tmp_path_factory.mktemp("broken"), text[:first] + word + text[last:])
        assert not re.search(r"\b(nan|inf)\b", ET.tostring(robot.root, encoding="unicode"))
        assert all(np.isfinite(value).all() for value in robot.values.values())


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


@pytest.mark.parametrize("option", ["base", "others", "contacts", "limits"])
def test_an_option_has_few_values(option: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=rf"bench\.{option}=free: no such choice"):
        read(tmp_path, LEG, **{option: "free"})
