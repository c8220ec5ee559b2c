"""Motion and torque of recordings as inverse dynamics needs them: without phase lag, and decimated alike."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.signal
from jaxtyping import Bool, Float

from frictionzoo.core.errors import ConfigError, LogError, refuse_outside
from frictionzoo.core.log import Log
from frictionzoo.logs.signals import check_filter, smooth

PASSED = 0.8  # of half the rate that is kept, up to which the decimation filter passes
_RIPPLE, _POLES = 0.05, 8  # dB and order of the decimation filter
_LOW = 2  # samples that are kept in a log at the least


class Motion(NamedTuple):
    """How joints moved, each of shape (time, nv).

    Attributes:
        qpos: [rad or m].
        qvel: [rad/s or m/s].
        qacc: [rad/s^2 or m/s^2].
    """

    qpos: Float[np.ndarray, "time nv"]
    qvel: Float[np.ndarray, "time nv"]
    qacc: Float[np.ndarray, "time nv"]


def estimate_motion(log: Log, cutoff: float, order: int, option: str = "fit.cutoff") -> Motion:
    """Position, velocity and acceleration from measured positions alone, without phase lag.

    A zero-phase Butterworth low-pass, then central differences twice.

    Source: M. Gautier, A. Janot, P.-O. Vandanjon, "A new closed-loop output error method for parameter identification
    of robot dynamics", 2013, section II.

    Args:
        log: The recording.
        cutoff: Cut-off frequency [Hz].
        order: Order of the filter, which running it twice doubles.
        option: Where a user sets the cut-off, for messages.

    Raises:
        LogError: The log is too short to filter.
        ConfigError: The cut-off does not suit the sample rate.
    """
    check_filter(option.rpartition(".")[0], cutoff, order)
    qpos = smooth(log.qpos, log.timestep, cutoff, order, log.name, option)
    # One central difference over two intervals, not two in a row: half as much noise is let through.
    inner = (qpos[2:] - 2 * qpos[1:-1] + qpos[:-2]) / log.timestep**2
    return Motion(qpos, np.gradient(qpos, log.timestep, axis=0), np.pad(inner, ((1, 1), (0, 0)), mode="edge"))


@dataclass(frozen=True)
class Decimation:
    """The same low-pass on both sides of an equation, and then few samples, which are next to independent.

    What lies above the bandwidth, a torque's noise and ripple, is left out of the comparison; since the filter is
    linear and the same for every term, nothing is distorted.

    Source: M. Gautier, "Dynamic identification of robots with power model", 1997, the parallel decimate filter.

    Attributes:
        factor: Of as many samples, one is kept.
        lengths: Samples of each log, one after the other.
        edge: Samples at either end of a log that are left out, for the filters know one side only there.
    """

    factor: int
    lengths: tuple[int, ...]
    edge: int

    @classmethod
    def of(cls, logs: Sequence[Log], bandwidth: float, option: str = "fit.bandwidth") -> "Decimation":
        """The decimation for logs of one sample interval.

        Args:
            logs: Recordings.
            bandwidth: Frequency up to which torques are compared [Hz].
            option: Where a user sets it, for messages.

        Raises:
            ConfigError: It is not positive, or leaves too few samples.
        """
        rate = 1 / logs[0].timestep
        refuse_outside(option, bandwidth, 0, rate)
        if not bandwidth > 0:
            raise ConfigError(f"{option}={bandwidth:g}: expected a positive frequency in Hz")
        factor = max(1, int(PASSED * rate / (2 * bandwidth)))
        edge = int(np.ceil(rate / bandwidth))
        made = cls(factor, tuple(log.samples for log in logs), edge)
        for log in logs:
            if log.samples <= 2 * edge + _LOW * factor:
                raise LogError(
                    f"{log.name}: {log.samples} samples, expected more than {2 * edge + _LOW * factor} with {option}="
                    f"{bandwidth:g} Hz; raise it or leave the log out"
                )
        return made

    def __call__(self, signal: Float[np.ndarray, "time *shape"]) -> Float[np.ndarray, "rows *shape"]:
        """A signal of all logs, filtered and decimated log by log."""
        parts = np.split(signal, np.cumsum(self.lengths)[:-1])
        if self.factor > 1:
            sections = scipy.signal.cheby1(_POLES, _RIPPLE, PASSED / self.factor, output="sos")
            parts = [scipy.signal.sosfiltfilt(sections, part, axis=0) for part in parts]
        return np.concatenate([part[self.edge : len(part) - self.edge : self.factor] for part in parts])


def is_moving(qvel: Float[np.ndarray, "rows nv"], slow: float) -> Bool[np.ndarray, "rows nv"]:
    """Where a joint's speed is above a share of its root mean square: where the direction of friction is known."""
    return np.abs(qvel) > slow * np.sqrt(np.mean(np.square(qvel), axis=0))
