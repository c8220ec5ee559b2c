"""Settings that find themselves: what a user leaves open is chosen on the training data alone, with a reason each."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from frictionzoo.bench import Bench
from frictionzoo.checkup.findings import Doubt
from frictionzoo.core.errors import ConfigError, closest
from frictionzoo.core.log import Dataset
from frictionzoo.core.params import AUTO
from frictionzoo.fit import Fit
from frictionzoo.identification.choices import OPTIONAL, Choice
from frictionzoo.identification.pilot import Found, Pilot
from frictionzoo.identification.stages import Stages
from frictionzoo.models import FrictionModel

_log = logging.getLogger(__name__)

RECIPES = ("given", AUTO)


@dataclass(frozen=True)
class Settled:
    """Settings of which nothing is left open.

    Attributes:
        settings: All options of the run.
        bench: The test stand with them.
        choices: What was left open, in the order in which it was chosen.
        start: Where the fit begins; None: at the initial values.
        doubts: Where the accuracy that was sought is not reached, a sentence each.
        pilot: One with these settings; None where there was none, or where they were kept in a file.
    """

    settings: Mapping[str, Any]
    bench: Bench
    choices: tuple[Choice, ...] = ()
    start: Found | None = None
    doubts: tuple[Doubt, ...] = ()
    pilot: Pilot | None = None


def settle(settings: Mapping[str, Any], bench: Bench, dataset: Dataset, model: FrictionModel, fit: Fit) -> Settled:
    """Choose what the settings leave open, on the training recordings alone, in float64.

    Args:
        settings: All options; an open one is `auto`. What is not, stays.
        bench: The test stand without what is open.
        dataset: Recordings.
        model: The law, bound to the joints of the bench; it stays as it is.
        fit: How parameters are to be found.

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
    found = stages.start, tuple(stages.doubts), stages.pilot
    return Settled(stages.settings, stages.bench(), tuple(choices), *found)


def refuse_unknown(recipe: str) -> None:
    """ConfigError where there is no such recipe."""
    if recipe not in RECIPES:
        raise ConfigError(f"recipe={recipe}: no such recipe; {closest(recipe, RECIPES)}")


def leave_open(bench: Mapping[str, Any], plain: Mapping[str, Any], from_file: bool) -> dict[str, Any]:
    """A bench's section that leaves open what its maker said nothing of.

    Args:
        bench: The section.
        plain: That of a configuration with `recipe=auto`, which says what may be left open.
        from_file: Whether a robot's file says by how much commands act late.
    """
    perhaps = {name: dict(plain["params"][name]) for name in OPTIONAL}
    perhaps["delay"] |= {"init": None} if from_file else {}
    steps = {name: plain[name] for name in ("timestep", "solreffriction", "second_order") if bench.get(name) is None}
    return {**bench, "params": {**perhaps, **(bench.get("params") or {})}, **steps}
