"""Which engine simulates a bench."""

import contextlib
from collections.abc import Iterator, Sequence

from frictionzoo.bench import Bench
from frictionzoo.core.errors import BenchError, ConfigError, closest
from frictionzoo.simulate.base import Engine, Friction
from frictionzoo.simulate.fold import CannotSpecialiseError
from frictionzoo.simulate.mjx import MjxEngine
from frictionzoo.simulate.specialised import SpecialisedEngine

_CHOICES = ("auto", "mjx", "specialised")
_MEASURED_JOINTS = 17
"""Up to so many joints of a branch `specialised` was measured, and is faster."""


def make_engine(choice: str, bench: Bench, friction: Friction, constraint: bool | Sequence[bool]) -> Engine:
    """The engine that was asked for.

    Args:
        choice: `mjx`, `specialised`, or `auto` for `specialised` where it applies and is known to be faster, and `mjx`
            elsewhere.
        bench: What is simulated.
        friction: The friction law's formula over `jax.numpy`.
        constraint: Whether the law answers with a `frictionloss`, or for which joints.

    Raises:
        ConfigError: No such engine, or `specialised` does not apply.
        BenchError: MJX lacks something that the bench has.
    """
    if choice not in _CHOICES:
        raise ConfigError(f"engine={choice}: no such engine; {closest(choice, _CHOICES)}")
    with naming_what_mjx_lacks(bench):
        return _make_engine(choice, bench, friction, constraint)


@contextlib.contextmanager
def naming_what_mjx_lacks(bench: Bench) -> Iterator[None]:
    """One line in place of what MJX raises where it takes a model over or steps it.

    Raises:
        BenchError: MJX has raised something.
    """
    try:
        yield
    except NotImplementedError as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise BenchError(
            f"{bench.source}: MJX, in which it is simulated, does not take it ({reason[:200]}); leave that out of the "
            "MJCF"
        ) from error


def _make_engine(choice: str, bench: Bench, friction: Friction, constraint: bool | Sequence[bool]) -> Engine:
    if choice == "mjx":
        return MjxEngine(bench, friction, constraint)
    most = max(bench.branches.count(number) for number in bench.branches)
    together = "" if most == bench.nv else " that move each other"
    reason = f"{most} joints{together} are more than the {_MEASURED_JOINTS} that were measured"
    if choice == "specialised" or most <= _MEASURED_JOINTS:
        try:
            return SpecialisedEngine(bench, friction, constraint)
        except CannotSpecialiseError as error:
            reason = f"{bench.source} has {error}"
    if choice == "specialised":
        raise ConfigError(f"engine=specialised: {reason}; set engine=auto or engine=mjx")
    engine = MjxEngine(bench, friction, constraint)
    engine.note = f"specialised does not apply: {reason}"
    return engine
