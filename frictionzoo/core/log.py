"""Recordings in SI units, and data sets of recordings."""

import hashlib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from frictionzoo.core.errors import LogError
from frictionzoo.core.state import Signals
from frictionzoo.core.telling import escape_controls

ABSURD = 1e9  # any signal above this in SI units is implausible
JITTER = 0.05  # largest deviation of a uniform sample interval from the median, as a share of the median

Origin = Literal["hardware", "simulated"]
ORIGINS: dict[str | None, bool | None] = {None: None, "hardware": False, "simulated": True}
"""Whether a simulator made the recordings, by the value of `data.origin`."""


def pool_origins(simulated: Iterable[bool | None]) -> Origin | None:
    """Return the origin of several recordings: simulated if one of them is; None: not stated."""
    stated = {*simulated}
    return "simulated" if True in stated else "hardware" if stated == {False} else None


class Payload(NamedTuple):
    """Payload of a drive: mass [kg], centre [m] in the carrying body's frame, inertia [kg m^2] about it."""

    mass: float
    position: tuple[float, float, float]
    inertia: tuple[float, float, float]


class Columns(NamedTuple):
    """Origin of the columns of one signal.

    Attributes:
        headers: Headers in the file, one a column.
        listed: Whether a user listed them; their order counts if they do not name the joints.
        by: How they were matched to the bench's joints: `name`, `listed` or `place`; empty before that.
    """

    headers: tuple[str, ...]
    listed: bool = False
    by: str = ""


@dataclass(frozen=True, repr=False)
class Log:
    """One recording of a drive in SI units.

    Attributes:
        name: Origin, for messages.
        time: Sample times [s], increasing by a constant interval.
        qpos: Joint position [rad or m].
        qvel: Joint velocity [rad/s or m/s], measured or estimated.
        ctrl: Command, one column an actuator, in the actuator law's unit.
        sha256: SHA-256 of the file or the generated data; any other text is replaced by the hash of the samples.
        simulated: Whether a simulator made it; None: not stated.
        payload: Payload of the drive.
        load: Effect of the payload on the bench's MuJoCo model, from `Bench.accept`.
        extras: Other recorded signals by name: supply [V], enable (0 or 1), temperature [degC].
        inputs: Further signals for the actuator law, by name, from `Bench.accept`.
        observed: Signals for the friction model, by name, from `Bench.accept`.
        velocity_estimated: Whether qvel of every joint was computed from qpos and adds no information.
        without_velocity: Joints, by number, whose qvel was computed from qpos.
        repairs: Changes made by cleaning, a sentence each.
        metadata: Other facts from the source (gains, notes).
        units: Stated unit of signals by name, before conversion to SI; others are missing.
        columns: Origin of the columns by signal; empty without a table. `Bench.accept` sorts them by joint.

    Raises:
        LogError: Shapes disagree, a sample is not finite or implausibly large, or time is not uniform.
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

    def __repr__(self) -> str:
        seconds, joints = self.samples * self.timestep, self.qpos.shape[1]
        extras = f", with {', '.join(self.extras)}" if self.extras else ""
        joint_count = f" of {joints} joints" if joints > 1 else ""
        size = f"{seconds:.4g} s, {self.samples} samples{joint_count} every {self.timestep:.4g} s"
        return escape_controls(f"{self.name}: {size}{extras}")

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
            self._refuse_impossible(signal)
        self._refuse_uneven_time()
        if not re.fullmatch("[0-9a-f]{64}", self.sha256):
            arrays = (self.time, self.qpos, self.qvel, self.ctrl)
            object.__setattr__(self, "sha256", hashlib.sha256(b"".join(map(np.ndarray.tobytes, arrays))).hexdigest())

    def _refuse_impossible(self, signal: str) -> None:
        values = getattr(self, signal).reshape(self.samples, -1)
        bad = ~np.isfinite(values).all(axis=1)
        if bad.any():
            raise LogError(
                f"{self.name}: {signal} is NaN or infinite in {bad.sum()} of {len(bad)} samples, first at sample "
                f"{int(np.argmax(bad))}; expected finite values; cut or repair the log"
            )
        size = np.abs(values).max(axis=1)
        if (size > ABSURD).any():
            i = int(np.argmax(size))
            raise LogError(
                f"{self.name}: {signal} is {size[i]:.3g} at sample {i}, expected at most {ABSURD:g} of any unit; "
                "cut or repair the log"
            )

    def _refuse_uneven_time(self) -> None:
        steps = np.diff(self.time)
        if (steps <= 0).any():
            i = int(np.argmax(steps <= 0))
            fault = "repeats" if steps[i] == 0 else "runs backwards"
            raise LogError(
                f"{self.name}: time {fault} at sample {i + 1} ({self.time[i]:.6g} s, then {self.time[i + 1]:.6g} s); "
                "expected increasing times; sort the log or drop the samples"
            )
        uneven = np.abs(steps - np.median(steps)) > JITTER * np.median(steps)
        if uneven.any():
            i = int(np.argmax(uneven))
            raise LogError(
                f"{self.name}: {steps[i]:.6g} s between samples {i} and {i + 1}, expected {np.median(steps):.6g} s "
                "everywhere; resample the log to a constant step"
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
        """Signals that drive a simulation."""
        return Signals(self.ctrl, dict(self.inputs), dict(self.observed))

    def between(self, start: int, stop: int, part: str) -> "Log":
        """Return the samples from start up to, not including, stop, under the name `NAME[part]`."""
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
    """Recordings to fit on (`train`) and other recordings to evaluate on (`test`)."""

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
