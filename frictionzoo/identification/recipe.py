"""Checked input of an identification, with automatic settings, which the folder of a run keeps."""

import contextlib
import copy
import hashlib
import json
import logging
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import safetensors
import safetensors.numpy
from msgspec.structs import astuple

from frictionzoo import __version__
from frictionzoo.bench import Bench
from frictionzoo.bench.given import Given
from frictionzoo.bench.interval import is_whole
from frictionzoo.bench.signals import pair_all
from frictionzoo.core.build import build
from frictionzoo.core.config import list_options
from frictionzoo.core.described import remake
from frictionzoo.core.errors import ConfigError, closest
from frictionzoo.core.log import Dataset
from frictionzoo.core.output import SETTLED, to_json, write_atomically
from frictionzoo.core.params import AUTO
from frictionzoo.core.telling import align, list_columns, tell
from frictionzoo.data.cache import digest
from frictionzoo.data.pairing import describe_columns
from frictionzoo.diagnostics.findings import Finding
from frictionzoo.diagnostics.recordings import check_up
from frictionzoo.fit import Fit
from frictionzoo.identification.choices import (
    GAIN,
    OPTIONAL,
    change_bench,
    fit_lengths,
    get,
    option_of,
    put,
    settle_gain,
    widen_bounds,
)
from frictionzoo.identification.pilot import Pilot, PilotResult
from frictionzoo.identification.stages import Stages
from frictionzoo.models import FrictionModel
from frictionzoo.models.by_name import complete_laws
from frictionzoo.result.record import describe_data
from frictionzoo.result.section_types import AutomaticSetting
from frictionzoo.simulation.context import computing, refuse_precision
from frictionzoo.simulation.drive import refuse_other_joints

