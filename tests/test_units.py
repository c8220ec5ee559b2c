"""Units that recordings show: raw registers, turns, radians and degrees, and angles that wrap."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.write_logs import write_csv

from frictionzoo.core.errors import ConfigError
from frictionzoo.data.clean import Cleaning, clean
from frictionzoo.data.files import Files
from frictionzoo.data.propose import propose
from frictionzoo.data.recording import Recording, Table
from frictionzoo.data.registers import SERIES, UNDETECTED, Registers, read_registers
from frictionzoo.data.signals import find_wrap, unwrap
from frictionzoo.diagnostics.survey import survey_recordings

TIME = np.arange(1500) / 100
QPOS = 0.9 * np.sin(2.1 * TIME) + 0.2 * np.sin(5 * TIME)
QVEL = 1.89 * np.cos(2.1 * TIME) + np.cos(5 * TIME)
CTRL = 1.03 * np.roll(QPOS, -2)

TWOS = {"present_position": 32, "present_velocity": 32, "goal_position": 32}
SIGNED = dict.fromkeys(TWOS)
SIGN_BIT = {"present_position": -15, "present_speed": -15, "goal_position": -15}


def encode(values: np.ndarray, coding: int | None) -> np.ndarray:
    """Write whole numbers as a servo does: two's complement in so many bits, or with a sign bit (negative number)."""
    values = np.round(values)
    if coding is None:
        return values
    return np.where(values < 0, 2.0**coding + values if coding > 0 else 2.0**-coding - values, values)


def registers(series: str, codings: dict[str, int | None], qpos: np.ndarray = QPOS) -> dict[str, np.ndarray]:
    kind, (position, velocity, command) = SERIES[series], codings
    offset = qpos - QPOS
    ticks = {
        position: qpos / kind.units("position") + kind.zero,
        velocity: QVEL / kind.units("velocity"),
        command: (CTRL + offset) / kind.units("position") + kind.zero,
    }
    return {"timestamp": TIME} | {header: encode(ticks[header], coding) for header, coding in codings.items()}


def table(columns: dict[str, np.ndarray]) -> Table:
    return Table("a.csv", columns, sha256="0" * 64)


def read(folder: Path, samples: dict[str, np.ndarray], **options: Any) -> Recording:
    write_csv(folder / "a.csv", samples)
    return Files(train=[str(folder / "a.csv")], **options).recordings()[0]


RAW = [
    ("dynamixel_x", SIGNED),
    ("dynamixel_x", TWOS),
    ("dynamixel_x", {"q": None, "dq": 16, "u_pos": None}),
    ("feetech_sts", SIGN_BIT),
    ("feetech_scs", {"present_position": None, "present_speed": -15, "goal_position": None}),
]


@pytest.mark.parametrize(("series", "codings"), RAW)
@pytest.mark.parametrize("stated", [True, False])
def test_raw_registers_are_read_in_radians(tmp_path, series, codings, stated):
    columns = {signal: [header] for signal, header in zip(("qpos", "qvel", "ctrl"), codings, strict=True)}
    options: dict[str, Any] = {"registers": series, "columns": columns} if stated else {}
    recording, kind = read(tmp_path, registers(series, codings), **options), SERIES[series]
    for signal, truth in (("qpos", QPOS), ("qvel", QVEL), ("ctrl", CTRL)):
        step = kind.units("velocity" if signal == "qvel" else "position")
        np.testing.assert_allclose(recording.signals[signal][:, 0], truth, atol=0.51 * step, err_msg=signal)


def test_the_makers_numbers():
    dynamixel, sts, scs = (SERIES[name] for name in ("dynamixel_x", "feetech_sts", "feetech_scs"))
    assert dynamixel.units("position") == sts.units("position") == pytest.approx(math.radians(0.087890625))
    assert dynamixel.units("velocity") == pytest.approx(0.229 * 2 * math.pi / 60)
    assert 50 * sts.units("velocity") == pytest.approx(0.732 * 2 * math.pi / 60, rel=1e-3)
    assert 1024 * scs.units("position") == pytest.approx(math.radians(300))
    assert dynamixel.decode(np.array([2048, 4095, 2**32 - 1]), "position").tolist() == [0, 2047, -2049]
    assert sts.decode(np.array([0, 1542, 700]), "effort").tolist() == [0, -518, 700]


