"""Choices of the automatic settings that need no fit: implied options, upper bounds, and lengths of rollouts."""

import copy
import functools
import logging
import operator
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from frictionzoo.bench import Actuator, Bench
from frictionzoo.core.build import build
from frictionzoo.core.config import list_choices
from frictionzoo.core.described import describe, remake
from frictionzoo.core.errors import LogError
from frictionzoo.core.log import Dataset, Log
from frictionzoo.core.params import AUTO, Param
from frictionzoo.core.segments import cut_segments, longest_window
from frictionzoo.diagnostics.balance import balance
from frictionzoo.models import FrictionModel
from frictionzoo.models.by_joint import ByJoint
from frictionzoo.models.by_name import law_section
from frictionzoo.result.evaluate import Evaluator
from frictionzoo.result.section_types import AutomaticSetting

_CHOSEN = ("params", "timestep", "solreffriction", "second_order")  # options of a bench
_log = logging.getLogger(__name__)
FEWEST = 10  # samples of a segment, and of an evaluation rollout
_AMPLE = 2.0  # factor on the bound that the torque allows
_LARGE = 99.0  # percentile of the absolute torque: a few samples may be wrong
_STILL = 0.1  # share of the fastest joint's speed or acceleration below which a joint is ignored

OPTIONAL = {
    "delay": "the data show a delay",
    "position_offset": "the data show an encoder offset",
    "torque_offset": "the data show a constant torque",
    "kp": "the data contradict the file's value",
}
"""Bench parameters that are identified only if the recordings show them, with that reason.

Otherwise each is 0, or the file's value if it is a gain.
"""
RIVALS = "torque_offset", "position_offset"
"""Two optional parameters that shift a balance with gravity alike: at most one of them is identified."""
GAIN = "kp"
_GAIN_BOUNDS = {"low": 1e-3, "high": 1e5, "scale": "log"}  # as in conf/bench/robot.yaml


def imply(loss: Mapping[str, Any]) -> Iterator[AutomaticSetting]:
    """Yield the choices that the options of a loss determine; an open option is `auto`."""
    options = {name: value for name, value in loss.items() if value != AUTO}
    if options.get("impulse"):
        yield AutomaticSetting("loss.position", 0.0, "loss.impulse uses measured velocities only")
        yield AutomaticSetting("loss.refine", False, "loss.impulse uses measured velocities only")
    if options.get("robust", "none") != "none":
        yield AutomaticSetting("loss.refine", False, "a robust loss starts at measured states")
    if 0 in (options.get("position"), options.get("velocity")):
        yield AutomaticSetting(
            "loss.refine", False, "multiple shooting needs weights above 0 for position and velocity"
        )
    if options.get("continuity"):
        yield AutomaticSetting("loss.refine", True, "loss.continuity needs estimated initial states")
        yield AutomaticSetting("segments.count", None, "loss.continuity needs consecutive segments")


def is_open(settings: Mapping[str, Any], option: str) -> bool:
    """Return whether the settings leave a dotted option open; an option that they lack is not open."""
    value = get(settings, option)
    return isinstance(value, str) and value == AUTO


def get(settings: Mapping[str, Any], option: str) -> Any:
    """Return the value of a dotted option; None if the settings lack it."""
    value: Any = settings
    for name in option.split("."):
        value = value.get(name) if isinstance(value, Mapping) else None
    return value


def put(settings: dict[str, Any], option: str, value: Any) -> None:
    """Set the value of a dotted option."""
    *path, name = option.split(".")
    functools.reduce(operator.getitem, path, settings)[name] = value


def option_of(name: str) -> str:
    """Return the dotted option of a bench's parameter that may be open."""
    return f"bench.actuator.params.{name}" if name == GAIN else f"bench.params.{name}"


def settle_gain(settings: Mapping[str, Any], bench: Bench) -> Mapping[str, Any]:
    """Decide whether position gains remain open, if nobody has stated whether they are identified.

    They do if `recipe` is `auto` and only a robot's file states them; otherwise they are not identified.
    """
    gain, section = bench.actuator.params.get(GAIN), settings["bench"].get("actuator")
    if gain is None or (section is not None and get(section, f"params.{GAIN}.identify") != AUTO):
        return settings
    is_positive = bool((bench.initial_values()[GAIN] > 0).all())  # not of servos of velocity and joints without one
    is_judged = settings["recipe"] == AUTO and gain.init is None and is_positive
    section = section or describe(bench.actuator)
    bounds = {} if gain.scale == "log" else _GAIN_BOUNDS
    gains = {**section["params"], GAIN: {**section["params"][GAIN], **bounds, "identify": AUTO if is_judged else False}}
    return {**settings, "bench": {**settings["bench"], "actuator": {**section, "params": gains}}}


