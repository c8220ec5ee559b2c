"""Upper bounds of armature and friction that the recorded motion asks for, where they are defaults."""

import copy
import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from frictionzoo.bench import Bench
from frictionzoo.checkup.balance import balance
from frictionzoo.core.config import list_choices
from frictionzoo.core.described import remake
from frictionzoo.core.log import Log
from frictionzoo.core.params import AUTO, Param
from frictionzoo.identification.choices import Choice
from frictionzoo.models import FrictionModel
from frictionzoo.models.by_joint import ByJoint
from frictionzoo.models.by_name import law_section

_log = logging.getLogger(__name__)
_AMPLE = 2.0  # times what the torque allows
_LARGE = 99.0  # percentile of the torque's size: a few samples may be wrong
_STILL = 0.1  # share of the fastest joint's speed, or acceleration, below which a joint does not count


def widen_bounds(
    settings: Mapping[str, Any], bench: Bench, logs: Sequence[Log], model: FrictionModel
) -> tuple[Mapping[str, Any], Bench, tuple[Choice, ...]]:
    """Raise upper bounds that are defaults to what the recordings allow.

    No dry friction is larger than the torque that moves a joint, no damping than that over the speed, no armature than
    that over the acceleration. A bound is never lowered, and one that is not the default stays.

    Args:
        settings: All options; with another recipe than `auto` nothing changes.
        bench: The test stand.
        logs: Training recordings that it accepted.
        model: The law, bound to the joints; its own bounds are raised.

    Returns:
        Settings and bench with these bounds, and a choice for each.
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
    """The largest parameter of any joint that recordings allow, by its dimension."""
    compiled = bench.compile(constraint=False)
    found = [one for log in logs if (one := balance(log, bench, compiled)) is not None]
    if not found:
        return {}
    torque, qvel, qacc = (np.concatenate([getattr(one, name) for one in found]) for name in ("torque", "qvel", "qacc"))
    size = _AMPLE * np.percentile(np.abs(torque), _LARGE, axis=0)
    speed, acceleration = (np.sqrt(np.mean(np.square(rows), axis=0)) for rows in (qvel, qacc))
    largest = {"torque": size.max()}
    for dimension, rate in (("damping", speed), ("inertia", acceleration)):
        moving = rate > _STILL * rate.max()
        largest |= {dimension: (size[moving] / rate[moving]).max()} if moving.any() else {}
    return {dimension: float(f"{high:.2g}") for dimension, high in largest.items()}


def _is_low(param: Param, allowed: Mapping[str, float]) -> bool:
    """Whether a parameter that a fit may change has one number as its upper bound, below what recordings allow."""
    high = param.high
    return param.is_identified and isinstance(high, float) and high < allowed.get(param.dimension, 0.0)


def _list_laws(
    model: FrictionModel, section: Mapping[str, Any]
) -> Iterator[tuple[FrictionModel, Sequence[Mapping[str, Any]], str]]:
    """Each law of a model that may have several, with the sections that make it, and the first one's option."""
    if not isinstance(model, ByJoint):
        yield model, [section], "model"
        return
    laws = section["laws"]
    patterns = [*laws] if isinstance(laws, Mapping) else range(len(laws))
    for number, (law, joints) in enumerate(zip(model.laws, model.members, strict=True)):
        own = [patterns[number]] if isinstance(laws, Mapping) else joints
        yield law, [laws[key] for key in own], f"model.laws.{own[0]}"


def _read_defaults(name: str, settings: Mapping[str, Any]) -> dict[str, float]:
    """Upper bounds that `conf/model` gives a law's parameters."""
    if name not in list_choices("model"):
        return {}
    return {key: param["high"] for key, param in law_section(name, settings, {}).get("params", {}).items()}


def _choose(option: str, param: Param, high: float) -> Choice:
    over = {"damping": " over the speed", "inertia": " over the acceleration"}.get(param.dimension, "")
    return Choice(f"{option}.high", high, f"twice the torque{over}; default {param.high:g}")
