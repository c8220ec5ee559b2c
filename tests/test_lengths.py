"""Lengths of the parts of recordings, of rollouts and of filters, which follow the recordings."""

import functools
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf

from frictionzoo.core.config import compose_config
from frictionzoo.core.errors import ConfigError, LogError
from frictionzoo.core.log import Dataset, Log
from frictionzoo.data.clean import Cleaning, clean
from frictionzoo.data.recording import Recording
from frictionzoo.data.split import Split
from frictionzoo.identification.choices import fit_lengths

LENGTHS = ("horizons", "trajectory", "local", "window")


def wave(seconds: float, rate: float, name: str = "a.csv", phase: float = 0.0) -> Log:
    time = np.arange(round(seconds * rate) + 1) / rate
    qpos = np.sin(2 * np.pi * time + phase)[:, None]
    return Log(name, time, qpos, np.gradient(qpos, 1 / rate, axis=0), qpos, "", None)


def divide(*logs: Log, **options: Any) -> Dataset:
    recordings = [Recording(log.name, log.time, {}) for log in logs]
    train, test = Split(**options).divide(recordings, [[log] for log in logs])
    return Dataset("waves", tuple(train), tuple(test))


@functools.cache
def defaults() -> dict[str, Any]:
    config: Any = OmegaConf.to_container(compose_config("data=files", "recipe=auto"), resolve=True)
    return {name: config[name] for name in ("segments", "evaluation")}


def settings(**evaluation: Any) -> dict[str, Any]:
    plain = defaults()
    return {**plain, "evaluation": {**plain["evaluation"], **evaluation}}


@pytest.mark.parametrize("rate", [15.0, 30.0, 200.0, 1000.0])
@pytest.mark.parametrize("seconds", [5.0, 10.0, 15.0, 100.0])
def test_any_length_and_rate_can_be_evaluated(seconds: float, rate: float) -> None:
    dataset = divide(wave(seconds, rate))
    (train,), (test,) = dataset.train, dataset.test
    gap = test.time[0] - train.time[-1]
    assert gap == pytest.approx(min(1.0, seconds / 10) + 1 / rate, abs=1.1 / rate)
    chosen, choices = fit_lengths(settings(), dataset, "hinge")
    longest = (test.samples - 1) / rate
    before, after = settings()["evaluation"], chosen["evaluation"]
    assert after["trajectory"] == pytest.approx(min(3.0, longest), rel=1e-5)
    assert after["horizons"] == pytest.approx([min(1.0, longest)], rel=1e-5)
    assert min(after["local"], after["window"]) >= 1 / rate
    assert {choice.option for choice in choices} == {
        f"evaluation.{name}" for name in LENGTHS if after[name] != before[name]
    }
    if seconds == 100.0:
        assert not choices and after == before


def test_long_rollouts_that_a_user_sets_follow_the_recordings_too() -> None:
    dataset = divide(wave(20.0, 100.0))
    chosen, choices = fit_lengths(settings(horizons=[9.0, 0.5, 7.0], trajectory=30.0), dataset, "hinge")
    assert chosen["evaluation"]["horizons"] == [3.99, 0.5] and chosen["evaluation"]["trajectory"] == 3.99
    assert "9, 0.5, 7 s" in str(choices[0]) and "3.99 s" in str(choices[0])


@pytest.mark.parametrize(
    ("changes", "kind", "line"),
    [
        ({"placement": "randon"}, ConfigError, r"evaluation\.placement"),
        ({"horizons": []}, ConfigError, r"evaluation\.horizons"),
        ({"window": 0.0}, ConfigError, r"evaluation\.window"),
        ({"local": -1.0}, ConfigError, r"evaluation\.local"),
    ],
)
def test_impossible_lengths_are_refused_before_the_work(changes: dict[str, Any], kind: type, line: str) -> None:
    with pytest.raises(kind, match=line):
        fit_lengths(settings(**changes), divide(wave(20.0, 100.0)), "hinge")


def test_recordings_of_a_few_samples_are_refused() -> None:
    with pytest.raises(LogError, match=r"a\.csv\[test\]: 6 samples to test, .*data\.split"):
        fit_lengths(settings(), divide(wave(0.3, 100.0)), "hinge")
    long = {**settings(), "segments": {"count": None, "length": 4000}}
    with pytest.raises(LogError, match=r"segments\.length"):
        fit_lengths(long, divide(wave(20.0, 100.0)), "hinge")


def test_a_piece_too_short_to_divide_trains(caplog: pytest.LogCaptureFixture) -> None:
    dataset = divide(wave(20.0, 30.0), wave(0.1, 30.0, "b.csv"))
    assert [log.name for log in dataset.train] == ["a.csv[train]", "b.csv"]
    assert [log.name for log in dataset.test] == ["a.csv[test]"]
    assert "b.csv: the test part has 1 of 4 samples" in caplog.text
    with pytest.raises(LogError, match=r"b\.csv: the test part"):
        divide(wave(0.1, 30.0, "b.csv"))


@pytest.mark.parametrize(("rate", "cutoff"), [(10.0, 4.0), (30.0, 12.0), (50.0, 20.0), (1000.0, 20.0)])
def test_the_velocity_estimate_follows_the_sample_rate(rate: float, cutoff: float) -> None:
    log = wave(20.0, rate)
    recording = Recording("a.csv", log.time, {"qpos": log.qpos, "ctrl": log.ctrl})
    (cleaned,) = clean(recording, Cleaning())
    assert f"at {cutoff:g} Hz" in " ".join(cleaned.repairs)
    inner = slice(20, -20)
    expected = 2 * np.pi * np.cos(2 * np.pi * log.time)[inner]
    assert np.abs(cleaned.qvel[inner, 0] - expected).max() < (1.0 if rate < 30 else 0.3)
    with pytest.raises(ConfigError, match=r"data\.clean\.cutoff"):
        clean(recording, Cleaning(cutoff=0.6 * rate))
