"""Benches: templates, joints, actuators, and the refusal of what does not fit."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from conftest import TWO_JOINTS

from frictionzoo.bench import Bench, Force, PositionPD
from frictionzoo.core.errors import BenchError
from frictionzoo.core.log import Log

KNOWN = {"low": 1e-6, "high": 1e3, "scale": "log", "identify": False}
ARMATURE = {"armature": {"init": 0.02, **KNOWN}}


def pd() -> PositionPD:
    return PositionPD({"kp": {"init": 20.0, **KNOWN}, "kd": {"init": 1.0, **KNOWN}})


def bench(tmp_path: Path, text: str, joint: Any = None) -> Bench:
    path = tmp_path / "bench.xml"
    path.write_text(text)
    return Bench(str(path), joint, actuator=pd(), params=ARMATURE)


def test_values_reach_the_compiled_model_unrounded(knee: Bench) -> None:
    values = {"armature": np.array([1 / 3]), "kp": np.array([2 / 3]), "kd": np.array([1 / 7])}
    model = mujoco.MjModel.from_xml_string(knee.mjcf(values, np.array([1 / 9]), np.array([1 / 11])))
    assert model.dof_armature[0] == 1 / 3
    assert model.dof_frictionloss[0] == 1 / 9
    assert model.dof_damping[0] == 1 / 11
    assert model.actuator_gainprm[0, 0] == 2 / 3
    np.testing.assert_array_equal(model.actuator_biasprm[0, :3], [0, -2 / 3, -1 / 7])


def test_position_pd_is_the_controller(knee: Bench) -> None:
    model = knee.compile(constraint=False)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = 0.3, -0.7, 0.5
    mujoco.mj_forward(model, data)
    assert data.qfrc_actuator[0] == pytest.approx(20 * (0.5 - 0.3) - 1 * -0.7, abs=1e-14)


def test_force_is_gain_times_command_plus_offset(make: Callable[..., Any]) -> None:
    emps = make("bench", "data=emps")
    values = emps.initial_values() | {"force_offset": np.array([-3.165])}
    model = mujoco.MjModel.from_xml_string(emps.mjcf(values))
    data = mujoco.MjData(model)
    data.ctrl[:] = 2.0
    mujoco.mj_forward(model, data)
    assert data.qfrc_actuator[0] == pytest.approx(2 * 35.15065188 - 3.165, abs=1e-12)
    assert isinstance(emps.actuator, Force)
    assert (emps.joint_type, emps.params["armature"].unit(emps.joint_type)) == ("slide", "kg")


def test_friction_row_only_where_asked_for(knee: Bench) -> None:
    assert knee.compile(constraint=False).dof_frictionloss[0] == 0
    assert knee.compile(constraint=True).dof_frictionloss[0] > 0


def test_only_joints_with_limits_keep_the_softness_of_these(tmp_path: Path) -> None:
    """Genesis softens dry friction by what MuJoCo softens limits by."""
    limited = 'name="knee" range="-30 40" solreflimit="0.03 0.8"'
    drive = bench(tmp_path, TWO_JOINTS.replace('name="knee"', limited), ["hip", "knee"])
    model = mujoco.MjModel.from_xml_string(drive.mjcf(drive.initial_values(), np.full(2, 0.1)))
    hip, knee = (model.joint(name).id for name in ("hip", "knee"))
    np.testing.assert_array_equal(model.jnt_solref[hip], model.dof_solref[model.joint("hip").dofadr[0]])
    np.testing.assert_array_equal(model.jnt_solref[knee], [0.03, 0.8])


def test_comments_cannot_break_the_file(knee: Bench) -> None:
    text = knee.mjcf(knee.initial_values(), comments=("a -- b",))
    assert "a - - b" in text
    mujoco.MjModel.from_xml_string(text)


BOTH = ["hip", "knee"]
REFUSED = [  # replaced part of the MJCF, its replacement, joints, and what the message names
    ("</mujoco>", "", None, "not XML"),
    ("", "", None, "joints hip, knee, .* set bench.joint"),
    ("", "", "kne", "did you mean knee"),
    ("", "", "knee", "2 degrees of freedom, but 1 identified joints"),
    ("", "", ["knee", "hip"], "each joint once in the order"),
    ("", "", ["hip", "hip", "knee"], "each joint once in the order"),
    ("<worldbody>", '<include file="a.xml"/><worldbody>', "knee", "<include>"),
    ("mass", "maas", "knee", "MuJoCo does not compile it"),
    ("<option", '<option integrator="RK4"', BOTH, "integrator RK4"),
    ("</mujoco>", '<actuator><motor name="m" joint="hip"/></actuator></mujoco>', BOTH, "actuator <motor m>"),
    ("<option", '<default><motor ctrlrange="-1 1"/></default><option', BOTH, "defaults for <motor>"),
    ("<option", '<option actuatorgroupdisable="0"/><option', BOTH, "disables actuators"),
    ('name="knee"', 'name="knee" type="slide"', BOTH, "all hinge or all slide"),
    ('name="hip"', 'name="hip" frictionloss="0.1"', BOTH, "joint hip has frictionloss"),
]


@pytest.mark.parametrize(("old", "new", "joint", "line"), REFUSED)
def test_a_template_that_does_not_fit_is_refused(tmp_path: Path, old: str, new: str, joint: Any, line: str) -> None:
    with pytest.raises(BenchError, match=line) as error:
        bench(tmp_path, TWO_JOINTS.replace(old, new) if old else TWO_JOINTS, joint)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("attribute", ['ref="10"', 'range="-30 40"', 'stiffness="0 2"'])
def test_what_a_position_offset_would_not_shift_is_refused(tmp_path: Path, attribute: str) -> None:
    drive = bench(tmp_path, TWO_JOINTS.replace('name="knee"', f'name="knee" {attribute}'), BOTH)
    offset = {"position_offset": {"init": 0.1, "low": -0.2, "high": 0.2, "scale": 0.1, "identify": True}}
    with pytest.raises(BenchError, match=rf"joint knee has {attribute.split('=')[0]} .*position_offset"):
        Bench(drive.source, BOTH, actuator=pd(), params=ARMATURE | offset)


def test_of_several_sections_all_are_heeded(tmp_path: Path) -> None:
    path = tmp_path / "bench.xml"
    path.write_text(TWO_JOINTS.replace("<worldbody>", '<option timestep="0.004"/><worldbody>', 1))
    assert Bench(str(path), BOTH, actuator=pd(), params=ARMATURE, timestep=0.002).timestep == 0.002


@pytest.mark.parametrize("flag", ["frictionloss", "constraint"])
def test_a_template_that_disables_friction_does_not_serve_a_law_that_needs_it(tmp_path: Path, flag: str) -> None:
    text = TWO_JOINTS.replace('<option timestep="0.001"/>', f'<option><flag {flag}="disable"/></option>')
    with pytest.raises(BenchError, match="disables friction constraints"):
        bench(tmp_path, text, BOTH).compile(constraint=True)


def test_a_template_that_is_missing_is_refused() -> None:
    with pytest.raises(BenchError, match=r"nowhere\.xml: cannot be read"):
        Bench("nowhere.xml", actuator=pd(), params=ARMATURE)


@pytest.mark.parametrize(
    ("timestep", "columns", "line"),
    [(0.0015, 1, "0.0015 s per sample, expected 0.001 s"), (0.001, 2, "qpos has 2 columns, expected 1")],
)
def test_a_log_of_another_bench_is_refused(knee: Bench, timestep: float, columns: int, line: str) -> None:
    zeros = np.zeros((10, columns))
    log = Log("a.csv", np.arange(10) * timestep, zeros, zeros, zeros, "", False)
    with pytest.raises(BenchError, match=line):
        knee.accept(log)
