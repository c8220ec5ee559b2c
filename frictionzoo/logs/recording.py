"""Recordings as they come, before cleaning: a file's columns, and the signals that they stand for."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, Real

from frictionzoo.core.log import Columns

COMMANDS = ("ctrl", "ctrl_velocity", "ctrl_torque", "kp", "kd")
"""What a drive was told: the command, and beside it desired velocity, feed-forward torque and gains."""

SIGNALS = ("time", "qpos", "qvel", *COMMANDS, "torque", "supply", "enable", "temperature")
"""What a column may stand for. Needed: time, qpos, ctrl; the others where the file has them."""

TURNED = ("qpos", "qvel", "ctrl", "ctrl_velocity", "ctrl_torque", "torque")
"""Signals that have a direction."""

HELD = (*COMMANDS, "enable")
"""Signals that keep their value until the next sample; the others go on in between."""


@dataclass(frozen=True)
class Table:
    """What a file holds, in its own names and units.

    Attributes:
        name: Where it came from, for messages; `ARCHIVE!MEMBER` for a member of an archive.
        columns: Samples by the file's own header; of several lengths where signals were recorded apart, each then with
            its own time. float64, or int64 where that would round (nanoseconds since 1970).
        fields: What the file says of the whole recording: gains, payload, trajectory.
        sha256: Hash of the bytes that were read.
        refused: Why a column of the file is none of `columns`, by its header: the line that the user gets who asks
            for it.
        times: Header of a column's own time, for signals that were recorded apart.
        units: Units that the format itself lays down, by header.
    """

    name: str
    columns: Mapping[str, Real[np.ndarray, "_"]]
    fields: Mapping[str, str | float] = field(default_factory=dict)
    sha256: str = ""
    refused: Mapping[str, str] = field(default_factory=dict)
    times: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Recording:
    """One recording in SI units, with the jitter, gaps and spikes that it came with.

    Attributes:
        name: Where it came from, for messages.
        time: Sample times since the first [s].
        signals: Samples of each of `SIGNALS` that there is besides time, of shape (time, columns): qpos [rad or m],
            qvel [rad/s or m/s], ctrl in the actuator law's unit, ctrl_velocity [rad/s or m/s], ctrl_torque [N m or N],
            kp [N m/rad or N/m], kd [N m s/rad or N s/m], torque as measured [N m or N], supply [V], enable (0 or 1),
            temperature [degC].
        fields: What the source says of the whole recording.
        sha256: Hash of what was read.
        simulated: Whether a simulator made it; False: recorded on hardware; None: not stated.
        notes: What was done to bring its signals together, a sentence each.
        columns: Where the columns of signals come from, by the signal.
    """

    name: str
    time: Float[np.ndarray, "time"]
    signals: Mapping[str, Float[np.ndarray, "time columns"]]
    fields: Mapping[str, Any] = field(default_factory=dict)
    sha256: str = ""
    simulated: bool | None = None
    notes: tuple[str, ...] = ()
    columns: Mapping[str, Columns] = field(default_factory=dict)
