"""Diagnosis: known faults of made recordings are found, and those of real drives that others have found."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import DATA, needs_data
from recordings import make_recording, read_sts3215, read_xl330, simulate_servo

from frictionzoo.core.errors import LogError
from frictionzoo.data.delay import estimate_delay
from frictionzoo.data.diagnose import diagnose, measure_timing
from frictionzoo.data.signals import (
    count_spikes,
    find_breaks,
    find_lag,
    find_quantum,
    find_spikes,
    find_velocity_lag,
    repair_spikes,
)


def swing(time, lag=0.0):
    """Position, and the velocity as a sensor has it that is so late; of two frequencies, so that no period repeats."""
    late = time - lag
    return np.sin(3 * time) + 0.5 * np.sin(11 * time), 3 * np.cos(3 * late) + 5.5 * np.cos(11 * late)


def test_a_uniform_clock():
    timing = measure_timing(0.002 * np.arange(1000))
    assert timing.interval == pytest.approx(0.002) and timing.duration == pytest.approx(1.998)
    assert timing[3:4] + timing[5:] == (0.0, 0, 0, 0, 0) and timing.worst < 1e-9


def test_faults_of_a_clock_are_counted():
    time = 0.01 * np.arange(1000)
    time[500:] += 1.0  # a gap
    time[700] += 0.001  # two uneven intervals
    time[900:] -= 5.0  # a reset
    time = np.delete(np.insert(time, 20, time[19]), [101, 102])  # repeated, missing
    timing = measure_timing(time)
    assert (timing.duplicates, timing.missing, timing.gaps, timing.resets) == (1, 2, 1, 1)
    # Two uneven intervals and the one in which samples are missing, of the 995 that are neither gap, reset nor zero.
    assert timing.jitter == pytest.approx(3 / 995)
    np.testing.assert_array_equal(find_breaks(time, 5.0), [499, 899])


@pytest.mark.parametrize("width", [1, 2])
def test_isolated_spikes_are_found_and_repaired(width):
    time = 0.01 * np.arange(600)
    position = np.round(np.sin(3 * time) / 0.0015) * 0.0015
    spiked = position.copy()
    spiked[100 : 100 + width] -= 0.5
    spiked[400 : 400 + width] += 0.2
    expected = [100, *range(101, 100 + width), 400, *range(401, 400 + width)]
    np.testing.assert_array_equal(find_spikes(spiked), expected)
    assert count_spikes(spiked) == 2 and count_spikes(position) == 0
    # Straight lines over 2 or 3 intervals: the second derivative, 9 rad/s^2, times half of (10 ms)^2, and two quanta.
    np.testing.assert_allclose(repair_spikes(spiked), position, atol=9 * 0.01**2 + 0.003)


@pytest.mark.parametrize(
    "motion",
    [
        np.sign(np.sin(np.arange(600) / 20)),  # steps
        np.random.default_rng(0).normal(size=600),  # noise
        np.repeat(np.arange(200) % 2, 3) * 0.0015,  # a flickering encoder at rest
        np.zeros(600),
        np.full(600, np.nan),
    ],
    ids=["steps", "noise", "flicker", "rest", "nan"],
)
def test_what_is_no_spike_is_none(motion):
    assert len(find_spikes(motion)) == 0


def test_the_quantum_of_an_encoder():
    smooth = np.sin(0.01 * np.arange(2000))
    for quantum in (2 * np.pi / 4096, 1e-5, 0.1):
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
    """The noise that rounding puts into the derivative; other units are told all the same."""
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
    found = diagnose(replace(recording, fields={"vin": 15.0}))
    (joint,) = found.joints
    # The filter rings a little where the motion stops.
    assert joint.velocity == pytest.approx((-np.pi, np.pi), rel=0.02) and joint.velocity_lag is None
    assert joint.rest == pytest.approx(0.5, abs=0.02)
    # Half of it at rest, and |cos| < 0.05 for 3 % of the other half.
    assert joint.slow == pytest.approx(0.5 + 0.5 * np.arcsin(0.05) / (np.pi / 2), abs=0.02)
    assert found.commands[0].range == (-1, 1)
    assert found.commands[0].saturated == pytest.approx(0.5 * 2 / 3, abs=0.02)  # |sin| > 1/2 for two thirds
    assert (found.supply.median, found.supply.field, found.supply.stated) == (12.0, "vin", 15.0)
    assert found.enabled == 0.75 and found.lost == 0


def test_units_that_disagree_show_in_the_scale():
    time = 0.01 * np.arange(1000)
    position, velocity = swing(time)
    found = diagnose(make_recording(time, qpos=position, qvel=np.rad2deg(velocity), ctrl=position))
    assert found.joints[0].velocity_scale == pytest.approx(np.rad2deg(1), rel=0.03)


def test_lost_samples_do_not_stop_the_diagnosis():
    time = 0.01 * np.arange(1000)
    position, velocity = swing(time, 0.02)
    position[100:110] = velocity[500] = np.nan
    found = diagnose(make_recording(time, qpos=position, qvel=velocity, ctrl=np.zeros(1000)))
    assert found.lost == 11 and found.joints[0].velocity_lag == pytest.approx(0.02, abs=1e-3)


def test_a_velocity_without_a_sample_has_no_lag():
    time = 0.01 * np.arange(1000)
    nothing = np.full(1000, np.nan)
    recording = make_recording(time, qpos=swing(time)[0], qvel=nothing, ctrl=swing(time)[0], supply=nothing)
    found = diagnose(recording)
    assert found.joints[0].velocity_lag is None and found.supply is None and found.lost == 1000


@pytest.mark.parametrize("signal", ["qpos", "ctrl"])
def test_an_empty_signal_is_refused_in_one_line(signal):
    signals = {"qpos": np.zeros(10), "ctrl": np.zeros(10)} | {signal: np.full(10, np.nan)}
    with pytest.raises(LogError, match=f"{signal} holds (0|no) finite sample.*data.columns.{signal}"):
        diagnose(make_recording(np.arange(10), **signals))


@pytest.mark.parametrize("delay", [0.0, 0.03])
@pytest.mark.parametrize("servo", [True, False], ids=["position", "torque"])
def test_the_delay_of_a_command(delay, servo):
    found = estimate_delay([simulate_servo(delay, servo, samples=500 if servo else 800)])
    assert found.command == ("position" if servo else "torque")
    # The simple drive's step is 2.5 ms, and its integrator a step's share early or late.
    assert found.seconds == pytest.approx(delay, abs=4e-3)


def test_the_delay_of_a_joint_at_rest_cannot_be_told():
    time = 0.01 * np.arange(800)
    rest = make_recording(time, qpos=np.zeros(800), ctrl=np.sin(time))
    short = make_recording(time[:50], qpos=np.sin(time[:50]), ctrl=np.sin(time[:50]))
    assert estimate_delay([rest]) is None and estimate_delay([short]) is None


@needs_data
def test_sts3215():
    found = [diagnose(recording) for recording in read_sts3215(DATA, every=8)]
    joints = [diagnosis.joints[0] for diagnosis in found]
    # By the notes on the data: the register is about 20 ms late, the encoder has 4096 steps a turn, about 150 of the
    # 960 logs hold a spike, so about 19 of these 120; the supply is 11.9 to 12.2 V and not the header's 15.
    assert np.median([joint.velocity_lag for joint in joints if joint.velocity_lag]) == pytest.approx(0.02, abs=2e-3)
    assert np.median([joint.position_quantum for joint in joints]) == pytest.approx(2 * np.pi / 4096, rel=1e-3)
    assert 12 <= sum(joint.spikes > 0 for joint in joints) <= 26
    assert all(11.7 < diagnosis.supply.median < 12.3 and diagnosis.supply.stated == 15 for diagnosis in found)


@needs_data
@pytest.mark.slow
def test_the_delay_of_sts3215():
    # Rollouts over all logs fit best with about 30 ms. The estimate of one gain is 18 to 40 ms.
    gain = read_sts3215(DATA, holding=b'"kp": 16')
    found = estimate_delay([recording for recording in gain if recording.fields["trajectory"] != "brutal"])
    assert found.command == "position" and 0.02 <= found.seconds <= 0.04


@needs_data
def test_xl330():
    found = [diagnose(recording).joints[0] for recording in read_xl330(DATA)]
    assert all(joint.velocity_lag == pytest.approx(0.02, abs=2e-3) for joint in found)
    assert all(joint.position_quantum == pytest.approx(2 * np.pi / 4096, rel=1e-3) for joint in found)
    assert all(joint.spikes == 0 for joint in found)
