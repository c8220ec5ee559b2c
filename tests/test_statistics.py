"""Statistics of comparisons against numbers computed by hand or by another library."""

import itertools

import numpy as np
import pytest
import scipy.stats

from frictionzoo.result.comparison.statistics import (
    BINS,
    Difference,
    autocorrelation,
    bin_evenly,
    difference,
    error_by_horizon,
    find_half_over_seeds,
    mean_of_finite,
    resample,
)

RNG = np.random.default_rng(5)


def compare(first, second):
    first, second = (np.asarray(errors, dtype=np.float64) for errors in (first, second))
    return difference(first, second, resample(len(first)))


def test_a_constant_difference_has_no_spread():
    errors = RNG.uniform(1, 2, 6)
    found = compare(errors + 0.1, errors)
    np.testing.assert_allclose([found.mean, found.low, found.high], 0.1, rtol=1e-9)
    assert found.verdict == "worse"
    assert compare(errors, errors + 0.1).verdict == "better"
    assert compare(errors, errors).verdict == "noise"
    # What does not matter is noise, however sure.
    assert [compare(share * errors, errors).verdict for share in (1.009, 1.011)] == ["noise", "worse"]
    assert [compare(errors, share * errors).verdict for share in (1.009, 1.011)] == ["noise", "better"]


@pytest.mark.parametrize(("first", "second"), [(2, 1), (3, 3), (3, 1), (5, 2)])
def test_the_interval_over_seeds_is_that_of_scipy(first, second):
    errors = RNG.normal(1, 0.1, first), RNG.normal(1, 0.3, second)
    means = errors[0].mean() - errors[1].mean()
    if second > 1:
        interval = scipy.stats.ttest_ind(*errors, equal_var=False).confidence_interval()
    else:
        interval = scipy.stats.ttest_1samp(errors[0] - errors[1], 0).confidence_interval()
    half = find_half_over_seeds(*(each.tolist() for each in errors))
    np.testing.assert_allclose((means - half, means + half), interval, rtol=1e-9)


def test_one_seed_or_equal_errors_have_no_interval_over_seeds():
    assert find_half_over_seeds([1.0], [2.0]) == find_half_over_seeds([1.0, 1.0], [2.0]) == 0


def test_the_interval_is_that_of_scipy():
    errors = RNG.normal(1, 0.1, (2, 12))
    gap = errors[0] - errors[1]
    found = compare(*errors)
    expected = scipy.stats.bootstrap((gap,), np.mean, n_resamples=20_000, method="percentile", rng=1)
    # 10 000 resamples place an end of the interval to a few percent of its width.
    width = np.ptp(expected.confidence_interval)
    np.testing.assert_allclose([found.low, found.high], expected.confidence_interval, atol=0.05 * width)
    assert found.mean == pytest.approx(gap.mean(), rel=1e-12)


def test_what_is_shared_by_the_rollouts_does_not_count():
    hard = np.array([1.0, 5.0, 2.0, 9.0, 1.5, 3.0, 7.0, 4.0])  # as a whole far from distinguishable
    better = hard + np.array([-0.1, -0.12, -0.09, -0.11, -0.1, -0.08, -0.12, -0.1])
    assert compare(better, hard).verdict == "better"
    assert compare(better, np.roll(hard, 1)).verdict == "noise"


def test_two_equal_drives_are_seldom_told_apart():
    counts = resample(20)  # the same in every call
    verdicts = [difference(*RNG.normal(1, 0.1, (2, 20)), counts).verdict for _ in range(300)]
    # 95 % are expected, a little fewer with 20 rollouts; three standard deviations of 300 draws are 4 %.
    assert 0.87 < verdicts.count("noise") / 300 < 0.99


def test_diverging_more_often_decides():
    errors = np.array([1.0, 1.1, 0.9, 1.0])
    lost = np.array([0.1, 0.1, 0.1, np.nan])
    found = compare(lost, errors)
    assert found.verdict == "worse" and found.mean == pytest.approx(-0.9, rel=1e-12)
    assert compare(errors, lost).verdict == "better"
    # Nothing in common has no difference.
    found = compare([1.0, np.nan], [np.nan, 1.0])
    assert np.isnan([found.mean, found.low, found.high]).all() and found.verdict == "noise"


def test_the_error_of_a_horizon_is_the_mean_up_to_it():
    error = np.array([[1.0, 2.0, 3.0, 6.0], [3.0, 2.0, 1.0, 2.0], [np.inf, 0.0, 0.0, 0.0]])
    horizon, mean = error_by_horizon(error, 0.5)
    np.testing.assert_allclose(horizon, [0.5, 1.0, 1.5, 2.0])
    np.testing.assert_allclose(mean, [2.0, 2.0, 2.0, 2.5])
    horizon, _ = error_by_horizon(np.ones((1, 3000)), 0.001)
    np.testing.assert_allclose(horizon, 0.1 * np.arange(1, 31))


def test_a_drive_that_always_diverges_has_no_error():
    assert np.isnan(error_by_horizon(np.full((2, 4), np.nan), 0.5)[1]).all()
    assert np.isnan(autocorrelation(np.full((2, 4), np.nan), 0.5, 1.0)[1]).all()
    assert np.isnan(mean_of_finite(np.array([np.nan, np.inf])))


def test_bins_hold_equally_many_windows_of_rising_value():
    values = RNG.normal(size=103)
    members = bin_evenly(values)
    assert len(members) == BINS and {len(bin) for bin in members} <= {12, 13}
    assert np.sort(np.concatenate(members)).tolist() == list(range(103))
    assert all(values[low].max() < values[high].min() for low, high in itertools.pairwise(members))
    assert [len(bin) for bin in bin_evenly(np.ones(4))] == [4]


def test_autocorrelation_is_that_of_numpy():
    residual = RNG.normal(size=(1, 400)) + 0.3
    lag, found = autocorrelation(residual, 0.01, 0.5)
    centred = residual[0] - residual[0].mean()
    whole = np.correlate(centred, centred, "full")[399:]
    np.testing.assert_allclose(lag, 0.01 * np.arange(51), atol=1e-12)
    np.testing.assert_allclose(found, whole[:51] / whole[0], atol=1e-12)
    residual = RNG.normal(size=(3, 50))
    scale = np.array([1.0, 1e-200, 1e200])[:, None]
    np.testing.assert_allclose(autocorrelation(residual * scale, 0.1, 1.0)[1], autocorrelation(residual, 0.1, 1.0)[1])


def test_white_errors_lie_within_the_band_and_waves_do_not():
    _, white = autocorrelation(RNG.normal(size=(10, 1000)), 0.001, 0.1)
    band = 1.96 / np.sqrt(10_000)
    assert np.mean(np.abs(white[1:]) < band) > 0.85  # of 100 lags 95 are expected
    wave = np.sin(2 * np.pi * 10 * 0.001 * np.arange(1000))
    lag, found = autocorrelation(np.stack([wave, -wave]), 0.001, 0.1)
    # The estimate is biased towards 0 by the share of the rollout that the lag takes off.
    assert found[lag == 0.05][0] == pytest.approx(-0.95, abs=0.01)


def test_what_is_decided_by_a_hair_says_so():
    for low, high, hair in ((-0.05, 1.0, True), (0.05, 1.0, True), (-1.0, 0.05, True), (-0.5, 1.0, False)):
        assert Difference((low + high) / 2, low, high, "noise").by_a_hair == hair
    assert not Difference(0.1, 0.1, 0.1, "worse").by_a_hair
    assert not Difference(np.nan, np.nan, np.nan, "worse").by_a_hair
