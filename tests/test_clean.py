"""Cleaning: what is clean passes untouched, every fault is repaired as asked, and every change is told."""

import re
from dataclasses import replace

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from frictionzoo.core.errors import ConfigError, LogError
from frictionzoo.data.clean import Cleaning, clean, summarise_repairs
from frictionzoo.data.recording import Recording
from frictionzoo.identification.noise import Noise

OPTIONS = dict(resample="linear", gap=5.0, spikes="repair", velocity="auto", cutoff=10.0, order=2, shortest=0.0)


def cleaning(**options):
    return Cleaning(**OPTIONS | options)


def record(time, name="a.csv", **signals):
    """A swing of 1 rad at 1 Hz with a stepwise command, or what `signals` say."""
    time = np.asarray(time, float)
    usual = {"qpos": np.sin(2 * np.pi * time), "qvel": 2 * np.pi * np.cos(2 * np.pi * time), "ctrl": np.floor(5 * time)}
    signals = {name: np.asarray(values, float) for name, values in (usual | signals).items() if values is not None}
    columns = {name: values.reshape(len(time), -1) for name, values in signals.items()}
    return Recording(name, time, columns, {"kp": 8}, "0" * 64, False)


def uniform(samples=500, step=0.01):
    return step * np.arange(samples)


def jittered(samples=500, step=0.01, share=0.3):
    time = uniform(samples, step)
    time[1:] += share * step * np.random.default_rng(0).uniform(-0.5, 0.5, samples - 1)
    return time


def test_a_clean_recording_passes_bit_for_bit():
    recording = record(uniform(2000, 0.001), supply=np.full(2000, 12.0))
    for options in ({}, {"step": 0.001}, {"spikes": "keep", "velocity": "measured"}):
        (log,) = clean(recording, cleaning(**options))
        assert log.repairs == () and log.name == "a.csv" and log.sha256 == recording.sha256
        assert log.time is recording.time and log.extras["supply"] is recording.signals["supply"]
        assert all(getattr(log, signal) is recording.signals[signal] for signal in ("qpos", "qvel", "ctrl"))
        assert log.metadata == {"kp": 8}


def test_jitter_is_taken_out():
    time = jittered()
    (log,) = clean(record(time), cleaning(resample="cubic"))
    np.testing.assert_allclose(np.diff(log.time), np.median(np.diff(time)), rtol=1e-9)
    assert log.time[0] == 0
    # The swing's fourth derivative, (2 pi)^4, times the step to the fourth, is the error's scale.
    np.testing.assert_allclose(log.qpos[:, 0], np.sin(2 * np.pi * log.time), atol=2e-5)
    assert any(sentence.startswith("resampled from about 100") and "cubic" in sentence for sentence in log.repairs)


def test_a_step_resamples_and_averages_the_held_command():
    (log,) = clean(record(uniform(500, 0.01)), cleaning(step=0.004))
    assert log.timestep == pytest.approx(0.004, rel=1e-12) and log.samples == 1248
    # Straight lines between samples of 10 ms miss the swing by at most its second derivative times h^2 / 8.
    np.testing.assert_allclose(log.qpos[:, 0], np.sin(2 * np.pi * log.time), atol=(2 * np.pi * 0.01) ** 2 / 8)
    # An interval of 4 ms lies within one of 10 ms, or has 2 ms in one and 2 ms in the next.
    command = np.floor(5 * uniform())
    first, last = (np.floor((log.time + late) / 0.01 + 1e-6).astype(int) for late in (0.0, 0.0039))
    np.testing.assert_allclose(log.ctrl[:, 0], (command[first] + command[last]) / 2, atol=1e-12)


def test_repeated_samples_are_dropped_and_missing_ones_interpolated():
    kept = np.delete(np.arange(500), [50, 51, 300])
    time = np.insert(uniform()[kept], 10, uniform()[9])
    (log,) = clean(record(time), cleaning())
    assert log.samples == 500
    np.testing.assert_allclose(log.qpos[:, 0], np.sin(2 * np.pi * uniform()), atol=5e-3)
    assert "samples with a repeated time dropped: 1" in log.repairs
    assert any("missing samples interpolated: 3" in sentence for sentence in log.repairs)


