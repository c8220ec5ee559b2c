"""A robot's own file as a bench: what it says is where a fit begins, what is left out is told, its drives are found."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import torch
from helpers.legged import JOINTS, position

import frictionzoo as fz
from frictionzoo.core.errors import BenchError, ConfigError
from frictionzoo.core.log import Dataset, Log
from frictionzoo.diagnostics.dataset import check_motion
from frictionzoo.models.mujoco_default import MujocoDefault

TRUTH = {"armature": [0.01, 0.03] * 2, "frictionloss": [0.1, 0.3] * 2, "damping": [0.05, 0.15] * 2}
FREE = {"low": 1e-4, "high": 10.0, "scale": "log", "identify": True}


def test_what_the_file_says_is_known_or_where_the_fit_begins(dog: Callable[..., fz.Robot]) -> None:
    robot = dog()
    assert robot.joints == JOINTS and robot.branches == (0, 0, 1, 1)
    values = robot.initial_values()
    assert values["armature"].tolist() == [0.02, 0.03] * 2
    assert values["kp"].tolist() == [20, 40] * 2 and values["kd"].tolist() == [0.5, 1.0] * 2
    assert robot.params["armature"].is_identified and not robot.params["kp"].is_identified
    begun = robot.initial_friction(fz.law("mujoco_default", 4).params)
    assert {name: value.tolist() for name, value in begun.items()} == {"frictionloss": [0.2] * 4, "damping": [0.1] * 4}
    told = " ".join(robot.notes)
    for what in ("floating base: body trunk", "neck", "limits of", "contacts are left out"):
        assert what in told


def test_what_the_user_says_comes_before_the_file(dog: Callable[..., fz.Robot]) -> None:
    limit = {"torque_limit": {"init": None, "low": 0.0, "high": 100.0, "scale": 1.0, "identify": False}}
    pd = fz.JointPD(limit, kp={"init": {".*_calf_joint": 50, ".*": 30}}, kd=1.0)
    robot = dog(actuator=pd, params={"armature": {"init": 0.05}}, tie={"calf": ".*_calf_joint"})
    values = robot.initial_values()
    assert values["kp"].tolist() == [30, 50] * 2 and values["armature"].tolist() == [0.05] * 4
    assert values["torque_limit"].tolist() == [9] * 4
    assert robot.groups(robot.params["armature"]) == ["left_hip_joint", "calf", "right_hip_joint", "calf"]
    assert dog(params={"armature": 0.01}).params["armature"].is_identified is False
    torque = dog(lambda name: f'<motor joint="{name}" gear="2"/>')
    assert torque.initial_values()["force_gain"].tolist() == [2.0] * 4


def test_bristles_of_dc_motors_are_where_laws_of_bristles_begin(dog: Callable[..., fz.Robot]) -> None:
    rubbing = '<dcmotor joint="{}" motorconst="1e-9" resistance="1" input="none" lugre="80 0.7 0.1 0.2 0.05"/>'
    robot = dog(lambda name: position(name) + (rubbing.format(name) if "calf" in name else ""))
    assert robot.initial_values()["kp"].tolist() == [20, 40] * 2
    law = fz.law("lugre", 4)
    own = {name: param.each("init", 4)[0] for name, param in law.params.items()}
    begun = robot.initial_friction(law.params)
    told = {"stiffness": 80, "micro_damping": 0.7, "kinetic_torque": 0.1, "static_torque": 0.2}
    told |= {"stribeck_velocity": 0.05, "viscous_coefficient": 0.1}  # the latter of the joint
    for name, value in told.items():
        np.testing.assert_allclose(begun[name], [own[name], value] * 2, rtol=1e-15)
    assert robot.initial_friction(fz.law("dahl", 4).params)["coulomb_torque"][1] == 0.1
    assert set(robot.initial_friction(fz.law("coulomb_stribeck", 4).params)) == set()
    by_joint = fz.law("by_joint", 4, laws={".*_calf_joint": "lugre", ".*": "mujoco_default"})
    by_joint.bind(robot.joints)
    assert len(robot.initial_friction(by_joint.params)) == 8


def test_where_a_fit_begins_elsewhere_than_the_file_a_line_says_so(dog: Callable[..., fz.Robot]) -> None:
    without = {"armature": {"low": 0.025, "high": 1.0}}
    robot = dog(params=without)
    said = [note for note in robot.notes if note.startswith("armature of left_hip_joint, ")]
    assert len(said) == 1 and "begins at 0.025" in said[0] and "the file has 0.02:" in said[0]
    assert not any("begins at" in note for note in dog().notes)
    late = dog(lambda name: position(name).replace("/>", ' delay="0.004" nsample="3"/>'))
    assert late.initial_values()["delay"].tolist() == [0.004] * 4 and "delay" not in dog().params
    free = dog(params={"delay": {"identify": True}})
    assert free.params["delay"].is_identified and not free.initial_values()["delay"].any()


def test_an_armature_of_zero_stays_where_it_is_known(tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(
        '<mujoco><worldbody><body><joint name="j" axis="0 1 0"/><inertial pos="0 0 .1" mass="1" '
        'diaginertia=".1 .1 .1"/></body></worldbody><actuator><motor joint="j"/></actuator></mujoco>'
    )
    assert fz.Robot(str(path), params={"armature": {"identify": False}}).initial_values()["armature"] == [0]
    begun = fz.Robot(str(path))
    assert begun.initial_values()["armature"] == [0.01]
    assert any(note.startswith("armature of j begins at 0.01, where the file has 0") for note in begun.notes)


def test_a_missing_value_of_the_file_is_asked_for(dog: Callable[..., fz.Robot]) -> None:
    with pytest.raises(BenchError, match=r"set bench\.actuator"):
        dog(lambda name: "")
    with pytest.raises(ConfigError, match=r"bench\.actuator\.params\.kp\.init"):
        dog(lambda name: "", actuator=fz.JointPD({"kp": {"init": None}}, kd=1.0))
    assert dog(timestep=0.001).timestep == 0.001 and dog().timestep == 0.002


def test_motion_beyond_limits_that_were_left_out_is_told(dog: Callable[..., fz.Robot], recorded: Log) -> None:
    robot = dog()
    assert list(check_motion(Dataset("dog", (recorded,), (recorded,)), robot)) == []
    far = replace(recorded, qpos=recorded.qpos + np.array([1.5, 0, 0, 0]))
    (doubt,) = (finding.text for finding in check_motion(Dataset("dog", (far,), (far,)), robot))
    assert doubt.startswith("joint left_hip_joint is beyond its limits in the file, -1 to 1, in ")
    kept = check_motion(Dataset("dog", (far,), (far,)), dog(limits="keep"))
    assert not any("beyond" in finding.text for finding in kept)


@pytest.fixture(scope="module")
def recorded(dog: Callable[..., fz.Robot]) -> Log:
    """Both legs follow chirps, with other armatures and friction than the file says."""
    robot = dog(params={"armature": TRUTH["armature"]})
    law = MujocoDefault(4, {name: TRUTH[name] for name in ("frictionloss", "damping")})
    time = np.arange(1500) * 0.002
    ctrl = 0.4 * np.sin(2 * np.pi * np.array([1.0, 1.7, 1.3, 2.1]) * time[:, None] * (1 + 0.4 * time[:, None]))
    still = torch.zeros((1, 4), dtype=torch.float64)
    signals = {name: torch.zeros((1, len(time) - 1, 4), dtype=torch.float64) for name in robot.actuator.inputs}
    with jax.enable_x64(True):
        parts = fz.rollout(robot, law, still, still, torch.from_numpy(ctrl)[None, :-1], signals=signals)
    states = (np.concatenate([np.zeros((1, 4)), part[0].detach().numpy()]) for part in parts)
    return Log("dog", time, *states, ctrl, sha256="0" * 64, simulated=True)


@pytest.mark.slow
@pytest.mark.usefixtures("in_haste")
def test_the_drives_of_legs_are_found_with_values_that_they_share(dog, recorded, tmp_path):
    robot = dog(tie={"hip": ".*_hip_joint", "calf": ".*_calf_joint"}, timestep=0.002)
    how: dict[str, Any] = {"test": 0.3, "method": "lm", "segments": {"length": 50, "count": None}, "dtype": "float64"}
    how |= {"recipe": "given", "evaluation": {"horizons": [0.2], "trajectory": 0.4}}
    found = fz.identify(robot, "mujoco_default", recorded, **how)
    for name in ("bench.armature", "friction.frictionloss", "friction.damping"):
        value = found.parameters[name].value
        np.testing.assert_allclose(value, TRUTH[name.partition(".")[2]], rtol=1e-3)
        assert value[0] == value[2] and value[1] == value[3]
    found.save(tmp_path)
    again = fz.load(tmp_path)
    assert isinstance(again.bench, fz.Robot) and again.bench.notes == robot.notes
    np.testing.assert_array_equal(again.rollout()[0], found.rollout()[0])


KNOWN: dict[str, Any] = {name: {"identify": False} for name in ("frictionloss", "damping")}


def test_known_friction_is_that_of_the_file_unless_it_is_stated(dog: Callable[..., fz.Robot]) -> None:
    """What `fit=known` judges: a default that nobody stated is no published value."""
    begun = dog().initial_friction(fz.law("mujoco_default", 4, params=KNOWN).params)
    assert {name: value.tolist() for name, value in begun.items()} == {"frictionloss": [0.2] * 4, "damping": [0.1] * 4}
    for identify in (False, True):
        stated = {**KNOWN, "frictionloss": {"identify": identify, "init": 0.03}}
        assert set(dog().initial_friction(fz.law("mujoco_default", 4, params=stated).params)) == {"damping"}


def test_known_friction_is_none_where_the_file_has_none(tmp_path: Path) -> None:
    path, joint = tmp_path / "bare.xml", '<joint name="left" axis="0 1 0"/><geom size="0.1" pos="0 0 -0.2"/>'
    path.write_text(
        f"<mujoco><worldbody><body>{joint}</body></worldbody><actuator>"
        '<position joint="left" kp="9" kv="1"/></actuator></mujoco>'
    )
    law, free = fz.law("mujoco_default", params=KNOWN), fz.law("mujoco_default")
    begun = fz.Robot(str(path)).initial_friction(law.params)
    assert begun["damping"] == 0 and begun["frictionloss"] == law.params["frictionloss"].low
    assert fz.Robot(str(path)).initial_friction(free.params) == {}  # a fit begins at its defaults
