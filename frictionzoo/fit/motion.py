"""Recordings of a fit, and their motion and torque for inverse dynamics: zero-phase filters and decimation."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.signal
from jaxtyping import Bool, Float

from frictionzoo.bench import Bench
from frictionzoo.core.errors import ConfigError, LogError, refuse_outside
from frictionzoo.core.log import Log
from frictionzoo.data.signals import check_filter, smooth
from frictionzoo.models import FrictionModel

PASSED = 0.8  # pass band of the decimation filter, as a share of half the decimated sample rate
_RIPPLE, _POLES = 0.05, 7  # ripple in dB and order of the decimation filter; an odd order passes constants unchanged
FEWEST = 10  # least number of decimated samples in a log
WIDER = 5.0  # cut-off of the positions' filter as a multiple of the bandwidth
BANDWIDTH = 20.0
"""Default frequency up to which torques are compared [Hz]."""


class Recordings(NamedTuple):
    """Bench, model and logs of a fit, ready for each other, for methods that need more than segments."""

    bench: Bench
    model: FrictionModel
    logs: tuple[Log, ...]


class Motion(NamedTuple):
    """Position [rad or m], velocity [rad/s or m/s] and acceleration [rad/s^2 or m/s^2] of the joints."""

    qpos: Float[np.ndarray, "time nv"]
    qvel: Float[np.ndarray, "time nv"]
    qacc: Float[np.ndarray, "time nv"]


@dataclass(frozen=True)
class Filtering:
    """Filter settings for positions, their derivatives and torques.

    Attributes:
        bandwidth: Frequency up to which torques are compared [Hz].
        cutoff: Cut-off of the low-pass filter of the positions [Hz]; None for `WIDER` times the bandwidth, so that
            accelerations below the bandwidth pass, or less if the sample rate requires it.
        order: Order of that filter, which running it forwards and backwards doubles.
        slow: Share of a joint's root mean square speed below which a sample does not count, because friction differs
            where the motion reverses.
        option: Prefix of the options in error messages.

    Raises:
        ConfigError: A value is out of range.
    """

    bandwidth: float = BANDWIDTH
    cutoff: float | None = None
    order: int = 4
    slow: float = 0.025
    option: str = "fit"

    def __post_init__(self) -> None:
        if not self.bandwidth > 0:
            raise ConfigError(f"{self.option}.bandwidth={self.bandwidth:g}; expected a positive frequency in Hz")
        check_filter(self.option, self.bandwidth if self.cutoff is None else self.cutoff, self.order)
        refuse_outside(f"{self.option}.slow", self.slow, 0, 1)

    def motion(self, log: Log) -> Motion:
        """Return motion from measured positions: a zero-phase Butterworth low-pass filter, then central differences.

        Source: M. Gautier, A. Janot, P.-O. Vandanjon, "A new closed-loop output error method for parameter
        identification of robot dynamics", 2013.

        Raises:
            LogError: The log is too short to filter.
            ConfigError: The cut-off does not suit the sample rate.
        """
        highest = PASSED * 0.5 / log.timestep
        cutoff = min(WIDER * self.bandwidth, highest) if self.cutoff is None else self.cutoff
        qpos = smooth(log.qpos, log.timestep, cutoff, self.order, log.name, f"{self.option}.cutoff")
        # The second difference over two intervals; two first differences in a row would span four.
        qacc = (qpos[2:] - 2 * qpos[1:-1] + qpos[:-2]) / log.timestep**2
        return Motion(qpos, np.gradient(qpos, log.timestep, axis=0), np.pad(qacc, ((1, 1), (0, 0)), mode="edge"))

    def is_moving(self, qvel: Float[np.ndarray, "rows nv"]) -> Bool[np.ndarray, "rows nv"]:
        """Return which samples count, joint by joint."""
        return np.abs(qvel) > self.slow * np.sqrt(np.mean(np.square(qvel), axis=0))

    def decimation(self, logs: Sequence[Log]) -> "Decimation":
        """Return the filter and decimation for torques of logs with one common sample interval.

        Raises:
            LogError: A log is too short.
        """
        rate = 1 / logs[0].timestep
        factor, edge = max(1, int(PASSED * rate / (2 * self.bandwidth))), int(np.ceil(rate / self.bandwidth))
        for log in logs:
            if log.samples < 2 * edge + FEWEST * factor:
                raise LogError(
                    f"{log.name}: {log.samples} samples, expected at least {2 * edge + FEWEST * factor} with "
                    f"{self.option}.bandwidth={self.bandwidth:g} Hz; raise it, or leave the log out"
                )
        return Decimation(factor, tuple(log.samples for log in logs), edge)


@dataclass(frozen=True)
class Decimation:
    """Low-pass filter and decimation for both sides of the torque equation; the samples kept are nearly independent.

    The filter removes torque noise and ripple above the bandwidth. It is linear and the same for every term, so the
    equation still holds.

    Source: M. Gautier, "Dynamic identification of robots with power model", 1997, the parallel decimate filter.

    Attributes:
        factor: One of `factor` samples is kept.
        lengths: Number of samples of each log.
        edge: Number of samples dropped at each end of a log, where the filters see one side only.
    """

    factor: int
    lengths: tuple[int, ...]
    edge: int

    @property
    def rows(self) -> tuple[int, ...]:
        """Number of samples kept from each log."""
        return tuple(len(range(self.edge, length - self.edge, self.factor)) for length in self.lengths)

    def __call__(self, signal: Float[np.ndarray, "time *shape"]) -> Float[np.ndarray, "rows *shape"]:
        """Filter and decimate a signal of all logs, log by log."""
        parts = np.split(signal, np.cumsum(self.lengths)[:-1])
        if self.factor > 1:
            sections = scipy.signal.cheby1(_POLES, _RIPPLE, PASSED / self.factor, output="sos")
            parts = [scipy.signal.sosfiltfilt(sections, part, axis=0) for part in parts]
        return np.concatenate([part[self.edge : len(part) - self.edge : self.factor] for part in parts])
