"""Survey of recordings: known faults of made recordings are found, and those of real drives that others have found."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import DATA, needs_data
from helpers.recordings import make_recording, read_sts3215, read_xl330, simulate_servo

from frictionzoo.core.errors import LogError
from frictionzoo.data.delay import estimate_delay
from frictionzoo.data.signals import (
    count_spikes,
    find_breaks,
    find_lag,
    find_quantum,
    find_spikes,
    find_velocity_lag,
    repair_spikes,
)
from frictionzoo.diagnostics.survey import measure, measure_timing

ENCODER = 2 * np.pi / 4096  # rad


def swing(time, lag=0.0):
    """Position, and the velocity as a sensor has it that is so late; of two frequencies, so that no period repeats."""
    late = time - lag
    return np.sin(3 * time) + 0.5 * np.sin(11 * time), 3 * np.cos(3 * late) + 5.5 * np.cos(11 * late)


def test_faults_of_a_clock_are_counted():
    faults = ("jitter", "duplicates", "missing", "gaps", "resets")
    even = measure_timing(0.002 * np.arange(1000))
    assert even["interval"] == pytest.approx(0.002) and even["duration"] == pytest.approx(1.998)
    assert [even[name] for name in faults] == [0] * 5 and even["worst"] < 1e-9
    time = 0.01 * np.arange(1000)
    time[500:] += 1.0  # a gap
    time[700] += 0.001  # two uneven intervals
    time[900:] -= 5.0  # a reset
    time = np.delete(np.insert(time, 20, time[19]), [101, 102])  # repeated, missing
    timing = measure_timing(time)
    # Two uneven intervals and the one in which samples are missing, of the 995 that are neither gap, reset nor zero.
    assert [timing[name] for name in faults] == [pytest.approx(3 / 995), 1, 2, 1, 1]
    np.testing.assert_array_equal(find_breaks(time, 5.0), [499, 899])


@pytest.mark.parametrize("width", [1, 2])
def test_isolated_spikes_are_found_and_repaired(width):
    time = 0.01 * np.arange(600)
    position = np.round(np.sin(3 * time) / 0.0015) * 0.0015
    spiked = position.copy()
    spiked[100 : 100 + width] -= 0.5
    spiked[400 : 400 + width] += 0.2
    np.testing.assert_array_equal(find_spikes(spiked), [*range(100, 100 + width), *range(400, 400 + width)])
    assert count_spikes(spiked) == 2 and count_spikes(position) == 0
    # Straight lines over 2 or 3 intervals: the second derivative, 9 rad/s^2, times half of (10 ms)^2, and two quanta.
    np.testing.assert_allclose(repair_spikes(spiked), position, atol=9 * 0.01**2 + 0.003)


def test_steps_noise_flicker_rest_and_nan_are_no_spikes():
    steps, noise = np.sign(np.sin(np.arange(600) / 20)), np.random.default_rng(0).normal(size=600)
    flicker = np.repeat(np.arange(200) % 2, 3) * 0.0015
    for motion in (steps, noise, flicker, np.zeros(600), np.full(600, np.nan)):
        assert len(find_spikes(motion)) == 0


def test_the_quantum_of_an_encoder():
    smooth = np.sin(0.01 * np.arange(2000))
    for quantum in (ENCODER, 1e-5, 0.1):
        assert find_quantum(np.round(smooth / quantum) * quantum) == pytest.approx(quantum, rel=1e-6)
    assert find_quantum(smooth + 1e-3 * np.random.default_rng(0).normal(size=2000)) is None
    assert find_quantum(np.zeros(100)) is None


@pytest.mark.parametrize("lag", [-0.013, 0.0, 0.004, 0.0237])
def test_a_lag_is_found_to_a_fraction_of_a_sample(lag):
    time = 0.01 * np.arange(1000)
    reference, signal = swing(time)[1], 1.7 * swing(time, lag)[1]
    found, scale = find_lag(signal, reference, 0.01)
    # A parabola through the peak of the correlation is off by a few hundredths of a sample.
    assert found == pytest.approx(lag, abs=5e-4) and scale == pytest.approx(1.7, rel=0.02)


def test_the_lag_of_a_velocity_despite_jitter_gap_and_quantum():
    rng = np.random.default_rng(1)
    time = 0.01 * np.arange(900) + rng.uniform(0, 0.003, 900)
    time[700:] += 2.0
    position, velocity = swing(time, 0.02)
    lag, scale = find_velocity_lag(time, np.round(position / 0.0015) * 0.0015, velocity)
    # The estimate of the velocity takes a little off its 11 rad/s part.
    assert lag == pytest.approx(0.02, abs=1e-3) and scale == pytest.approx(1.0, abs=0.03)
    assert find_velocity_lag(time, position, rng.normal(size=900)) is None


def test_a_coarse_encoder_does_not_scale_a_velocity():
    """The noise that rounding puts into the derivative; other units are found all the same."""
    time = 0.002 * np.arange(10_000)
    position, velocity = swing(time)
    rounded = np.round(0.5 * position / 0.0245) * 0.0245  # of 8 bits a turn
    for unit, sure in ((1.0, 0.01), (1.5, 0.1)):
        lag, scale = find_velocity_lag(time, rounded, 0.5 * unit * velocity)
        assert lag == pytest.approx(0.0, abs=1e-3) and scale == pytest.approx(unit, rel=sure)


def test_excitation_and_supply():
    time = 0.01 * np.arange(2000)
    position = np.where(time < 10, np.sin(np.pi * time), 0.0)  # at rest for the second half
    command = np.clip(2 * position, -1, 1)
    recording = make_recording(time, qpos=position, ctrl=command, supply=np.full(2000, 12.0), enable=time < 15)
    found = measure(replace(recording, fields={"vin": 15.0}))
    (joint,), (ctrl,) = found["joints"], found["commands"]
    # The filter rings a little where the motion stops.
    assert joint["velocity"] == pytest.approx((-np.pi, np.pi), rel=0.02) and joint["velocity_lag"] is None
    assert joint["rest"] == pytest.approx(0.5, abs=0.02)
    # Half of it at rest, and |cos| < 0.05 for 3 % of the other half.
    assert joint["slow"] == pytest.approx(0.5 + 0.5 * np.arcsin(0.05) / (np.pi / 2), abs=0.02)
    assert ctrl["range"] == (-1, 1) and ctrl["saturated"] == pytest.approx(0.5 * 2 / 3, abs=0.02)  # |sin| > 1/2
    assert found["supply"] == {"median": 12.0, "range": (12.0, 12.0), "outliers": 0, "field": "vin", "stated": 15.0}
    assert found["enabled"] == 0.75 and found["lost"] == 0


def test_missing_samples_and_other_units_do_not_hide_the_lag():
    time = 0.01 * np.arange(1000)
    position, velocity = swing(time, 0.02)
    degrees = measure(make_recording(time, qpos=position, qvel=np.rad2deg(velocity), ctrl=position))
    assert degrees["joints"][0]["velocity_scale"] == pytest.approx(np.rad2deg(1), rel=0.03)
    position[100:110] = velocity[500] = np.nan
    found = measure(make_recording(time, qpos=position, qvel=velocity, ctrl=np.zeros(1000)))
    assert found["lost"] == 11 and found["joints"][0]["velocity_lag"] == pytest.approx(0.02, abs=1e-3)


def test_a_signal_without_a_sample():
    time, nothing = 0.01 * np.arange(1000), np.full(1000, np.nan)
    found = measure(make_recording(time, qpos=swing(time)[0], qvel=nothing, ctrl=swing(time)[0], supply=nothing))
    assert found["joints"][0]["velocity_lag"] is None and found["supply"] is None and found["lost"] == 1000
    for signal in ("qpos", "ctrl"):
        signals = {"qpos": time, "ctrl": time} | {signal: nothing}
        with pytest.raises(LogError, match=f"data.columns.{signal}"):
            measure(make_recording(time, **signals))


@pytest.mark.parametrize("delay", [0.0, 0.03])
@pytest.mark.parametrize("servo", [True, False], ids=["position", "torque"])
def test_the_delay_of_a_command(delay, servo):
    found = estimate_delay([simulate_servo(delay, servo, samples=500 if servo else 800)])
    assert found.command == ("position" if servo else "torque")
    # The simple drive's step is 2.5 ms, and its integrator a step's share early or late.
    assert found.seconds == pytest.approx(delay, abs=4e-3)


def test_rest_and_short_recordings_do_not_determine_a_delay():
    time = 0.01 * np.arange(800)
    rest = make_recording(time, qpos=np.zeros(800), ctrl=np.sin(time))
    short = make_recording(time[:50], qpos=np.sin(time[:50]), ctrl=np.sin(time[:50]))
    assert estimate_delay([rest]) is None and estimate_delay([short]) is None


@needs_data
def test_sts3215():
    found = [measure(recording) for recording in read_sts3215(DATA, every=8)]
    joints = [entry["joints"][0] for entry in found]
    # By the notes on the data: the register is about 20 ms late, the encoder has 4096 steps a turn, about 150 of the
    # 960 logs hold a spike, so about 19 of these 120; the supply is 11.9 to 12.2 V and not the header's 15.
    assert np.median([j["velocity_lag"] for j in joints if j["velocity_lag"]]) == pytest.approx(0.02, abs=2e-3)
    assert np.median([joint["position_quantum"] for joint in joints]) == pytest.approx(ENCODER, rel=1e-3)
    assert 12 <= sum(joint["spikes"] > 0 for joint in joints) <= 26
    assert all(11.7 < entry["supply"]["median"] < 12.3 and entry["supply"]["stated"] == 15 for entry in found)


@needs_data
@pytest.mark.slow
def test_the_delay_of_sts3215():
    # Rollouts over all logs fit best with about 30 ms. The estimate of one gain is 18 to 40 ms.
    gain = read_sts3215(DATA, holding=b'"kp": 16')
    found = estimate_delay([recording for recording in gain if recording.fields["trajectory"] != "brutal"])
    assert found.command == "position" and 0.02 <= found.seconds <= 0.04


@needs_data
def test_xl330():
    for joint in (measure(recording)["joints"][0] for recording in read_xl330(DATA)):
        assert joint["velocity_lag"] == pytest.approx(0.02, abs=2e-3) and not joint["spikes"]
        assert joint["position_quantum"] == pytest.approx(ENCODER, rel=1e-3)
