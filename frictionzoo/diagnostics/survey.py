"""`inspect.json`: survey of the recordings of a data set; `inspect.schema.json` in this folder describes it."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from importlib import resources
from typing import Any

import numpy as np
from jaxtyping import Float

from frictionzoo import __version__
from frictionzoo.core.errors import LogError
from frictionzoo.core.log import Log, pool_origins
from frictionzoo.core.output import to_json
from frictionzoo.core.params import UNITS
from frictionzoo.data.delay import estimate_delay
from frictionzoo.data.diagnose import SLOWEST, Diagnosis, diagnose
from frictionzoo.data.pairing import arrange, describe_columns, has_names, label, reorder
from frictionzoo.data.recording import Recording
from frictionzoo.data.signals import TOP, derive_velocity, repair_spikes
from frictionzoo.diagnostics.survey_findings import list_findings

SCHEMA_VERSION = 3

Survey = dict[str, Any]
"""Content of `inspect.json`."""


def read_schema() -> dict[str, Any]:
    """Return the JSON schema of `inspect.json`, which documents every field."""
    return json.loads(resources.files("frictionzoo.diagnostics").joinpath("inspect.schema.json").read_text("utf-8"))


def list_recordings(source: Any) -> list[Recording]:
    """Return the raw recordings of a data source, or its logs if it has no recordings.

    Raises:
        LogError: The recordings cannot be read.
    """
    return source.recordings() if hasattr(source, "recordings") else [_as_recording(log) for log in source.load().logs]


def put_in_order(recordings: Sequence[Recording], joints: Sequence[str] = ()) -> tuple[list[Recording], list[str]]:
    """Return recordings of one drive with columns in one joint order, and the names of the joints.

    `joints` are the bench's joints, if the columns are in their order. Without a bench, the position headers of the
    first recording give the names, and all columns are matched with them.
    """
    count = recordings[0].signals["qpos"].shape[1]
    if len(joints) == count:
        return list(recordings), list(joints)
    if any("qpos" not in recording.columns for recording in recordings):
        return list(recordings), list(map(str, range(1, count + 1)))
    headers = recordings[0].columns["qpos"].headers
    names = label(headers)
    expected = names if has_names(headers) else [f"number {name}" for name in names]
    ordered = []
    for entry in recordings:
        try:
            matches = arrange(entry.name, entry.columns, expected if count > 1 else ())
        except LogError:  # columns with other names cannot be matched: keep their order
            return list(recordings), list(names)
        signals = {signal: entry.signals[signal][:, list(order)] for signal, (order, _) in matches.items()}
        ordered.append(replace(entry, signals=signals, columns=reorder(entry.columns, matches)))
    return ordered, list(names)


def survey_recordings(
    name: str, recordings: Sequence[Recording], joint_type: str | None = None, names: Sequence[str] = ()
) -> Survey:
    """Survey raw recordings of one drive and list findings; only joints present in all recordings are surveyed.

    `joint_type`, `hinge` or `slide`, gives the units. `names` are joints in column order; empty for numbers.

    Raises:
        LogError: A recording is incomplete or too short, or the shapes of its signals disagree.
    """
    diagnoses = [diagnose(recording) for recording in recordings]
    joints = min(len(diagnosis.joints) for diagnosis in diagnoses)
    names = list(names) or [str(number) for number in range(1, joints + 1)]
    survey = {
        "schema_version": SCHEMA_VERSION,
        "version": __version__,
        "data": _describe_data(name, recordings),
        "units": {
            dimension: " or ".join(units[dimension] for kind, units in UNITS.items() if joint_type in (None, kind))
            for dimension in ("position", "velocity")
        },
        "timing": _pool_timing(diagnoses),
        "joints": [{"name": names[joint]} | _pool_joint(recordings, diagnoses, joint) for joint in range(joints)],
        "columns": describe_columns(recordings, names),
        "commands": _pool_commands(diagnoses, names),
        "supply": _pool_supply(diagnoses),
        "enabled": _spread(diagnosis.enabled for diagnosis in diagnoses),
        "recordings": [
            asdict(diagnosis) | {"timing": diagnosis.timing._asdict(), "sha256": recording.sha256}
            for diagnosis, recording in zip(diagnoses, recordings, strict=True)
        ],
    }
    survey = to_json(survey)
    return survey | {"findings": [asdict(finding) for finding in list_findings(survey)]}


def pool_velocities(recordings: Sequence[Recording], joint: int) -> Float[np.ndarray, "samples"]:
    """Return the velocities of a joint in all recordings, estimated from the position [rad/s or m/s]."""
    return np.concatenate([derive_velocity(r.time, repair_spikes(r.signals["qpos"][:, joint])) for r in recordings])


def _as_recording(log: Log) -> Recording:
    signals = {"qpos": log.qpos, "qvel": log.qvel, "ctrl": log.ctrl, **log.extras}
    return Recording(log.name, log.time, signals, log.metadata, log.sha256, log.simulated, columns=log.columns)


def _describe_data(name: str, recordings: Sequence[Recording]) -> dict[str, Any]:
    return {
        "name": name,
        "origin": pool_origins(recording.simulated for recording in recordings),
        "recordings": len(recordings),
        "samples": sum(len(recording.time) for recording in recordings),
        "duration": sum(float(np.maximum(np.diff(recording.time), 0).sum()) for recording in recordings),
    }


def _pool_timing(diagnoses: Sequence[Diagnosis]) -> dict[str, Any]:
    timings = [diagnosis.timing for diagnosis in diagnoses]
    spreads = {name: _spread(getattr(timing, name) for timing in timings) for name in ("interval", "jitter", "worst")}
    totals = {name: sum(getattr(t, name) for t in timings) for name in ("duplicates", "missing", "gaps", "resets")}
    return spreads | totals | {"lost": sum(diagnosis.lost for diagnosis in diagnoses)}


def _pool_joint(recordings: Sequence[Recording], diagnoses: Sequence[Diagnosis], joint: int) -> dict[str, Any]:
    joints = [diagnosis.joints[joint] for diagnosis in diagnoses]
    velocity = pool_velocities(recordings, joint)
    low, high = np.quantile(velocity, [TOP, 1 - TOP])
    top = max(-low, high)
    delay = estimate_delay(recordings, joint)
    names = ("position_quantum", "velocity_quantum", "velocity_lag", "velocity_scale", "top_speed", "rest")
    return {
        "position": _envelop(entry.position for entry in joints),
        "velocity": [low, high],
        **{name: _spread(getattr(entry, name) for entry in joints) for name in names},
        "measured": all("qvel" in recording.signals for recording in recordings),
        "spikes": sum(entry.spikes for entry in joints),
        "spiky": sum(entry.spikes > 0 for entry in joints),
        "slow": {"speed": SLOWEST * top, "share": float((np.abs(velocity) <= SLOWEST * top).mean())},
        "forward": float((velocity > SLOWEST * top).mean()),
        "backward": float((velocity < -SLOWEST * top).mean()),
        "delay": delay and delay._asdict(),
    }


def _pool_commands(diagnoses: Sequence[Diagnosis], names: Sequence[str]) -> list[dict[str, Any]]:
    count = min(len(diagnosis.commands) for diagnosis in diagnoses)
    columns = [[diagnosis.commands[column] for diagnosis in diagnoses] for column in range(count)]
    names = names if len(names) == count else [str(number) for number in range(1, count + 1)]
    return [
        {
            "name": names[column],
            "range": _envelop(c.range for c in commands),
            "saturated": _spread(c.saturated for c in commands),
        }
        for column, commands in enumerate(columns)
    ]


def _pool_supply(diagnoses: Sequence[Diagnosis]) -> dict[str, Any] | None:
    supplies = [diagnosis.supply for diagnosis in diagnoses if diagnosis.supply is not None]
    if not supplies:
        return None
    return {
        "measured": _spread(supply.median for supply in supplies),
        "range": _envelop(supply.range for supply in supplies),
        "outliers": sum(supply.outliers for supply in supplies),
        "outlying": sum(supply.outliers > 0 for supply in supplies),
        "field": next((supply.field for supply in supplies if supply.field is not None), None),
        "stated": _spread(supply.stated for supply in supplies),
    }


def _spread(values: Iterable[float | None]) -> dict[str, float] | None:
    """Return lowest, median and highest over the recordings; None if none has a value."""
    present = [float(value) for value in values if value is not None]
    if not present:
        return None
    low, median, high = np.quantile(present, [0, 0.5, 1])
    return {"low": low, "median": median, "high": high, "known": len(present)}


def _envelop(ranges: Iterable[Sequence[float]]) -> list[float]:
    lows, highs = zip(*ranges, strict=True)
    return [float(np.nanmin(lows)), float(np.nanmax(highs))]


def rank_by_faults(survey: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the entries of the recordings, worst first: by spikes, then breaks and lost samples, then jitter."""

    def faults(entry: Mapping[str, Any]) -> tuple[int, int, float]:
        timing = entry["timing"]
        broken = sum(timing[name] for name in ("gaps", "resets", "missing", "duplicates"))
        return sum(joint["spikes"] for joint in entry["joints"]), broken + entry["lost"], timing["worst"]

    return sorted(survey["recordings"], key=faults, reverse=True)
