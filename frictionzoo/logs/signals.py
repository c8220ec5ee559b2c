"""What a signal tells by itself or beside another: breaks, spikes, outliers, quantum, lag and derivative."""

import numpy as np
from jaxtyping import Bool, Float, Int

from frictionzoo.logs.velocity import estimate_velocity

GAP = 5.0  # median intervals; a longer one is a gap, not a few missing samples
SPIKE = 20.0  # a spike leaves both neighbours by this many times the usual second difference
FAR = 1.0  # times the range of the others that an outlier lies beyond it
RETURN = 0.5  # and its neighbours differ by less than this share of what it leaves them by
WIDEST = 2  # samples; a longer excursion may be a motion
QUANTISED = 0.9  # share of the steps between samples that are multiples of a quantum, if there is one
TOP = 0.001  # share of the samples on either side that may lie beyond what counts as the range
LONGEST_LAG = 0.1  # s, searched on either side
ALIKE = 0.9  # correlation from which on two signals are delayed copies of each other
ORDER = 2  # of the velocity estimate's filter; its cut-off is a tenth of the sample rate, at most 50 Hz


def find_breaks(time: Float[np.ndarray, "time"], gap: float) -> Int[np.ndarray, "breaks"]:
    """Samples with which another stretch begins: after a gap, or where the clock runs backwards.

    Args:
        time: Sample times [s].
        gap: Longest interval within a stretch, in median intervals.
    """
    steps = np.diff(time)
    return np.flatnonzero((steps < 0) | (steps > gap * np.median(steps[steps > 0]))) + 1


def find_spikes(signal: Float[np.ndarray, "time"]) -> Int[np.ndarray, "spikes"]:
    """Samples that leave their neighbours on both sides the same way, while these are close to each other.

    The usual second difference and the signal's own step say what is usual, so a fast but smooth motion is no spike.

    Args:
        signal: Position, or another signal that cannot jump and come back.

    Returns:
        Every sample of every spike; a spike has one sample or two.
    """
    second = np.abs(np.diff(signal, 2))
    steps = np.abs(np.diff(signal))
    if not np.isfinite(second).any() or not (steps > 0).any():
        return np.zeros(0, int)
    usual = max(float(np.nanmedian(second)), float(steps[steps > 0].min()))
    found = [_find_spikes_of(signal, usual, width) for width in range(1, WIDEST + 1)]
    return np.unique(np.concatenate(found))


def _find_spikes_of(signal: Float[np.ndarray, "time"], usual: float, width: int) -> Int[np.ndarray, "spikes"]:
    before, after = signal[: -width - 1], signal[width + 1 :]
    leaves, returns = signal[1:-width] - before, signal[width:-1] - after
    size = np.where(leaves * returns > 0, np.minimum(np.abs(leaves), np.abs(returns)), 0.0)
    first = np.flatnonzero((size > SPIKE * usual) & (np.abs(before - after) < RETURN * size)) + 1
    return np.concatenate([first + i for i in range(width)])


def count_spikes(signal: Float[np.ndarray, "time"]) -> int:
    """Spikes of a signal, one for neighbouring samples.

    Args:
        signal: As `find_spikes` takes it.
    """
    found = find_spikes(signal)
    return len(found) and 1 + int((np.diff(found) > 1).sum())


def repair_spikes(signal: Float[np.ndarray, "time"]) -> Float[np.ndarray, "time"]:
    """The signal with a straight line in place of each spike.

    Args:
        signal: As `find_spikes` takes it.
    """
    repaired, found = signal.copy(), find_spikes(signal)
    others = np.delete(np.arange(len(signal)), found)
    repaired[found] = np.interp(found, others, signal[others])
    return repaired


def find_outliers(signal: Float[np.ndarray, "time"]) -> Bool[np.ndarray, "time"]:
    """Samples far beyond the range of the others, one or two in a row.

    Args:
        signal: Any, a held command too.
    """
    few = min(max(3, round(TOP * len(signal))), (len(signal) - 1) // 4)
    low, high = np.partition(signal, (few, len(signal) - 1 - few))[[few, -1 - few]]
    far = np.maximum(signal - high, low - signal) > FAR * (high - low)
    if not high > low:
        return np.zeros(len(signal), bool)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], far, [False]]).astype(int)))
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        far[first:last] = last - first <= WIDEST
    return far


