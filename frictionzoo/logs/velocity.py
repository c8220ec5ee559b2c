"""Velocity where none was measured, or where the measured one lags: from the position, without phase lag."""

import numpy as np
import scipy.signal
from jaxtyping import Float

from frictionzoo.core.errors import ConfigError, LogError, refuse_outside

MOST_ORDER = 20  # of a filter; above, its coefficients are rounding


def check_filter(section: str, cutoff: float, order: int) -> None:
    """Refuse a filter that is none.

    Args:
        section: Dotted key of the section that has `cutoff` and `order`.
        cutoff: Cut-off frequency [Hz].
        order: Of the filter.

    Raises:
        ConfigError: The cut-off is not positive, or the order is below 1 or above `MOST_ORDER`.
    """
    if not cutoff > 0:
        raise ConfigError(f"{section}.cutoff={cutoff}: expected a positive frequency in Hz")
    refuse_outside(f"{section}.order", order, 1, MOST_ORDER)


def estimate_velocity(
    position: Float[np.ndarray, "time"],
    timestep: float,
    cutoff: float,
    order: int,
    name: str,
    option: str = "data.cutoff",
) -> Float[np.ndarray, "time"]:
    """Velocity without phase lag: a zero-phase Butterworth low-pass, then central differences.

    Args:
        position: Measured position [rad or m].
        timestep: Sample interval [s].
        cutoff: Cut-off frequency [Hz]; the filter runs forwards and backwards, so the gain there is 1/2.
        order: Order of the filter, which running it twice doubles.
        name: The log's name, for messages.
        option: Where a user sets the cut-off, for messages.

    Raises:
        LogError: The log is too short to filter.
        ConfigError: The cut-off is not below half the sample rate, or so low that nothing would be left.
    """
    if not cutoff < 0.5 / timestep:
        raise ConfigError(
            f"{option}={cutoff:g}: expected less than half the sample rate, {0.5 / timestep:g} Hz; lower it, or set "
            "data.units.time"
        )
    sections = np.asarray(scipy.signal.butter(order, cutoff, fs=1 / timestep, output="sos"))
    padding = 3 * (2 * len(sections) + 1)  # scipy's default, which it refuses to use on a log that is not longer
    if len(position) <= padding:
        raise LogError(f"{name}: {len(position)} samples, expected more than {padding} to estimate the velocity")
    try:
        smooth = scipy.signal.sosfiltfilt(sections, position, padlen=padding)
    except np.linalg.LinAlgError:  # its coefficients are 0 but for rounding
        raise ConfigError(
            f"{option}={cutoff:g}: too low for a filter of order {order} at {1 / timestep:g} samples/s; raise it"
        ) from None
    return np.gradient(smooth, timestep)