RECIPES = ("given", AUTO)
_TEXT = "settled"  # entry of the file's header
_ARRAYS = ("vector", "half", "enough", "at_bound", "measured", "states", "sizes")
_INDIFFERENT = ("compilation_cache", "device", "logger", "loop", "resume", "threads")
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Parts:
    """Input of a problem, checked, and settings without open options.

    Attributes:
        settings: All options that the record reports; among them `segments`, `loss` and `evaluation`, the arguments of
            `cut_segments`, `Objective` and `Evaluator`.
        model: The friction model; it is prepared for the data, and a fit leaves the best values in it.
        doubts: Likely faults of the recordings, and warnings where the wanted accuracy is not reached.
        choices: Automatic settings in the order in which they were chosen.
        start: Start of the fit; None: the initial values.
        pilot: A pilot fit with these settings; None if there was none.
        seconds: Time to prepare the parts [s].
    """

    settings: Mapping[str, Any]
    bench: Bench
    dataset: Dataset
    model: FrictionModel
    fit: Fit
    doubts: list[Finding]
    choices: tuple[AutomaticSetting, ...] = ()
    start: PilotResult | None = None
    pilot: Pilot | None = None
    seconds: float = 0.0

    @classmethod
    def from_settings(
        cls, settings: Mapping[str, Any], given: Given | None = None, folder: Path | None = None
    ) -> "Parts":
        """Build the parts that the settings describe; `given` are bench and recordings that have been read already.

        Raises:
            FrictionzooError: The input is at fault.
        """
        began = time.perf_counter()
        bench, dataset, earlier, settings = given or Given.read(settings)._replace(seconds=0.0)
        settings = {**settings, "model": complete_laws(settings["model"], settings)}
        model = build(settings["model"], FrictionModel, nv=bench.nv)
        model.bind(bench.joints)
        model.begin(bench.initial_friction(model.params))
        parts = cls.settle(settings, bench, dataset, model, build(settings["fit"], Fit), folder)
        return replace(parts, seconds=earlier + time.perf_counter() - began)

    @classmethod
    def settle(
        cls,
        settings: Mapping[str, Any],
        bench: Bench,
        dataset: Dataset,
        model: FrictionModel,
        fit: Fit,
        folder: Path | None = None,
    ) -> "Parts":
        """Check the input, and choose open options (`auto`) on the training recordings alone, in float64.

        Other options do not change. `bench` has no open options. `folder` keeps the choices for runs with the same
        options and data.

        Raises:
            FrictionzooError: The input is at fault, or the choices cannot be written.
        """
        began = time.perf_counter()
        refuse_unknown(settings["recipe"])
        if settings["dtype"] != AUTO:
            refuse_precision(settings["dtype"])  # before the first fit
        for note in bench.notes:
            _log.info("%s: %s", bench.source, note)
        refuse_other_joints(model, bench)
        model.bind(bench.joints)
        dataset = pair_all(dataset, bench.joints, bench.passive)
        bench, settings = _divide_interval(bench, settings, dataset.train[0].timestep)
        settings, shortened = fit_lengths(settings, dataset, bench.joint_type)
        for columns in describe_columns(dataset.logs, bench.joints) if bench.nv > 1 else ():
            others = len(columns["logs"]) - 1
            names = columns["logs"][0] + (f" and {others} more" if others else "")
            for line in (f"{names}: columns by joint", *align(list_columns(columns)).splitlines()):
                _log.info("%s", line)
        observing = bench.observing(model.inputs)
        train, test = (tuple(map(observing.accept, logs)) for logs in (dataset.train, dataset.test))
        tell("checking the recordings")
        doubts = check_up(Dataset(dataset.name, train, test), observing, settings["checkup"])
        settings, bench, widened = widen_bounds(settings, bench, train, model)
        settings = settle_gain(settings, bench)
        parts = cls(settings, bench, dataset, model, fit, doubts, (*shortened, *widened))
        if settings["recipe"] == AUTO:
            with computing("float64", settings["device"], settings["compilation_cache"]):
                parts = parts._choose() if folder is None else parts._choose_once(folder / SETTLED)
        return replace(parts, seconds=time.perf_counter() - began)

    def computing(self) -> contextlib.AbstractContextManager[str]:
        """Return a context with JAX in the precision and on the device of the settings."""
        return computing(*(self.settings[name] for name in ("dtype", "device", "compilation_cache")))

    @property
    def _stages(self) -> Stages:
        return Stages(self.settings, self.bench, self.dataset, self.model, self.fit)

    def _choose(self, advice: str = "") -> "Parts":
        stages = self._stages
        stages.run()
        tell("")
        names = [name for name in OPTIONAL if get(stages.settings, f"{option_of(name)}.identify") is True]
        _log.info(
            "automatic settings: %d options%s; the report gives the reasons%s",
            len(stages.choices),
            f", {' and '.join(names)} identified" if names else "",
            advice,
        )
        return replace(
            self,
            settings=stages.settings,
            bench=stages.bench(),
            choices=(*self.choices, *stages.choices),
            start=stages.start,
            doubts=[*self.doubts, *stages.doubts],
            pilot=stages.pilot,
        )

    def _choose_once(self, path: Path) -> "Parts":
        """Choose open options, or read the choices of a run with the same options and data.

        The file may come from a stranger: nothing in it is executed.
        """
        identity = self._identify()
        if (stored := self._read(path, identity)) is not None:
            _log.info("automatic settings read from %s", path)
            if stored.start is None:
                return stored
            pilot = self._stages.repeat(stored.settings, stored.start)
            return replace(stored, pilot=pilot)  # the fit uses its compiled equations
        chosen = self._choose(", hydra.verbose=frictionzoo prints them")  # of the command line
        before, start = dict(list_options(self.settings)), chosen.start
        text = {
            "identity": identity,
            "options": {key: value for key, value in list_options(chosen.settings) if before.get(key) != value},
            "choices": [*map(astuple, chosen.choices[len(self.choices) :])],
            "doubts": [doubt.text for doubt in chosen.doubts[len(self.doubts) :]],
            "labels": start and start.labels,
            "loss": start and start.loss,
        }
        arrays = {name: getattr(start, name) for name in _ARRAYS} if start else {}
        arrays = {name: array for name, array in arrays.items() if array is not None}
        header = {_TEXT: json.dumps(to_json(text))}
        header["sha256"] = _sign(header[_TEXT], arrays)
        write_atomically(path, safetensors.numpy.save(arrays, header))
        return chosen

    def _read(self, path: Path, identity: str) -> "Parts | None":
        """Return these parts with stored choices; None if there are none, or they cannot be read."""
        if not path.exists():
            return None
        try:
            with safetensors.safe_open(path, "numpy") as file:
                arrays: dict[str, Any] = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
                header = file.metadata() or {}
            stored, whole = json.loads(header[_TEXT]), header["sha256"] == _sign(header[_TEXT], arrays)
            open_options = {option for option, value in list_options(self.settings) if value == AUTO}
            inits = {f"{each.removesuffix('identify')}init" for each in open_options if each.endswith(".identify")}
            fits = whole and stored["identity"] == identity and {*stored["options"]} <= open_options | inits
        except (OSError, ValueError, KeyError, TypeError, safetensors.SafetensorError):
            fits = False
        if not fits:
            _log.info("%s: damaged, or from other options or data; choosing automatic settings again", path)
            return None
        settings, start = copy.deepcopy(dict(self.settings)), None
        for option, value in stored["options"].items():
            put(settings, option, value)
        if stored["labels"] is not None:
            start = PilotResult(labels=stored["labels"], loss=stored["loss"], **{"states": None, **arrays})
        return replace(
            self,
            settings=settings,
            bench=change_bench(self.bench, settings["bench"]),
            choices=(*self.choices, *(AutomaticSetting(*choice) for choice in stored["choices"])),
            doubts=[*self.doubts, *(Finding("caution", "timestep", text) for text in stored["doubts"])],
            start=start,
        )

    def _identify(self) -> str:
        state = {name: value.numpy() for name, value in self.model.state_dict().items()}
        values = self.bench.initial_values()
        facts = {
            "version": __version__,
            "settings": {name: value for name, value in self.settings.items() if name not in _INDIFFERENT},
            "data": describe_data(self.dataset),
            "bench": [self.bench.template(), values and digest(values)],
            "model": digest(state),
        }
        return hashlib.sha256(json.dumps(to_json(facts), sort_keys=True).encode()).hexdigest()