def test_gaps_and_resets_split():
    time = np.concatenate([uniform(200), uniform(200) + 3.0, uniform(100)])
    logs = clean(record(time), cleaning())
    assert [(log.name, log.samples) for log in logs] == [("a.csv[1]", 200), ("a.csv[2]", 200), ("a.csv[3]", 100)]
    assert all(log.time[0] == 0 and any("split" in sentence for sentence in log.repairs) for log in logs)


def test_short_pieces_are_left_out_and_counted():
    time = np.concatenate([uniform(200), uniform(50) + 3.0])
    (log,) = clean(record(time), cleaning(shortest=1.0))
    assert log.samples == 200 and "pieces shorter than 1 s left out: 1" in log.repairs
    assert clean(record(time), cleaning(shortest=10.0)) == []


@pytest.mark.parametrize(("run", "pieces"), [(3, 1), (20, 2)])
def test_nan_is_interpolated_or_splits(run, pieces):
    position, command = np.sin(2 * np.pi * uniform()), np.ones(500)
    position[100 : 100 + run] = np.nan
    logs = clean(record(uniform(), qpos=position), cleaning())
    assert [log.samples for log in logs] == ([500] if pieces == 1 else [100, 500 - 100 - run])
    if pieces == 1:
        np.testing.assert_allclose(logs[0].qpos[:, 0], np.sin(2 * np.pi * uniform()), atol=5e-3)
        assert logs[0].repairs == (f"NaN samples of qpos interpolated: {run}",)
    command[:2] = command[-1] = np.nan
    (log,) = clean(record(uniform(), ctrl=command), cleaning())
    assert log.samples == 497 and np.isfinite(log.ctrl).all()


def test_an_angle_goes_on_over_its_turns():
    position = np.linspace(-9, 7, 500)
    (log,) = clean(record(uniform(), qpos=(position + np.pi) % (2 * np.pi) - np.pi), cleaning(wrap=2 * np.pi))
    np.testing.assert_allclose(log.qpos[:, 0] - log.qpos[0, 0], position - position[0], atol=1e-12)
    assert "turns of the position unwrapped: 2" in log.repairs


def test_an_outlier_of_a_held_command_is_what_was_held_before():
    command = np.floor(5 * uniform())
    command[[200, 201, 300]] = [900.0, 900.0, -1e6]
    (log,) = clean(record(uniform(), ctrl=command), cleaning())
    assert log.ctrl[199, 0] == log.ctrl[200, 0] == log.ctrl[201, 0] and log.ctrl[300, 0] == log.ctrl[299, 0]
    assert "outliers of ctrl replaced by the previous value: 3" in log.repairs


@pytest.mark.parametrize("width", [1, 2])
def test_spikes_are_repaired_dropped_or_kept(width):
    position = np.sin(2 * np.pi * uniform())
    position[100 : 100 + width] -= 2.0
    recording = record(uniform(), qpos=position)
    (log,) = clean(recording, cleaning())
    np.testing.assert_allclose(log.qpos[:, 0], np.sin(2 * np.pi * uniform()), atol=5e-3)
    assert log.repairs == ("spikes of qpos interpolated: 1",)
    assert clean(recording, cleaning(spikes="drop")) == []
    (kept,) = clean(recording, cleaning(spikes="keep"))
    assert kept.qpos is recording.signals["qpos"]


def test_velocity_is_estimated_where_asked_for_or_missing():
    recording = record(uniform())
    for candidate, options in ((recording, {"velocity": "estimated"}), (record(uniform(), qvel=None), {})):
        (log,) = clean(candidate, cleaning(**options))
        inner = slice(50, -50)  # the filter has transients at the ends
        expected = recording.signals["qvel"][inner]
        # A second-order filter run twice at 10 Hz takes (1 / 10)^4 off the gain at 1 Hz, differences (w h)^2 / 6.
        np.testing.assert_allclose(log.qvel[inner], expected, atol=2e-3 * 2 * np.pi)
        assert any("zero-phase" in sentence for sentence in log.repairs)