def test_turns_of_a_multi_turn_register_below_its_zero(tmp_path):
    recording = read(tmp_path, registers("dynamixel_x", TWOS, QPOS - 4 * math.pi), registers="dynamixel_x")
    np.testing.assert_allclose(recording.signals["qpos"][:, 0], QPOS - 4 * math.pi, atol=1e-3)


def test_own_registers_and_a_unit_that_a_user_states(tmp_path):
    columns = {"t": TIME, "q": np.round(QPOS * 16384 / math.tau) + 5000, "u": np.round(CTRL * 16384 / math.tau) + 5000}
    own = read(tmp_path, columns, registers={"turn": 16384, "zero": 5000}).signals
    np.testing.assert_allclose(own["qpos"][:, 0], QPOS, atol=2e-4)
    np.testing.assert_allclose(own["ctrl"][:, 0], CTRL, atol=2e-4)
    # A stated unit selects the series with its zero; no series has another unit.
    raw = registers("dynamixel_x", SIGNED)
    rounded = read(tmp_path, raw, units={"qpos": "0.00153398", "ctrl": "0.00153398", "qvel": "0.0239809"})
    np.testing.assert_allclose(rounded.signals["qpos"][:, 0], QPOS, atol=1e-3)
    for options in ({"registers": UNDETECTED}, {"units": {"qpos": "mrad"}}):
        assert read(tmp_path, raw, **options).signals["qpos"].min() > 0.5


@pytest.mark.parametrize(
    ("position", "velocity"),
    [("position", "velocity"), ("q", "dq")],
)
def test_whole_numbers_in_another_unit_are_no_registers(position, velocity):
    tenths = {"time": TIME, position: np.round(900 + 572.96 * QPOS), velocity: np.round(572.96 * QVEL)}
    assert propose(table(tenths)).registers is None


@pytest.mark.parametrize(
    ("given", "option"),
    [
        ("dynamixl_x", r"data\.registers=dynamixl_x: .*dynamixel_x"),
        ({"zero": 3}, r"data\.registers\.turn=None"),
        ({"turn": -4096}, r"data\.registers\.turn=-4096"),
        ({"turn": 4096, "velocity": "fast"}, r"data\.registers\.velocity=fast"),
        ({"turn": 4096, "turns": 1}, r"data\.registers\.turns.*turn"),
        ({"turn": 4096, "signs": {"velocity": 40}}, r"data\.registers\.signs\.velocity=40"),
        ({"turn": 4096, "signs": 15}, r"data\.registers\.signs"),
    ],
)
def test_impossible_registers(given, option):
    with pytest.raises(ConfigError, match=option):
        read_registers(given)
    assert isinstance(read_registers({"turn": 4096, "zero": 2048, "signs": {"velocity": 15}}), Registers)


IN_TURNS = {
    "moteus": (("time", "mode", "position", "velocity", "q_current", "fault", "cmd_position"), "rev"),
    "odrive": (("time", "axis0.pos_estimate", "axis0.vel_estimate", "axis0.pos_setpoint"), "rev"),
    "odrive-velocity": (("time", "pos_estimate", "vel_estimate", "vel_setpoint"), "rev/s"),
    "odrive-current": (("time", "pos_estimate", "vel_estimate", "Iq_setpoint"), None),
}


@pytest.mark.parametrize(("headers", "command"), IN_TURNS.values(), ids=IN_TURNS)
def test_drives_that_log_turns(headers, command):
    values = {"time": TIME, "pos": QPOS / math.tau, "vel": QVEL / math.tau}
    columns = {header: values.get(next((n for n in values if n in header), ""), np.sin(TIME)) for header in headers}
    proposal = propose(table(columns))
    assert proposal.units == {"qpos": "rev", "qvel": "rev/s"} | ({"ctrl": command} if command else {})


@pytest.mark.parametrize("seed", range(4))
def test_a_wheel_that_turns_on_is_in_radians(seed):
    rng = np.random.default_rng(seed)
    speed = rng.uniform(5, 200) * (1.1 + np.sin(rng.uniform(0.3, 2) * TIME))
    position = np.cumsum(speed) * 0.01
    columns = {"time": TIME, "position": position, "velocity": speed, "velocity_command": 1.01 * speed}
    assert not propose(table(columns)).units
    signals = {"qpos": position[:, None], "qvel": speed[:, None], "ctrl": speed[:, None]}
    found = survey_recordings("a", [Recording("a", TIME, signals)])["findings"]
    assert not [finding for finding in found if finding["option"] == "data.units.qpos=deg"]