def find_quantum(signal: Float[np.ndarray, "time"]) -> float | None:
    """Step of a quantised signal, None where it is not quantised.

    Args:
        signal: Samples; NaN are left out.
    """
    steps = np.abs(np.diff(signal))
    # What is left by arithmetic on the way from counts to radians is no step.
    steps = steps[np.isfinite(steps) & (steps > 1e-9 * np.nanmax(np.abs(signal), initial=1e-300))]
    if len(steps) < 2:
        return None
    small = steps[steps < 20 * steps.min()]
    quantum = float(np.median(small / np.round(small / steps.min())))
    ratio = steps / quantum
    few = ratio < 1000  # beyond, the rounding of the quantum itself decides
    whole = np.abs(ratio[few] - np.round(ratio[few])) < 0.1
    return quantum if whole.mean() >= QUANTISED else None


def find_lag(
    signal: Float[np.ndarray, "time"], reference: Float[np.ndarray, "time"], timestep: float
) -> tuple[float, float] | None:
    """Time by which a signal lags another, and its scale, by cross-correlation; None where they are not alike.

    Args:
        signal: Uniform samples.
        reference: What it may be a delayed copy of.
        timestep: Sample interval [s].

    Returns:
        Lag [s], to a fraction of a sample by a parabola through the peak; and signal over reference.
    """
    most = min(round(LONGEST_LAG / timestep), len(signal) // 4)
    if most < 1 or not (np.ptp(signal) > 0 and np.ptp(reference) > 0):
        return None
    inner = reference[most : len(reference) - most]
    windows = np.lib.stride_tricks.sliding_window_view(signal, len(inner))
    products, energy = windows @ inner, np.einsum("ij,ij->i", windows, windows)
    correlation = products / np.sqrt(np.maximum(energy, 1e-300) * max(float(inner @ inner), 1e-300))
    peak = int(np.argmax(correlation))
    if correlation[peak] < ALIKE or peak in (0, len(correlation) - 1):
        return None
    left, top, right = correlation[peak - 1 : peak + 2]
    fraction = 0.5 * (left - right) / (left - 2 * top + right) if left - 2 * top + right < 0 else 0.0
    return float(peak - most + fraction) * timestep, float(products[peak] / (inner @ inner))


def find_velocity_lag(
    time: Float[np.ndarray, "time"], position: Float[np.ndarray, "time"], velocity: Float[np.ndarray, "time"]
) -> tuple[float, float] | None:
    """Time by which a measured velocity lags the position's zero-phase derivative [s], and its scale against it.

    Args:
        time: Sample times [s]; jitter is taken out, the longest stretch without a gap counts.
        position: Measured position [rad or m].
        velocity: Measured velocity [rad/s or m/s].

    Returns:
        None where the recording is too short, or the two are no copies of each other.
    """
    grid, positions, velocities = regular_stretch(time, position, velocity)
    if len(grid) < 50:
        return None
    return find_lag(velocities, _derive(positions, float(grid[1] - grid[0])), float(grid[1] - grid[0]))


def regular_stretch(
    time: Float[np.ndarray, "time"], *signals: Float[np.ndarray, "time"]
) -> tuple[Float[np.ndarray, "grid"], ...]:
    """The longest stretch without a gap on a uniform grid of the median interval, the grid first.

    Args:
        time: Sample times [s].
        signals: Samples; those that are not finite are left out.
    """
    known = np.all([np.isfinite(signal) for signal in signals], axis=0)
    time, signals = time[known], tuple(signal[known] for signal in signals)
    if not (np.diff(time) > 0).any():
        return np.zeros(0), *(np.zeros(0) for _ in signals)
    new = np.concatenate([[True], np.diff(time) != 0])
    time, signals = time[new], tuple(signal[new] for signal in signals)
    edges = np.concatenate([[0], find_breaks(time, GAP), [len(time)]])
    longest = int(np.argmax(np.diff(edges)))
    cut = slice(edges[longest], edges[longest + 1])
    time = time[cut]
    grid = np.arange(time[0], time[-1], np.median(np.diff(time))) if len(time) > 1 else time
    return grid, *(np.interp(grid, time, signal[cut]) for signal in signals)


def derive_velocity(time: Float[np.ndarray, "time"], position: Float[np.ndarray, "time"]) -> Float[np.ndarray, "grid"]:
    """Velocity over the longest stretch without a gap, estimated from the position, on a uniform grid [rad/s or m/s].

    Args:
        time: Sample times [s].
        position: Measured position without spikes [rad or m].

    Returns:
        One zero for a recording that is too short.
    """
    grid, positions = regular_stretch(time, position)
    return _derive(positions, float(grid[1] - grid[0])) if len(grid) > 20 else np.zeros(1)


def _derive(position: Float[np.ndarray, "time"], timestep: float) -> Float[np.ndarray, "time"]:
    return estimate_velocity(position, timestep, min(0.1 / timestep, 50.0), ORDER, "")
