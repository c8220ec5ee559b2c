"""Robots' own files: everything that is left out or changed has its line, and what cannot be is refused in one."""

import contextlib
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
from helpers.robot_texts import ARM, GRIPPER, LEG, TWO, body, changed, compiled, read, save

from frictionzoo.bench.robot_file import read_robot
from frictionzoo.core.errors import BenchError, ConfigError

TIED = '<tendon><fixed name="t"><joint joint="hinge" coef="1"/></fixed></tendon>'
BOX = '<link name="box"><collision><geometry><box size="1 1 1"/></geometry></collision></link>'
BOX += '<joint name="b" type="fixed"><parent link="tool"/><child link="box"/></joint>'


def option(attributes: str, inside: str = "") -> str:
    return body("", f"<option {attributes}>{inside}</option>")


def flag(attributes: str) -> str:
    return option("", f"<flag {attributes}/>")


def driven(actuators: str, more: str = "") -> str:
    return body("", f"{more}<actuator>{actuators}</actuator>")


def hinge(attribute: str) -> str:
    return changed(body(""), ("axis", f"{attribute} axis"))


LINES = [  # what a file has, and what the line about it names
    (LEG, "floating base: body trunk"),
    (LEG, "2 joints are not chosen .* hip, toe"),
    (LEG, "left out: 2 actuators of joints that are not chosen, hip, toe"),
    (LEG, "left out, .*: 1 sensors, 1 keys, 1 textures, 1 materials"),
    (LEG, r"contacts are left out: .* bench\.contacts=keep"),
    (option('integrator="RK4"'), "integrator RK4: Euler"),
    (option('iterations="3"'), r"options of the solver left out \(iterations=3\)"),
    (option('cone="elliptic"'), "contact options left out: cone"),
    (option('wind="1 0 0"'), "option wind left out"),
    (option('density="1.2"'), r"kept: a medium of 1\.2 kg/m\^3"),
    (flag('energy="enable"'), "flags left out: energy"),
    (flag('actuation="disable"'), "flag actuation=disable left out"),
    (flag('constraint="disable"'), "flags constraint=disable"),
    (hinge('solreffriction="0.01 1"'), r"solreffriction of joint hinge \(0\.01 1\)"),
    (hinge('stiffness="1 2"'), "nonlinear springs of joint hinge"),
    (hinge('damping="1 2"'), "nonlinear damping of joint hinge"),
    (ARM, "velocity limits of 1 joints"),
    (ARM, "limits of 1 joints are left out"),
    (changed(ARM, ('friction="0.4"', 'friction="-0.4"')), r"frictionloss below 0 .* shoulder \(-0\.4\)"),
    (changed(ARM, ('izz="0.01" ixy', 'izz="0.09" ixy')), "the inertia of link upper is not physical"),
    (changed(ARM, ("<transmission", f"{BOX}<transmission")), r"links without <inertial>: .* box \(1e\+03 kg\)"),
    (driven('<general name="a" joint="hinge" dyntype="filter" dynprm="0.02"/>'), r"actuator a: its filter of 0\.02 s"),
    (driven('<intvelocity name="a" joint="hinge" kp="2" actrange="-1 1"/>'), r"actuator a .*activation \(integrator\)"),
    (driven('<muscle name="a" joint="hinge" lengthrange="0 1"/>'), r"actuator a .* activation \(muscle\)"),
    (driven('<damper name="a" joint="hinge" kv="1" ctrlrange="0 1"/>'), r"actuator a .* gain \(affine\)"),
    (driven('<motor name="a" joint="hinge"/><motor name="b" joint="hinge"/>'), "joint hinge has 2 .* b left out"),
    (
        driven('<motor name="a" joint="hinge" group="2"/>', '<option actuatorgroupdisable="2"/>'),
        "actuator a .* actuatorgroupdisable",
    ),
    (driven('<motor tendon="t"/>', TIED), "left out: 1 actuators that act by a tendon, number 0"),
    (body("", TIED), "left out: 1 tendons .*, t"),
    (body('<body name="end"><joint name="spin"/></body>'), r"1 moving links have no mass or no inertia \(end\)"),
    (changed(GRIPPER, ('<mimic joint="left"', '<mimic joint="nobody"')), "MuJoCo warns: <mimic> on joint right"),
    (GRIPPER, "kept: 1 equality constraints"),
]


@pytest.mark.parametrize(("text", "line"), LINES, ids=[line for _, line in LINES])
def test_everything_left_out_or_changed_has_its_line(text: str, line: str, tmp_path: Path) -> None:
    robot = read(tmp_path, text, "knee" if "not chosen" in line else None)
    assert any(re.match(line, note) for note in robot.notes), robot.notes
    assert all("\n" not in note for note in robot.notes)
    compiled(robot)


