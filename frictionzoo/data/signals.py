"""Signal analysis: breaks, spikes, outliers, quantum, noise, lag and velocity."""

import math

import numpy as np
import scipy.interpolate
import scipy.signal
from jaxtyping import Bool, Float, Int

from frictionzoo.core.errors import ConfigError, LogError, refuse_outside

FOLLOWED = 1e-6  # tolerance of equal times, as a share of the median interval
GAP = 5.0  # median intervals; a longer interval is a gap
SPIKE = 20.0  # least distance of a spike from both neighbours, in usual second differences
FAR = 1.0  # least distance of an outlier from the range of the other samples, in ranges
RETURN = 0.5  # largest difference of a spike's neighbours, as a share of its distance from them
WIDEST = 2  # samples of a spike; a longer excursion may be motion
QUANTISED = 0.9  # least share of steps between samples that are multiples of the quantum
TOP = 0.001  # share of the samples on either side outside the range of a signal
LONGEST_LAG = 0.1  # s; searched on either side
ALIKE = 0.9  # least correlation of two signals that are delayed copies of each other
ORDER = 2  # of the filter for velocity; its cut-off is a tenth of the sample rate, at most 50 Hz
_DIFFERENCES = 6  # largest order of differences used to estimate noise
JUMPED = 0.8  # smallest jump of a wrapped position, as a share of its range
BESIDE = 0.25  # largest motion beside a jump, as a share of the jump
SAME_PERIOD = 0.02  # relative difference of periods that are the same
ENCODERS = range(9, 25)  # bits of an encoder whose turn is a power of two
MOST_ORDER = 20  # of a filter; at higher orders its coefficients are rounding errors

Signal = Float[np.ndarray, "time"]
"""Samples of one signal, or their times [s]."""
Grid = Float[np.ndarray, "grid"]
Samples = Float[np.ndarray, "time *columns"]


def find_breaks(time: Signal, gap: float) -> Int[np.ndarray, "breaks"]:
    """Return the first samples after a backward time step or one above `gap` median intervals."""
    steps = np.diff(time)
    return np.flatnonzero((steps < 0) | (steps > gap * np.median(steps[steps > 0]))) + 1


def find_spikes(signal: Signal) -> Int[np.ndarray, "spikes"]:
    """Find spikes: one or two samples off their neighbours in the same direction, with neighbours close to each other.

    The threshold scales with the median second difference and the smallest step, so fast smooth motion is no spike. Use
    it only for a position, or another signal that cannot jump and return.
    """
    second = np.abs(np.diff(signal, 2))
    steps = np.abs(np.diff(signal))
    if not np.isfinite(second).any() or not (steps > 0).any():
        return np.zeros(0, int)
    usual = max(float(np.nanmedian(second)), float(steps[steps > 0].min()))
    spikes = [_find_spikes_of(signal, usual, width) for width in range(1, WIDEST + 1)]
    return np.unique(np.concatenate(spikes))


def _find_spikes_of(signal: Signal, usual: float, width: int) -> Int[np.ndarray, "spikes"]:
    before, after = signal[: -width - 1], signal[width + 1 :]
    leaves, returns = signal[1:-width] - before, signal[width:-1] - after
    size = np.where(leaves * returns > 0, np.minimum(np.abs(leaves), np.abs(returns)), 0.0)
    starts = np.flatnonzero((size > SPIKE * usual) & (np.abs(before - after) < RETURN * size)) + 1
    return np.concatenate([starts + i for i in range(width)])


def count_spikes(signal: Signal) -> int:
    """Count the spikes from `find_spikes`; adjacent samples count as one."""
    spikes = find_spikes(signal)
    return len(spikes) and 1 + int((np.diff(spikes) > 1).sum())


def repair_spikes(signal: Signal) -> Signal:
    """Interpolate linearly across each spike from `find_spikes`."""
    repaired, spikes = signal.copy(), find_spikes(signal)
    others = np.delete(np.arange(len(signal)), spikes)
    repaired[spikes] = np.interp(spikes, others, signal[others])
    return repaired


