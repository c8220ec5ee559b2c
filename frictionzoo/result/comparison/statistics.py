"""Statistics for drives that were evaluated on the same rollouts."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.special
from jaxtyping import Bool, Float, Int

RESAMPLES = 10_000
INTERVAL = (2.5, 97.5)  # percentiles
MATTERS = 0.01  # smallest relevant difference, relative to the smaller error
POINTS = 30  # number of horizons of an error curve
HAIR = 0.2  # share of half an interval; if an end is closer to 0, other rollouts might move it across
BINS = 8  # largest number of bins of speed and of load, each with the same number of windows
FEWEST = 5  # smallest number of windows in a bin
LAGS = 101  # largest number of lags of an autocorrelation

Errors = Float[np.ndarray, "rollouts"]
Curve = tuple[Float[np.ndarray, "points"], Float[np.ndarray, "points"]]


@dataclass(frozen=True)
class Difference:
    """Difference of the mean errors of two drives on the same rollouts, first minus second, with its 95 % interval.

    Attributes:
        mean: Mean of the rollouts' differences [rad or m]; NaN if no rollout is finite for both.
        verdict: `better` if the first drive's error is smaller, `worse` if larger, `noise` if the interval contains 0
            or the mean is below `MATTERS` of the smaller error. If one drive diverged more often, that alone decides.
    """

    mean: float
    low: float
    high: float
    verdict: str

    @property
    def by_a_hair(self) -> bool:
        """Whether an end of the interval is so close to 0 that other rollouts might change the verdict."""
        return min(abs(self.low), abs(self.high)) < HAIR * (self.high - self.low) / 2


def resample(rollouts: int) -> Int[np.ndarray, "resamples rollouts"]:
    """Return how often each rollout is drawn in each bootstrap resample; the same in every call."""
    return np.random.default_rng(0).multinomial(rollouts, np.full(rollouts, 1 / rollouts), size=RESAMPLES)


def difference(
    first: Errors, second: Errors, counts: Int[np.ndarray, "resamples rollouts"], over_seeds: float = 0.0
) -> Difference:
    """Estimate the mean difference of two drives' errors with a percentile interval from a paired bootstrap.

    An error is NaN if its rollout diverged; `counts` comes from `resample`. `over_seeds` is half the interval of the
    difference over random seeds [rad or m]; it widens the interval.

    Source: B. Efron, R. J. Tibshirani, "An Introduction to the Bootstrap", Chapman and Hall 1993, section 13.3.
    """
    finite = np.isfinite(first) & np.isfinite(second)
    mean, low, high = _interval(np.where(finite, first - second, 0.0), finite, counts)
    low, high = mean - math.hypot(mean - low, over_seeds), mean + math.hypot(high - mean, over_seeds)
    surplus = np.isnan(first).sum() - np.isnan(second).sum()
    if surplus:
        return Difference(mean, low, high, "worse" if surplus > 0 else "better")
    smaller = min(errors[finite].mean() if finite.any() else 0.0 for errors in (first, second))
    distinct = not low <= 0 <= high and abs(mean) >= MATTERS * smaller
    return Difference(mean, low, high, ("better" if mean < 0 else "worse") if distinct else "noise")


def find_half_over_seeds(*errors: Sequence[float]) -> float:
    """Return half the 95 % interval of the difference of two drives' mean errors, each over its seeds; 0 for one seed.

    Source: B. Welch, "The generalization of 'Student's' problem when several different population variances are
    involved", 1947.
    """
    variances = [(float(np.var(each, ddof=1)) / len(each), len(each) - 1) for each in errors if len(each) > 1]
    total, squares = sum(v for v, _ in variances), sum(v**2 / freedom for v, freedom in variances)
    return scipy.special.stdtrit(total**2 / squares, INTERVAL[1] / 100) * math.sqrt(total) if squares else 0.0


def _interval(
    gap: Errors, counted: Bool[np.ndarray, "rollouts"], counts: Int[np.ndarray, "resamples rollouts"]
) -> tuple[float, float, float]:
    drawn = counts @ counted
    if not drawn.any():
        return np.nan, np.nan, np.nan
    low, high = np.percentile((counts @ gap)[drawn > 0] / drawn[drawn > 0], INTERVAL)
    return float(gap.sum() / counted.sum()), float(low), float(high)


def error_by_horizon(error: Float[np.ndarray, "rollouts steps"], timestep: float) -> Curve:
    """Return evenly spaced horizons h [s], and the mean absolute error over the first h seconds of the rollouts.

    `error` is the absolute error at each `timestep` [s]; rollouts with non-finite errors are ignored. The result is NaN
    if all rollouts diverged.
    """
    steps = np.unique(np.linspace(0, error.shape[1], POINTS + 1).round().astype(int)[1:])
    steps = steps[steps > 0]
    kept = error[np.isfinite(error).all(axis=1)]
    if not len(kept):
        return steps * timestep, np.full(len(steps), np.nan)
    running = kept.cumsum(axis=1).mean(axis=0) / np.arange(1, error.shape[1] + 1)
    return steps * timestep, running[steps - 1]


def bin_evenly(values: Float[np.ndarray, "windows"]) -> list[Int[np.ndarray, "members"]]:
    """Return the indices of the windows in bins of increasing value and equal count."""
    order = np.argsort(values, kind="stable")
    return np.array_split(order, max(1, min(BINS, len(values) // FEWEST)))


def mean_of_finite(values: Float[np.ndarray, "values"]) -> float:
    """Return the mean of the finite values; NaN if there is none."""
    kept = values[np.isfinite(values)]
    return float(kept.mean()) if len(kept) else np.nan


def autocorrelation(residual: Float[np.ndarray, "rollouts steps"], timestep: float, longest: float) -> Curve:
    """Return lags [s] up to `longest`, and the autocorrelation of signed simulation errors, mean over rollouts.

    It shows structure that a better model could explain. For white noise, the coefficients at lags above 0 lie within
    +- 1.96 / sqrt(samples) in 95 % of cases. Rollouts with non-finite errors are ignored; NaN if all diverged or have
    no error.

    Source: L. Ljung, "System Identification", 2nd ed., Prentice Hall 1999, section 16.6, residual analysis.
    """
    steps = residual.shape[1]
    last = min(steps - 1, round(longest / timestep))
    lags = np.unique(np.linspace(0, last, min(LAGS, last + 1)).round().astype(int))
    kept = residual[np.isfinite(residual).all(axis=1)]
    largest = np.abs(kept).max(axis=1, initial=0.0, keepdims=True)
    kept = kept[largest[:, 0] > 0] / largest[largest > 0][:, None]  # squares of very large errors may overflow
    kept = kept - kept.mean(axis=1, keepdims=True)
    kept = kept[np.square(kept).sum(axis=1) > 0]
    if not len(kept):
        return lags * timestep, np.full(len(lags), np.nan)
    spectrum = np.abs(np.fft.rfft(kept, 2 * steps, axis=1)) ** 2
    products = np.fft.irfft(spectrum, axis=1)[:, :steps]
    return lags * timestep, (products / products[:, :1]).mean(axis=0)[lags]
