"""A drive written into a robot's own file: the joints have it, and every other byte is the maker's."""

import difflib
import logging
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from conftest import DATA, needs_data
from helpers.fitted import fit
from helpers.robot_texts import ARM, LEG, changed, save

from frictionzoo.api.identified import Identified
from frictionzoo.bench import JointPD
from frictionzoo.bench.robot_file import read_robot
from frictionzoo.core.errors import ConfigError, ExportError, FrictionzooError
from frictionzoo.export.bench import write_bench
from frictionzoo.export.in_place import InPlace
from frictionzoo.export.isaaclab import IsaacLab
from frictionzoo.export.mjcf import Mjcf, write_identified
from frictionzoo.export.mjlab import Mjlab
from frictionzoo.export.nearest import Nearest
from frictionzoo.export.robot import Equipped, put_into, say_whole

INTEGRATORS = {"implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST, "RK4": mujoco.mjtIntegrator.mjINT_RK4}
EXACT = 1e-9  # N m or rad; rounding stays far below
ROBOT = changed(
    LEG,
    ("<worldbody>", "<!-- the maker's; 0.30000000000000004 -->\n<worldbody  >"),
    ('gear="6"', 'group="2" gear="6"'),
    ("</actuator></mujoco>", "</actuator>\n</mujoco>\n<!-- end -->\n"),
)


def written(fitted: Identified) -> dict[str, bytes]:
    """What a run leaves behind, by file."""
    return {file.name: file.content for file in write_identified(fitted)}


def lines(before: str, after: str) -> tuple[list[str], list[str]]:
    """What was taken out and put in, element by element."""
    old, new = (re.split(r"(?<=>)", text) for text in (before, after))
    found = [line for line in difflib.ndiff(old, new) if line[:2] in ("- ", "+ ")]
    gone, come = ([line[2:].strip() for line in found if line.startswith(sign)] for sign in "-+")
    return gone, come


def test_a_robots_joints_have_the_drive_and_every_other_byte_is_the_makers(tmp_path: Path) -> None:
    source = save(tmp_path, ROBOT)
    fitted = fit(source)
    files = written(fitted)
    assert set(files) == {"bench.xml", "identified.xml"}
    gone, come = lines(ROBOT, files["identified.xml"].decode())
    assert {re.split(r"[ >]", text)[0] for text in gone} == {"<joint", "<motor", "<position", "<velocity"}
    assert len(gone) == 6
    assert len(come) == 7 and come[0].startswith("<!-- frictionzoo: ")
    assert come[2].startswith('<joint name="knee" class="knee" stiffness="4" springref="20" pos="0.01 0 0" armature=')
    (tmp_path / "identified.xml").write_bytes(files["identified.xml"])
    read = read_robot(str(tmp_path / "identified.xml"))
    np.testing.assert_array_equal(read.values["armature"], fitted.values["bench"]["armature"])  # not the motor's too
    for name in ("frictionloss", "damping"):
        np.testing.assert_array_equal(read.values[name], fitted.values["friction"][name])
    assert [(read.name, read.kind, read.gain, read.bias2) for read in read.actuators if read] == [
        ("hip", "position", 20, -1),
        ("knee", "position", 20, -1),
        ("toe", "position", 20, -1),
    ]


def test_the_bench_beside_it_is_what_was_simulated(tmp_path: Path) -> None:
    fitted = fit(save(tmp_path, ROBOT), ["hip", "knee"])
    folder = tmp_path / "export"
    folder.mkdir()
    export = Mjcf().write(fitted, folder, {})
    assert export.files == ("bench.xml", "identified.xml")
    assert {name: (folder / name).read_bytes() for name in export.files} == written(fitted)
    moved, loaded, torque = export.differences
    assert (moved.quantity, loaded.quantity, torque.quantity) == ("qpos", "qpos", "torque")
    assert max(moved.largest, loaded.largest, torque.largest) < EXACT  # the hip's own limits act in bench and file
    assert mujoco.MjModel.from_xml_path(str(folder / "bench.xml")).nv == 2
    assert any("nor the original" in limit for limit in export.limits)  # its meshes are not there
    assert '<joint name="toe" axis="0 1 0" ref="15"/>' in (folder / "identified.xml").read_text()


def test_a_robots_file_has_the_steps_that_its_parameters_are_for(tmp_path: Path) -> None:
    fitted = fit(save(tmp_path, ROBOT), substeps=4, second_order=True)
    timestep = 4 * fitted.timestep
    option = ET.fromstring(put(fitted.at()).content).find("option")
    own = ET.fromstring(ROBOT).find("option")
    assert option is not None and own is not None and option.attrib == own.attrib
    for integrator in ("implicitfast", "RK4"):
        robot = put(fitted.at(timestep, integrator.lower()))
        option = robot.model.opt
        assert (option.timestep, mujoco.mjtIntegrator(option.integrator)) == (timestep, INTEGRATORS[integrator])
        assert "<option>" in robot.notes[0] and integrator in robot.notes[0]
    with pytest.raises(ConfigError, match="integrator=RK4: target=mujoco"):
        fitted.export("mujoco", tmp_path / "no", integrator="RK4")
    with pytest.raises(ConfigError, match="integrator=RK4: the parameters"):
        fit(fitted.bench.source).at(None, "RK4")


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.0, 0.009, 0.021])
def test_rk4_moves_as_the_drive_in_continuous_time(delay: float, tmp_path: Path) -> None:
    """As loaded in MuJoCo C, with commands that are late by up to a few steps; half a step is 4 mrad at 1 rad/s."""
    fitted = fit(save(tmp_path, LEG), substeps=2, second_order=True, params={"delay": delay})
    for file in write_identified(fitted.at(2 * fitted.timestep, "RK4")):
        assert file.difference is not None and file.difference.mean < 4e-4


