"""Automatic settings: open options are chosen on the training data alone, each with a reason."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from frictionzoo.bench import Bench
from frictionzoo.core.errors import ConfigError, closest
from frictionzoo.core.log import Dataset
from frictionzoo.core.params import AUTO
from frictionzoo.diagnostics.findings import Doubt
from frictionzoo.fit import Fit
from frictionzoo.identification.choices import OPTIONAL, Choice
from frictionzoo.identification.pilot import Found, Pilot
from frictionzoo.identification.stages import Stages
from frictionzoo.models import FrictionModel

_log = logging.getLogger(__name__)

RECIPES = ("given", AUTO)


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
    start: Found | None = None
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
