"""Check that a model equals each of its nested models at the declared parameter values."""

from collections.abc import Mapping
from typing import Any, NoReturn

import numpy as np
import torch

from frictionzoo.core.errors import ModelError
from frictionzoo.core.state import DriveState
from frictionzoo.models.base import FrictionModel, sliding_torque
from frictionzoo.models.formula import DRAWS, numpy_terms
from frictionzoo.models.registry import get_model

_NEAR = 0.2  # fraction of the way from the initial value to a bound
_SLIDING = 1.0  # rad/s or m/s, far above the smoothing of any sign
_TOLERANCE = 1e-3  # relative, for the error of a smooth sign at that speed


def check_contained(model: FrictionModel, samples: DriveState) -> None:
    """Check that the sliding friction of a model equals each nested model's, at random values of both.

    Raises:
        ModelError: The friction differs, or `contains` names an unknown parameter.
    """
    random = np.random.default_rng(0)
    sliding = samples._replace(qvel=samples.qvel + np.where(samples.qvel < 0, -_SLIDING, _SLIDING))
    for name, within in model.contains.items():
        law = get_model(name)
        _refuse_unknown(model, law, within)
        for _ in range(DRAWS):
            theirs, ours = _draw(model, law, within, random)
            other = law(model.nv, params={param: list(value) for param, value in theirs.items()})
            expected, actual = (_torque(*pair, sliding) for pair in ((other, theirs), (model, ours)))
            error = float((np.abs(actual - expected) / np.maximum(np.abs(expected), np.finfo(float).tiny)).max())
            if not error <= _TOLERANCE:
                _fail(
                    model,
                    f"in sliding, it differs from {name} by {error:.3g} of its friction; see the values in contains",
                )


def _refuse_unknown(model: FrictionModel, law: type[FrictionModel], within: Mapping[str, Any]) -> None:
    for param, rule in within.items():
        if param not in model.dimensions:
            _fail(model, f"{param} is not one of its parameters; name one of {', '.join(model.dimensions)}")
        if isinstance(rule, str) and rule not in law.dimensions:
            _fail(model, f"{param} is {rule} of {law.name}, which has {', '.join(law.dimensions)}; name one of these")


def _draw(
    model: FrictionModel, law: type[FrictionModel], within: Mapping[str, Any], random: np.random.Generator
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return values of the nested model, and the containing model's values that make both equal, of shape (nv,)."""
    ours = {name: _between(model, name, random) for name in model.params}
    rules = {name: within.get(name, name) for name in model.params}
    theirs = {rule: ours[name] for name, rule in rules.items() if isinstance(rule, str) and rule in law.dimensions}
    theirs = {name: theirs.get(name, np.exp(random.uniform(-1, 1, model.nv))) for name in law.dimensions}  # any value
    for name, rule in rules.items():
        if isinstance(rule, float):
            ours[name] = np.full(model.nv, rule)
        elif callable(rule):
            ours[name] = np.asarray(rule(theirs))
        elif rule in theirs:
            ours[name] = theirs[rule]
    return theirs, ours


def _between(model: FrictionModel, name: str, random: np.random.Generator) -> np.ndarray:
    """Return a value near the initial one, because a model may clip near its bounds; a known value stays."""
    param = model.params[name]
    low, high, init = (param.each(field, model.nv) for field in ("low", "high", "init"))
    if not param.is_identified:
        return np.array(init)
    low, high, init = (param.to_coordinate(end, np) for end in (low, high, init))
    return param.from_coordinate(init + _NEAR * (random.uniform(low, high) - init), np)


def _torque(model: FrictionModel, values: Mapping[str, np.ndarray], samples: DriveState) -> np.ndarray:
    state = {**model.state_dict(), **{name: torch.tensor(value) for name, value in values.items()}}
    return sliding_torque(np, numpy_terms(model, state, samples), samples.qvel)


def _fail(model: FrictionModel, message: str) -> NoReturn:
    raise ModelError(f"{model.name}: contains: {message}")
