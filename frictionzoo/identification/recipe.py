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
from frictionzoo.identification.trials import put
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
    stages.run()
    outcome = stages.start, tuple(stages.doubts), stages.pilot
    return Settled(stages.settings, stages.bench(), tuple(stages.choices), *outcome)


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


def settle_once(
    folder: Path, settings: Mapping[str, Any], bench: Bench, dataset: Dataset, model: FrictionModel, fit: Fit
) -> Settled:
    """Choose as `settle` does, or return the choices that a run with the same options and data left in this folder.

    The folder may come from a stranger: nothing in it is executed.

    Raises:
        FrictionzooError: The input is at fault, or the file cannot be written.
    """
    if settings["recipe"] != AUTO:
        return settle(settings, bench, dataset, model, fit)
    path, identity = folder / SETTLED, _identify(settings, bench, dataset, model)
    if (stored := _read(path, identity, settings, bench)) is not None:
        _log.info("automatic settings read from %s", path)
        if stored.start is None:
            return stored
        pilot = Stages(settings, bench, dataset, model, fit).repeat(stored.settings, stored.start)
        return replace(stored, pilot=pilot)  # the fit uses its compiled equations
    settled = settle(settings, bench, dataset, model, fit)
    before, start = dict(list_options(settings)), settled.start
    text = {
        "identity": identity,
        "options": {key: value for key, value in list_options(settled.settings) if before.get(key) != value},
        "choices": settled.choices,
        "doubts": settled.doubts,
        "labels": start and start.labels,
        "loss": start and start.loss,
    }
    arrays = {name: getattr(start, name) for name in _ARRAYS} if start else {}
    arrays = {name: array for name, array in arrays.items() if array is not None}
    write_atomically(path, safetensors.numpy.save(arrays, {_TEXT: json.dumps(to_json(text))}))
    return settled


def _read(path: Path, identity: str, settings: Mapping[str, Any], bench: Bench) -> Settled | None:
    """Return the settings stored for these options and data; None if there are none, or they cannot be read."""
    if not path.exists():
        return None
    try:
        with safetensors.safe_open(path, "numpy") as file:
            arrays: dict[str, Any] = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
            stored = json.loads((file.metadata() or {})[_TEXT])
        fits = stored["identity"] == identity and {*stored["options"]} <= {*_list_open(settings)}
    except (OSError, ValueError, KeyError, TypeError, safetensors.SafetensorError):
        fits = False
    if not fits:
        _log.info("%s: damaged, or for other options or data; automatic settings are chosen again", path)
        return None
    chosen, start = copy.deepcopy(dict(settings)), None
    for option, value in stored["options"].items():
        put(chosen, option, value)
    if stored["labels"] is not None:
        start = PilotResult(labels=stored["labels"], loss=stored["loss"], **{"states": None, **arrays})
    doubts = (Doubt(text, tuple(Repair(*repair) for repair in repairs)) for text, repairs in stored["doubts"])
    section = {name: chosen["bench"][name] for name in _OF_THE_BENCH if name in chosen["bench"]}
    choices = tuple(Choice(*choice) for choice in stored["choices"])
    return Settled(chosen, remake(bench, **section), choices, start, tuple(doubts))


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
