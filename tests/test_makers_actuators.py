"""Actuators of makers' files: a bench moves as MuJoCo C moves the file itself, says what it leaves out, or refuses."""

import re
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from conftest import check_each
from helpers.makers_actuators import (
    KINDS,
    MOTOR,
    POSITION,
    STEP,
    STIFF,
    VELOCITY,
    Variant,
    as_recorded,
    compare_in_c,
    draw,
    moved_by,
    save,
    values_of,
    variants,
)

import frictionzoo as fz
from frictionzoo.bench import Actuator
from frictionzoo.bench.robot_file import read_robot
from frictionzoo.core.errors import BenchError, FrictionzooError
from frictionzoo.models.mujoco_default import MujocoDefault
from frictionzoo.simulation import friction_of, make_engine
from frictionzoo.simulation.rollout import make_rollout

pytestmark = pytest.mark.usefixtures("x64")

VARIANTS = dict(variants())
SAME = 1e-9
KNOWN = {"armature": {"identify": False}}


def test_a_bench_is_the_makers_file(tmp_path: Path) -> None:
    def check(name: str, variant: Variant) -> None:
        path = save(tmp_path, variant.text())
        robot = fz.Robot(str(path), params=KNOWN)
        assert compare_in_c(robot, mujoco.MjModel.from_xml_path(str(path))) < SAME, robot.notes

    assert len(VARIANTS) > 100
    check_each(check, VARIANTS.items())


@pytest.mark.slow
@pytest.mark.parametrize("law", ["JointPD", "Force"])
def test_the_engine_moves_as_the_makers_file(law: str, tmp_path: Path) -> None:
    """One compiled rollout for all files, of which it gets the numbers."""
    pd: dict[str, Any] = {"kp": [1.0, 0.0], "kd": 1.0, "ctrl_low": -1.0, "ctrl_high": 1.0} if law == "JointPD" else {}
    actuator: Actuator = getattr(fz, law)(torque_limit=1.0, torque_low=-2.0, **pd)
    path = save(tmp_path, Variant(MOTOR.format(1, "")).text())
    general = fz.Robot(str(path), actuator=actuator, params={**KNOWN, "delay": 5 * STEP})
    sampling, far = general.sampling(STEP), {"ctrl_low": -1e12, "torque_low": -1e12, "delay": 0.0}
    engine = make_engine(
        "specialised", general, friction_of(MujocoDefault(2, {"frictionloss": 0.1, "damping": 0.1})), True
    )
    rollout, compared = make_rollout(engine, sampling).compiled, 0
    for name, variant in VARIANTS.items():
        robot = fz.Robot(str(save(tmp_path, variant.text())), params=KNOWN)
        if type(robot.actuator).__name__ != law or variant.integrator != "Euler":
            continue
        model = mujoco.MjModel.from_xml_path(str(tmp_path / "arm.xml"))
        states, ctrl = draw(model.nv, model.nu)
        own = values_of(robot)
        limit = own["bench"].get("torque_limit")
        filled = {n: np.full(2, far.get(n, 1e12)) for n in general.params} | own["bench"]
        if limit is not None and "torque_low" not in own["bench"]:
            filled["torque_low"] = -limit
        moved = rollout({**own, "bench": filled}, *states, as_recorded(robot, ctrl, sampling.history))
        assert np.abs(np.stack(moved) - moved_by(model, states, ctrl)).max() < SAME, name
        compared += 1
    assert compared >= 30


def one(text: str) -> str:
    return Variant(text).text()