def put(fitted: Identified, actuators: str = "identified") -> Equipped:
    """The drive in the robot's own file, its friction as it is."""
    friction = fitted.values["friction"]
    nearest = Nearest(dict(fitted.values["bench"]), friction["frictionloss"], friction["damping"])
    path, bench = Path(fitted.bench.source), write_bench(fitted, nearest)
    return put_into(path, fitted.bench.joints, actuators, fitted, nearest, bench).commented()


def actuators(robot: Equipped) -> list[dict[str, str]]:
    """Attributes of each."""
    return [{**element.attrib} for element in ET.fromstring(robot.content).iterfind("./actuator/general")]


def test_limits_of_actuators_stay_in_the_unit_of_the_new_command(tmp_path: Path) -> None:
    text = changed(ROBOT, ('gear="-1"', 'gear="-2" ctrlrange="-1 3" group="4"'), ('kv="1"', 'kv="1" ctrlrange="-9 9"'))
    path = save(tmp_path, text)
    hip, knee, toe = actuators(put(fit(path)))
    # A motor of gear 6 within 2 and 1.5 of its units: torque, where the new command is a position.
    assert (hip["ctrllimited"], hip["forcerange"], hip["group"]) == ("false", "-9.0 6.0", "2")
    # By its gear of -2, it took 1 for a position of -0.5.
    assert (knee["ctrlrange"], knee["forcelimited"], knee["group"]) == ("-1.5 0.5", "false", "4")
    assert (toe["ctrllimited"], toe["forcelimited"]) == ("false", "false")
    (hip,) = (a for a in actuators(put(fit(path, "hip", actuator=None))) if a["joint"] == "hip")
    assert (hip["gainprm"], hip["ctrlrange"], hip["forcerange"]) == ("6.0", "-2.0 2.0", "-9.0 6.0")  # still a motor


def test_bristles_of_the_robots_own_do_not_add_to_what_was_identified(tmp_path: Path) -> None:
    rubbing = (
        '<dcmotor name="rub" joint="hip" motorconst="1e-9" resistance="1" input="none" lugre="80 1 0.1 0.2 0.05"/>'
    )
    path = save(tmp_path, changed(ROBOT, ("</actuator>", f"\n  {rubbing}\n</actuator>")))
    fitted = fit(path, "hip")
    robot = put(fitted)
    assert b"dcmotor" not in robot.content and b"\n\n" not in robot.content and robot.model.na == 0
    assert any("<dcmotor> of joint hip" in note for note in robot.notes)
    with pytest.raises(ExportError, match="a <dcmotor> keeps its bristles"):
        put(fitted, "keep")


def test_a_urdf_has_dynamics_and_the_armature_as_a_comment(tmp_path: Path) -> None:
    text = changed(ARM, ('<transmission name="t1"/>', '<transmission name="t1"><joint name="elbow"/></transmission>'))
    source = save(tmp_path, text)
    fitted = fit(source)
    files = written(fitted)
    assert set(files) == {"bench.xml", "identified.urdf"}
    armature, (_, file) = float(fitted.values["bench"]["armature"][0]), write_identified(fitted)
    assert f"armature {armature!r}" in file.content.decode() and any("no armature" in limit for limit in file.limits)
    gone, come = lines(text, files["identified.urdf"].decode())
    assert gone == ['<dynamics damping="0.7" friction="0.4"/>']
    assert [re.split(r"[ >]", text)[0] for text in come] == ["<!--", "<dynamics", "<!--", "<dynamics", "<!--"]
    (tmp_path / "identified.urdf").write_bytes(files["identified.urdf"])
    read = read_robot(str(tmp_path / "identified.urdf"))
    np.testing.assert_array_equal(read.values["frictionloss"], fitted.values["friction"]["frictionloss"])
    np.testing.assert_array_equal(read.values["damping"], fitted.values["friction"]["damping"])


