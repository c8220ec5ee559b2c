"""Segments: which samples a window holds, that train and test never meet, and what bad input says."""

import dataclasses

import numpy as np
import pytest

from frictionzoo.core.errors import ConfigError, LogError
from frictionzoo.core.log import Log
from frictionzoo.core.segments import cut_rollouts, cut_segments, longest_window, split_by_time


def make_log(
    samples: int, name: str = "a.csv", timestep: float = 0.01, nv: int = 1, nu: int = 1, base: float = 0.0
) -> Log:
    """A log in which every sample tells its own number: qpos = base + i, qvel = -qpos, ctrl = 1000 + qpos."""
    number = base + np.arange(samples, dtype=float)[:, None]
    time = np.arange(samples) * timestep
    qpos, ctrl = number + np.zeros(nv), 1000 + number + np.zeros(nu)
    return Log(name, time, qpos, -qpos, ctrl, "hash", simulated=True)


def test_a_segment_starts_at_a_state_and_holds_the_commands_between_the_states():
    segments = cut_segments([make_log(12)], None, 5)
    assert (segments.count, segments.length) == (2, 5)
    assert segments.timestep == pytest.approx(0.01, rel=1e-12)  # the mean of rounded sample times
    np.testing.assert_array_equal(segments.qpos[..., 0], [[0, 1, 2, 3, 4, 5], [5, 6, 7, 8, 9, 10]])
    np.testing.assert_array_equal(segments.qvel, -segments.qpos)
    np.testing.assert_array_equal(segments.signals.ctrl[..., 0], 1000 + segments.qpos[:, :-1, 0])
    several = cut_segments([make_log(11, nv=3, nu=2)], None, 5)
    assert several.qpos.shape == (2, 6, 3) and several.signals.ctrl.shape == (2, 5, 2)


def test_no_segment_crosses_from_one_log_into_the_next():
    segments = cut_segments([make_log(13), make_log(9, "b.csv", base=100.0)], None, 4)
    np.testing.assert_array_equal(segments.qpos[:, 0, 0], [0, 4, 8, 100, 104])
    np.testing.assert_array_equal(np.diff(segments.qpos[..., 0], axis=1), 1)
    # Before a log begins, its own first command counts.
    segments = cut_segments([make_log(9), make_log(9, "b.csv", base=100.0)], None, 4, history=2)
    before = [[1000, 1000], [1002, 1003], [1100, 1100], [1102, 1103]]
    np.testing.assert_array_equal(segments.signals.ctrl[:, :2, 0], before)
    np.testing.assert_array_equal(segments.acting.ctrl[..., 0], 1000 + segments.qpos[:, :-1, 0])


@pytest.mark.parametrize("count", [1, 3, 7, 99])
def test_fewer_segments_are_distinct_and_spread_over_the_whole_log(count):
    starts = cut_segments([make_log(1001)], count, 10).qpos[:, 0, 0]
    assert len(starts) == count == len(set(starts))
    spacing = np.diff([*starts, 1000])
    assert np.abs(spacing - 1000 / count).max() <= 10  # no gap is more than one segment off the mean
    assert cut_segments([make_log(21)], 500, 5).count == 4


def test_a_log_that_is_too_short_is_left_out_and_named_or_refused(caplog):
    assert cut_segments([make_log(11), make_log(4, "short.csv")], None, 5).count == 2
    assert "short.csv: 4 samples" in caplog.text
    assert cut_segments([make_log(6)], 10, 5).count == 1
    with pytest.raises(LogError, match=r"^a\.csv: 4 samples, expected at least 6 .*segments\.length"):
        cut_segments([make_log(4)], 10, 5)


@pytest.mark.parametrize(("count", "length", "line"), [(0, 5, "segments.count=0"), (None, 0, "segments.length=0")])
def test_segments_refuse_impossible_options(count, length, line):
    with pytest.raises(ConfigError, match=line):
        cut_segments([make_log(50)], count, length)


@pytest.mark.parametrize(
    ("other", "line"), [({"timestep": 0.02}, "timestep 0.02 s"), ({"nv": 2}, "2 .*qpos"), ({"nu": 3}, "3 .*ctrl")]
)
def test_logs_that_do_not_belong_together(other, line):
    logs = [make_log(50), make_log(50, "b.csv", **other)]
    for cut in (lambda: cut_segments(logs, None, 5), lambda: cut_rollouts(logs, 0.1, None, "consecutive", 0)):
        with pytest.raises(LogError, match=rf"b\.csv: {line}.* as in a\.csv"):
            cut()
    with pytest.raises(LogError, match="no log"):
        cut_segments([], None, 5)
    # Jitter of a clock is not another timestep.
    jittered = dataclasses.replace(make_log(50, "b.csv"), time=np.arange(50) * 0.010001)
    assert cut_segments([make_log(50), jittered], None, 5).timestep == pytest.approx(0.01, rel=1e-12)


