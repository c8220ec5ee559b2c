"""`inspect.json`: survey of the recordings of a data set; `inspect.schema.json` in this folder describes it."""

import contextlib
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from frictionzoo import __version__
from frictionzoo.core import records
from frictionzoo.core.errors import LogError
from frictionzoo.core.log import JITTER, Log, pool_origins
from frictionzoo.core.output import to_json
from frictionzoo.core.units import UNITS
from frictionzoo.data.delay import estimate_delay
from frictionzoo.data.pairing import arrange_recording, describe_columns, has_names, label
from frictionzoo.data.recording import Recording, refuse_incomplete
from frictionzoo.data.signals import (
    GAP,
    TOP,
    Signal,
    count_spikes,
    derive_velocity,
    find_quantum,
    find_velocity_lag,
    find_wrap,
    repair_spikes,
    unwrap,
)
from frictionzoo.diagnostics.survey_findings import list_findings

read_schema = partial(records.read_schema, "frictionzoo.diagnostics", "inspect")
"""Return the JSON schema of `inspect.json`, which documents every field."""
SCHEMA_VERSION = 4
OUTLIER = 0.2  # largest plausible deviation of a supply voltage, as a share of its median
SLOWEST = 0.05  # share of the top speed below which a sample counts as slow
RESTING = 0.005  # share of the top speed below which a sample counts as standing still
VOLTAGES = ("vin", "voltage", "supply", "supply_voltage", "input_voltage")  # header fields with the supply voltage

Survey = dict[str, Any]
"""Content of `inspect.json`, or a part of it."""


def list_recordings(source: Any) -> list[Recording]:
    """Return the raw recordings of a data source, or its logs if it has no recordings.

    Raises:
        LogError: The recordings cannot be read.
    """
    return source.recordings() if hasattr(source, "recordings") else [as_recording(log) for log in source.load().logs]


def as_recording(log: Log) -> Recording:
    """Return a log as a recording."""
    signals = {"qpos": log.qpos, "qvel": log.qvel, "ctrl": log.ctrl, **log.extras}
    return Recording(log.name, log.time, signals, log.metadata, log.sha256, log.simulated, columns=log.columns)


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
    with contextlib.suppress(LogError):  # columns with other names cannot be matched: keep their order
        recordings = [arrange_recording(recording, expected if count > 1 else ())[0] for recording in recordings]
    return list(recordings), list(names)


def survey_recordings(
    name: str, recordings: Sequence[Recording], joint_type: str | None = None, names: Sequence[str] = ()
) -> Survey:
    """Survey raw recordings of one drive and list findings; only joints present in all recordings are surveyed.

    `joint_type`, `hinge` or `slide`, gives the units. `names` are joints in column order; empty for numbers.

    Raises:
        LogError: A recording is incomplete or too short, or the shapes of its signals disagree.
    """
    measured = [measure(recording) for recording in recordings]
    joints, commands = (min(len(entry[part]) for entry in measured) for part in ("joints", "commands"))
    names = list(names) or list(map(str, range(1, joints + 1)))
    command_names = names if len(names) == commands else list(map(str, range(1, commands + 1)))
    survey = {
        "schema_version": SCHEMA_VERSION,
        "version": __version__,
        "data": {
            "name": name,
            "origin": pool_origins(recording.simulated for recording in recordings),
            "recordings": len(recordings),
            "samples": sum(len(recording.time) for recording in recordings),
            "duration": sum(float(np.maximum(np.diff(recording.time), 0).sum()) for recording in recordings),
        },
        "units": {
            dimension: " or ".join(units[dimension] for kind, units in UNITS.items() if joint_type in (None, kind))
            for dimension in ("position", "velocity")
        },
        "timing": _pool_timing(measured),
        "joints": [{"name": names[joint]} | _pool_joint(recordings, measured, joint) for joint in range(joints)],
        "columns": describe_columns(recordings, names),
        "commands": [
            {
                "name": command_names[column],
                "range": _envelop(entry["commands"][column]["range"] for entry in measured),
                "saturated": _spread(entry["commands"][column]["saturated"] for entry in measured),
            }
            for column in range(commands)
        ],
        "supply": _pool_supply([entry["supply"] for entry in measured if entry["supply"] is not None]),
        "enabled": _spread(entry["enabled"] for entry in measured),
        "recordings": measured,
    }
    survey = to_json(survey)
    stated = all("qpos" in recording.units for recording in recordings)
    keys = ("state", "title", "text", "option")
    return survey | {"findings": [{key: getattr(one, key) for key in keys} for one in list_findings(survey, stated)]}


def measure(recording: Recording) -> Survey:
    """Return the entry of a recording before cleaning; it may have jitter, gaps, NaN and spikes.

    Raises:
        LogError: `refuse_incomplete` refuses the recording, or a joint or command has too few finite samples.
    """
    refuse_incomplete(recording)
    signals, enable = recording.signals, recording.signals.get("enable")
    finite = np.all([np.isfinite(values).all(axis=1) for values in signals.values()], axis=0)
    measured = signals["qvel"].T if "qvel" in signals else [None] * signals["qpos"].shape[1]

    def measure_command(command: Signal) -> Survey:
        samples = command[np.isfinite(command)]
        if not len(samples):
            raise LogError(f"{recording.name}: ctrl holds no finite sample; check data.columns.ctrl")
        low, high = float(samples.min()), float(samples.max())
        share = float(((samples == low) | (samples == high)).mean()) if high > low else 0.0
        return {"range": (low, high), "saturated": share}

    return {
        "name": recording.name,
        "timing": measure_timing(recording.time),
        "lost": int((~finite).sum()),
        "joints": [_measure_joint(recording, *pair) for pair in zip(signals["qpos"].T, measured, strict=True)],
        "commands": [measure_command(command) for command in signals["ctrl"].T],
        "supply": _measure_supply(signals.get("supply"), recording.fields),
        "enabled": None if enable is None else float((enable > 0.5).mean()),
        "sha256": recording.sha256,
    }