REFUSED = {
    "two actuators": ("</actuator>", '<motor joint="hip" name="boost"/></actuator>', "joint=hip: 2 actuators"),
    "a default with armature": ("<default><joint", '<default><general armature="1"/><joint', "armature of joint hip"),
    "a keyframe": ("<key ", '<key ctrl="0 0" ', "keyframes have ctrl of 2 actuators, expected 3"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_file_that_cannot_hold_the_drive_is_refused(case: str, tmp_path: Path) -> None:
    old, new, message = REFUSED[case]
    text = changed(ROBOT, (old, new))
    if case == "a keyframe":
        text = changed(text, ('<velocity name="toe" joint="toe" kv="1"/>', ""))
    fitted = fit(save(tmp_path, text))
    with pytest.raises(FrictionzooError, match=re.escape(message)) as caught:
        put(fitted)
    assert "\n" not in str(caught.value)


def test_a_file_that_cannot_hold_the_drive_leaves_the_bench(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "more.xml").write_text('<mujoco><sensor><jointpos joint="hip"/></sensor></mujoco>')
    fitted = fit(save(tmp_path, changed(ROBOT, ("<sensor>", '<include file="more.xml"/><sensor>'))), "hip")
    with caplog.at_level(logging.WARNING, "frictionzoo"):
        files = written(fitted)
    assert files["identified.xml"] == files["bench.xml"]
    (said,) = (record.getMessage() for record in caplog.records if "is the bench alone" in record.getMessage())
    assert "has an <include>" in said and "\n" not in said
    export = Mjcf().write(fitted, tmp_path, {})
    assert export.files == ("bench.xml",) and "has an <include>" in export.limits[-1]


def test_a_robot_that_mujoco_compiles_is_compiled_with_the_drive(tmp_path: Path) -> None:
    whole = re.sub(r"<asset>.*</asset>|<geom [^>]*mesh[^>]*>|<geom type=.hfield[^>]*>", "", ROBOT, flags=re.DOTALL)
    whole = changed(whole, (' material="m"', ""), ('<body name="thigh"', '<geom size="0.1"/><body name="thigh"'))
    robot = put(fit(save(tmp_path, whole)))
    assert say_whole(tmp_path / "robot.xml", robot) == ()
    broken = replace(robot, content=robot.content.replace(b'name="imu"', b'name="eye"'))  # its sensor is lost
    with pytest.raises(ExportError, match="with the drive in it, MuJoCo does not compile it"):
        say_whole(tmp_path / "robot.xml", broken)


@pytest.mark.parametrize("target", [Mjlab, IsaacLab])
def test_configurations_list_every_joint(target: Any, tmp_path: Path) -> None:
    fitted = fit(
        save(tmp_path, ROBOT), ["hip", "knee"], actuator=JointPD(kp=20.0, kd=1.0), params={"torque_offset": 0.4}
    )
    export = target().write(fitted, tmp_path, {})
    joints = target().read((tmp_path / target.file).read_text())
    np.testing.assert_array_equal([joint.armature for joint in joints], fitted.values["bench"]["armature"])
    np.testing.assert_array_equal([joint.frictionloss for joint in joints], fitted.values["friction"]["frictionloss"])
    np.testing.assert_array_equal([joint.damping for joint in joints], fitted.values["friction"]["damping"])
    assert [joint.motor.stiffness for joint in joints] == [20, 20]
    (said,) = (limit for limit in export.limits if "constant torque" in limit)
    assert "0.4 N m" in said
    assert export.differences[0].largest < 1e-3  # kd is explicit there


@needs_data
def test_the_quadruped_of_the_recordings(tmp_path: Path) -> None:
    source = Path(str(DATA)) / "go2" / "go2.xml"
    fitted = fit(source, timestep=0.005)
    written = put(fitted).content
    before, after = (content.decode().splitlines() for content in (source.read_bytes(), written))
    after.pop(1)  # the remark
    differing = [old for old, new in zip(before, after, strict=True) if old != new]
    assert len(differing) == 24 and all(re.match(r"\s*<(joint|motor) ", line) for line in differing)
    root = ET.fromstring(written)
    assert root.find(".//freejoint") is not None
    ranges = [element.get("forcerange") for element in root.iterfind("./actuator/general")]
    assert ranges == 4 * ["-23.7 23.7", "-23.7 23.7", "-45.43 45.43"]  # of their classes


def test_what_is_changed_in_place_leaves_the_rest() -> None:
    content = (
        b'\xef\xbb\xbf<?xml version="1.0"?>\r\n<a x = "1>" y=\'2\'>\r\n  <b/>\r\n  <c>t<d/></c >\r\n</a>\n<!-- > -->'
    )
    file = InPlace.read(content)
    assert file.write() == content
    a, b, c, d = file.tags
    assert d.owner is c and d.path == ("a", "c")
    file.set(a, {"y": "<", "z": 'ö"'})
    file.append(a, ET.Element("k"))
    file.append(b, ET.Element("q"))
    file.replace(c, ET.Element("w", {"v": "1"}))
    file.remark("so -- it is")
    assert file.write() == (
        b'\xef\xbb\xbf<?xml version="1.0"?>\r\n<a x = "1>" y="&lt;" z=\'&#246;"\'>\r\n  <!-- so - - it is -->\r\n'
        b'  <b><q/></b>\r\n  <w v="1"/>\r\n  <k/>\r\n</a>\n<!-- > -->'
    )