GENERAL = '<general name="g{{joint}}" joint="{{joint}}" gainprm="3" {0}/>'.replace("{{", "{").replace("}}", "}")
BIASED = GENERAL.format('biastype="affine" biasprm="{0}"', joint="{joint}")
LINES = {  # what a file has, and the line that names it
    "filter": (POSITION.format(1, 'timeconst="0.05"'), r"actuator pj0: its filter of 0\.05 s is left out"),
    "exact filter": (GENERAL.format('dyntype="filterexact" dynprm="0.02"', joint="{joint}"), r"its filter of 0\.02 s"),
    "cylinder": ('<cylinder name="y{joint}" joint="{joint}" area="2" timeconst="0.1"/>', r"actuator yj0: its filter"),
    "two positions": (
        POSITION.format(1, "") + STIFF.format(2, "").replace('="p', '="s'),
        r"joint j0 has 2 actuators: pj0 is read",
    ),
    "unnamed": (
        "<motor joint='{joint}'/><motor joint='{joint}'/>",
        r"actuators: number 0 is read, and number 1 left out",
    ),
    "ranges of a part": (STIFF.format(1, "") + VELOCITY.format(1, 'forcerange="-1 1"'), r"ranges of actuators vj0 are"),
    "delay of a part": (
        STIFF.format(1, 'delay="0.008" nsample="3"') + VELOCITY.format(1, ""),
        r"delays of actuators pj0, vj0 differ: all of their commands are 0\.008 s late",
    ),
    "range of a velocity": (KINDS["PID"].format(1, 'velrange="-1 1"'), r"ranges of ctrl_velocity of actuator cj0"),
    "cubic": (POSITION.format(1, 'delay="0.006" nsample="4" interp="cubic"'), r"interpolated linearly, not by a cubic"),
    "gear": (POSITION.format(2, ""), r"command of joint j0: ctrl is 0\.5 times the file's ctrl\[0\]"),
    "short delay": (POSITION.format(1, 'delay="0.0005" nsample="2"'), r"delay of actuator pj0, 0\.0005 s: 0\.004 s"),
}
LEFT = {  # what a bench does not hold, and why its actuator is left out; without one it has no law
    "integrator": (
        '<intvelocity name="a{joint}" joint="{joint}" kp="2" actrange="-1 1"/>',
        r"activation \(integrator\)",
    ),
    "damper": ('<damper name="a{joint}" joint="{joint}" kv="1" ctrlrange="0 1"/>', r"gain \(affine\) is not constant"),
    "muscle": ('<muscle name="a{joint}" joint="{joint}" lengthrange="0 1"/>', r"activation \(muscle\)"),
    "user dynamics": ('<general joint="{joint}" dyntype="user" actdim="1"/>', r"activation \(user\)"),
    "user gain": ('<general joint="{joint}" gaintype="user"/>', r"gain \(user\)"),
    "user bias": ('<general joint="{joint}" biastype="user"/>', r"bias \(user\)"),
    "integral": (KINDS["PID"].format(1, 'ki="1"'), r"activation \(pid\)"),
    "slew rate": (KINDS["PID"].format(1, 'slewmax="1"'), r"activation \(pid\)"),
    "velocity alone": (KINDS["PID"].format(1, 'input="vel"'), r"its commands have no position"),
    "DC motor": ('<dcmotor joint="{joint}" motorconst="0.5" resistance="2" inductance="0.1"/>', r"a winding with"),
}
NO_LAW = {  # what is read, but is no law that a bench takes by itself
    "constant": BIASED.replace("{0}", "1 -3 0"),
    "other stiffness": BIASED.replace("{0}", "0 -2 0"),
    "no gain": '<general joint="{joint}" gainprm="0"/>',
}


@pytest.mark.parametrize("case", LINES)
def test_what_differs_is_named(case: str, tmp_path: Path) -> None:
    text, line = LINES[case]
    robot = fz.Robot(str(save(tmp_path, one(text))), params=KNOWN)
    assert any(re.search(line, note) for note in robot.notes), robot.notes
    assert not any("\n" in note for note in robot.notes)


@pytest.mark.parametrize("case", [*LEFT, *NO_LAW])
def test_what_no_bench_holds_is_refused(case: str, tmp_path: Path) -> None:
    text, reason = LEFT[case] if case in LEFT else (NO_LAW[case], "")
    path = str(save(tmp_path, one(text)))
    assert re.search(reason, " ".join(read_robot(path).notes))
    with pytest.raises(BenchError, match=r"bench\.actuator") as refused:
        fz.Robot(path, params=KNOWN)
    assert "\n" not in str(refused.value)