def measure_timing(time: Signal) -> Survey:
    """Return a recording's clock from its sample times [s], with at least one positive interval."""
    steps = np.diff(time)
    forward = steps[steps > 0]
    interval = float(np.median(forward))
    steady = forward[forward <= GAP * interval]
    deviation = np.abs(steady / interval - 1)
    return {
        "samples": len(time),
        "duration": float(forward.sum()),
        "interval": interval,
        "jitter": float((deviation > JITTER).mean()),
        "worst": float(deviation.max()),
        "duplicates": int((steps == 0).sum()),
        "missing": int((np.round(steady[steady > 1.5 * interval] / interval) - 1).sum()),
        "gaps": len(forward) - len(steady),
        "resets": int((steps < 0).sum()),
    }


def _measure_joint(recording: Recording, position: Signal, measured: Signal | None) -> Survey:
    finite = position[np.isfinite(position)]
    if len(finite) < 2:
        raise LogError(f"{recording.name}: qpos holds {len(finite)} finite samples; check data.columns.qpos")
    wrap = find_wrap(position)
    smooth = repair_spikes(unwrap(position, wrap))
    velocity = derive_velocity(recording.time, smooth)
    match = None if measured is None else find_velocity_lag(recording.time, smooth, measured)
    lag, scale = match or (None, None)
    low, high = _range(velocity)
    top = max(-low, high)
    return {
        "position": _range(finite),
        "wrap": wrap,
        "position_quantum": find_quantum(position),
        "spikes": count_spikes(position),
        "velocity": (low, high),
        "velocity_quantum": None if measured is None else find_quantum(measured),
        "velocity_lag": lag,
        "velocity_scale": scale,
        "top_speed": top,
        "slow": float((np.abs(velocity) <= SLOWEST * top).mean()),
        "rest": float((np.abs(velocity) <= RESTING * top).mean()),
    }


def _measure_supply(supply: Float[np.ndarray, "time columns"] | None, fields: Mapping[str, Any]) -> Survey | None:
    if supply is None or not np.isfinite(supply).any():
        return None
    field = next((name for name in VOLTAGES if isinstance(fields.get(name), int | float)), None)
    median, voltages = float(np.nanmedian(supply)), supply[np.isfinite(supply)]
    return {
        "median": median,
        "range": (float(voltages.min()), float(voltages.max())),
        "outliers": int((np.abs(voltages - median) > OUTLIER * abs(median)).sum()),
        "field": field,
        "stated": None if field is None else float(fields[field]),
    }


def _range(values: Float[np.ndarray, "samples"]) -> tuple[float, float]:
    low, high = np.quantile(values, [TOP, 1 - TOP])
    return float(low), float(high)


def pool_velocities(recordings: Sequence[Recording], joint: int) -> Float[np.ndarray, "samples"]:
    """Return the velocities of a joint in all recordings, estimated from the position [rad/s or m/s]."""
    positions = [recording.signals["qpos"][:, joint] for recording in recordings]
    smooth = [repair_spikes(unwrap(position, find_wrap(position))) for position in positions]
    return np.concatenate([derive_velocity(r.time, each) for r, each in zip(recordings, smooth, strict=True)])


def _pool_timing(measured: Sequence[Survey]) -> Survey:
    timings = [entry["timing"] for entry in measured]
    spreads = {name: _spread(timing[name] for timing in timings) for name in ("interval", "jitter", "worst")}
    totals = {name: sum(timing[name] for timing in timings) for name in ("duplicates", "missing", "gaps", "resets")}
    return spreads | totals | {"lost": sum(entry["lost"] for entry in measured)}


def _pool_joint(recordings: Sequence[Recording], measured: Sequence[Survey], joint: int) -> Survey:
    joints = [entry["joints"][joint] for entry in measured]
    velocity = pool_velocities(recordings, joint)
    low, high = _range(velocity)
    top, delay = max(-low, high), estimate_delay(recordings, joint)
    names = ("wrap", "position_quantum", "velocity_quantum", "velocity_lag", "velocity_scale", "top_speed", "rest")
    return {
        "position": _envelop(entry["position"] for entry in joints),
        "velocity": [low, high],
        **{name: _spread(entry[name] for entry in joints) for name in names},
        "measured": all("qvel" in recording.signals for recording in recordings),
        "spikes": sum(entry["spikes"] for entry in joints),
        "spiky": sum(entry["spikes"] > 0 for entry in joints),
        "slow": {"speed": SLOWEST * top, "share": float((np.abs(velocity) <= SLOWEST * top).mean())},
        "forward": float((velocity > SLOWEST * top).mean()),
        "backward": float((velocity < -SLOWEST * top).mean()),
        "delay": delay and delay._asdict(),
    }


def _pool_supply(supplies: Sequence[Survey]) -> Survey | None:
    if not supplies:
        return None
    return {
        "measured": _spread(supply["median"] for supply in supplies),
        "range": _envelop(supply["range"] for supply in supplies),
        "outliers": sum(supply["outliers"] for supply in supplies),
        "outlying": sum(supply["outliers"] > 0 for supply in supplies),
        "field": next((supply["field"] for supply in supplies if supply["field"] is not None), None),
        "stated": _spread(supply["stated"] for supply in supplies),
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
