"""Quantities on which a model's friction depends: those it declares, and those found in its terms."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from frictionzoo.core.errors import ModelError
from frictionzoo.core.state import DriveState
from frictionzoo.models.base import FrictionModel, TorchFriction, Values, sliding_torque
from frictionzoo.models.formula import draw_values, numpy_terms
from frictionzoo.models.network import NetworkModel, reverse
from frictionzoo.models.registry import REGISTRY

SEES = ("speed", "slow", "fast", "direction", "load", "position", "temperature", "reversal")
"""Quantities on which friction may depend; see `FrictionModel.sees`."""
FEW = 8  # states that are checked
FAR = 1e3  # order of speeds at which only friction that grows faster than the speed is curved
CHANGED = 1e-9  # smallest relative change of the torque that counts


def observe(model: FrictionModel, samples: DriveState) -> set[str]:
    """Return the quantities on which the friction of any joint depends, at constant velocity, for any values in bounds.

    They are found from the sum of all terms while the joint slides: another magnitude of the velocity, a smaller torque
    at a higher speed (`slow`), a torque curve that bends up (`fast`), reversed motion with reversed load, other torques
    of actuator and load, another position and temperature. A model with memory depends on reversals. The model is
    prepared; the samples are numpy arrays of shape (samples, nv).
    """
    quantities, state = {"reversal"} if model.memory else set(), _moving(samples)
    for values in draw_values(model, weights=True):
        quantities |= {quantity for quantity, depends in _looks(model, values, state) if depends}
    return quantities


def is_curved(model: FrictionModel, samples: DriveState) -> bool:
    """Return whether the friction over speed bends up anywhere, which also happens with the Stribeck effect."""
    state, speeds = _moving(samples), np.linspace(0.1, 3, 15)
    return any(_bends(_speeds(model, values, state, speeds)) for values in draw_values(model, weights=True))


def suggest_law(model: FrictionModel, seen: set[str], missing: str) -> tuple[str | None, bool]:
    """Return a model that has a missing dependency, or has it with more parameters, and whether it has all in `seen`.

    `seen` are the dependencies of the present model. Candidates have all of them. The order prefers models without
    a network, then the fewest additional dependencies, the same sticking as the present model, and the fewest
    parameters. Without such a candidate, return the model that has the missing dependency and most of the others; None
    if no model has it.
    """
    count = len(model.dimensions) if missing in seen else -1
    laws = {
        n: cls for n, cls in _known_laws() if n != model.name and missing in cls.sees and len(cls.dimensions) > count
    }
    complete = {name: cls for name, cls in laws.items() if seen <= {*cls.sees}}

    def cost(name: str) -> tuple[int, bool, int, bool, int, str]:
        cls = laws[name]
        lost, extra = len(seen - {*cls.sees}), len({*cls.sees} - seen - {missing})
        return lost, issubclass(cls, NetworkModel), extra, cls.constraint != model.constraint, len(cls.dimensions), name

    if missing in seen:
        laws = complete
    return min(complete or laws, key=cost, default=None), bool(complete)


def simpler_law(model: FrictionModel, seen: set[str]) -> str | None:
    """Return the model with most, but not all, of these dependencies and no other; None if there is none."""
    laws = {name: cls for name, cls in _known_laws() if {*cls.sees} < seen and cls.sees}

    def cost(name: str) -> tuple[int, bool, int, str]:
        cls = laws[name]
        return -len(cls.sees), cls.constraint != model.constraint, len(cls.dimensions), name

    return min(laws, key=cost, default=None)


def _known_laws() -> Iterator[tuple[str, type[FrictionModel]]]:
    """Yield models with declared dependencies that a run can select by name alone."""
    for name in REGISTRY.names():
        try:
            cls = REGISTRY.get(name)
        except ModelError:  # from another package, and not requested
            continue
        if cls.sees and not issubclass(cls, TorchFriction):
            yield name, cls


def _looks(model: FrictionModel, values: Values, state: DriveState) -> Iterator[tuple[str, bool]]:
    """Yield each quantity and whether the friction depends on it with these values."""

    def torque(**changed: np.ndarray) -> np.ndarray:
        return _torque(model, values, state._replace(**changed))

    base, sizes = torque(), _speeds(model, values, state, np.linspace(0.05, 3, 20))
    yield "speed", _differs(sizes - sizes[0], sizes)
    yield "slow", bool((-np.diff(sizes, axis=0) > CHANGED * np.abs(sizes).max()).any())
    yield "fast", _bends(_speeds(model, values, state, FAR * np.arange(1, 6)))
    yield "direction", _differs(base + _torque(model, values, reverse(state)), base)
    for name in ("motor_torque", "external_torque"):
        yield "load", _differs(base - torque(**{name: 0.5 * getattr(state, name) + 0.3}), base)
    yield "position", _differs(base - torque(qpos=0.7 * state.qpos + 0.31), base)
    if state.temperature is not None:
        yield "temperature", _differs(base - torque(temperature=state.temperature + 5.0), base)


def _moving(samples: DriveState) -> DriveState:
    """Return a few of the states, spread over all, none at standstill."""
    few = samples.map(lambda signal: signal[:: max(1, len(signal) // FEW)])
    return few._replace(qvel=np.where(few.qvel == 0, 1.0, few.qvel))


def _speeds(
    model: FrictionModel, values: Values, state: DriveState, speeds: Float[np.ndarray, "speeds"]
) -> Float[np.ndarray, "speeds samples nv"]:
    """Return the friction's magnitude in each state at each of these speeds, in the state's direction."""
    shape, direction = (len(speeds), *state.qvel.shape), np.where(state.qvel < 0, -1.0, 1.0)
    states = state.map(lambda signal: np.broadcast_to(signal, shape).copy())
    return direction * _torque(model, values, states._replace(qvel=direction * speeds[:, None, None]))


def _torque(model: FrictionModel, values: Values, state: DriveState) -> np.ndarray:
    return sliding_torque(np, numpy_terms(model, values, state), state.qvel)


def _differs(change: np.ndarray, of: np.ndarray) -> bool:
    return bool(np.abs(change).max() > CHANGED * np.abs(of).max())


def _bends(sizes: Float[np.ndarray, "speeds samples nv"]) -> bool:
    """Return whether values at evenly spaced speeds have a second difference above 0."""
    return bool((np.diff(sizes, 2, axis=0) > CHANGED * np.abs(sizes).max()).any())
