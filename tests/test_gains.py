"""Gains of a user's controller: stated, recorded, found by the recorded torque, or asked for; never those of conf/."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Finished
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from frictionzoo.bench.gains import find_gains
from frictionzoo.bench.given import Given
from frictionzoo.core.config import compose_config
from frictionzoo.core.errors import ConfigError, MissingValueError
from frictionzoo.core.log import Dataset, Log

MISSING = {"actuator": {"params": {"kp": {"init": None}, "kd": {"init": None}}}}
TIME = np.arange(600) * 0.005


def move(joints: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Commands with positions and velocities that follow them late and smaller."""
    rng = np.random.default_rng(seed)
    rates = np.array([[0.4], [1.3], [2.9]]) * rng.uniform(0.9, 1.1, (3, joints))
    angle = 2 * np.pi * rates * TIME[:, None, None] + rng.uniform(0, 6, (3, joints))
    ctrl = np.sin(angle).sum(axis=1)
    follows, lags = np.array([[0.95], [0.8], [0.5]]), np.array([[0.1], [0.3], [0.9]])
    qpos = (follows * np.sin(angle - lags)).sum(axis=1)
    return ctrl, qpos, (follows * 2 * np.pi * rates * np.cos(angle - lags)).sum(axis=1)


def log_of(ctrl: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, **extras: Any) -> Dataset:
    log = Log("a", TIME, qpos, qvel, ctrl, "0" * 64, None, extras=extras)
    return Dataset("a", (log,), (log,))


def find(dataset: Dataset) -> dict[str, Any]:
    return find_gains(MISSING, dataset, MissingValueError("kp.init: null"))


@settings(max_examples=12, deadline=None)
@given(
    st.integers(1, 3),
    st.floats(0.5, 300),
    st.floats(0.01, 0.2),
    st.integers(0, 12),
    st.sampled_from(["columns", "torque"]),
    st.integers(0, 1000),
)
def test_gains_are_those_of_the_recordings(joints, kp, share, late, source, seed):
    ctrl, qpos, qvel = move(joints, seed)
    kps, kds = kp * (1 + np.arange(joints)), share * kp * (1 + np.arange(joints))
    if source == "columns":
        extras = {"kp": np.tile(kps, (600, 1)), "kd": np.tile(kds, (600, 1))}
    else:
        held = ctrl[np.maximum(np.arange(600) - late, 0)]
        torque = kps * (held - qpos) - kds * qvel
        noise = np.random.default_rng(seed).normal(size=torque.shape)
        extras = {"torque": torque + 0.3 + 0.02 * torque.std(axis=0) * noise}
    found = find(log_of(ctrl, qpos, qvel, **extras))
    assert list(found) == ["kp", "kd"]
    for values, truth in zip(found.values(), (kps, kds), strict=True):
        np.testing.assert_allclose(np.atleast_1d(values), truth, rtol=0.05)


@settings(max_examples=15, deadline=None)
@given(
    st.sampled_from(["nothing", "noise", "current with dry friction", "saturated", "one of two"]), st.integers(0, 99)
)
def test_recordings_that_do_not_tell_gains_are_refused(what: str, seed: int) -> None:
    ctrl, qpos, qvel = move(1, seed)
    torque = 20 * (ctrl - qpos) - qvel
    extras: dict[str, Any] = {
        "nothing": {},
        "noise": {"torque": np.random.default_rng(seed).normal(size=qpos.shape)},
        "current with dry friction": {"torque": 5 * np.sign(np.sin(50 * TIME))[:, None] * torque.std() + torque},
        "saturated": {"torque": np.sign(torque)},
        "one of two": {"kp": np.full_like(qpos, 20.0)},
    }[what]
    with pytest.raises(ConfigError, match=r"bench\.actuator\.params\.k[pd]\.init=") as refused:
        find(log_of(ctrl, qpos, qvel, **extras))
    assert "\n" not in str(refused.value)


def test_a_gain_that_is_identified_needs_no_value(recording: Path, compose: Callable[..., Any]) -> None:
    options = ["bench.actuator.params.kp.identify=true", "bench.actuator.params.kd.init=0.1"]
    config = compose("data=files", f"data.train=[{recording}]", *options)
    read = Given.read(OmegaConf.to_container(config, resolve=True))
    assert read.settings["bench"]["actuator"]["params"]["kp"]["init"] == 1.0


def test_gains_that_vary_name_the_law_that_takes_them(recording: Path, compose: Callable[..., Any]) -> None:
    ctrl, qpos, qvel = move(1, 0)
    with pytest.raises(ConfigError, match="RecordedPD") as refused:
        find(log_of(ctrl, qpos, qvel, kp=5 + TIME[:, None], kd=np.ones_like(qpos)))
    options = str(refused.value).rpartition("recorded gains: ")[2].split()
    compose("data=files", f"data.train=[{recording}]", *options)


def test_a_log_without_gains_is_refused_before_the_work(call: Callable[..., Finished], recording: Path) -> None:
    finished = call("data=files", f"data.train=[{recording}]")
    assert finished.status == 2
    (line,) = [line for line in finished.err.splitlines() if line.startswith("frictionzoo: ")]
    assert "bench.actuator.params.kp.init=" in line and "bench.actuator.params.kd.init=" in line
    assert "loading torch" not in finished.err and not [*Path().rglob("result.json")]


def test_a_recorded_torque_stands_for_the_gains(recording, tmp_path, caplog):
    columns = np.loadtxt(recording, delimiter=",", skiprows=1)
    torque = 20 * (columns[:, 3] - columns[:, 1]) - columns[:, 2]
    header = "time,qpos,qvel,ctrl,torque"
    np.savetxt(tmp_path / "a.csv", np.column_stack([columns, torque]), delimiter=",", header=header, comments="")
    config = compose_config("data=files", f"data.train=[{tmp_path / 'a.csv'}]", "data.split.gap=0.05")
    options: Any = OmegaConf.to_container(config, resolve=True)
    with caplog.at_level(logging.INFO):
        given = Given.read(options)
    params = given.bench.initial_values()
    assert params["kp"][0] == pytest.approx(20, rel=1e-3) and params["kd"][0] == pytest.approx(1, rel=1e-3)
    assert given.settings["bench"]["actuator"]["params"]["kp"]["init"] == params["kp"][0]
    assert sum("from the recorded torque" in line for line in caplog.messages) == 2