@pytest.mark.parametrize("option", [0.02, "auto"])
def test_the_lag_of_a_velocity_is_taken_out(option):
    time = jittered()
    phase = 2 * np.pi * time + np.sin(3 * time)
    late = 2 * np.pi * (time - 0.02) + np.sin(3 * (time - 0.02))
    rate = 2 * np.pi + 3 * np.cos(3 * (time - 0.02))
    recording = record(time, qpos=np.sin(phase), qvel=rate * np.cos(late))
    (log,) = clean(recording, cleaning(velocity_lag=option, resample="cubic"))
    at = log.time + time[0]
    truth = (2 * np.pi + 3 * np.cos(3 * at)) * np.cos(2 * np.pi * at + np.sin(3 * at))
    # 1 ms of lag is left at most: times the largest acceleration, some 90 rad/s^2.
    np.testing.assert_allclose(log.qvel[:, 0], truth, atol=0.09)
    assert log.time[-1] <= time[-1] - 0.018
    assert any(sentence.startswith("qvel shifted 0.0") for sentence in log.repairs)


def test_enable_is_held_and_supply_interpolated():
    time = uniform(400)
    on, volts = (time < 2).astype(float), 12 - time
    (log,) = clean(record(time, enable=on, supply=volts), cleaning(step=0.004))
    assert set(np.unique(log.extras["enable"])) == {0.0, 1.0}
    np.testing.assert_allclose(log.extras["supply"][:, 0], 12 - log.time, atol=1e-9)


def test_repairs_of_many_logs_are_summed_up_with_notes_of_the_reader():
    late = [replace(record(uniform() + start), notes=("ctrl held from 40 samples",)) for start in (1.0, 2.0)]
    logs = [log for recording in late for log in clean(recording, cleaning())]
    assert logs[1].repairs == ("ctrl held from 40 samples", "time counted from its first sample, at 2 s")
    assert summarise_repairs(logs) == [f"2 of 2 logs: {sentence}" for sentence in logs[0].repairs]
    late_joints = replace(logs[0], repairs=("qvel of joint 1 lags by 18 ms", "qvel of joint 2 lags by 19 ms"))
    assert summarise_repairs([late_joints, logs[0]])[0] == "1 of 2 logs: qvel of joint 1 lags by 18 ms"


@pytest.mark.parametrize(
    ("option", "value"),
    [
        *(("step", -1.0), ("resample", "spline"), ("gap", 1.0), ("spikes", "fix"), ("velocity", "measure")),
        *(("cutoff", 0.0), ("wrap", 0.0), ("order", 0), ("velocity_lag", "automatic"), ("velocity_lag", np.nan)),
        *(("command_lag", np.nan), ("shortest", -1.0)),
    ],
)
def test_an_impossible_option_is_refused_in_one_line(option, value):
    with pytest.raises(ConfigError, match=rf"^data\.clean\.{option}={value}.*(expected|did you mean)") as caught:
        cleaning(**{option: value})
    assert "\n" not in str(caught.value)


NOISE = np.random.default_rng(0).normal(size=500)


@pytest.mark.parametrize(
    ("change", "options", "kind", "message"),
    [
        ({}, {"velocity": "estimated", "cutoff": 60.0}, ConfigError, r"data\.clean\.cutoff=60"),
        ({"qpos": None}, {}, LogError, r"data\.columns\.qpos"),
        ({"ctrl": None}, {}, LogError, r"data\.columns\.ctrl"),
        ({"qvel": None}, {"velocity": "measured"}, LogError, r"qvel.*data\.clean\.velocity=estimated"),
        ({"qvel": NOISE}, {"velocity_lag": "auto"}, LogError, r"data\.clean\.velocity_lag=auto"),
        ({"time": np.where(uniform() == 1.0, np.nan, uniform())}, {}, LogError, "time is NaN .* sample 100"),
        ({"time": np.zeros(500)}, {}, LogError, "at one time"),
    ],
)
def test_what_cannot_be_cleaned_is_refused(change, options, kind, message):
    recording = record(uniform(), **{signal: values for signal, values in change.items() if signal != "time"})
    with pytest.raises(kind, match=message):
        clean(replace(recording, time=change.get("time", recording.time)), cleaning(**options))


@pytest.mark.parametrize("factor", [180 / np.pi, np.pi / 180], ids=["velocity", "position"])
def test_a_wrong_unit_is_refused(factor):
    time = uniform(500, 0.01)
    recording = record(time, qpos=np.sin(5 * time), qvel=factor * 5 * np.cos(5 * time))
    with pytest.raises(LogError, match=rf"qvel is {str(factor)[:2]}[\d.]* times .*data\.units"):
        clean(recording, cleaning())
    (log,) = clean(recording, cleaning(velocity="measured"))
    np.testing.assert_array_equal(log.qvel, recording.signals["qvel"])


