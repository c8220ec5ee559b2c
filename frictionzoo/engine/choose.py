"""Which engine simulates a bench."""

from frictionzoo.bench import Bench
from frictionzoo.engine.base import Engine, Friction
from frictionzoo.engine.mjx import MjxEngine
from frictionzoo.engine.specialise import CannotSpecialiseError
from frictionzoo.engine.specialised import SpecialisedEngine
from frictionzoo.errors import ConfigError, closest

_CHOICES = ("auto", "mjx", "specialised")
_MEASURED_JOINTS = 7
"""Up to so many joints `specialised` was measured, and is faster."""


def make_engine(choice: str, bench: Bench, friction: Friction, constraint: bool) -> Engine:
    """The engine that was asked for.

    Args:
        choice: `mjx`, `specialised`, or `auto` for `specialised` where it applies and is known to be faster, and `mjx`
            elsewhere.
        bench: What is simulated.
        friction: The friction law's formula over `jax.numpy`.
        constraint: Whether the law answers with a `frictionloss`.

    Raises:
        ConfigError: No such engine, or `specialised` does not apply.
    """
    if choice not in _CHOICES:
        raise ConfigError(f"engine={choice}: no such engine; {closest(choice, _CHOICES)}")
    if choice == "mjx":
        return MjxEngine(bench, friction, constraint)
    reason = f"{bench.nv} joints are more than the {_MEASURED_JOINTS} that were measured"
    if choice == "specialised" or bench.nv <= _MEASURED_JOINTS:
        try:
            return SpecialisedEngine(bench, friction, constraint)
        except CannotSpecialiseError as error:
            reason = f"{bench.source} has {error}"
    if choice == "specialised":
        raise ConfigError(f"engine=specialised: {reason}; set engine=auto or engine=mjx")
    engine = MjxEngine(bench, friction, constraint)
    engine.note = f"specialised does not apply: {reason}"
    return engine