@pytest.mark.parametrize("velocity", [True, False])
def test_a_joint_in_degrees_is_not_in_radians(velocity):
    columns = {"time": TIME, "position": np.degrees(1.5 * QPOS), "goal": np.degrees(1.5 * CTRL)}
    columns |= {"velocity": np.degrees(1.5 * QVEL)} if velocity else {}
    units = propose(table(columns)).units
    assert units == {"qpos": "deg", "ctrl": "deg"} | ({"qvel": "deg/s"} if velocity else {})
    signals = {"qpos": columns["position"][:, None], "ctrl": np.zeros((1500, 1))}
    raw = Recording("a", TIME, signals)
    options = [finding["option"] for finding in survey_recordings("a", [raw])["findings"]]
    assert "data.units.qpos=deg" in options
    stated = Recording("a", TIME, signals, units={"qpos": "rad"})
    assert "data.units.qpos=deg" not in [row["option"] for row in survey_recordings("a", [stated])["findings"]]


def test_angles_do_not_belong_to_velocities_of_lengths():
    ticks = {"time": TIME, "q": 651.9 * QPOS + 0.1, "dq": 41.7 * QVEL}
    assert "mm" not in propose(table(ticks)).units.values()


PERIODS = {
    "turn": (math.tau, None),
    "deg": (360.0, "deg"),
    "rev": (1.0, "rev"),
    "ticks": (4096.0, repr(math.tau / 4096)),
}


@pytest.mark.parametrize(("period", "unit"), PERIODS.values(), ids=PERIODS)
@pytest.mark.parametrize("low", [0.0, -0.5])
def test_an_angle_that_wraps_shows_its_unit(period, unit, low):
    angle = period * (1.7 * np.sin(0.8 * TIME) + 0.02 * np.sin(9 * TIME))
    wrapped = np.mod(angle - low * period, period) + low * period
    assert find_wrap(wrapped) == period and find_wrap(angle) is None
    np.testing.assert_allclose(np.diff(unwrap(wrapped, period)), np.diff(angle), atol=1e-9 * period)
    rate = np.gradient(angle, TIME)
    units = propose(table({"time": TIME, "q": wrapped, "dq": rate, "u": wrapped})).units
    assert units.get("qpos") == unit and "mm" not in units.values()


@pytest.mark.parametrize("period", [math.tau, math.tau / 6, 25.0])
def test_any_wrap_is_found_and_mended_with_its_command(period):
    rng = np.random.default_rng(3)
    angle = 0.9 * period * np.sin(1.3 * TIME) + 0.4 * period
    command = angle + 0.02 * period * np.cos(1.3 * TIME)
    still = 0.1 * period * np.sin(TIME)
    wrapped = [np.stack([np.mod(one, period), still], axis=1) for one in (angle, command)]
    wrapped[0][rng.integers(0, 1500, 5), 0] = np.nan
    recording = Recording("a", TIME, dict(zip(("qpos", "ctrl"), wrapped, strict=True)))
    (log,) = clean(recording, Cleaning(wrap="auto"))
    offset = period * np.round((log.qpos[0, 0] - angle[0]) / period)
    np.testing.assert_allclose(log.qpos[:, 0], angle + offset, atol=0.01 * period)
    np.testing.assert_allclose(log.ctrl[:, 0], command + offset, atol=1e-4 * period)
    np.testing.assert_array_equal(log.qpos[:, 1], still)
    assert any("turns of the position unwrapped" in repair and f"{period:.6g}" in repair for repair in log.repairs)
    still = replace(recording, signals={**recording.signals, "ctrl": np.zeros((1500, 2))})
    found = {row["title"]: row for row in survey_recordings("a", [still])["findings"]}
    assert found["Wrap, joint 1"]["option"] == "data.clean.wrap=auto" and "Wrap, joint 2" not in found


def test_steps_spikes_and_noise_do_not_wrap():
    spiked, rng = QPOS.copy(), np.random.default_rng(0)
    spiked[[300, 700]] += math.tau
    for signal in (
        QPOS,
        spiked,
        np.sign(np.sin(TIME)),
        rng.normal(size=1500),
        np.where(TIME < 5, 0.0, 1.0) + QPOS / 50,
    ):
        assert find_wrap(signal) is None
    log = clean(Recording("a", TIME, {"qpos": QPOS[:, None], "ctrl": CTRL[:, None]}), Cleaning(wrap="auto"))[0]
    np.testing.assert_array_equal(log.qpos[:, 0], QPOS)