def test_rollouts_restart_every_horizon_or_are_distinct_and_follow_the_seed():
    rollouts = cut_rollouts([make_log(41)], 0.1, None, "consecutive", 0)
    np.testing.assert_array_equal(rollouts.qpos[:, 0, 0], [0, 10, 20, 30])
    assert rollouts.length == 10
    logs = [make_log(300), make_log(200, "b.csv", base=1000.0)]
    first, again, other = (cut_rollouts(logs, 1.0, 50, "random", seed).qpos[:, 0, 0] for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert set(first) != set(other)
    assert len(set(first)) == 50
    assert (first < 1000).any() and (first >= 1000).any()  # both logs take part
    np.testing.assert_array_equal(np.diff(cut_rollouts(logs, 1.0, 50, "random", 3).qpos[..., 0], axis=1), 1)


def test_a_window_says_of_which_log_it_is_and_when_it_begins():
    logs = [make_log(100), dataclasses.replace(make_log(80), time=make_log(80).time + 5.0)]
    cut = cut_rollouts(logs, 0.01, 40, "random", seed=0)
    assert cut.recording is not None and cut.begins is not None and {*cut.recording} == {0, 1}
    for number, begins, qpos in zip(cut.recording, cut.begins, cut.qpos, strict=True):
        at = np.flatnonzero(logs[number].time == begins)
        np.testing.assert_array_equal(logs[number].qpos[at], qpos[:1])


def test_more_random_rollouts_than_places_gives_every_place():
    rollouts = cut_rollouts([make_log(15)], 0.1, 100, "random", 0)
    assert sorted(rollouts.qpos[:, 0, 0]) == [0, 1, 2, 3, 4]
    with pytest.raises(LogError, match=r"^b\.csv: 50 samples, expected at least 101 .*evaluation\.horizons"):
        cut_rollouts([make_log(50, "b.csv")], 1.0, 10, "random", 0)


@pytest.mark.parametrize("placement", ["random", "consecutive"])
def test_a_log_shorter_than_the_rollouts_gives_none(placement: str) -> None:
    rollouts = cut_rollouts([make_log(50), make_log(300, "b.csv"), make_log(101, "c.csv")], 1.0, 10, placement, 0)
    assert rollouts.recording is not None and {*rollouts.recording} <= {1, 2} and 1 in rollouts.recording


@pytest.mark.parametrize(
    ("samples", "longest"), [([500], 499), ([500, 400], 399), ([1000, 30], 999), ([100] * 9 + [20], 99), ([7, 7, 7], 6)]
)
def test_the_longest_window_leaves_out_only_a_few_samples(samples: list[int], longest: int) -> None:
    assert longest_window([make_log(count, f"{number}.csv") for number, count in enumerate(samples)]) == longest


@pytest.mark.parametrize(
    ("horizon_s", "count", "placement", "line"),
    [
        (0.1, 5, "randon", r"evaluation\.placement=randon: .*did you mean random"),
        (0.1, None, "random", r"evaluation\.rollouts=null"),
        (0.1, 0, "random", r"evaluation\.rollouts=0"),
        (0.1, 0, "consecutive", r"evaluation\.rollouts=0"),
        (0.001, 5, "random", r"evaluation\.horizons: 0\.001 s"),
    ],
)
def test_rollouts_refuse_impossible_options(horizon_s, count, placement, line):
    with pytest.raises(ConfigError, match=line):
        cut_rollouts([make_log(50)], horizon_s, count, placement, 0)


def test_train_and_test_never_meet():
    train, test = split_by_time(make_log(1000), 0.2, 1.0)
    assert (train.name, test.name) == ("a.csv[train]", "a.csv[test]")
    assert (train.samples, test.samples) == (700, 200)
    assert train.qpos[0, 0] == 0 and test.qpos[-1, 0] == 999
    assert test.time[0] - train.time[-1] == pytest.approx(1.01, rel=1e-9)  # the gap and one sample interval


@pytest.mark.parametrize(
    ("test_share", "gap", "kind", "line"),
    [
        (0.0, 0.0, LogError, r"a\.csv: the test part has 0 of 100 samples .* change data\.split"),
        (0.01, 0.0, LogError, r"the test part has 1 of 100 samples"),
        (1.0, 0.0, LogError, r"the train part has 0 of 100 samples"),
        (0.5, 9.0, LogError, r"the train part has 0 of 100 samples"),
        (1.5, 0.0, ConfigError, "test_share=1.5"),
        (0.2, -1.0, ConfigError, r"gap=-1\.0"),
    ],
)
def test_a_split_that_leaves_a_part_empty_or_is_impossible(test_share, gap, kind, line):
    with pytest.raises(kind, match=line):
        split_by_time(make_log(100), test_share, gap)
