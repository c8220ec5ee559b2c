"""Parameters: coordinates, bounds, units, and the line of each section that makes no sense."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
import torch

import frictionzoo as fz
from frictionzoo.bench import Actuator
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.params import Param, read_params
from frictionzoo.core.units import UNITS
from frictionzoo.models.mujoco_default import MujocoDefault

GOOD = {"init": 0.1, "low": 0.01, "high": 1.0, "scale": "log", "identify": True}


def make(**changes) -> Param:
    return Param.from_config("armature", "inertia", GOOD | changes)


@pytest.mark.parametrize("scale", ["log", 1, 0.25], ids=str)
@pytest.mark.parametrize(
    ("xp", "array"), [(np, np.asarray), (torch, torch.as_tensor), (jnp, jnp.asarray)], ids=["numpy", "torch", "jax"]
)
def test_a_coordinate_goes_there_and_back(scale, xp, array):
    values = array(np.array([0.01, 0.1, 1.0], dtype=np.float32))
    param = make(scale=scale)
    back = param.from_coordinate(param.to_coordinate(values, xp), xp)
    np.testing.assert_allclose(np.asarray(back), [0.01, 0.1, 1.0], rtol=1e-5)  # float32 through exp and log


def test_a_step_of_the_coordinate_is_a_share():
    assert make(scale="log").from_coordinate(math.log(0.2) + 0.01, np) == pytest.approx(0.2 * 1.01, rel=1e-4)
    assert make(scale=0.5).from_coordinate(0.4 + 0.01, np) == pytest.approx(0.2 + 0.005, rel=1e-12)


@pytest.mark.parametrize(
    ("dimension", "hinge", "slide"),
    [
        *(("inertia", "kg m^2", "kg"), ("torque", "N m", "N"), ("damping", "N m s/rad", "N s/m")),
        ("velocity", "rad/s", "m/s"),
    ],
)
def test_the_unit_follows_from_the_joint(dimension, hinge, slide):
    param = Param.from_config("x", dimension, GOOD)
    assert (param.unit("hinge"), param.unit("slide")) == (hinge, slide)
    assert UNITS["hinge"].keys() == UNITS["slide"].keys()


BAD = {
    "empty-bounds": ({"low": 1.0, "high": 1.0, "init": 1.0}, r"^armature: bounds low=1, high=1; expected low < high"),
    "below": ({"init": 0.001}, r"^armature: init=0\.001 lies outside low=0\.01, high=1; start inside"),
    "above": ({"init": 2.0}, r"init=2 lies outside"),
    "nan": ({"init": float("nan")}, r"init=nan lies outside"),
    "nan-bound": ({"low": float("nan")}, r"bounds low=nan"),
    "log-of-zero": ({"low": 0.0}, r"low=0 with scale=log; expected low > 0, or a number as scale"),
    "zero-scale": ({"scale": 0.0}, r"scale=0\.0; expected log or a positive number"),
    "negative-scale": ({"scale": -1.0}, r"scale=-1\.0; expected log or a positive number"),
    "word-scale": ({"scale": "logarithm"}, r"^armature: could not convert .* scale is log or a number"),
    "word": ({"high": "much"}, r"^armature: could not convert .* init, low, high are numbers"),
    "unknown": ({"hihg": 2.0}, r"^armature\.hihg: unknown option; did you mean high\?"),
}


@pytest.mark.parametrize(("changes", "line"), BAD.values(), ids=BAD)
def test_a_section_that_makes_no_sense_gets_one_line(changes, line):
    with pytest.raises(ConfigError, match=line) as caught:
        make(**changes)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("key", GOOD)
def test_every_key_of_a_section_is_needed(key):
    with pytest.raises(ConfigError, match=rf"^armature\.{key}: missing; give high, identify, init, low, scale"):
        Param.from_config("armature", "inertia", {k: v for k, v in GOOD.items() if k != key})


def test_sections_become_parameters_in_the_order_in_which_they_are_declared():
    param = make(init="0.2", scale=2, identify=False)
    assert (param.name, param.dimension) == ("armature", "inertia")
    assert (param.init, param.low, param.high, param.scale, param.identify) == (0.2, 0.01, 1.0, 2.0, False)
    dimensions = {"viscous_coefficient": "damping", "coulomb_torque": "torque"}
    params = read_params("Law", dimensions, {"coulomb_torque": GOOD, "viscous_coefficient": GOOD})
    assert list(params) == ["viscous_coefficient", "coulomb_torque"]
    assert params["coulomb_torque"].dimension == "torque"


def test_a_parameter_that_the_law_lacks_or_that_lacks_a_section():
    law = "Law", {"coulomb_torque": "torque"}
    with pytest.raises(ConfigError, match=r"^Law: unknown parameter colomb_torque; did you mean coulomb_torque\?"):
        read_params(*law, {"coulomb_torque": GOOD, "colomb_torque": GOOD})
    with pytest.raises(ConfigError, match=r"^Law: no parameter coulomb_torque; give its value, or params\.coulomb_t"):
        read_params(*law, {})


@pytest.mark.parametrize("value", [1e6, 0.0, 1e-9])
def test_a_known_value_is_not_held_to_the_bounds_of_a_fit(value):
    param = make(init=value, identify=False)
    assert param.init == value
    joints = Param.from_config("armature", "inertia", GOOD | {"init": [value, 0.1], "identify": [False, True]})
    assert joints.is_at_bound(np.array([value, 0.1])).tolist()[1] is False
    if not 0.01 <= value <= 1:
        with pytest.raises(ConfigError, match=r"^armature: init="):
            make(init=value, identify=True)
    with pytest.raises(ConfigError, match=r"^armature: nan"):
        make(init=float("nan"), identify=False)


NEVER_NEGATIVE = {
    "PositionPD": {"kp": 15.0, "kd": 0.5},
    "JointPD": {"kp": 15.0, "kd": 0.5, "torque_gain": 1.0, "torque_limit": 3.0, "torque_saturation": 9.0},
    "DcMotorPD": {"kp": 9.0, "kd": 1.0, "stall_torque": 3.0, "torque_limit": 2.0, "no_load_velocity": 5.0},
    "VoltageServo": {"kt_over_r": 0.4, "kt2_over_r": 0.4, "duty_gain": 0.2, "duty_limit": 1.0},
}


@pytest.mark.parametrize("law", NEVER_NEGATIVE)
def test_a_gain_or_limit_below_zero_is_refused_by_name(law):
    made: type[Actuator] = getattr(fz, law)
    values = NEVER_NEGATIVE[law]
    assert set(made(**values).params) >= set(values)
    for name, value in values.items():
        for wrong in (-value, [value, -value], {"init": {"hip": -value, ".*": value}}):
            with pytest.raises(ConfigError, match=rf"{law}: {name}="):
                made(**{**values, name: wrong})


@pytest.mark.parametrize("name", ["frictionloss", "damping"])
def test_friction_below_zero_is_refused_by_name(name):
    good = {"frictionloss": 0.1, "damping": 0.2}
    with pytest.raises(ConfigError, match=rf"MujocoDefault: {name}=-0\.1"):
        MujocoDefault(1, {**good, name: -0.1})
    with pytest.raises(ConfigError, match=rf"MujocoDefault: {name}\.low=-1"):
        MujocoDefault(1, {**good, name: {"init": 0.1, "low": -1.0, "high": 1.0, "scale": 1.0, "identify": True}})


def test_an_armature_below_zero_is_refused_by_name():
    for wrong in (-0.1, {"init": -0.1, "identify": False}, {"init": 0.1, "low": -1.0, "scale": 1.0}):
        with pytest.raises(ConfigError, match=r"^bench\.params\.armature"):
            fz.Bench("knee_rod.xml", "knee", actuator=fz.PositionPD(kp=1, kd=1), params={"armature": wrong})


@pytest.mark.parametrize("part", ["init", "low", "high", "identify"])
def test_lists_of_different_lengths_are_refused(part: str) -> None:
    section = {"init": [1.0, 1.0, 1.0], "low": [0.1, 0.1, 0.1], "high": [9.0, 9.0, 9.0], "identify": [True] * 3}
    with pytest.raises(ConfigError, match=r"^damping: "):
        Param.from_config("damping", "damping", {**section, "scale": 1.0, part: section[part][:2]})