def test_at_the_actuators_limit_implicit_integrators_differ_and_a_line_says_so(tmp_path: Path) -> None:
    for force, joint in (('forcerange="-0.5 0.5"', ""), ("", 'actuatorfrcrange="-0.5 0.5"')):
        path = save(tmp_path, Variant(POSITION.format(1, force), joint, "implicitfast").text())
        robot = fz.Robot(str(path), params=KNOWN)
        said = [note for note in robot.notes if note.startswith("forcerange of joint j0, j1: while the torque is at")]
        distance = compare_in_c(robot, mujoco.MjModel.from_xml_path(str(path)))
        assert bool(said) == bool(force) == (distance > SAME)


def test_a_law_of_the_users_own_gets_the_files_ranges(tmp_path: Path) -> None:
    text = one(MOTOR.format(2, 'ctrlrange="-3 3" forcerange="-2 2"'))
    path = str(save(tmp_path, text.replace('range="-0.5 0.8"', 'actuatorfrcrange="-5 3" range="-0.5 0.8"')))
    stated = fz.Robot(path, actuator=fz.JointPD(kp=1, kd=0.1)).initial_values()
    assert stated["torque_limit"].tolist() == [3, 4] and stated["torque_low"].tolist() == [-4, -4]
    assert "ctrl_low" not in stated
    own = fz.Robot(path, actuator=fz.JointPD(kp=1, kd=0.1, torque_limit=7)).initial_values()
    assert own["torque_limit"].tolist() == [7, 7] and "torque_low" not in own
    for none in (fz.JointPD(kp=1, kd=0.1, torque_limit=0), fz.JointPD(kp=1, kd=0.1)):
        robot = fz.Robot(path, actuator=none, ranges="keep" if "torque_limit" in none.said else "leave_out")
        assert "torque_limit" not in robot.initial_values()
    plain = fz.Robot(path, actuator=fz.PositionPD(kp=1, kd=0.1))
    assert any(note.startswith("ranges of torque of the file are left out: PositionPD") for note in plain.notes)
    with pytest.raises(FrictionzooError, match=r"bench\.ranges=of_course"):
        fz.Robot(path, ranges="of_course")


def packages() -> list[Path]:
    """MJCF files with actuators among the test data of MuJoCo's own packages."""
    folder = Path(str(distribution("mujoco-mjx").locate_file("mujoco")))
    several = "[0-9]_humanoids"  # the humanoid again and again
    files = [path for path in folder.rglob("*.xml") if not path.match(f"*{several}.xml")]
    return sorted(path for path in files if b"<actuator" in path.read_bytes())


@pytest.mark.parametrize("path", packages(), ids=lambda path: path.name)
def test_actuators_of_packages_give_the_torque_that_mujoco_c_gives(path: Path) -> None:
    """In random states of the whole file, whatever moves there; what is left out has a line."""
    try:
        robot = read_robot(str(path))
        makers = mujoco.MjModel.from_xml_path(str(path))
    except (BenchError, ValueError) as refused:
        assert str(refused)
        return
    rng, data = np.random.default_rng(0), mujoco.MjData(makers)
    for _ in range(10):
        data.qvel[:], data.ctrl[:] = rng.normal(size=makers.nv), rng.normal(0, 2, makers.nu)
        for joint in robot.joints:
            data.qpos[makers.jnt_qposadr[makers.joint(joint).id]] = rng.normal()
        mujoco.mj_forward(makers, data)
        for index, (joint, read) in enumerate(zip(robot.joints, robot.actuators, strict=True)):
            at = makers.joint(joint).id
            if read is None:
                continue
            dof, ends = int(makers.jnt_dofadr[at]), np.array([read.ctrlrange, robot.forceranges[index]])
            ends = np.where(np.isnan(ends), [-np.inf, np.inf], ends)
            ctrl = float(np.clip(data.ctrl[read.commands[0].index], *ends[0]))
            torque = read.gain * ctrl + read.bias0 + read.bias1 * data.qpos[makers.jnt_qposadr[at]]
            torque = np.clip(torque + read.bias2 * data.qvel[dof], *ends[1])
            if abs(torque - data.qfrc_actuator[dof]) > SAME:
                named = " ".join(robot.notes)
                assert f"actuator {read.name}" in named or f"joint {joint} has" in named or "act by" in named
