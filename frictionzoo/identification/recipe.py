"""Automatic settings: options chosen on the training data, each with a reason, and kept in the folder of a run."""

import copy
import hashlib
import json
import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import safetensors
import safetensors.numpy

from frictionzoo import __version__
from frictionzoo.bench import Bench
from frictionzoo.core.config import list_options
from frictionzoo.core.described import remake
from frictionzoo.core.errors import ConfigError, closest
from frictionzoo.core.log import Dataset
from frictionzoo.core.output import SETTLED, to_json, write_atomically
from frictionzoo.core.params import AUTO
from frictionzoo.data.cache import digest
from frictionzoo.diagnostics.findings import Doubt, Repair
from frictionzoo.fit import Fit
from frictionzoo.identification.choices import OPTIONAL, Choice
from frictionzoo.identification.pilot import Pilot, PilotResult
from frictionzoo.identification.stages import Stages
from frictionzoo.models import FrictionModel
from frictionzoo.result.record import describe_data

RECIPES = ("given", AUTO)
_TEXT = "settled"  # entry of the file's header
_ARRAYS = ("vector", "half", "enough", "at_bound", "measured", "states", "sizes")
_INDIFFERENT = ("compilation_cache", "device", "logger", "loop", "resume", "threads")
_OF_THE_BENCH = ("params", "timestep", "solreffriction", "second_order")
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Settled:
    """Settings without open options.

    Attributes:
        choices: Choices in the order in which they were made.
        start: Start of the fit; None: the initial values.
        doubts: Warnings where the wanted accuracy is not reached.
        pilot: A pilot fit with these settings; None if there was none, or if the settings come from a file.
    """

    settings: Mapping[str, Any]
    bench: Bench
    choices: tuple[Choice, ...] = ()
    start: PilotResult | None = None
    doubts: tuple[Doubt, ...] = ()
    pilot: Pilot | None = None


def settle(settings: Mapping[str, Any], bench: Bench, dataset: Dataset, model: FrictionModel, fit: Fit) -> Settled:
    """Choose open options (`auto`) on the training recordings alone, in float64.

    Other options and the model, which is bound to the joints, do not change. `bench` has no open options.

    Raises:
        FrictionzooError: The input is at fault.
    """
    refuse_unknown(settings["recipe"])
    if settings["recipe"] != AUTO:
        return Settled(settings, bench)
    stages = Stages(settings, bench, dataset, model, fit)
    choices = []
    for choice in stages.run():
        _log.info("%s", choice)
        choices.append(choice)
    outcome = stages.start, tuple(stages.doubts), stages.pilot
    return Settled(stages.settings, stages.bench(), tuple(choices), *outcome)


def refuse_unknown(recipe: str) -> None:
    """Raise ConfigError for an unknown recipe."""
    if recipe not in RECIPES:
        raise ConfigError(f"recipe={recipe}: no such recipe; {closest(recipe, RECIPES)}")


def leave_open(bench: Mapping[str, Any], plain: Mapping[str, Any], from_file: bool) -> dict[str, Any]:
    """Return a bench's section with all options open that it does not set.

    `plain` is the section of a configuration with `recipe=auto`, which lists the options that may be open. `from_file`
    is whether a robot's file states the delay of commands.
    """
    optional = {name: dict(plain["params"][name]) for name in OPTIONAL}
    optional["delay"] |= {"init": None} if from_file else {}
    open_options = {
        name: plain[name] for name in ("timestep", "solreffriction", "second_order") if bench.get(name) is None
    }
    return {**bench, "params": {**optional, **(bench.get("params") or {})}, **open_options}


class Kept:
    """Automatic settings with a file in the run's folder, for runs with the same options and data.

    The folder may come from a stranger: nothing in it is executed.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / SETTLED

    def settle(
        self, settings: Mapping[str, Any], bench: Bench, dataset: Dataset, model: FrictionModel, fit: Fit
    ) -> Settled:
        """Choose as the function `settle` does, or return the stored choices.

        Raises:
            FrictionzooError: The input is at fault, or the file cannot be written.
        """
        if settings["recipe"] != AUTO:
            return settle(settings, bench, dataset, model, fit)
        identity = _identify(settings, bench, dataset, model)
        if (read := self._read(identity, settings, bench)) is not None:
            stored, had_pilot = read
            if stored.start is not None and had_pilot:  # the fit uses its compiled equations
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

    def _read(self, identity: str, settings: Mapping[str, Any], bench: Bench) -> tuple[Settled, bool] | None:
        """Return the settings stored for these options and data, and whether a pilot fit chose them.

        None if the file is missing, damaged or for others.
        """
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
        if stored["labels"] is not None:
            start = PilotResult(labels=stored["labels"], loss=stored["loss"], **{"states": None, **arrays})
        settled = Settled(
            chosen,
            remake(bench, **{name: section[name] for name in _OF_THE_BENCH if name in section}),
            tuple(Choice(*choice) for choice in stored["choices"]),
            start,
            tuple(Doubt(text, tuple(Repair(*repair) for repair in repairs)) for text, repairs in stored["doubts"]),
        )
        return settled, bool(stored["pilot"])


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
