"""Logs and data sets: what they hold, and what they refuse."""

import dataclasses

import numpy as np
import pytest

from frictionzoo.core.errors import LogError, closest
from frictionzoo.core.log import Dataset, Log
from frictionzoo.core.segments import cut_segments


def make_log(**changes) -> Log:
    """Ten samples at 100 samples/s of two joints and one actuator, with some of it changed."""
    number = np.arange(10.0)
    fields = {
        "name": "a.csv",
        "time": number / 100,
        "qpos": np.stack([number, number], axis=1),
        "qvel": np.stack([-number, -number], axis=1),
        "ctrl": number[:, None],
        "sha256": "hash",
        "simulated": False,
    }
    return Log(**(fields | changes))


def with_value(values: np.ndarray, place, value: float) -> np.ndarray:
    changed = values.copy()
    changed[place] = value
    return changed


TIME = np.arange(10) / 100
TWO = np.zeros((10, 2))


def test_a_log_knows_its_timestep_and_length():
    log = make_log()
    assert log.timestep == pytest.approx(0.01, rel=1e-12)
    assert log.samples == 10
    assert log.metadata == {}


def test_a_part_keeps_everything_but_the_other_samples():
    part = make_log(metadata={"mass": 0.26}).between(3, 7, "train")
    assert part.name == "a.csv[train]"
    np.testing.assert_array_equal(part.time, TIME[3:7])
    np.testing.assert_array_equal(part.qpos[:, 0], [3, 4, 5, 6])
    np.testing.assert_array_equal(part.qvel[:, 1], [-3, -4, -5, -6])
    np.testing.assert_array_equal(part.ctrl[:, 0], [3, 4, 5, 6])
    assert (part.sha256, part.simulated, part.metadata) == ("hash", False, {"mass": 0.26})


def test_a_log_cannot_be_changed():
    with pytest.raises(dataclasses.FrozenInstanceError):
        make_log().name = "b.csv"


def test_the_jitter_of_a_clock_is_accepted():
    jitter = 1e-4 * np.resize([1.0, -1.0], 10)  # every other interval is 4 % longer
    assert make_log(time=TIME + jitter).timestep == pytest.approx(0.01, rel=0.01)


BAD = {
    "one-sample": (
        {"time": TIME[:1], "qpos": TWO[:1], "qvel": TWO[:1], "ctrl": TWO[:1]},
        r"^a\.csv: 1 samples, expected at least 2; record a longer log$",
    ),
    "no-sample": (
        {"time": TIME[:0], "qpos": TWO[:0], "qvel": TWO[:0], "ctrl": TWO[:0]},
        r"^a\.csv: 0 samples, expected at least 2",
    ),
    "nan": (
        {"qvel": with_value(TWO, (4, 1), np.nan)},
        r"^a\.csv: qvel is NaN or infinite in 1 of 10 samples, first at sample 4; expected finite values",
    ),
    "infinite": ({"ctrl": with_value(TWO, (slice(7, 9), 0), -np.inf)}, r"ctrl is NaN or infinite in 2 .* sample 7"),
    "nan-time": ({"time": with_value(TIME, 2, np.nan)}, r"time is NaN or infinite in 1 of 10 samples"),
    "backwards": (
        {"time": with_value(TIME, 5, 0.03)},
        r"^a\.csv: time runs backwards at sample 5 \(0\.04 s, then 0\.03 s\); expected increasing times",
    ),
    "repeats": ({"time": with_value(TIME, 5, 0.04)}, r"time repeats at sample 5 \(0\.04 s, then 0\.04 s\)"),
    "gap": (
        {"time": TIME + 0.5 * (np.arange(10) > 6)},
        r"^a\.csv: 0\.51 s between samples 6 and 7, expected 0\.01 s everywhere; resample",
    ),
}


@pytest.mark.parametrize(("changes", "line"), BAD.values(), ids=BAD)
def test_a_bad_recording_gets_one_line(changes, line):
    with pytest.raises(LogError, match=line) as caught:
        make_log(**changes)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("part", ["train", "test"])
def test_a_data_set_needs_both_parts(part):
    parts = {"train": (make_log(),), "test": (make_log(),)} | {part: ()}
    with pytest.raises(LogError, match=rf"^mine: the {part} part is empty; change data\.split"):
        Dataset("mine", **parts)


def test_the_logs_of_a_data_set_are_train_first():
    train, test = make_log(name="a.csv"), make_log(name="b.csv")
    assert [log.name for log in Dataset("mine", (train,), (test,)).logs] == ["a.csv", "b.csv"]


def test_segments_count_steps_not_samples():
    segments = cut_segments([make_log()], None, 3)
    assert (segments.count, segments.length) == (3, 3)
    assert segments.qpos.shape == (3, 4, 2)


@pytest.mark.parametrize(
    ("name", "options", "hint"),
    [
        ("colomb", ["stribeck", "coulomb"], "did you mean coulomb? (expected one of coulomb, stribeck)"),
        ("xyz", ["stribeck", "coulomb"], "expected one of coulomb, stribeck"),
        ("xyz", [], "none is available"),
    ],
    ids=["near", "far", "none"],
)
def test_the_hint_for_an_unknown_name(name, options, hint):
    assert closest(name, options) == hint
