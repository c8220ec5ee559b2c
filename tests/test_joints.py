"""Parameters joint by joint: lists, patterns of names, known in one and identified in the other, shared values."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.two_joints import identify, record

import frictionzoo as fz
from frictionzoo.bench import Bench, PositionPD
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.log import Log
from frictionzoo.core.params import Param, read_params, read_tie
from frictionzoo.fit import Space
from frictionzoo.models.mujoco_default import MujocoDefault

pytestmark = pytest.mark.usefixtures("x64")

JOINTS = ("FL_hip", "FL_calf", "FR_hip", "FR_calf")
MOTORS = {"hip": ".*_hip", "calf": ".*_calf"}
TRUTH = {"armature": (0.02, 0.03), "frictionloss": (0.1, 0.3), "damping": (0.05, 0.2)}
SECTION = {"init": 0.1, "low": 1e-4, "high": 10.0, "scale": "log", "identify": True}


def param(joints: tuple[int, ...] | None = None, **changes: Any) -> Param:
    return replace(Param.from_config("kp", "stiffness", SECTION | changes), joints=joints)


def friction(**changes: Any) -> MujocoDefault:
    return MujocoDefault(2, {name: SECTION | changes for name in ("frictionloss", "damping")})


def test_a_pattern_stands_for_the_joints_that_it_fits_and_the_first_one_counts() -> None:
    bound = param(init={".*_hip": 0.2, "FL_.*": 0.3, ".*": 0.4}, high=[1.0, 2.0, 3.0, 4.0]).for_joints(JOINTS)
    assert bound.init == (0.2, 0.3, 0.2, 0.4)
    assert bound.each("high", 4).tolist() == [1, 2, 3, 4]
    assert bound.each("low", 4).tolist() == [1e-4] * 4


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"init": [0.1, 0.2]}, r"kp\.init: 2 values, expected 4"),
        ({"init": {".*_hip": 0.1}}, r"kp\.init: .* FL_calf"),
        ({"init": {"(": 0.1}}, r"kp\.init: \(: no pattern"),
        ({"init": {".*_hip": 0.1, ".*": 20.0}}, "kp: init=0.1, 20, 0.1, 20 lies outside"),
        ({"identify": [True, 1, True, True]}, r"kp\.identify="),
        ({"tie": 3}, r"kp\.tie=3"),
    ],
)
def test_what_fits_no_joint_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        param(**changes).for_joints(JOINTS)


def test_a_quantity_that_some_joints_have_has_entries_for_these_alone() -> None:
    calf = param(init={".*_hip": 0.2, "FL_.*": 0.3, ".*": 0.4}, high=[1.0, 2.0], identify=[True, False], joints=(1, 3))
    bound = calf.for_joints(JOINTS)
    assert bound.init == (0.3, 0.4)
    np.testing.assert_array_equal(bound.each("high", 4), [np.nan, 1, np.nan, 2])
    assert bound.each("identify", 4).tolist() == [False, True, False, False]
    np.testing.assert_array_equal(bound.each("low", 4), [np.nan, 1e-4, np.nan, 1e-4])
    assert bound.is_at_bound(bound.spread([1.0, 0.4], 4)).tolist() == [False, True, False, False]
    with pytest.raises(ConfigError, match=r"kp\.high: 3 values, expected 2, one a joint"):
        param(high=[1.0, 2.0, 3.0], joints=(1, 3)).for_joints(JOINTS)


def test_values_that_are_known_joint_by_joint_need_no_section() -> None:
    found = read_params(
        "pd", {"kp": "stiffness", "kd": "damping"}, {"kp": [20.0, 40.0], "kd": {"init": {"k.*": 2.0, ".*": 1}}}
    )
    assert not any(param.is_identified for param in found.values())
    assert found["kd"].for_joints(("hip", "knee")).init == (1.0, 2.0)


def test_a_law_waits_for_the_joints_names_and_keeps_what_it_has(two_joints: Bench) -> None:
    law = friction(init={"hip": 0.2, "knee": 0.4})
    law.bind(two_joints.joints)
    assert law.get_parameter("damping").tolist() == [0.2, 0.4]
    with torch.no_grad():
        law.get_parameter("damping").fill_(0.3)
    law.bind(two_joints.joints)
    assert law.get_parameter("damping").tolist() == [0.3, 0.3]


def test_coordinates_are_those_of_the_joints_that_are_identified(leg: Callable[..., Bench]) -> None:
    bench = leg(params={"armature": {"init": [0.02, 0.05], "identify": {"hip": False, ".*": True}}})
    space = Space(bench, friction(high=[1.0, 2.0]), "float32")
    assert space.labels == [
        "bench.armature/knee",
        *(f"friction.{p}/{joint}" for p in ("frictionloss", "damping") for joint in ("hip", "knee")),
    ]
    np.testing.assert_allclose(np.exp(space.high), [1, 1, 2, 1, 2], rtol=1e-6)
    values = space.values(space.start + np.log(2).astype(np.float32))
    np.testing.assert_allclose(values["bench"]["armature"], [0.02, 0.1], rtol=1e-6)
    np.testing.assert_array_equal(np.isnan(space.physical(np.asarray(space.start))["bench.armature"]), [True, False])


def test_joints_that_are_tied_share_a_coordinate(leg: Callable[..., Bench]) -> None:
    offset = {"init": 0.0, "low": -0.1, "high": 0.1, "scale": 1.0, "identify": True}
    bench = leg(tie={"motor": ".*"}, params={"position_offset": offset})
    space = Space(bench, friction(), "float64")
    # The offset is an encoder's, not a motor's.
    assert [*space.labels[:3]] == ["bench.armature", "bench.position_offset/hip", "bench.position_offset/knee"]
    assert len(space.start) == 5
    values = space.values(space.start.at[0].set(np.log(0.07)))
    np.testing.assert_allclose(values["bench"]["armature"], [0.07, 0.07])
    own = Space(leg(tie=True), friction(tie=False), "float64")
    assert len(own.start) == 1 + 4
    with pytest.raises(ConfigError, match=r"friction.frictionloss.init: 0.1 of hip and 0.2 of knee, which share"):
        Space(bench, friction(init=[0.1, 0.2]), "float64")
    with pytest.raises(ConfigError, match=r"bench.tie.hop=.*_hop: no joint of that name; "):
        leg(tie={"hop": ".*_hop"})
    with pytest.raises(ConfigError, match=r"bench.tie: hip belongs to a and b, expected one group"):
        leg(tie={"a": "hip", "b": ".*"})


@pytest.fixture(scope="module")
def recorded(leg: Callable[..., Bench]) -> Log:
    """Hip and knee with gains of their own, simulated with different armatures and friction."""
    bench = leg(actuator=PositionPD(kp=[20, 40], kd=[1, 2]), params={"armature": list(TRUTH["armature"])})
    law = MujocoDefault(2, {name: list(TRUTH[name]) for name in ("frictionloss", "damping")})  # pyright: ignore
    return record(bench, law)


def test_each_joint_is_found_with_gains_of_its_own(leg: Callable[..., Bench], recorded: Log) -> None:
    bench = leg(actuator=PositionPD(kp={"init": {"knee": 40, ".*": 20}}, kd=[1, 2]))
    found = identify(bench, recorded, friction(high={"hip": 1.0, "knee": 2.0}))
    for name in ("bench.armature", "friction.frictionloss", "friction.damping"):
        np.testing.assert_allclose(found.parameters[name].value, TRUTH[name.partition(".")[2]], rtol=1e-4)
    errors = [found.by_joint[joint]["test"].position_mae for joint in ("hip", "knee")]
    assert np.mean(errors) == pytest.approx(found.metrics["test"].position_mae, rel=1e-12)
    row = next(row for row in found.result["parameters"] if row["name"] == "damping")
    assert (row["low"], row["high"]) == (1e-4, [1.0, 2.0])


def test_a_known_joint_stays_and_a_shared_value_is_one(leg: Callable[..., Bench], recorded: Log) -> None:
    armature = {"init": list(TRUTH["armature"]), "identify": [False, True]}
    bench = leg(actuator=PositionPD(kp=[20, 40], kd=[1, 2]), params={"armature": armature}, tie={"all": ".*"})
    with pytest.raises(ConfigError, match=r"bench.armature.low|bench.armature.identify"):
        identify(bench, recorded, friction())  # one is known, and they share a value
    bench = leg(actuator=PositionPD(kp=[20, 40], kd=[1, 2]), params={"armature": {**armature, "tie": False}}, tie=True)
    found = identify(bench, recorded, friction())
    armature = found.parameters["bench.armature"]
    assert armature.value[0] == TRUTH["armature"][0] and np.isnan(armature.interval[0]).all()
    assert armature.value[1] != TRUTH["armature"][1] and np.isfinite(armature.interval[1]).all()
    told = {"hip": (False, None), "knee": (True, True)}
    assert {row["name"]: (row["identified"], row["identifiable"]) for row in armature.by_joint} == told
    damping = found.parameters["friction.damping"]
    (shared,) = damping.by_joint
    assert (shared["name"], shared["joints"]) == ("all joints", ["hip", "knee"])
    assert shared["interval"] == damping.interval[0].tolist()
    assert damping.value[0] == damping.value[1]
    np.testing.assert_array_equal(damping.interval[0], damping.interval[1])
    assert TRUTH["damping"][0] < damping.value[0] < TRUTH["damping"][1]


def test_a_configuration_names_joints_by_patterns(compose: Callable[..., Any]) -> None:
    from frictionzoo.core.config import check_overrides

    plain = compose()
    for option in (
        "bench.actuator.params.kp.init={.*_hip:20.0,.*:40.0}",
        "bench.params.armature.high=[1.0,2.0]",
        "model.params.kinetic_torque.identify={.*_hip:false,.*:true}",
        "bench.tie={hip:.*_hip}",
        "++bench.params.delay.tie=true",
    ):
        check_overrides(compose(option), plain)
    for option, message in {
        "bench.params.armature.init={.*:x}": "armature: could not",
        "bench.tie=[hip]": "bench.tie",
    }.items():
        with pytest.raises(ConfigError, match=message):
            config = compose(option)
            check_overrides(config, plain)
            fz.Bench("knee_rod.xml", actuator=PositionPD(kp=1, kd=1), params=config.bench.params)
            read_tie("bench.tie", config.bench.tie)