def find_outliers(signal: Signal) -> Bool[np.ndarray, "time"]:
    """Find one or two successive samples far outside the range of the others; for any signal, held commands too."""
    tail = min(max(3, round(TOP * len(signal))), (len(signal) - 1) // 4)
    low, high = np.partition(signal, (tail, len(signal) - 1 - tail))[[tail, -1 - tail]]
    far = np.maximum(signal - high, low - signal) > FAR * (high - low)
    if not high > low:
        return np.zeros(len(signal), bool)
    for first, last in np.flatnonzero(np.diff(far, prepend=False, append=False)).reshape(-1, 2):
        far[first:last] = last - first <= WIDEST
    return far


def find_wrap(position: Signal) -> float | None:
    """Return the period with which a position wraps; None if it does not wrap.

    Motion beside a jump is small and goes the other way. A period near a turn in radians, degrees, turns or ticks is
    that turn; another one must occur twice.
    """
    steps = np.diff(position[np.isfinite(position)])
    if len(steps) < 3:
        return None
    before, jump, after = steps[:-2], steps[1:-1], steps[2:]
    motion, beside = (before + after) / 2, np.maximum(np.abs(before), np.abs(after))
    jumps = (np.abs(jump) > JUMPED * float(np.ptp(position[np.isfinite(position)]))) & (jump * motion < 0)
    jumps &= beside < BESIDE * np.abs(jump)
    periods = np.abs(jump - motion)[jumps]
    if not len(periods):
        return None
    period = float(np.median(periods))
    known = [math.tau, 360.0, 1.0, *(2.0**bits for bits in ENCODERS)]
    nearest = min(known, key=lambda turn: abs(math.log(period / turn)))
    if abs(period / nearest - 1) < SAME_PERIOD:
        return nearest
    return period if len(periods) > 1 and np.ptp(periods) < SAME_PERIOD * period else None


def unwrap(position: Signal, period: float | None) -> Signal:
    """Return a position without its jumps by a period; None changes nothing, and missing samples stay missing."""
    unwrapped, finite = position.copy(), np.isfinite(position)
    if period is not None:
        unwrapped[finite] = np.unwrap(position[finite], period=period)
    return unwrapped


def find_quantum(signal: Signal) -> float | None:
    """Return the step of a quantised signal, ignoring NaN; None if it is not quantised."""
    steps = np.abs(np.diff(signal))
    # Rounding errors from the conversion of counts to radians are not steps.
    steps = steps[np.isfinite(steps) & (steps > 1e-9 * np.nanmax(np.abs(signal), initial=1e-300))]
    if len(steps) < 2:
        return None
    small = steps[steps < 20 * steps.min()]
    quantum = float(np.median(small / np.round(small / steps.min())))
    ratio = steps / quantum
    reliable = ratio < 1000  # beyond, the quantum's rounding error decides
    is_multiple = np.abs(ratio[reliable] - np.round(ratio[reliable])) < 0.1
    return quantum if is_multiple.mean() >= QUANTISED else None


def find_noise(signal: Signal) -> float:
    """Return the standard deviation of the white noise in a smooth signal, in the signal's unit.

    The difference of order d removes polynomials of lower order and multiplies the noise variance by the binomial
    coefficient (2 d, d). The smallest estimate of all orders up to `_DIFFERENCES` is used. Quantisation counts as noise
    with a variance of one twelfth of the squared step.

    Source: P. Hall, J. Kay, D. Titterington, "Asymptotically optimal difference-based estimation of variance in
    nonparametric regression", Biometrika 77(3), 1990.
    """
    orders = range(1, min(_DIFFERENCES, len(signal) - 1) + 1)
    variances = [float(np.square(np.diff(signal, order)).mean()) / math.comb(2 * order, order) for order in orders]
    rounding = (find_quantum(signal) or 0.0) / math.sqrt(12)
    return max(math.sqrt(min(variances, default=0.0)), rounding)


def find_lag(signal: Signal, reference: Signal, timestep: float) -> tuple[float, float] | None:
    """Return the lag of a signal behind a reference [s] and its scale against it; None if they are not alike.

    The lag is the peak of the cross-correlation of uniform samples, `timestep` [s] apart, refined by a parabola. Noise
    in the reference lowers the slope of the signal's regression on it; noise in the signal raises the inverse slope of
    the reverse regression. The scale lies between the two; the value nearest to 1 is returned.

    Source: R. Frisch, "Statistical confluence analysis by means of complete regression systems", 1934, for the bounds.
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
    scale = np.clip(1.0, products[peak] / (inner @ inner), energy[peak] / products[peak])
    return float(peak - most + fraction) * timestep, float(scale)


def find_velocity_lag(time: Signal, position: Signal, velocity: Signal) -> tuple[float, float] | None:
    """Return a measured velocity's lag behind the position's zero-phase derivative [s] and its scale against it.

    None if the longest stretch without a gap is too short, or the two are not alike there.
    """
    grid, positions, velocities = regular_stretch(time, position, velocity)
    if len(grid) < 50:
        return None
    return find_lag(velocities, _derive(positions, float(grid[1] - grid[0])), float(grid[1] - grid[0]))


def regular_stretch(time: Signal, *signals: Signal) -> tuple[Grid, ...]:
    """Resample the longest stretch without a gap to a uniform grid of the median interval; return grid [s] and signals.

    Samples at which any signal is not finite are left out.
    """
    finite = np.all([np.isfinite(signal) for signal in signals], axis=0)
    time, signals = time[finite], tuple(signal[finite] for signal in signals)
    if not (np.diff(time) > 0).any():
        return np.zeros(0), *(np.zeros(0) for _ in signals)
    is_new = np.concatenate([[True], np.diff(time) != 0])
    time, signals = time[is_new], tuple(signal[is_new] for signal in signals)
    edges = np.concatenate([[0], find_breaks(time, GAP), [len(time)]])
    longest = int(np.argmax(np.diff(edges)))
    cut = slice(edges[longest], edges[longest + 1])
    time = time[cut]
    grid = np.arange(time[0], time[-1], np.median(np.diff(time))) if len(time) > 1 else time
    return grid, *(np.interp(grid, time, signal[cut]) for signal in signals)


def derive_velocity(time: Signal, position: Signal) -> Grid:
    """Derive the velocity on the grid of `regular_stretch` [rad/s or m/s]; a single 0 if that is too short."""
    grid, positions = regular_stretch(time, position)
    return _derive(positions, float(grid[1] - grid[0])) if len(grid) > 20 else np.zeros(1)


def _derive(position: Signal, timestep: float) -> Signal:
    return estimate_velocity(position, timestep, min(0.1 / timestep, 50.0), ORDER, "")


def check_filter(section: str, cutoff: float, order: int) -> None:
    """Refuse an impossible cut-off [Hz] or order of a filter; `section` is the dotted key of the options.

    Raises:
        ConfigError: The cut-off is not positive, or the order is below 1 or above `MOST_ORDER`.
    """
    if not cutoff > 0:
        raise ConfigError(f"{section}.cutoff={cutoff}: expected a positive frequency in Hz")
    refuse_outside(f"{section}.order", order, 1, MOST_ORDER)


def smooth(signal: Samples, timestep: float, cutoff: float, order: int, name: str, option: str) -> Samples:
    """Filter uniform samples, each column separately, with a zero-phase Butterworth low-pass.

    It runs forwards and backwards, so the gain at `cutoff` [Hz] is 1/2, and the two passes double `order`. `name` of
    the log and `option` of the cut-off are for messages; `timestep` is in s.

    Raises:
        LogError: The log is too short to filter.
        ConfigError: The cut-off is not below half the sample rate, or too low for the order.
    """
    if not cutoff < 0.5 / timestep:
        raise ConfigError(
            f"{option}={cutoff:g}: expected less than half the sample rate, {0.5 / timestep:g} Hz; lower it, or set "
            "data.units.time"
        )
    sections = np.asarray(scipy.signal.butter(order, cutoff, fs=1 / timestep, output="sos"))
    padding = 3 * (2 * len(sections) + 1)  # SciPy's default, which needs a longer log
    if len(signal) <= padding:
        raise LogError(f"{name}: {len(signal)} samples, expected more than {padding} to filter them")
    try:
        return scipy.signal.sosfiltfilt(sections, signal, axis=0, padlen=padding)
    except np.linalg.LinAlgError:  # the coefficients are 0 except for rounding
        raise ConfigError(
            f"{option}={cutoff:g}: too low for a filter of order {order} at {1 / timestep:g} samples/s; raise it"
        ) from None


def estimate_velocity(
    position: Signal, timestep: float, cutoff: float, order: int, name: str, option: str = "data.cutoff"
) -> Signal:
    """Estimate velocity [rad/s or m/s] by `smooth` and central differences; arguments and errors as `smooth`."""
    return np.gradient(smooth(position, timestep, cutoff, order, name, option), timestep)


def sample_signal(values: Signal, time: Signal, at: Grid, method: str) -> Grid:
    """Return a signal's values at other times [s]: `held`, `linear`, `cubic`, or the `mean` of the held signal."""
    if method == "held":
        tolerance = FOLLOWED * float(np.median(np.diff(time))) if len(time) > 1 else 0.0
        return values[np.maximum(np.searchsorted(time, at + tolerance, side="right") - 1, 0)]
    if method == "cubic" and len(time) > 3:
        return scipy.interpolate.CubicSpline(time, values)(np.clip(at, time[0], time[-1]))
    if method == "mean":  # of the held signal over each interval of the uniform grid
        step = float(at[-1] - at[0]) / (len(at) - 1) if len(at) > 1 else float(np.median(np.diff(time)))
        edges = np.append(time, time[-1] + step)
        integral = np.append(0.0, np.cumsum(values * np.diff(edges)))
        return np.diff(np.interp(np.append(at, at[-1] + step), edges, integral)) / step
    return np.interp(at, time, values)
