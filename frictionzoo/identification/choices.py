"""Choices of the automatic settings that need no fit: implied options, and upper bounds of armature and friction."""

import copy
import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from frictionzoo.bench import Bench
from frictionzoo.core.config import list_choices
from frictionzoo.core.described import remake
from frictionzoo.core.log import Log
from frictionzoo.core.params import AUTO, Param
from frictionzoo.diagnostics.balance import balance
from frictionzoo.models import FrictionModel
from frictionzoo.models.by_joint import ByJoint
from frictionzoo.models.by_name import law_section

_log = logging.getLogger(__name__)
_AMPLE = 2.0  # factor on the bound that the torque allows
_LARGE = 99.0  # percentile of the absolute torque: a few samples may be wrong
_STILL = 0.1  # share of the fastest joint's speed or acceleration below which a joint is ignored

OPTIONAL = {
    "delay": "the data show a delay",
    "position_offset": "the data show an encoder offset",
    "torque_offset": "the data show a constant torque",
}
"""Bench parameters that are identified only if the recordings show them, with that reason; 0 means absent for each."""
RIVALS = "torque_offset", "position_offset"
"""Two optional parameters that shift a balance with gravity alike: at most one of them is identified."""


class Choice(NamedTuple):
    """The value chosen for an open option, and the reason."""

    option: str
    value: Any
    reason: str

    def __str__(self) -> str:
        value = "null" if self.value is None else self.value
        return f"{self.option}={str(value).lower() if isinstance(value, bool) else value}: {self.reason}"


def imply(loss: Mapping[str, Any]) -> Iterator[Choice]:
    """Yield the choices that the options of a loss determine; an open option is `auto`."""
    options = {name: value for name, value in loss.items() if value != AUTO}
    if options.get("impulse"):
        yield Choice("loss.position", 0.0, "loss.impulse uses measured velocities only")
        yield Choice("loss.refine", False, "loss.impulse uses measured velocities only")
    if options.get("robust", "none") != "none":
        yield Choice("loss.refine", False, "a robust loss starts at measured states")
    if 0 in (options.get("position"), options.get("velocity")):
        yield Choice("loss.refine", False, "multiple shooting needs weights above 0 for position and velocity")
    if options.get("continuity"):
        yield Choice("loss.refine", True, "loss.continuity needs estimated initial states")
        yield Choice("segments.count", None, "loss.continuity needs consecutive segments")


def is_open(params: Mapping[str, Any], name: str) -> bool:
    """Return whether a bench's parameter section leaves open if this parameter is identified."""
    return isinstance(params.get(name), Mapping) and params[name].get("identify") == AUTO


def widen_bounds(
    settings: Mapping[str, Any], bench: Bench, logs: Sequence[Log], model: FrictionModel
) -> tuple[Mapping[str, Any], Bench, tuple[Choice, ...]]:
    """Raise default upper bounds to the largest values that recordings allow, if `recipe` is `auto`.

    The torque that moves a joint limits its dry friction, torque over speed its damping, and torque over acceleration
    its armature. Bounds are never lowered, and bounds that differ from the default are kept. `logs` are training
    recordings that the bench has accepted; the bounds of `model`, bound to the joints, are raised in place.

    Returns:
        Settings and bench with the new bounds, and one choice for each raised bound.
    """
    if settings["recipe"] != AUTO:
        return settings, bench, ()
    allowed, changed, choices = _allow(bench, logs), copy.deepcopy(dict(settings)), []
    for law, sections, option in _list_laws(model, changed["model"]):
        low = {name: param for name, param in law.params.items() if _is_low(param, allowed)}
        defaults = _read_defaults(law.name, settings) if low else {}
        for name, param in low.items():
            if param.high == defaults.get(name):
                high = allowed[param.dimension]
                law.params[name] = replace(param, high=high)
                for section in sections:
                    section["params"][name]["high"] = high
                choices.append(_choose(f"{option}.params.{name}", param, high))
    model.bind(bench.joints)
    armature = bench.params["armature"]
    if _is_low(armature, allowed) and armature.high == bench.armature_high:
        high, params = allowed["inertia"], dict(changed["bench"].get("params") or {})
        params["armature"] = {**params.get("armature", {}), "high": high}
        changed["bench"]["params"], bench = params, remake(bench, params=params)
        choices.append(_choose("bench.params.armature", armature, high))
    for choice in choices:
        _log.info("%s", choice)
    return changed, bench, tuple(choices)


def _allow(bench: Bench, logs: Sequence[Log]) -> dict[str, float]:
    """Return the largest value that recordings allow in any joint, for each dimension of a parameter."""
    compiled = bench.compile(constraint=False)
    balances = [signals for log in logs if (signals := balance(log, bench, compiled)) is not None]
    if not balances:
        return {}
    torque, qvel, qacc = (
        np.concatenate([getattr(signals, name) for signals in balances]) for name in ("torque", "qvel", "qacc")
    )
    size = _AMPLE * np.percentile(np.abs(torque), _LARGE, axis=0)
    speed, acceleration = (np.sqrt(np.mean(np.square(rows), axis=0)) for rows in (qvel, qacc))
    largest = {"torque": size.max()}
    for dimension, rate in (("damping", speed), ("inertia", acceleration)):
        moving = rate > _STILL * rate.max()
        largest |= {dimension: (size[moving] / rate[moving]).max()} if moving.any() else {}
    return {dimension: float(f"{high:.2g}") for dimension, high in largest.items()}


def _is_low(param: Param, allowed: Mapping[str, float]) -> bool:
    """Return whether an identified parameter has a scalar upper bound below the one that recordings allow."""
    high = param.high
    return param.is_identified and isinstance(high, float) and high < allowed.get(param.dimension, 0.0)


def _list_laws(
    model: FrictionModel, section: Mapping[str, Any]
) -> Iterator[tuple[FrictionModel, Sequence[Mapping[str, Any]], str]]:
    """Yield each friction model of a possibly composite one, its sections, and the option of the first section."""
    if not isinstance(model, ByJoint):
        yield model, [section], "model"
        return
    laws = section["laws"]
    patterns = [*laws] if isinstance(laws, Mapping) else range(len(laws))
    for number, (law, joints) in enumerate(zip(model.laws, model.members, strict=True)):
        keys = [patterns[number]] if isinstance(laws, Mapping) else joints
        yield law, [laws[key] for key in keys], f"model.laws.{keys[0]}"


def _read_defaults(name: str, settings: Mapping[str, Any]) -> dict[str, float]:
    """Return the default upper bounds of a friction model's parameters."""
    if name not in list_choices("model"):
        return {}
    return {key: param["high"] for key, param in law_section(name, settings, {}).get("params", {}).items()}


def _choose(option: str, param: Param, high: float) -> Choice:
    over = {"damping": " over the speed", "inertia": " over the acceleration"}.get(param.dimension, "")
    return Choice(f"{option}.high", high, f"twice the torque{over} in the recordings; default {param.high:g}")