def test_spikes_do_not_hide_a_velocity_of_another_unit():
    spiked = np.sin(2 * np.pi * uniform())
    spiked[100:400:100] -= 50.0
    slow = 0.005 * 2 * np.pi * np.cos(2 * np.pi * uniform())
    with pytest.raises(LogError, match=r"qvel is 0\.005\d* times .*data\.units"):
        clean(record(uniform(), qpos=spiked, qvel=slow), cleaning())


def test_swapped_columns_are_noted():
    time = uniform(500, 0.01)
    qpos, qvel = np.sin(2 * time) + 0.3 * np.sin(5 * time), 2 * np.cos(2 * time) + 1.5 * np.cos(5 * time)
    assert not clean(record(time, qpos=qpos, qvel=qvel), cleaning())[0].repairs
    (log,) = clean(record(time, qpos=qvel, qvel=qpos), cleaning())
    assert any("swapped columns" in sentence for sentence in log.repairs)


def test_commands_that_were_recorded_late_are_moved_and_the_rest_stays() -> None:
    time = 0.01 * np.arange(300)
    told = np.sign(np.sin(3 * time))
    recording = record(time, qpos=np.sin(time), ctrl=np.concatenate([np.repeat(told[:1], 7), told[:-7]]))
    (log,) = clean(recording, cleaning(command_lag=0.07))
    np.testing.assert_array_equal(log.ctrl[:, 0], told[: log.samples])
    np.testing.assert_array_equal(log.qpos[:, 0], np.sin(time)[: log.samples])
    assert log.samples == 293 and "ctrl shifted 0.07 s earlier" in log.repairs


JOINTS = 3
FAULTS = {
    "sound": lambda velocity, rng: velocity,
    "zero": lambda velocity, rng: np.zeros_like(velocity),
    "constant": lambda velocity, rng: np.full_like(velocity, 3.3),
    "missing": lambda velocity, rng: np.full_like(velocity, np.nan),
    "infinite": lambda velocity, rng: np.full_like(velocity, np.inf),
    "rarely there": lambda velocity, rng: np.where(rng.random(len(velocity)) < 0.1, velocity, np.nan),
    "jitter": lambda velocity, rng: rng.normal(0.0, 1e-5, len(velocity)),
    "one glitch": lambda velocity, rng: np.where(np.arange(len(velocity)) == 7, 1.0, 0.0),
}


def record_joints(faults, jitter=0.0):
    """Swings of joints at frequencies of their own, their velocities with these faults."""
    time, rng = jittered(1500, 0.002, jitter), np.random.default_rng(0)
    phases = 2 * np.pi * time[:, None] * (0.7 + 0.3 * np.arange(len(faults)))
    truth = np.gradient(np.sin(phases), time, axis=0) + rng.normal(0.0, 1e-3, phases.shape)
    qvel = np.stack([FAULTS[fault](column, rng) for fault, column in zip(faults, truth.T, strict=True)], axis=1)
    return record(time, qpos=np.sin(phases), qvel=qvel, ctrl=np.sin(phases)), truth


@settings(deadline=None, max_examples=25, derandomize=True)
@given(
    st.lists(st.sampled_from(list(FAULTS)), min_size=1, max_size=JOINTS),
    st.sampled_from([None, "auto", 0.0]),
    st.sampled_from([0.0, 0.3]),
)
def test_a_velocity_that_shows_no_motion_is_estimated_joint_by_joint(faults, lag, jitter):
    recording, truth = record_joints(faults, jitter)
    (log,) = clean(recording, cleaning(spikes="keep", velocity_lag=lag))
    dead = tuple(joint for joint, fault in enumerate(faults) if fault != "sound")
    assert log.without_velocity == dead and log.velocity_estimated == (len(dead) == len(faults))
    told = "; ".join(line for line in log.repairs if re.match("qvel.* (is|varies)", line))
    assert len(re.findall("qvel", told)) == len(dead)
    assert len(faults) == 1 or re.findall(r"joint (\d)", told) == [str(joint + 1) for joint in dead]
    expected = np.stack([np.interp(log.time, recording.time, column) for column in truth.T], axis=1)
    np.testing.assert_allclose(log.qvel[100:-100], expected[100:-100], atol=0.15)
    if not lag and not jitter:
        measured = [joint for joint, fault in enumerate(faults) if fault == "sound"]
        np.testing.assert_array_equal(log.qvel[:, measured], truth[: log.samples, measured])
    noise = Noise.of([log])
    assert 0 < noise.velocity_weight < 1e3 and (noise.velocity is None) == log.velocity_estimated


