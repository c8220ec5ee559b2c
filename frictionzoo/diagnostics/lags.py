"""Similarity of two signals at many lags, and the drift of a lag."""

from typing import NamedTuple

import numpy as np
import scipy.fft
from jaxtyping import Bool, Float

from frictionzoo.data.signals import Signal
from frictionzoo.diagnostics.findings import Finding, Repair

FARTHEST = 1.0  # s, largest lag in either direction
WINDOWS = 6  # windows of a recording, each with its own lag
SHORTEST = 50  # samples of a window
SURE = 0.15  # s, widest range of lags with nearly the lowest misfit of a lag that counts
NEARLY = 1.5  # factor on the lowest misfit that counts as nearly as low
ROUNDING = 1e-4  # negligible misfit
DRIFT = 0.15  # s, smallest change of a lag over a recording that indicates drifting clocks; motion changes it less
STEADY = 0.2  # largest scatter of the windows' lags, as a share of that change


class Likeness(NamedTuple):
    """Correlation (-1 to 1), scale and RMS distance of a signal from a reference at many lags of the signal [s]."""

    lags: Float[np.ndarray, "lags"]
    correlation: Float[np.ndarray, "lags"]
    scale: Float[np.ndarray, "lags"]
    distance: Float[np.ndarray, "lags"]

    def between(self, low: float, high: float) -> "Likeness":
        """Return the similarity at lags from low to high [s]; if there are none, at those closest to low."""
        inside = (self.lags >= low) & (self.lags <= high)
        inside = inside if inside.any() else np.abs(self.lags - low) == np.abs(self.lags - low).min()
        return Likeness(*(values[inside] for values in self))

    @property
    def best(self) -> int:
        """Index of the lag with the highest correlation."""
        return int(np.argmax(self.correlation))

    @property
    def misfit(self) -> Float[np.ndarray, "lags"]:
        """Share of the signal's variance that a scaled reference does not explain; above 1 for a negative scale."""
        return 1 - self.correlation * np.abs(self.correlation)


def compare(signal: Signal, reference: Signal, timestep: float, on: Bool[np.ndarray, "time"]) -> Likeness:
    """Compare a signal with a reference at all lags up to `FARTHEST`, in the samples of the signal that are `on`.

    Lags at which fewer than half of these samples have a partner are ignored.
    """
    signal, reference = signal - signal.mean(), reference - signal.mean()
    length = scipy.fft.next_fast_len(2 * len(signal) - 1, real=True)
    weight, ones = on.astype(float), np.ones(len(signal))
    signals = [scipy.fft.rfft(values, length) for values in (weight, weight * signal, weight * signal**2)]
    others = [scipy.fft.rfft(values, length).conj() for values in (ones, reference, reference**2)]
    pairs = [(0, 0), (1, 0), (2, 0), (0, 1), (0, 2), (1, 1)]
    sums = np.asarray(scipy.fft.irfft(np.stack([signals[s] * others[r] for s, r in pairs]), length))
    farthest = min(round(FARTHEST / timestep), len(signal) - 1)
    steps = np.arange(-farthest, farthest + 1)
    sums = np.take(sums, steps, axis=1, mode="wrap")
    has_partners = sums[0] > max(2.0, 0.5 * weight.sum())
    sum_s, square_s, sum_r, square_r, product = sums[1:, has_partners] / sums[0, has_partners]
    covariance, variance_s, variance_r = product - sum_s * sum_r, square_s - sum_s**2, square_r - sum_r**2
    floor = 1e-12 * max(float(np.mean(signal**2)), float(np.mean(reference**2)), 1e-300)
    correlation = covariance / np.sqrt(np.maximum(variance_s, floor) * np.maximum(variance_r, floor))
    distance = np.sqrt(np.maximum(square_s + square_r - 2 * product, 0.0))
    return Likeness(steps[has_partners] * timestep, correlation, covariance / np.maximum(variance_r, floor), distance)


def find_drift(found: list[tuple[float, float] | None]) -> Finding | None:
    """Find a drifting lag from time and lag of each window [s], which is None for windows without a clear lag."""
    pairs = [pair for pair in found if pair is not None]
    if len(pairs) < WINDOWS - 1:
        return None
    when, lags = np.array(pairs).T
    slope, start = np.polyfit(when, lags, 1)
    scatter = float(np.abs(lags - (start + slope * when)).max())
    first, last = (float(start + slope * when[index]) for index in (0, -1))
    text = f"the motion lags ctrl by {1e3 * first:.0f} ms at the start and by {1e3 * last:.0f} ms at the end: their "
    text += "clocks drift; record both with one clock and name its column (data.columns.time), or cut the "
    text += "recording into pieces"
    return Finding("caution", "drift", text) if abs(last - first) > max(DRIFT, scatter / STEADY) else None


def find_shift(moves: str, lag: float, settles: float | None = None) -> Finding:
    """Return the finding of a motion, `moves` in its text, by `lag` behind its command [s], or ahead if negative.

    `settles` is the lag that a position controller's gains explain [s]; None for a torque command.
    """
    if lag < 0:
        command_lag, hint = (f"{-lag:.2g}", "") if settles is None else (f"{-lag + settles:.2g}", ", or its true lag")
        text = f"{moves} is ahead of ctrl by {-1e3 * lag:.3g} ms, expected to follow it: ctrl was recorded late; set "
        text += f"data.clean.command_lag={command_lag} (s){hint}"
        return Finding("bad", "early", text, repairs=(Repair("data.clean.command_lag", float(command_lag)),))
    gains = "" if settles is None else f"; the controller's gains explain {1e3 * settles:.3g} ms"
    high = f"{1.5 * lag:.2g}"
    text = f"{moves} lags ctrl by {1e3 * lag:.3g} ms{gains}: identify bench.params.delay "
    text += f"(bench.params.delay.identify=true and bench.params.delay.high={high}), or check that the columns have "
    text += "the same times"
    repairs = Repair("bench.params.delay.identify", True), Repair("bench.params.delay.high", float(high))
    return Finding("caution", "late", text, repairs=repairs)


def pick_lag(lags: Float[np.ndarray, "lags"], misfit: Float[np.ndarray, "lags"]) -> float | None:
    """Return the lag with the lowest misfit [s]; None if distant lags are nearly as good or it lies at an end."""
    index = int(np.argmin(misfit))
    similar = lags[misfit < NEARLY * misfit[index] + ROUNDING]
    return None if index in (0, len(lags) - 1) or similar.max() - similar.min() > SURE else float(lags[index])
