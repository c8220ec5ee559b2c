"""Recordings in SI units, and data sets of them."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from frictionzoo.core.errors import LogError
from frictionzoo.core.state import Signals

ABSURD = 1e9  # of any signal in SI units; a drive's are far below
JITTER = 0.05  # largest deviation of a sample interval from the median, as a share of it, that still counts as uniform

Origin = Literal["hardware", "simulated"]
ORIGINS: dict[str | None, bool | None] = {None: None, "hardware": False, "simulated": True}
"""Whether a simulator made recordings, by what `data.origin` states."""


def pool_origins(simulated: Iterable[bool | None]) -> Origin | None:
    """Return the origin of several recordings: one that a simulator made makes them simulated; None: not stated."""
    stated = {*simulated}
    return "simulated" if True in stated else "hardware" if stated == {False} else None


class Payload(NamedTuple):
    """What a drive carried in one recording besides the bench's own bodies.

    Attributes:
        mass: [kg].
        position: Centre of mass in the frame of the body that carries it [m].
        inertia: About that centre, along the frame's axes [kg m^2].
    """

    mass: float
    position: tuple[float, float, float]
    inertia: tuple[float, float, float]


class Columns(NamedTuple):
    """Where the columns of one signal come from.

    Attributes:
        headers: Of the file, one a column.
        listed: Whether a user listed them, so that their order counts where they do not name the joints.
        by: How they were brought into the order of a bench's joints: `name`, `listed` or `place`; empty before that.
    """

    headers: tuple[str, ...]
    listed: bool = False
    by: str = ""


@dataclass(frozen=True)
class Log:
    """One recording of a drive in SI units.

    Attributes:
        name: Where it came from, for messages.
        time: Sample times [s], increasing by one constant interval.
        qpos: Joint position [rad or m].
        qvel: Joint velocity [rad/s or m/s], measured or estimated.
        ctrl: Command, one column an actuator, in the actuator law's unit.
        sha256: Hash of what was read or made.
        simulated: Whether a simulator made it; False: recorded on hardware; None: not stated.
        payload: What the drive carried; None for nothing.
        load: What that changes in the bench's model, of shape (load,); `Bench.accept` computes it.
        extras: Other signals that were recorded with it, by name: supply [V], enable (0 or 1), temperature [degC], each
            of shape (time, columns).
        inputs: Those that the bench's actuator law needs besides the command, by name; `Bench.accept` picks them.
        observed: Those that the friction law looks at, by name; `Bench.accept` picks them too.
        velocity_estimated: Whether qvel was computed from qpos, so that it says nothing of its own.
        without_velocity: Joints, by number, whose qvel was computed from qpos because what was recorded shows nothing.
        repairs: What cleaning changed, a sentence each.
        metadata: What else the source says about it (gains, notes).
        units: Unit of signals by name, as the source or the user stated them, before they became SI; of those alone of
            which somebody said it.
        columns: Where the columns of signals come from, by the signal; empty for a log that came from no table.
            `Bench.accept` brings them into the order of its joints.

    Raises:
        LogError: Shapes disagree, a sample is not finite, or time is not uniform.
    """

    name: str
    time: Float[np.ndarray, "time"]
    qpos: Float[np.ndarray, "time nv"]
    qvel: Float[np.ndarray, "time nv"]
    ctrl: Float[np.ndarray, "time nu"]
    sha256: str
    simulated: bool | None
    payload: Payload | None = None
    load: Float[np.ndarray, "load"] = field(default_factory=lambda: np.zeros(0))
    extras: Mapping[str, Float[np.ndarray, "time _"]] = field(default_factory=dict)
    inputs: Mapping[str, Float[np.ndarray, "time nv"]] = field(default_factory=dict)
    observed: Mapping[str, Float[np.ndarray, "time nv"]] = field(default_factory=dict)
    velocity_estimated: bool = False
    without_velocity: tuple[int, ...] = ()
    repairs: tuple[str, ...] = ()
    metadata: Mapping[str, Any] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    columns: Mapping[str, Columns] = field(default_factory=dict)

    def __post_init__(self) -> None:
        samples = len(self.time)
        if samples < 2:
            raise LogError(f"{self.name}: {samples} samples, expected at least 2; record a longer log")
        for signal in ("qpos", "qvel", "ctrl"):
            values = getattr(self, signal)
            if values.ndim != 2 or len(values) != samples:
                raise LogError(
                    f"{self.name}: {signal} has shape {values.shape}, expected ({samples}, columns) as time has; "
                    "check the columns"
                )
        if self.qvel.shape != self.qpos.shape:
            raise LogError(
                f"{self.name}: qvel has {self.qvel.shape[1]} columns and qpos {self.qpos.shape[1]}, expected as many; "
                "check the columns"
            )
        for signal in ("time", "qpos", "qvel", "ctrl"):
            self._refuse_nonfinite(signal)
            self._refuse_absurd(signal)
        self._refuse_uneven_time()

    def _refuse_nonfinite(self, signal: str) -> None:
        values = getattr(self, signal)
        bad = ~np.isfinite(values.reshape(len(values), -1)).all(axis=1)
        if bad.any():
            raise LogError(
                f"{self.name}: {signal} is NaN or infinite in {bad.sum()} of {len(bad)} samples, first at sample "
                f"{int(np.argmax(bad))}; expected finite values; cut or repair the log"
            )

    def _refuse_absurd(self, signal: str) -> None:
        size = np.abs(getattr(self, signal)).reshape(self.samples, -1).max(axis=1)
        if (size > ABSURD).any():
            at = int(np.argmax(size))
            raise LogError(
                f"{self.name}: {signal} is {size[at]:.3g} at sample {at}, expected at most {ABSURD:g} of any unit; "
                "cut or repair the log"
            )

    def _refuse_uneven_time(self) -> None:
        steps = np.diff(self.time)
        if (steps <= 0).any():
            at = int(np.argmax(steps <= 0))
            what = "repeats" if steps[at] == 0 else "runs backwards"
            raise LogError(
                f"{self.name}: time {what} at sample {at + 1} ({self.time[at]:.6g} s, then {self.time[at + 1]:.6g} s); "
                "expected increasing times; sort the log or drop the samples"
            )
        uneven = np.abs(steps - np.median(steps)) > JITTER * np.median(steps)
        if uneven.any():
            at = int(np.argmax(uneven))
            raise LogError(
                f"{self.name}: {steps[at]:.6g} s between samples {at} and {at + 1}, expected {np.median(steps):.6g} s "
                f"everywhere; resample the log to a constant step"
            )

    @property
    def timestep(self) -> float:
        """Sample interval [s]."""
        return float((self.time[-1] - self.time[0]) / (len(self.time) - 1))

    @property
    def samples(self) -> int:
        """Number of samples."""
        return len(self.time)

    @property
    def signals(self) -> Signals:
        """What drives a simulation."""
        return Signals(self.ctrl, dict(self.inputs), dict(self.observed))

    def between(self, start: int, stop: int, part: str) -> "Log":
        """The samples from start up to, not including, stop, under the name `NAME[part]`."""
        cut = slice(start, stop)
        return replace(
            self,
            name=f"{self.name}[{part}]",
            time=self.time[cut],
            qpos=self.qpos[cut],
            qvel=self.qvel[cut],
            ctrl=self.ctrl[cut],
            **{
                part: {name: values[cut] for name, values in getattr(self, part).items()}
                for part in ("extras", "inputs", "observed")
            },
        )


@dataclass(frozen=True)
class Dataset:
    """Recordings to fit on and other recordings to judge on.

    Attributes:
        name: The data set's name.
        train: Logs that a fit may see.
        test: Logs that only the evaluation sees.
    """

    name: str
    train: tuple[Log, ...]
    test: tuple[Log, ...]

    def __post_init__(self) -> None:
        for part in ("train", "test"):
            if not getattr(self, part):
                raise LogError(f"{self.name}: the {part} part is empty; change data.split so that both parts have data")

    @property
    def logs(self) -> tuple[Log, ...]:
        """All logs, train first."""
        return self.train + self.test
