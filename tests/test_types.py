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
        "sha256": "a" * 64,
        "simulated": False,
    }
    return Log(**(fields | changes))


def put(values: np.ndarray, place, value: float) -> np.ndarray:
    changed = values.copy()
    changed[place] = value
    return changed


TIME = np.arange(10) / 100
TWO = np.zeros((10, 2))


def test_a_log_cannot_be_changed_and_a_part_keeps_all_but_the_other_samples():
    log = make_log(metadata={"mass": 0.26})
    assert log.timestep == pytest.approx(0.01, rel=1e-12) and log.samples == 10 and make_log().metadata == {}
    with pytest.raises(dataclasses.FrozenInstanceError):
        log.name = "b.csv"
    part = log.between(3, 7, "train")
    assert (part.name, part.sha256, part.simulated, part.metadata) == ("a.csv[train]", "a" * 64, False, {"mass": 0.26})
    for signal in ("time", "qpos", "qvel", "ctrl"):
        np.testing.assert_array_equal(getattr(part, signal), getattr(log, signal)[3:7])


def test_the_jitter_of_a_clock_is_accepted():
    jitter = 1e-4 * np.resize([1.0, -1.0], 10)  # every other interval is 4 % longer
    assert make_log(time=TIME + jitter).timestep == pytest.approx(0.01, rel=0.01)


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        *(({"time": TIME[:n], "qpos": TWO[:n], "qvel": TWO[:n], "ctrl": TWO[:n]}, f"{n} samples") for n in (0, 1)),
        ({"qvel": put(TWO, (4, 1), np.nan)}, "qvel is NaN or infinite in 1 of 10 samples, first at sample 4"),
        ({"ctrl": put(TWO, (slice(7, 9), 0), -np.inf)}, "ctrl is NaN or infinite in 2 .* sample 7"),
        ({"time": put(TIME, 2, np.nan)}, "time is NaN or infinite in 1 of 10 samples"),
        ({"time": put(TIME, 5, 0.03)}, r"time runs backwards at sample 5 \(0\.04 s, then 0\.03 s\)"),
        ({"time": put(TIME, 5, 0.04)}, r"time repeats at sample 5 \(0\.04 s, then 0\.04 s\)"),
        ({"time": TIME + 0.5 * (np.arange(10) > 6)}, r"0\.51 s between samples 6 and 7, expected 0\.01 s everywhere"),
    ],
)
def test_a_bad_recording_gets_one_line(changes, line):
    with pytest.raises(LogError, match=rf"^a\.csv: {line}") as caught:
        make_log(**changes)
    assert "\n" not in str(caught.value)


def test_a_data_set_needs_both_parts_and_has_those_for_training_first():
    train, test = make_log(name="a.csv"), make_log(name="b.csv")
    assert [log.name for log in Dataset("mine", (train,), (test,)).logs] == ["a.csv", "b.csv"]
    for parts, part in ((((), (test,)), "train"), (((train,), ()), "test")):
        with pytest.raises(LogError, match=rf"^mine: the {part} part is empty; change data\.split"):
            Dataset("mine", *parts)


def test_segments_count_steps_not_samples():
    segments = cut_segments([make_log()], None, 3)
    assert (segments.count, segments.length, segments.qpos.shape) == (3, 3, (3, 4, 2))


def test_the_hint_for_an_unknown_name():
    options, expected = ["stribeck", "coulomb"], "expected one of coulomb, stribeck"
    assert closest("colomb", options) == f"did you mean coulomb? ({expected})"
    assert closest("xyz", options) == expected and closest("xyz", []) == "none is available"
