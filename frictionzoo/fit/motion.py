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
_RIPPLE, _POLES = 0.05, 7  # dB and order of the decimation filter; of an odd order, constants pass unchanged
FEWEST = 10  # samples that are kept in a log at the least
WIDER = 5.0  # times the bandwidth, the cut-off of the positions' filter
BANDWIDTH = 20.0
"""Frequency up to which torques are compared where nothing else is said [Hz]."""


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


@dataclass(frozen=True)
class Filtering:
    """How positions become velocities and accelerations, and up to which frequency torques are compared.

    Attributes:
        bandwidth: Frequency up to which torques are compared [Hz].
        cutoff: Of the low-pass of the positions [Hz]; None for `WIDER` times the bandwidth, so that what it takes from
            the accelerations lies above. Where the sample rate does not allow it, as high as that does.
        order: Of that filter, which running it forwards and backwards doubles.
        slow: Share of a joint's root mean square speed below which a sample does not count: what friction does where
            the motion turns round is not what it does in motion.
        option: Where a user sets them, for messages.

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
        """Position, velocity and acceleration from measured positions alone, without phase lag.

        A zero-phase Butterworth low-pass, then central differences.

        Source: M. Gautier, A. Janot, P.-O. Vandanjon, "A new closed-loop output error method for parameter
        identification of robot dynamics", 2013.

        Raises:
            LogError: The log is too short to filter.
            ConfigError: The cut-off does not suit the sample rate.
        """
        highest = PASSED * 0.5 / log.timestep
        cutoff = min(WIDER * self.bandwidth, highest) if self.cutoff is None else self.cutoff
        qpos = smooth(log.qpos, log.timestep, cutoff, self.order, log.name, f"{self.option}.cutoff")
        # The difference over two intervals, not two differences in a row: these would see twice as far.
        inner = (qpos[2:] - 2 * qpos[1:-1] + qpos[:-2]) / log.timestep**2
        return Motion(qpos, np.gradient(qpos, log.timestep, axis=0), np.pad(inner, ((1, 1), (0, 0)), mode="edge"))

    def is_moving(self, qvel: Float[np.ndarray, "rows nv"]) -> Bool[np.ndarray, "rows nv"]:
        """Which samples count, joint by joint."""
        return np.abs(qvel) > self.slow * np.sqrt(np.mean(np.square(qvel), axis=0))

    def decimation(self, logs: Sequence[Log]) -> "Decimation":
        """What torques of logs of one sample interval pass before they are compared.

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

    @property
    def rows(self) -> tuple[int, ...]:
        """How many samples of each log are left."""
        return tuple(len(range(self.edge, length - self.edge, self.factor)) for length in self.lengths)

    def __call__(self, signal: Float[np.ndarray, "time *shape"]) -> Float[np.ndarray, "rows *shape"]:
        """A signal of all logs, filtered and decimated log by log."""
        parts = np.split(signal, np.cumsum(self.lengths)[:-1])
        if self.factor > 1:
            sections = scipy.signal.cheby1(_POLES, _RIPPLE, PASSED / self.factor, output="sos")
            parts = [scipy.signal.sosfiltfilt(sections, part, axis=0) for part in parts]
        return np.concatenate([part[self.edge : len(part) - self.edge : self.factor] for part in parts])