def change_bench(bench: Bench, section: Mapping[str, Any]) -> Bench:
    """Return the bench with the chosen options of a section in the settings."""
    changed = {name: section[name] for name in _CHOSEN if name in section}
    gain = bench.actuator.params.get(GAIN)
    if gain is not None and not gain.is_identified and get(section, f"actuator.params.{GAIN}.identify") is True:
        changed["actuator"] = build(section["actuator"], Actuator)
    return remake(bench, **changed)


def widen_bounds(
    settings: Mapping[str, Any], bench: Bench, logs: Sequence[Log], model: FrictionModel
) -> tuple[Mapping[str, Any], Bench, tuple[AutomaticSetting, ...]]:
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
        is_shipped = low and law.name in list_choices("model")
        defaults = law_section(law.name, settings, {}).get("params", {}) if is_shipped else {}
        for name, param in low.items():
            if name in defaults and param.high == defaults[name]["high"]:
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


def _choose(option: str, param: Param, high: float) -> AutomaticSetting:
    over = {"damping": " over the speed", "inertia": " over the acceleration"}.get(param.dimension, "")
    return AutomaticSetting(f"{option}.high", high, f"twice the torque{over} in the recordings; default {param.high:g}")


def fit_lengths(
    settings: Mapping[str, Any], dataset: Dataset, kind: str
) -> tuple[dict[str, Any], tuple[AutomaticSetting, ...]]:
    """Shorten evaluation rollouts to the recordings, and check that segments and rollouts can be cut.

    `kind`: type of the joints, `hinge` or `slide`. Return settings with the new lengths, and one choice for each.

    Raises:
        LogError: The recordings are too short for an evaluation, or for segments of a length that was set.
        ConfigError: An option of the evaluation is impossible.
    """
    for part, logs in (("test", dataset.test), ("train", dataset.train)):
        if (longest := max(logs, key=lambda log: log.samples)).samples <= FEWEST:
            raise LogError(
                f"{longest.name}: {longest.samples} samples to {part}, expected more than {FEWEST}; use a longer log, "
                "or change data.split"
            )
    evaluation = dict(settings["evaluation"])
    choices = tuple(_shorten(evaluation, dataset))
    evaluation |= {choice.option.partition(".")[2]: choice.value for choice in choices}
    for choice in choices:
        _log.info("%s", choice)
    Evaluator(dataset, kind, **evaluation)  # refuses impossible options before the work
    length = settings["segments"]["length"]
    if length != AUTO:
        cut_segments(dataset.train, 1, length)
    return {**settings, "evaluation": evaluation}, choices


def _shorten(evaluation: Mapping[str, Any], dataset: Dataset) -> Iterator[AutomaticSetting]:
    """Yield the lengths of rollouts that the recordings do not allow: longer than they are, or below a sample."""
    test, train = _longest(dataset.test), _longest(dataset.train)
    interval = float(f"{dataset.test[0].timestep:.6g}")

    def limit(seconds: float, longest: float) -> float:
        return min(max(seconds, interval), longest) if seconds > 0 else seconds

    horizons = [limit(horizon, min(test, train)) for horizon in evaluation["horizons"]]
    lengths = {option: limit(evaluation[option], test) for option in ("trajectory", "local")}
    lengths["window"] = limit(evaluation["window"], lengths["trajectory"])
    reason = f"instead of {{}} s: test recordings last {test:g} s, with a sample every {interval:g} s"
    for option, value in {"horizons": list(dict.fromkeys(horizons)), **lengths}.items():
        if value != (before := evaluation[option]) and (option != "horizons" or horizons != list(before)):
            shown = ", ".join(f"{seconds:g}" for seconds in before) if option == "horizons" else f"{before:g}"
            yield AutomaticSetting(f"evaluation.{option}", value, reason.format(shown))


def _longest(logs: Sequence[Log]) -> float:
    return float(f"{longest_window(logs) * logs[0].timestep:.6g}")
