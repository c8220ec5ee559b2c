"""Automatic settings stored in a run's folder, for a resumed run."""

import copy
import hashlib
import json
import logging
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import safetensors
import safetensors.numpy

from frictionzoo import __version__
from frictionzoo.bench import Bench
from frictionzoo.core.config import list_options
from frictionzoo.core.described import remake
from frictionzoo.core.log import Dataset
from frictionzoo.core.output import SETTLED, to_json, write_atomically
from frictionzoo.core.params import AUTO
from frictionzoo.data.cache import digest
from frictionzoo.diagnostics.findings import Doubt, Repair
from frictionzoo.fit import Fit
from frictionzoo.identification.choices import Choice
from frictionzoo.identification.pilot import Found
from frictionzoo.identification.recipe import Settled, settle
from frictionzoo.identification.stages import Stages
from frictionzoo.models import FrictionModel
from frictionzoo.result.record import describe_data

_TEXT = "settled"  # entry of the file's header
_ARRAYS = ("vector", "half", "enough", "at_bound", "measured", "states", "sizes")
_INDIFFERENT = ("compilation_cache", "device", "logger", "loop", "resume", "threads")
_OF_THE_BENCH = ("params", "timestep", "solreffriction", "second_order")
_log = logging.getLogger(__name__)


class Kept:
    """Automatic settings with a file in the run's folder, for runs with the same options and data.

    The folder may come from a stranger: nothing in it is executed.
    """

    def __init__(self, folder: Path) -> None:
        self._path, self._had_pilot = folder / SETTLED, False

    def settle(
        self, settings: Mapping[str, Any], bench: Bench, dataset: Dataset, model: FrictionModel, fit: Fit
    ) -> Settled:
        """Choose as `frictionzoo.identification.recipe.settle` does, or return the stored choices.

        Raises:
            FrictionzooError: The input is at fault, or the file cannot be written.
        """
        if settings["recipe"] != AUTO:
            return settle(settings, bench, dataset, model, fit)
        identity = _identify(settings, bench, dataset, model)
        if (stored := self._read(identity, settings, bench)) is not None:
            if stored.start is not None and self._had_pilot:  # the fit uses its compiled equations
                pilot = Stages(settings, bench, dataset, model, fit).repeat(stored.settings, stored.start)
                stored = replace(stored, pilot=pilot)
            _log.info("automatic settings read from %s", self._path)
            return stored
        settled = settle(settings, bench, dataset, model, fit)
        self._write(identity, settings, settled)
        return settled

    def _write(self, identity: str, settings: Mapping[str, Any], settled: Settled) -> None:
        before, start = dict(list_options(settings)), settled.start
        arrays = {} if start is None else {name: getattr(start, name) for name in _ARRAYS}
        arrays = {name: array for name, array in arrays.items() if array is not None}
        text = {
            "identity": identity,
            "options": {key: value for key, value in list_options(settled.settings) if before.get(key) != value},
            "choices": settled.choices,
            "doubts": settled.doubts,
            "labels": start and start.labels,
            "loss": start and start.loss,
            "pilot": settled.pilot is not None,
        }
        header = {_TEXT: json.dumps(to_json(text)), "sha256": ""}
        header["sha256"] = _sign(header[_TEXT], arrays)
        write_atomically(self._path, safetensors.numpy.save(arrays, header))

    def _read(self, identity: str, settings: Mapping[str, Any], bench: Bench) -> Settled | None:
        """Return the settings stored for these options and data; None if the file is missing, damaged or for others."""
        if not self._path.exists():
            return None
        try:
            with safetensors.safe_open(self._path, "numpy") as file:
                names, header = file.keys(), file.metadata() or {}
                arrays = {name: file.get_tensor(name) for name in names}
        except (OSError, safetensors.SafetensorError):
            header, arrays = {}, {}
        text = header.get(_TEXT, "")
        if header.get("sha256") != _sign(text, arrays):
            _log.info("%s: damaged; automatic settings are chosen again", self._path)
            return None
        stored = json.loads(text)
        if stored["identity"] != identity or not set(stored["options"]) <= {*_list_open(settings)}:
            _log.info("%s: for other options or data; automatic settings are chosen again", self._path)
            return None
        chosen = _put(settings, stored["options"])
        section, start = chosen["bench"], None
        self._had_pilot = bool(stored["pilot"])
        if stored["labels"] is not None:
            start = Found(labels=stored["labels"], loss=stored["loss"], **{"states": None, **arrays})
        return Settled(
            chosen,
            remake(bench, **{name: section[name] for name in _OF_THE_BENCH if name in section}),
            tuple(Choice(*choice) for choice in stored["choices"]),
            start,
            tuple(Doubt(text, tuple(Repair(*repair) for repair in repairs)) for text, repairs in stored["doubts"]),
        )


def _sign(text: str, arrays: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the file's content, to detect damage."""
    ordered = {name: arrays[name] for name in _ARRAYS if name in arrays}
    return hashlib.sha256(f"{text}{[*ordered]}{digest(ordered)}".encode()).hexdigest()


def _identify(settings: Mapping[str, Any], bench: Bench, dataset: Dataset, model: FrictionModel) -> str:
    """Return the SHA-256 of everything that the automatic settings depend on."""
    state = {name: value.numpy() for name, value in model.state_dict().items()}
    facts = {
        "version": __version__,
        "settings": {name: value for name, value in settings.items() if name not in _INDIFFERENT},
        "data": describe_data(dataset),
        "bench": [bench.template(), bench.initial_values() and digest(bench.initial_values())],
        "model": digest(state),
    }
    return hashlib.sha256(json.dumps(to_json(facts), sort_keys=True).encode()).hexdigest()


def _list_open(settings: Mapping[str, Any]) -> Iterator[str]:
    """Yield the open options, and the initial values of optional parameters."""
    for option, value in list_options(settings):
        if value == AUTO:
            yield option
            if option.endswith(".identify"):
                yield f"{option.removesuffix('identify')}init"


def _put(settings: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
    changed = copy.deepcopy(dict(settings))
    for option, value in options.items():
        *path, key = option.split(".")
        part = changed
        for name in path:
            part = part[name]
        part[key] = value
    return changed