HAND = body(
    '<body name="tip" pos="0 0 0.2"/>',
    '<equality><connect name="c" body1="tip" body2="hand" anchor="0 0 0"/></equality>',
).replace("<worldbody>", '<worldbody><body name="hand" mocap="true"/>')
SPATIAL = '<tendon><spatial name="t" stiffness="1"><site site="a"/><site site="b"/></spatial></tendon>'
SPACE = body('<site name="a"/>', SPATIAL).replace("<worldbody>", '<worldbody><site name="b" pos="1 0 0"/>')
REFUSED = [  # a file, options, and what the message names
    (None, {}, r"nowhere\.xml: cannot be read .* bench\.mjcf"),
    ("<mujoco>", {}, r"robot\.xml: not XML"),
    ("<sdf/>", {}, "<sdf>, expected <mujoco>"),
    ('<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:arm/></robot>', {}, "xacro"),
    ("<mujoco><worldbody><hinge/></worldbody></mujoco>", {}, r"MuJoCo does not take it \(XML Error: .*hinge"),
    (LEG, {"base": "as_is"}, r"bench\.base=as_is: body trunk"),
    (LEG, {"joint": "hip", "others": "as_is"}, r"bench\.others=as_is: 2 joints are not chosen \(knee, toe\)"),
    (
        changed(LEG, ('<body name="pad"', '<geom type="mesh" mesh="shell"/><body name="pad"')),
        {},
        r"the inertia of body thigh .* mesh not/there\.stl",
    ),
    (GRIPPER, {"joint": "left"}, r"equality constraint .* ties joint right to left .*bench\.joint"),
    (body(TWO, '<equality><connect name="c" body1="tip" anchor="0 0 0.1"/></equality>'), {}, "constraint c .* loop"),
    (HAND, {}, "equality constraint c .* pulls at one from outside"),
    (SPACE, {}, "tendon t runs in space"),
    (changed(LEG, ('"degree"', '"degree" settotalmass="7"')), {}, "settotalmass, .* trunk"),
    (body('<geom size="1" fluidshape="ellipsoid"/>', '<option density="1"/>'), {}, "fluidshape of geoms"),
    (changed(body(""), ('name="hinge"', "")), {}, "joints without a name"),
    (LEG, {"joint": "hop"}, r"no joint hop; did you mean hip\?.* set bench\.joint"),
    (LEG, {"joint": ["hip", "k.*x"]}, r"no joint k\.\*x; "),
    (LEG, {"joint": "("}, r"bench\.joint: \(: no pattern"),
    (LEG, {"joint": "root"}, "no joint root; "),
    (LEG, {"joint": ["knee", "hip"]}, r"bench\.joint=\[knee, hip\]: expected each joint once"),
    (LEG, {"joint": []}, "no hinge and no slide is chosen"),
    *((LEG, {option: "free"}, rf"bench\.{option}=free") for option in ("base", "others", "contacts", "limits")),
]


@pytest.mark.parametrize(("text", "options", "message"), REFUSED)
def test_what_cannot_be_left_out_is_refused_in_one_line(text, options, message, tmp_path):
    source = str(tmp_path / "nowhere.xml") if text is None else save(tmp_path, text)
    with pytest.raises((BenchError, ConfigError), match=message) as refused:
        read_robot(source, **options)
    assert "\n" not in str(refused.value)


NUMBER = re.compile(r'(?<=[" ])-?\d+(\.\d+)?(e-?\d+)?(?=[" ])')
DRIVEN = driven('<position joint="hinge" kp="1" kv="2" forcerange="-1 1" delay="1" nsample="5"/>')
BROKEN = [(text, match.span()) for text in (ARM, LEG, DRIVEN) for match in NUMBER.finditer(text)]


@hypothesis.given(broken=st.sampled_from(BROKEN), word=st.sampled_from(["nan", "inf", "-inf", "1e400"]))
@hypothesis.settings(max_examples=60, deadline=None)
def test_a_number_that_is_none_is_refused(broken, word, tmp_path_factory):
    """Or does not matter: then all that was read is finite."""
    text, (first, last) = broken
    with contextlib.suppress(BenchError):
        robot = read(tmp_path_factory.mktemp("broken"), text[:first] + word + text[last:])
        assert not re.search(r"\b(nan|inf)\b", ET.tostring(robot.root, encoding="unicode"))
        assert all(np.isfinite(value).all() for value in robot.values.values())
