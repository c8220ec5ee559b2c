"""What distinguishes drives that were judged on the same rollouts: numbers from arrays, nothing else."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

RESAMPLES = 10_000
INTERVAL = (2.5, 97.5)  # percentiles
MATTERS = 0.01  # of the smaller error: a difference below it decides nothing, however sure it is
POINTS = 30  # horizons of an error curve
HAIR = 0.2  # of half an interval; as near to 0 as that, its end might as well be on the other side
BINS = 8  # of speed and of load, each with as many windows
FEWEST = 5  # windows in a bin
LAGS = 101  # of an autocorrelation

Errors = Float[np.ndarray, "rollouts"]
Curve = tuple[Float[np.ndarray, "points"], Float[np.ndarray, "points"]]


@dataclass(frozen=True)
class Difference:
    """How much larger one drive's mean error over the rollouts is than another's.

    Attributes:
        mean: Mean of the rollouts' differences [rad or m]; NaN where no rollout counts for both.
        low: Lower end of its 95 % interval.
        high: Upper end.
        verdict: `better` if the first drive's error is smaller, `worse` if it is larger, `noise` if the interval
            holds 0 or the mean is below `MATTERS` of the smaller error. Where one of them diverged more often, that
            alone decides.
    """

    mean: float
    low: float
    high: float
    verdict: str

    @property
    def by_a_hair(self) -> bool:
        """Whether an end of the interval is so near to 0 that a few other rollouts would have told otherwise."""
        return min(abs(self.low), abs(self.high)) < HAIR * (self.high - self.low) / 2


def resample(rollouts: int) -> Int[np.ndarray, "resamples rollouts"]:
    """How often each of so many rollouts is drawn in each bootstrap resample, the same in every call."""
    return np.random.default_rng(0).multinomial(rollouts, np.full(rollouts, 1 / rollouts), size=RESAMPLES)


def difference(first: Errors, second: Errors, counts: Int[np.ndarray, "resamples rollouts"]) -> Difference:
    """Paired bootstrap over rollouts: percentile interval of the mean difference of two drives' errors.

    Source: B. Efron, R. J. Tibshirani, "An Introduction to the Bootstrap", Chapman and Hall 1993, section 13.3.

    Args:
        first: Error of each rollout of one drive; NaN where it diverged.
        second: Errors of the other on the same rollouts.
        counts: From `resample`.
    """
    both = np.isfinite(first) & np.isfinite(second)
    mean, low, high = _interval(np.where(both, first - second, 0.0), both, counts)
    lost = np.isnan(first).sum() - np.isnan(second).sum()
    if lost:
        return Difference(mean, low, high, "worse" if lost > 0 else "better")
    smaller = min(errors[both].mean() if both.any() else 0.0 for errors in (first, second))
    told_apart = not low <= 0 <= high and abs(mean) >= MATTERS * smaller
    return Difference(mean, low, high, ("better" if mean < 0 else "worse") if told_apart else "noise")


def _interval(
    gap: Errors, counted: Bool[np.ndarray, "rollouts"], counts: Int[np.ndarray, "resamples rollouts"]
) -> tuple[float, float, float]:
    drawn = counts @ counted
    if not drawn.any():
        return np.nan, np.nan, np.nan
    means = (counts @ gap)[drawn > 0] / drawn[drawn > 0]
    low, high = np.percentile(means, INTERVAL)
    return float(gap.sum() / counted.sum()), float(low), float(high)


def error_by_horizon(error: Float[np.ndarray, "rollouts steps"], timestep: float) -> Curve:
    """Mean absolute error over the first h seconds of the rollouts, for evenly spaced h.

    Args:
        error: Absolute error at each step of each rollout; a rollout that is not finite everywhere is left out.
        timestep: [s].

    Returns:
        Horizons [s], and the error at each, NaN where all rollouts diverged.
    """
    steps = np.unique(np.linspace(0, error.shape[1], POINTS + 1).round().astype(int)[1:])
    steps = steps[steps > 0]
    kept = error[np.isfinite(error).all(axis=1)]
    if not len(kept):
        return steps * timestep, np.full(len(steps), np.nan)
    running = kept.cumsum(axis=1).mean(axis=0) / np.arange(1, error.shape[1] + 1)
    return steps * timestep, running[steps - 1]


def bin_evenly(values: Float[np.ndarray, "windows"]) -> list[Int[np.ndarray, "members"]]:
    """Windows in bins of rising value, each with as many of them."""
    order = np.argsort(values, kind="stable")
    return np.array_split(order, max(1, min(BINS, len(values) // FEWEST)))


def mean_of_finite(values: Float[np.ndarray, "values"]) -> float:
    """Mean of the values that are finite; NaN if none is."""
    kept = values[np.isfinite(values)]
    return float(kept.mean()) if len(kept) else np.nan


def autocorrelation(residual: Float[np.ndarray, "rollouts steps"], timestep: float, longest: float) -> Curve:
    """Autocorrelation of the simulation errors, mean over rollouts: what is left in them that a law could explain.

    Errors without structure have none but at lag 0, within +- 1.96 / sqrt(samples).

    Source: L. Ljung, "System Identification", 2nd ed., Prentice Hall 1999, section 16.6, residual analysis.

    Args:
        residual: Signed error at each step of each rollout; a rollout that is not finite everywhere is left out.
        timestep: [s].
        longest: Largest lag [s].

    Returns:
        Lags [s], and the coefficients, NaN where all rollouts diverged or have no error.
    """
    steps = residual.shape[1]
    last = min(steps - 1, round(longest / timestep))
    lags = np.unique(np.linspace(0, last, min(LAGS, last + 1)).round().astype(int))
    kept = residual[np.isfinite(residual).all(axis=1)]
    largest = np.abs(kept).max(axis=1, initial=0.0, keepdims=True)
    kept = kept[largest[:, 0] > 0] / largest[largest > 0][:, None]  # the square of a runaway's error may overflow
    kept = kept - kept.mean(axis=1, keepdims=True)
    kept = kept[np.square(kept).sum(axis=1) > 0]
    if not len(kept):
        return lags * timestep, np.full(len(lags), np.nan)
    spectrum = np.abs(np.fft.rfft(kept, 2 * steps, axis=1)) ** 2
    products = np.fft.irfft(spectrum, axis=1)[:, :steps]
    return lags * timestep, (products / products[:, :1]).mean(axis=0)[lags]
