"""How alike a signal and another are, at each time by which it may be late."""

from typing import NamedTuple

import numpy as np
import scipy.fft
from jaxtyping import Bool, Float

from frictionzoo.logs.signals import Signal

FARTHEST = 1.0  # s, looked at on either side
WINDOWS = 6  # of a recording, in each of which a lag is found anew
SHORTEST = 50  # samples of a window
SURE = 0.15  # s, within which the misfit is nearly as low as at the lag, of a lag that counts
NEARLY = 1.5  # times the lowest misfit
ROUNDING = 1e-4  # misfit that is nothing
DRIFT = 0.15  # s, by which a lag changes along a recording at the least if clocks drift; motions change it by less
STEADY = 0.2  # share of that change which the windows may scatter by


class Likeness(NamedTuple):
    """A signal beside a reference that is delayed by each of many lags.

    Attributes:
        lags: By which the signal is late [s].
        correlation: Of the two, -1 to 1.
        scale: Of the signal against the reference, where they are compared.
        distance: Root mean square of their difference.
    """

    lags: Float[np.ndarray, "lags"]
    correlation: Float[np.ndarray, "lags"]
    scale: Float[np.ndarray, "lags"]
    distance: Float[np.ndarray, "lags"]

    def between(self, low: float, high: float) -> "Likeness":
        """Lags from low to high alone [s]; the one next to both where there is none."""
        kept = (self.lags >= low) & (self.lags <= high)
        kept = kept if kept.any() else np.abs(self.lags - low) == np.abs(self.lags - low).min()
        return Likeness(*(values[kept] for values in self))

    @property
    def best(self) -> int:
        """Index of the lag at which the two are most alike."""
        return int(np.argmax(self.correlation))

    @property
    def misfit(self) -> Float[np.ndarray, "lags"]:
        """Share of the signal's variance that a scaled reference does not explain; more than 1 where it opposes."""
        return 1 - self.correlation * np.abs(self.correlation)


class Drift(NamedTuple):
    """How a lag changes along a recording.

    Attributes:
        first: Lag at its beginning [s].
        last: At its end [s].
    """

    first: float
    last: float


def compare(signal: Signal, reference: Signal, timestep: float, on: Bool[np.ndarray, "time"]) -> Likeness:
    """A signal beside a reference at all lags up to `FARTHEST`, of samples of the signal that are `on`.

    Lags at which fewer than half of these samples have a partner are left out.
    """
    signal, reference = signal - signal.mean(), reference - signal.mean()
    length = scipy.fft.next_fast_len(2 * len(signal) - 1, real=True)
    weight, ones = on.astype(float), np.ones(len(signal))
    signals = [scipy.fft.rfft(each, length) for each in (weight, weight * signal, weight * signal**2)]
    others = [scipy.fft.rfft(each, length).conj() for each in (ones, reference, reference**2)]
    pairs = [(0, 0), (1, 0), (2, 0), (0, 1), (0, 2), (1, 1)]
    sums = np.asarray(scipy.fft.irfft(np.stack([signals[s] * others[r] for s, r in pairs]), length))
    farthest = min(round(FARTHEST / timestep), len(signal) - 1)
    steps = np.arange(-farthest, farthest + 1)
    sums = np.take(sums, steps, axis=1, mode="wrap")
    kept = sums[0] > max(2.0, 0.5 * weight.sum())
    sum_s, square_s, sum_r, square_r, product = sums[1:, kept] / sums[0, kept]
    both, variance_s, variance_r = product - sum_s * sum_r, square_s - sum_s**2, square_r - sum_r**2
    least = 1e-12 * max(float(np.mean(signal**2)), float(np.mean(reference**2)), 1e-300)
    correlation = both / np.sqrt(np.maximum(variance_s, least) * np.maximum(variance_r, least))
    distance = np.sqrt(np.maximum(square_s + square_r - 2 * product, 0.0))
    return Likeness(steps[kept] * timestep, correlation, both / np.maximum(variance_r, least), distance)


def find_drift(found: list[tuple[float, float] | None]) -> Drift | None:
    """What a lag does along a recording, from when each window is and its lag [s]; None where it does not drift.

    Args:
        found: One entry a window; None where the window tells no lag.
    """
    known = [pair for pair in found if pair is not None]
    if len(known) < WINDOWS - 1:
        return None
    when, lags = np.array(known).T
    slope, start = np.polyfit(when, lags, 1)
    scatter = float(np.abs(lags - (start + slope * when)).max())
    first, last = (float(start + slope * when[at]) for at in (0, -1))
    return Drift(first, last) if abs(last - first) > max(DRIFT, scatter / STEADY) else None


def say_drift(drift: Drift) -> str:
    """A sentence on a lag that changes."""
    return (
        f"the motion lags ctrl by {1e3 * drift.first:.0f} ms at the start and by {1e3 * drift.last:.0f} ms at "
        "the end: their clocks drift apart; record both with one clock and name its column (data.columns.time), or cut "
        "the recording into pieces"
    )


def pick_lag(lags: Float[np.ndarray, "lags"], misfit: Float[np.ndarray, "lags"]) -> float | None:
    """The lag of the lowest misfit [s]; None where others do nearly as well, or it lies at an end."""
    at = int(np.argmin(misfit))
    near = lags[misfit < NEARLY * misfit[at] + ROUNDING]
    return None if at in (0, len(lags) - 1) or near.max() - near.min() > SURE else float(lags[at])
