"""Where an error is: drives whose friction has one term more than the law are told by that term; a right law is not."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from helpers.rod import DRY, VISCOUS, Friction, leave, plain, record

from frictionzoo.core.log import Log
from frictionzoo.models import FrictionModel
from frictionzoo.result.attribution import Candidate, attribute
from frictionzoo.result.residuals import describe_residual

pytestmark = pytest.mark.usefixtures("x64")


def looked_at(log: Log, model: FrictionModel | None = None, **bench: Any) -> Any:
    """What goes with what is left of the torque of a drive with about the right values."""
    left, space = leave(log, model, **bench)
    return None if left is None else describe_residual(left, space, np.asarray(space.start))


def told(found: Any) -> list[tuple[str, str | None]]:
    (row,) = found["by_joint"]
    return [(place["place"], place["law"]) for place in row["places"]]


MISSING: dict[str, tuple[Friction, str | None]] = {
    "slow": (lambda q, v, motor, gravity, t: 0.25 * math.exp(-((v / 0.4) ** 2)), "stribeck"),
    "fast": (lambda q, v, motor, gravity, t: 0.03 * abs(v) ** 2, "polynomial_viscous"),
    "direction": (lambda q, v, motor, gravity, t: 0.06 * v, "asymmetric"),
    "constant": (lambda q, v, motor, gravity, t: 0.05 if v > 0 else -0.05, None),
    "load": (lambda q, v, motor, gravity, t: 0.15 * abs(motor - gravity), "load_dependent"),
    "position": (lambda q, v, motor, gravity, t: 0.08 * math.sin(9 * q), "ripple"),
    "temperature": (lambda q, v, motor, gravity, t: -0.15 * (t / 20 - 0.5), "temperature_arrhenius"),
    "pull": (lambda q, v, motor, gravity, t: math.copysign(0.1, v) * math.sin(2 * q + 1), None),
}


@pytest.mark.parametrize("place", MISSING)
def test_what_a_law_lacks_is_told_by_where_it_is(place: str) -> None:
    more, name = MISSING[place]
    found = looked_at(record(more))
    assert {*told(found)} == {(place, name)}
    row = found["by_joint"][0]
    most = row["places"][0]
    assert most["share"] > 0.5 and most["chance"] < 0.01 and not most["known"] and most["whole"] == (name is not None)
    if place == "position":
        assert most["periods"] == 9
    if place == "constant":  # what the drive has besides its actuator, which acts against positive velocities here
        assert most["value"] == pytest.approx(-0.05, rel=0.1)


def test_gains_and_limits_that_are_not_stated_are_told_with_their_size() -> None:
    log = record(lambda *_: 0.0)
    (most,) = looked_at(log, force_gain=1.25)["by_joint"][0]["places"]
    assert most["place"] == "scale" and most["value"] == pytest.approx(0.8, rel=0.05)
    limit = float(np.quantile(np.abs(log.ctrl), 0.97))
    most = looked_at(record(lambda *_: 0.0, most=limit))["by_joint"][0]["places"][0]
    assert most["place"] == "limit" and most["value"] == pytest.approx(limit, rel=0.1)


def test_a_drive_with_the_right_law_has_no_finding() -> None:
    found = looked_at(record(lambda *_: 0.0))
    (row,) = found["by_joint"]
    assert row["places"] == [] and row["residual"] < 0.02 * row["friction"]


def test_encoder_noise_is_told_as_noise() -> None:
    (row,) = looked_at(record(lambda *_: 0.0, noise=3e-4))["by_joint"]
    assert row["places"] == [] and row["residual"] < 2 * row["noise"] and row["correlation"] < 0.3


def test_a_law_that_has_the_term_has_no_finding() -> None:
    more, _ = MISSING["load"]
    model = plain("load_dependent", frictionloss=DRY, damping=VISCOUS, load_friction=0.15)
    assert told(looked_at(record(more), model)) == []


def test_too_little_is_not_looked_at() -> None:
    assert looked_at(record(lambda *_: 0.0, seconds=2.0)) is None


@pytest.mark.parametrize("alike", [0.0, 0.8])
def test_noise_is_seldom_taken_for_a_place(alike: float) -> None:
    """At the level of 1 %, of noise that is alike over some rows, and far from normal."""
    random, found, tries = np.random.default_rng(3), 0, 100
    for _ in range(tries):
        position, velocity, steps = _wander(random, 600), _wander(random, 600), random.standard_t(5, size=600)
        error = np.zeros(600)
        for i in range(1, 600):
            error[i] = alike * error[i - 1] + steps[i]
        side = np.sign(velocity)
        columns: dict[str, Sequence[np.ndarray]] = {
            "direction": (np.ones(600), abs(velocity)),
            "position": [side * position**power for power in (1, 2, 3)],
            "load": (side * abs(position), side * abs(np.roll(velocity, 9))),
        }
        known = np.stack([side, velocity], axis=1)
        candidates = {name: Candidate(np.stack(own, axis=1)) for name, own in columns.items()}
        found += bool(attribute(error, known, candidates))
    assert found <= 4  # of a hundred; more has a chance of 0.3 %


def _wander(random: np.random.Generator, count: int) -> np.ndarray:
    time = 0.02 * np.arange(count)
    return sum(random.normal() * np.sin(2 * np.pi * rate * time + random.uniform(0, 6)) for rate in (0.3, 0.7, 1.3))


def test_of_two_causes_each_is_told() -> None:
    ripple, load = MISSING["position"][0], MISSING["load"][0]
    names = told(looked_at(record(lambda *state: ripple(*state) + load(*state))))
    assert {place for place, _ in names} == {"load", "position"}
