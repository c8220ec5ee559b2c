"""A law drawn beside what recordings imply: on drives whose friction is known, both lie on it."""

import math
from typing import Any

import jax
import numpy as np
import pytest
from helpers.rod import ARMATURE, DRY, STEP, VISCOUS, leave, plain, record

import frictionzoo as fz
from frictionzoo.core.state import DriveState
from frictionzoo.result.portrait import NEIGHBOURS, Portrait, Rows, portray

pytestmark = pytest.mark.usefixtures("x64")

TORQUE = 0.5  # N m, about that of the drive


def truth(velocity: np.ndarray) -> np.ndarray:
    return DRY * np.sign(velocity) + VISCOUS * velocity


def test_the_band_covers_the_true_curve_and_the_points_lie_on_it() -> None:
    """As many as may: an interval of 95 % covers the truth at nine of ten places, and not at all of them."""
    logs = [record(lambda *_: 0.0, seconds=8.0, seed=seed, noise=1e-4) for seed in (1, 2)]
    bench = fz.Bench("knee_rod.xml", actuator=fz.Force(), params={"armature": {"init": ARMATURE, "identify": True}})
    cut = {"count": 60, "length": 100}
    judging: Any = {"horizons": [0.5], "rollouts": 4, "places": 2, "trajectory": 1.0}
    how: Any = {"recipe": "given", "discretisation": False, "dtype": "float64", "segments": cut, "evaluation": judging}
    drive = fz.identify(bench, "mujoco_default", logs, test=0.3, method="lm", checkup="warn", **how)
    found = drive.curves.portraits["velocity"]
    at, moves = found.at[:, 0], found.at[:, 0] != 0
    assert at.min() < -1 and at.max() > 1
    covered = (found.low[:, 0] <= truth(at)) & (truth(at) <= found.high[:, 0])
    assert covered[moves].mean() >= 0.9
    width = np.nanmax(found.high - found.low)
    assert 0 < width < 0.1 * TORQUE  # a band that covers everything says nothing
    np.testing.assert_allclose(found.law[moves, 0], truth(at[moves]), atol=0.02 * TORQUE)
    where, binned = found.where[:, 0], ~np.isnan(found.where[:, 0])
    assert binned.sum() > 10
    inside = (found.lower[binned, 0] <= truth(where[binned])) & (truth(where[binned]) <= found.upper[binned, 0])
    assert inside.mean() >= 0.9


@pytest.fixture(scope="module")
def beside() -> dict[str, Portrait]:
    """Of a law whose dry friction is too small, on a drive whose friction grows with the load, too."""
    with jax.enable_x64(True):
        log = record(lambda q, v, motor, gravity, t: 0.15 * abs(motor - gravity))
        left, _ = leave(log, plain("load_dependent", frictionloss=DRY / 2, damping=VISCOUS, load_friction=0.15))
        assert left is not None
        return portray(left.recordings.model, {}, left.rows)


def test_points_lie_on_the_true_curve_where_the_law_does_not(beside: dict[str, Portrait]) -> None:
    found = beside["load"]
    where, binned = found.where[:, 0], ~np.isnan(found.where[:, 0])
    law = np.interp(where[binned], found.at[:, 0], found.law[:, 0])
    missing = found.implied[binned, 0] - law
    np.testing.assert_allclose(np.median(missing), DRY / 2, atol=0.2 * DRY / 2)


def test_a_law_is_drawn_over_what_it_sees(beside: dict[str, Portrait]) -> None:
    assert [*beside] == ["velocity", "load"]
    assert np.isnan(beside["load"].low).all()  # without draws there is no band
    slope = np.polyfit(beside["load"].at[:, 0], beside["load"].law[:, 0], 1)[0]
    assert 0.1 < slope < 0.4  # 0.15 of the load, and what goes with the speeds at which loads are large


def test_joints_have_places_of_their_own() -> None:
    """One moves twenty times as fast as another, and a third rests."""
    random, size = np.random.default_rng(0), np.array([1.0, 20.0, 0.0])
    velocity, none = size * random.uniform(-1, 1, (400, 3)), np.zeros((400, 3))
    state = DriveState(none, velocity, none, none, none)
    model = plain_of_three()
    found = portray(
        model,
        {"friction.damping": VISCOUS * np.linspace(0.9, 1.1, 50)[:, None] * np.ones(3)},
        Rows(state, velocity != 0, truth(velocity)),
    )["velocity"]
    assert len(state.qvel) > NEIGHBOURS
    for joint in (0, 1):
        np.testing.assert_allclose(np.ptp(found.at[:, joint]), 2 * size[joint], rtol=0.02)
        np.testing.assert_allclose(found.law[:, joint], truth(found.at[:, joint]), atol=1e-9)
        wide = 0.19 * VISCOUS * np.abs(found.at[:, joint])
        np.testing.assert_allclose((found.high - found.low)[:, joint], wide, atol=1e-9 + 0.02 * wide.max())
        seen = ~np.isnan(found.where[:, joint])
        assert ((found.lower <= found.implied) & (found.implied <= found.upper))[seen, joint].all()
        assert math.isclose(float(np.abs(found.where[seen, joint]).max()), size[joint], rel_tol=0.1)
    assert np.isnan(found.law[:, 2]).all() and np.isnan(found.implied[:, 2]).all()


def plain_of_three() -> fz.FrictionModel:
    values = {"frictionloss": DRY, "damping": VISCOUS}
    return fz.law("mujoco_default", nv=3, params={name: {"init": value} for name, value in values.items()})


def test_a_step_of_the_recording_is_no_more_than_a_row() -> None:
    """Time and what is left of each row belong together, and rows at rest count for nothing."""
    left, _ = leave(record(lambda *_: 0.0, seconds=8.0))
    assert left is not None
    assert left.time.shape == (len(left.torque),) and 0 < left.time[0] < left.time[-1] < 8.0
    steps = np.diff(left.time) / STEP
    np.testing.assert_allclose(steps, np.round(steps[0]), rtol=1e-9)
    np.testing.assert_array_equal(left.rows.counts, left.counts)
