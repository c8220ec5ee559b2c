"""What the friction of a law changes with: by what its class says, and seen in its answers."""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float

from frictionzoo.core.errors import ModelError
from frictionzoo.core.state import DriveState
from frictionzoo.models.base import FrictionModel, Values, sliding_torque
from frictionzoo.models.network import NetworkModel
from frictionzoo.models.registry import REGISTRY
from frictionzoo.models.torch_friction import TorchFriction

SEES = ("speed", "slow", "fast", "direction", "load", "position", "temperature", "reversal")
"""What friction may change with, as `FrictionModel.sees` has it."""
DRAWS = 5  # of values between their bounds
FEW = 8  # states that are looked at
FAR = 1e3  # order of the speeds at which only friction that grows faster than the speed is curved
CHANGED = 1e-9  # share of the torque by which it differs where it differs


def observe(model: FrictionModel, samples: DriveState) -> set[str]:
    """What the friction of a law changes with in some of its joints, at constant velocity, with any values in bounds.

    It is seen in the torque of all its terms while the joint slides: with another size of the velocity, with a smaller
    size at a larger speed (`slow`), with a size that bends up (`fast`), in the reversed motion under the reversed load,
    with other torques of actuator and load, with another position and temperature. What remembers sees reversals.

    Args:
        model: The law, its constants prepared.
        samples: States, numpy arrays of shape (samples, nv).
    """
    found, state = {"reversal"} if model.memory else set(), _moving(samples)
    for values in _draw(model):
        found |= {what for what, seen in _looks(model, values, state) if seen}
    return found


def is_curved(model: FrictionModel, samples: DriveState) -> bool:
    """Whether a law's friction bends up with the speed anywhere, which a Stribeck effect does too.

    Args:
        model: The law.
        samples: As in `observe`.
    """
    state = _moving(samples)
    return any(_bends(_speeds(model, values, state, np.linspace(0.1, 3, 15))) for values in _draw(model))


def suggest_law(model: FrictionModel, seen: set[str], missing: str) -> tuple[str | None, bool]:
    """The law of the zoo that sees something that a law does not, or sees it with more parameters.

    Of those that see all that the law sees besides, one without a network comes first, then the one that sees the least
    more, sticks as the present law does, and has the fewest parameters. Where no law sees all of it, it is the one that
    sees what is missing and most of the rest.

    Args:
        model: The present law.
        seen: What it sees.
        missing: What is to be seen.

    Returns:
        Its name, None where no law sees what is missing; and whether it sees all that the present one does.
    """
    more = len(model.dimensions) if missing in seen else -1
    laws = {
        n: cls for n, cls in _known_laws() if n != model.name and missing in cls.sees and len(cls.dimensions) > more
    }
    whole = {name: cls for name, cls in laws.items() if seen <= {*cls.sees}}

    def cost(name: str) -> tuple[int, bool, int, bool, int, str]:
        cls = laws[name]
        lost, extra = len(seen - {*cls.sees}), len({*cls.sees} - seen - {missing})
        return lost, issubclass(cls, NetworkModel), extra, cls.constraint != model.constraint, len(cls.dimensions), name

    if missing in seen:
        laws = whole
    return min(whole or laws, key=cost, default=None), bool(whole)


def simpler_law(model: FrictionModel, seen: set[str]) -> str | None:
    """The law that sees less than a law does, and the most of that; None where none does."""
    laws = {name: cls for name, cls in _known_laws() if {*cls.sees} < seen and cls.sees}

    def cost(name: str) -> tuple[int, bool, int, str]:
        cls = laws[name]
        return -len(cls.sees), cls.constraint != model.constraint, len(cls.dimensions), name

    return min(laws, key=cost, default=None)


def _known_laws() -> Iterator[tuple[str, type[FrictionModel]]]:
    """Laws that say what they see, and that a run can be asked for by name alone."""
    for name in REGISTRY.names():
        try:
            cls = REGISTRY.get(name)
        except ModelError:  # another package's, which is not what was asked for
            continue
        if cls.sees and not issubclass(cls, TorchFriction):
            yield name, cls


def _draw(model: FrictionModel) -> Iterator[Values]:
    """A law's own values, and others between their bounds."""
    random, drawn = np.random.default_rng(0), {n: v.detach().double() for n, v in model.state_dict().items()}
    weights = [name for name, tensor in model.named_parameters() if name not in model.params]
    for _ in range(1 + DRAWS):
        yield drawn
        drawn = {**drawn, **{name: torch.tensor(random.normal(size=drawn[name].shape)) for name in weights}}
        for name, param in model.params.items():
            ends = (param.each(side, model.nv)[param.members(model.nv)] for side in ("low", "high"))
            low, high = (param.to_coordinate(end, np) for end in ends)
            drawn[name] = torch.tensor(param.from_coordinate(random.uniform(low, high), np))


def _looks(model: FrictionModel, values: Values, state: DriveState) -> Iterator[tuple[str, bool]]:
    """What the law sees with these values."""

    def torque(**changed: np.ndarray) -> np.ndarray:
        return _torque(model, values, state._replace(**changed))

    base, sizes = torque(), _speeds(model, values, state, np.linspace(0.05, 3, 20))
    yield "speed", _differs(sizes - sizes[0], sizes)
    yield "slow", bool((-np.diff(sizes, axis=0) > CHANGED * np.abs(sizes).max()).any())
    yield "fast", _bends(_speeds(model, values, state, FAR * np.arange(1, 6)))
    mirrored = {name: -getattr(state, name) for name in ("qvel", "motor_torque", "external_torque")}
    yield "direction", _differs(base + torque(**mirrored), base)
    for name in ("motor_torque", "external_torque"):
        yield "load", _differs(base - torque(**{name: 0.5 * getattr(state, name) + 0.3}), base)
    yield "position", _differs(base - torque(qpos=0.7 * state.qpos + 0.31), base)
    if state.temperature is not None:
        yield "temperature", _differs(base - torque(temperature=state.temperature + 5.0), base)


def _moving(samples: DriveState) -> DriveState:
    """A few of the states, spread over all, none at standstill."""
    few = samples.map(lambda signal: signal[:: max(1, len(signal) // FEW)])
    return few._replace(qvel=np.where(few.qvel == 0, 1.0, few.qvel))


def _speeds(
    model: FrictionModel, values: Values, state: DriveState, speeds: Float[np.ndarray, "speeds"]
) -> Float[np.ndarray, "speeds samples nv"]:
    """Size of the friction in each state at each of these speeds, in the direction in which it moves there."""
    shape, direction = (len(speeds), *state.qvel.shape), np.where(state.qvel < 0, -1.0, 1.0)
    whole = state.map(lambda signal: np.broadcast_to(signal, shape).copy())
    return direction * _torque(model, values, whole._replace(qvel=direction * speeds[:, None, None]))


def _torque(model: FrictionModel, values: Values, state: DriveState) -> np.ndarray:
    with torch.no_grad():
        tensors = state.map(lambda signal: torch.tensor(signal, dtype=torch.float64))
        return sliding_torque(torch, model.terms(torch, values, tensors), tensors.qvel).numpy()


def _differs(change: np.ndarray, of: np.ndarray) -> bool:
    return bool(np.abs(change).max() > CHANGED * np.abs(of).max())


def _bends(sizes: Float[np.ndarray, "speeds samples nv"]) -> bool:
    """Whether sizes at evenly spaced speeds have a second difference above 0."""
    return bool((np.diff(sizes, 2, axis=0) > CHANGED * np.abs(sizes).max()).any())
