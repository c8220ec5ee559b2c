"""Loading of a drive from a card's folder."""

import hashlib
from pathlib import Path
from typing import Any, cast

import numpy as np

from frictionzoo.bench import Bench
from frictionzoo.core.errors import RunError
from frictionzoo.core.segments import Sampling, Segments
from frictionzoo.core.state import Signals
from frictionzoo.models.formula import as_numpy, torch_values
from frictionzoo.report.card.portable import build_parts, place_settings
from frictionzoo.report.card.record import CARD, CARD_VERSION, MODEL, read_schema
from frictionzoo.report.card.types import Card
from frictionzoo.result import record
from frictionzoo.result.curves import Curves
from frictionzoo.result.evaluate import Values
from frictionzoo.result.fitted_drive import FittedDrive
from frictionzoo.result.read_back import put_law, read_tensors
from frictionzoo.result.types import Result
from frictionzoo.result.values import read_parameters

_LENGTH = 10_000  # intervals of the empty segments
_ROUNDED = 1e-6  # relative difference allowed between a float32 value of a fit and its record


def read_card(folder: Path) -> FittedDrive:
    """Load the drive of a card; it has no recordings.

    Raises:
        RunError: The folder does not contain a card of this version, or a file is damaged.
        FrictionzooError: The card's settings are invalid.
    """
    card = read_record(folder)
    result, settings = cast(Result, card["result"]), place_settings(folder, card["result"]["settings"])
    bench, model = build_parts(folder, settings)
    result["settings"] = settings
    path, tensors = folder / MODEL, read_tensors(folder / MODEL, model.name)
    parts: dict[str, Any] = {
        owner: {k.removeprefix(f"{owner}."): v for k, v in tensors.items() if k.startswith(f"{owner}.")}
        for owner in ("bench", "friction")
    }
    state = put_law(model, parts["friction"], path)
    values = {
        "bench": {name: value.double().numpy() for name, value in parts["bench"].items()},
        "friction": as_numpy(torch_values(model)),
    }
    params = {"bench": bench.params, "friction": model.params}
    _refuse_others(path, result, values, params, bench)
    sampling = bench.sampling(result["data"]["timestep"])
    segments = _none(bench, sampling)
    return FittedDrive(folder, result, bench, model, state, values, segments, sampling, _undrawn(segments))


def read_record(folder: Path) -> Card:
    """Read a card's `card.json`, and verify the hashes of the other files.

    Raises:
        RunError: `card.json` is invalid, or a file is missing or damaged.
    """
    path = folder / CARD
    card = record.read_valid(path, CARD_VERSION, read_schema())
    record.refuse_invalid(path, card["result"], record.read_schema())
    for name, sha256 in card["files"].items():
        if Path(name).name != name:
            raise RunError(f"{path}: it names the file {name}, expected names without folders; get another card")
        try:
            digest = hashlib.sha256((folder / name).read_bytes()).hexdigest()
        except OSError as error:
            raise RunError(
                f"{folder / name}: {error.strerror}; expected the file of a card; get the card again"
            ) from None
        if digest != sha256:
            raise RunError(f"{folder / name}: SHA-256 {digest[:12]}, expected {sha256[:12]}; get the card again")
    return cast(Card, card)


def _refuse_others(path: Path, result: Result, values: Values, params: dict[str, Any], bench: Bench) -> None:
    recorded = read_parameters(result, bench.nv)
    keys = {f"{owner}.{name}": (owner, name) for owner, group in params.items() for name in group}
    if recorded.keys() != keys.keys() or values["bench"].keys() != bench.params.keys():
        raise RunError(f"{path}: its parameters differ, expected those in {CARD}; get the card again")
    for full, (owner, name) in keys.items():
        param, value = params[owner][name], values[owner][name]
        same = value.shape == (len(param.members(bench.nv)),)
        if not same or not np.allclose(
            param.spread(value, bench.nv), recorded[full].value, rtol=_ROUNDED, atol=0, equal_nan=True
        ):
            raise RunError(f"{path}: {full} differs, expected the value in {CARD}; get the card again")


def _none(bench: Bench, sampling: Sampling) -> Segments:
    """Return segments without rollouts, with enough intervals for long simulation steps."""
    state, drive = np.zeros((0, _LENGTH + 1, bench.nv)), np.zeros((0, _LENGTH + sampling.history, bench.nv))
    inputs, observed = ({name: drive for name in names} for names in (bench.actuator.inputs, bench.observed))
    return Segments(state, state, Signals(drive, inputs, observed), sampling.interval)


def _undrawn(segments: Segments) -> Curves:
    moved, flat, none = segments.qpos[:, 1:], np.empty((0, segments.qpos.shape[2])), np.empty(0)
    motion = moved, moved, moved, moved
    law = none, flat, flat, flat
    states = segments.qpos, segments.qvel, segments.signals, segments.loads
    return Curves(*states, *motion, none, none, none, none, none, *law, {})