def _sign(text: str, arrays: Mapping[str, Any]) -> str:
    return hashlib.sha256(f"{text}{digest(dict(sorted(arrays.items())))}".encode()).hexdigest()


def refuse_unknown(recipe: str) -> None:
    """Raise ConfigError for an unknown recipe."""
    if recipe not in RECIPES:
        raise ConfigError(f"recipe={recipe}: no such recipe; {closest(recipe, RECIPES)}")


def leave_open(bench: Mapping[str, Any], plain: Mapping[str, Any], from_file: bool) -> dict[str, Any]:
    """Return a bench's section with all options open that it does not set.

    `plain` is the section of a configuration with `recipe=auto`, which lists the options that may be open. `from_file`
    is whether a robot's file states the delay of commands.
    """
    optional = {name: dict(plain["params"][name]) for name in OPTIONAL if name != GAIN}
    optional["delay"] |= {"init": None} if from_file else {}
    open_options = {
        name: plain[name] for name in ("timestep", "solreffriction", "second_order") if bench.get(name) is None
    }
    return {**bench, "params": {**optional, **(bench.get("params") or {})}, **open_options}


def _divide_interval(bench: Bench, settings: Mapping[str, Any], interval: float) -> tuple[Bench, Mapping[str, Any]]:
    """Make the timestep divide the sample interval [s] if none was set; an open one stays `auto` in the settings."""
    timestep, steps = settings["bench"].get("timestep"), interval / bench.timestep
    if timestep not in (None, AUTO) or is_whole(interval, bench.timestep):
        return bench, settings
    step = interval / math.ceil(steps)
    text = "%s: timestep %g s instead of %g s, to divide the sample interval of %g s"
    _log.info(text, bench.source, step, bench.timestep, interval)
    if timestep is None:
        settings = {**settings, "bench": {**settings["bench"], "timestep": step}}
    return remake(bench, timestep=step), settings
