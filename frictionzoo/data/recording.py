"""Recordings before cleaning: the columns of a file, and signals in SI units."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Real

from frictionzoo.core.errors import LogError
from frictionzoo.core.log import Columns

COMMANDS = ("ctrl", "ctrl_velocity", "ctrl_torque", "kp", "kd")
"""Commands to a drive: main command, desired velocity, feed-forward torque and gains."""

SIGNALS = ("time", "qpos", "qvel", *COMMANDS, "torque", "supply", "enable", "temperature")
"""Signals that a column may contain; time, qpos and ctrl are required, the others optional."""

TURNED = ("qpos", "qvel", "ctrl", "ctrl_velocity", "ctrl_torque", "torque")
"""Signals whose sign depends on the direction of motion."""

HELD = (*COMMANDS, "enable")
"""Signals held constant until the next sample; the others are continuous."""


@dataclass(frozen=True)
class Table:
    """Contents of a file, with the file's names and units.

    Attributes:
        name: Origin, for messages; `ARCHIVE!MEMBER` for a member of an archive.
        columns: Samples by header; lengths differ if signals were recorded at different times. float64, or int64 if
            float64 would round (nanoseconds since 1970).
        fields: Values for the whole recording, such as gains, payload, trajectory.
        sha256: Hash of the bytes that were read.
        refused: Error messages for unusable columns, by header.
        times: Header of the time column, by the header of a column with separate times.
        units: Units that the format specifies, by header.
        signals: Signals that the format specifies, by header; empty: none; `effort`: a torque, commanded or measured.
        motors: Makers' packages of messages with numbers of motors, by header, see `frictionzoo.data.presets`.
        notes: Assumptions of the reading, a sentence each.
        is_joined: Whether it joins several files, whose time columns `times` has.
    """

    name: str
    columns: Mapping[str, Real[np.ndarray, "_"]]
    fields: Mapping[str, str | float] = field(default_factory=dict)
    sha256: str = ""
    refused: Mapping[str, str] = field(default_factory=dict)
    times: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    signals: Mapping[str, str] = field(default_factory=dict)
    motors: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    is_joined: bool = False


@dataclass(frozen=True)
class Recording:
    """One recording in SI units before cleaning, with jitter, gaps and spikes.

    Attributes:
        name: Origin, for messages.
        time: Sample times from the first sample on [s].
        signals: Samples of each recorded signal except time, of shape (time, columns): qpos [rad or m], qvel [rad/s or
            m/s], ctrl in the actuator law's unit, ctrl_velocity [rad/s or m/s], ctrl_torque [N m or N], kp [N m/rad or
            N/m], kd [N m s/rad or N s/m], measured torque [N m or N], supply [V], enable (0 or 1), temperature [degC].
        fields: Values for the whole recording.
        sha256: Hash of the bytes that were read.
        simulated: Whether a simulator made it; None: not stated.
        notes: Assumptions of the reading, and changes so far, a sentence each.
        columns: Origin of the columns by signal.
        units: Stated unit of signals by name, before conversion to SI; others are missing.
        without_velocity: Numbers of the joints whose qvel is estimated from qpos.
    """

    name: str
    time: Float[np.ndarray, "time"]
    signals: Mapping[str, Float[np.ndarray, "time columns"]]
    fields: Mapping[str, Any] = field(default_factory=dict)
    sha256: str = ""
    simulated: bool | None = None
    notes: tuple[str, ...] = ()
    columns: Mapping[str, Columns] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    without_velocity: tuple[int, ...] = ()

    def say(self, *sentences: str) -> "Recording":
        """Return the recording with further notes."""
        return replace(self, notes=self.notes + sentences)

    def keep(self, kept: Bool[np.ndarray, "time"] | slice) -> "Recording":
        """Return the recording with only the kept samples."""
        return replace(self, time=self.time[kept], signals={name: v[kept] for name, v in self.signals.items()})


def refuse_incomplete(recording: Recording) -> None:
    """Refuse a recording that no part of the program can use.

    Raises:
        LogError: qpos or ctrl is missing, shapes disagree, a time is not finite, or fewer than two samples have
            increasing times.
    """
    name, samples = recording.name, len(recording.time)
    for signal in ("qpos", "ctrl"):
        if signal not in recording.signals:
            advice = f"name its column in data.columns.{signal}"
            raise LogError(f"{name}: no {signal}, expected time, qpos and ctrl; {advice}")
    for signal, values in recording.signals.items():
        if values.ndim != 2 or len(values) != samples:
            raise LogError(f"{name}: {signal} has shape {values.shape}, expected ({samples}, columns) like time")
    joints, speeds = (recording.signals.get(signal, recording.signals["qpos"]).shape[1] for signal in ("qpos", "qvel"))
    if speeds != joints:
        raise LogError(
            f"{name}: qvel has {speeds} columns and qpos {joints}, expected as many; name them in data.columns.qvel, "
            "or set it to [] to omit it"
        )
    if not np.isfinite(recording.time).all():
        sample = int(np.argmin(np.isfinite(recording.time)))
        raise LogError(f"{name}: time is NaN or infinite at sample {sample}, expected seconds; cut or repair the file")
    if samples < 2 or not (np.diff(recording.time) > 0).any():
        raise LogError(f"{name}: {samples} samples at one time, expected at least 2 times; check data.columns.time")
