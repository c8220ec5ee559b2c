"""Upper bounds of armature and friction: as wide as the recordings ask for, where nobody stated others."""

from typing import Any

import numpy as np
import pytest

import frictionzoo as fz
from frictionzoo.bench import Bench, Robot
from frictionzoo.bench.actuators.force import Force
from frictionzoo.core.config import compose_config, compose_settings
from frictionzoo.core.described import describe
from frictionzoo.core.log import Log
from frictionzoo.identification.choices import widen_bounds
from frictionzoo.models import FrictionModel

RATE = 2.0  # rad/s, of a sine of 1 rad


def stand(**params: Any) -> Bench:
    return Bench("knee_rod.xml", "knee", actuator=Force(), params=params)


def record(torque: float, bench: Bench) -> Log:
    time = np.arange(10_000) * 1e-3
    qpos, qvel = np.sin(RATE * time), RATE * np.cos(RATE * time)
    ctrl = torque * np.cos(RATE * time)
    return bench.accept(Log("sine", time, qpos[:, None], qvel[:, None], ctrl[:, None], "", simulated=True))


def widen(torque: float, bench: Bench, law: FrictionModel, **options: Any) -> tuple[dict[str, Any], Bench]:
    """The bounds that were raised, by their options, each of which is in the settings too."""
    law.bind(bench.joints)
    sections = {"bench": describe(bench), "model": describe(law)}
    settings = {**compose_settings({}, "recipe=auto"), **sections, **options}
    settings, bench, choices = widen_bounds(settings, bench, [record(torque, bench)], law)
    for choice in choices:
        part: Any = settings
        for key in choice.option.split("."):
            part = part[int(key) if isinstance(part, list) else key]
        assert part == choice.value and "twice the torque" in choice.reason
    return {choice.option: choice.value for choice in choices}, bench


def test_bounds_are_raised_to_what_the_torque_allows() -> None:
    law = fz.law("mujoco_default")
    raised, bench = widen(60.0, stand(), law)
    assert raised["model.params.frictionloss.high"] == law.params["frictionloss"].high == pytest.approx(120, rel=0.05)
    assert raised["model.params.damping.high"] == pytest.approx(2 * 60 / (RATE / 2**0.5), rel=0.1)
    assert raised["bench.params.armature.high"] == pytest.approx(2 * 60 / (RATE**2 / 2**0.5), rel=0.1)
    assert bench.params["armature"].high == raised["bench.params.armature.high"]
    assert law.params["frictionloss"].low == fz.law("mujoco_default").params["frictionloss"].low


def test_bounds_of_a_small_drive_stay() -> None:
    law = fz.law("mujoco_default")
    assert widen(0.1, stand(), law)[0] == {} and law.params["frictionloss"].high == 10.0


@pytest.mark.parametrize("options", [{}, {"recipe": "given"}], ids=str)
def test_bounds_that_are_stated_stay(options: dict[str, Any]) -> None:
    law = fz.law("mujoco_default", params={"frictionloss": {"high": 5.0}, "damping": {"identify": False}})
    bench = stand(armature={"high": 2.0})
    raised, after = widen(60.0, bench, law, **options)
    assert raised == {} and law.params["frictionloss"].high == 5.0 and after.params["armature"].high == 2.0


@pytest.mark.parametrize("laws", [{"knee": "mujoco_default"}, ["coulomb_smooth"]], ids=str)
def test_each_law_of_several_has_wider_bounds(laws: Any) -> None:
    law = fz.law("by_joint", 1, laws=laws)
    raised, _ = widen(60.0, stand(armature=0.01), law)
    (option,) = (option for option in raised if "frictionloss" in option or "static_torque" in option)
    place = "model.laws.knee.params.frictionloss" if isinstance(laws, dict) else "model.laws.0.params.static_torque"
    assert option == f"{place}.high"
    assert max(param.high for param in law.params.values()) == max(raised.values())  # type: ignore[type-var]


def test_default_bounds_are_those_of_the_configuration() -> None:
    for bench, kind in (("drive", Bench), ("robot", Robot), ("robot_torque", Robot)):
        assert compose_config(f"bench={bench}", "data=files").bench.params.armature.high == kind.armature_high
