"""Recordings for tests: a simulated servo with known faults, and real ones as they lie in the data folder."""

import json
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from frictionzoo.data.recording import Recording

SIGNALS = {
    **{"qpos": "position", "qvel": "speed", "ctrl": "goal_position", "supply": "input_volts"},
    **{"enable": "torque_enable", "temperature": "temp"},
}


def make_recording(time: Sequence[float], name: str = "a.csv", simulated: bool = False, **signals: Any) -> Recording:
    """A recording of these signals, one column each."""
    time = np.asarray(time, float)
    columns = {key: np.asarray(values, float).reshape(len(time), -1) for key, values in signals.items()}
    return Recording(name, time, columns, {}, "0" * 64, simulated)


def simulate_servo(
    delay: float, servo: bool, gain: float = 300.0, samples: int = 800, step: float = 0.01, lag: float = 0.02
) -> Recording:
    """A pendulum with dry friction: of a position servo, or of a motor whose command is its torque.

    The command sweeps from 0.2 to 2 Hz, acts `delay` late and is held between samples; the velocity comes `lag` late.
    """
    fine = step / 20
    time = fine * np.arange(20 * samples)
    command = np.sin(2 * np.pi * (0.2 + 0.225 * time / 2) * time)[::20].repeat(20)
    late = np.concatenate([np.zeros(round(delay / fine)), command])[: len(time)]
    q, v = np.zeros(len(time) + 1), np.zeros(len(time) + 1)
    for i, u in enumerate(late):
        drive = gain * np.clip(u - q[i], -0.5, 0.5) if servo else 60 * u
        free = v[i] + fine * (drive - 12 * v[i] - 30 * np.sin(q[i]))
        v[i + 1] = free - np.clip(free, -3 * fine, 3 * fine)
        q[i + 1] = q[i] + fine * v[i + 1]
    measured = np.concatenate([np.zeros(round(lag / fine)), v])[: len(time)]
    return make_recording(time[::20], qpos=q[:-1][::20], qvel=measured[::20], ctrl=command[::20])


def read_bam(name: str, log: Mapping[str, Any]) -> Recording:
    entries = log["entries"]
    columns = {key: np.array([[float(entry[header])] for entry in entries]) for key, header in SIGNALS.items()}
    fields = {key: value for key, value in log.items() if isinstance(value, str | float | int)}
    return Recording(name, np.array([entry["timestamp"] for entry in entries]), columns, fields, "0" * 64)


def read_sts3215(folder: str, every: int = 1, holding: bytes = b"") -> list[Recording]:
    """Every so-many-th of the STS3215 logs whose text holds these bytes; there are 960."""
    with zipfile.ZipFile(Path(folder) / "sts3215_12v" / "sts3215_12v_raw.zip") as archive:
        names = sorted(name for name in archive.namelist() if name.endswith(".json"))[::every]
        texts = ((name, archive.read(name)) for name in names)
        return [read_bam(name, json.loads(text)) for name, text in texts if holding in text]


def read_xl330(folder: str) -> list[Recording]:
    return [
        read_bam(path.name, json.loads(path.read_text())) for path in sorted((Path(folder) / "xl330").glob("*.json"))
    ]