@settings(deadline=None, max_examples=25, derandomize=True)
@given(
    st.sampled_from([0.0, 1e-4, 1e-3]), st.sampled_from([0.0, 1e-3, 0.03, 0.3]), st.integers(0, 15), st.integers(0, 9)
)
def test_a_velocity_is_kept_where_it_is_more_accurate_than_the_estimate(rounding, noise, lag, seed):
    time, rng = uniform(4000, 0.001), np.random.default_rng(seed)
    frequencies = rng.uniform(1.0, 20.0, 5)  # rad/s
    truth = np.cos(time[:, None] * frequencies) @ np.ones(5)
    position = np.sin(time[:, None] * frequencies) @ (1 / frequencies)
    position = np.round(position / rounding) * rounding if rounding else position
    late = np.concatenate([np.full(lag, truth[0]), truth[: len(truth) - lag]]) + rng.normal(0.0, noise, len(time))
    recording = record(time, qpos=position, qvel=late, ctrl=position)
    errors = {}
    for how in ("auto", "measured", "estimated"):
        (log,) = clean(recording, cleaning(spikes="keep", velocity=how, cutoff=20.0))
        errors[how] = float(np.sqrt(np.square(log.qvel[:, 0] - truth).mean()))
    assert errors["auto"] <= 1.5 * min(errors["measured"], errors["estimated"])
    if lag > 5 and not noise:
        (log,) = clean(recording, cleaning(spikes="keep", cutoff=20.0))
        assert f"qvel lags qpos by {lag} ms" in " ".join(log.repairs)


@pytest.mark.parametrize(("samples", "cutoff"), [(10, 10.0), (500, 60.0), (500, 1e-9)])
def test_a_measured_velocity_needs_no_estimate(samples, cutoff):
    recording = record(uniform(samples))
    (log,) = clean(recording, cleaning(cutoff=cutoff))
    assert log.qvel is recording.signals["qvel"]


@pytest.mark.parametrize("fault", [fault for fault in FAULTS if fault != "sound"])
def test_a_measured_velocity_that_shows_no_motion_is_refused(fault):
    recording, _ = record_joints(["sound", fault])
    with pytest.raises(LogError, match=r"qvel of joint 2 .*data\.clean\.velocity=auto"):
        clean(recording, cleaning(spikes="keep", velocity="measured"))


def test_a_velocity_that_is_not_used_costs_no_samples():
    recording, truth = record_joints(["missing", "rarely there"])
    (log,) = clean(recording, cleaning(spikes="keep", velocity="estimated"))
    assert log.samples == len(truth) and log.velocity_estimated


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_a_joint_that_stands_still_has_no_velocity(value):
    still = np.full(500, 0.2)
    (log,) = clean(record(uniform(), qpos=still, qvel=np.full(500, value)), cleaning(spikes="keep"))
    np.testing.assert_allclose(log.qvel, 0.0, atol=1e-9)
    assert np.isfinite(Noise.of([log]).velocity_weight)


@pytest.mark.parametrize(("rate", "step"), [(300, 0.002), (150, 0.005), (1000, 0.01)])
def test_rounded_times_of_an_even_clock_are_evened_out(rate, step):
    even = np.arange(600) / rate
    (log,) = clean(record(np.round(even / step) * step, qpos=np.sin(even), qvel=np.cos(even), ctrl=even), cleaning())
    assert any(said.startswith(f"times are rounded to {step:g} s") for said in log.repairs)
    assert log.timestep == pytest.approx(1 / rate, rel=1e-3) and log.samples == 600
    np.testing.assert_array_equal(log.qpos[:, 0], np.sin(even))


def test_times_that_are_uneven_or_missing_are_not_rounded_ones():
    for dropped in (np.arange(100, 103), np.arange(60, 300, 30)):
        (log,) = clean(record(np.delete(np.arange(400) * 0.01, dropped)), cleaning())
        assert not any("rounded" in said for said in log.repairs)
