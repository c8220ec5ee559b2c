"""Choice of the engine that simulates a bench."""

import contextlib
from collections.abc import Iterator, Sequence

from frictionzoo.bench import Bench
from frictionzoo.core.errors import BenchError, ConfigError, closest
from frictionzoo.simulation.base import Engine, Friction
from frictionzoo.simulation.fold import CannotSpecialiseError
from frictionzoo.simulation.mjx import MjxEngine
from frictionzoo.simulation.specialised import SpecialisedEngine

_CHOICES = ("auto", "mjx", "specialised")
_MEASURED_JOINTS = 17  # most joints in a branch for which `specialised` was measured to be faster


def make_engine(choice: str, bench: Bench, friction: Friction, constraint: bool | Sequence[bool]) -> Engine:
    """Return the engine `mjx` or `specialised`; `auto` is `specialised` if it applies and is known to be faster.

    `constraint` is whether the model returns a `frictionloss`, or for which joints.

    Raises:
        ConfigError: There is no such engine, or `specialised` does not apply.
        BenchError: MJX does not support something in the bench.
    """
    if choice not in _CHOICES:
        raise ConfigError(f"engine={choice}: no such engine; {closest(choice, _CHOICES)}")
    joints = max(bench.branches.count(number) for number in bench.branches)
    coupled = "" if joints == bench.nv else " that move each other"
    reason = f"{joints} joints{coupled} are more than the {_MEASURED_JOINTS} that were measured"
    with naming_what_mjx_lacks(bench):
        if choice == "mjx":
            return MjxEngine(bench, friction, constraint)
        if choice == "specialised" or joints <= _MEASURED_JOINTS:
            try:
                return SpecialisedEngine(bench, friction, constraint)
            except CannotSpecialiseError as error:
                reason = f"{bench.source} has {error}"
        if choice == "specialised":
            raise ConfigError(f"engine=specialised: {reason}; set engine=auto or engine=mjx")
        return MjxEngine(bench, friction, constraint, note=f"specialised does not apply: {reason}")


@contextlib.contextmanager
def naming_what_mjx_lacks(bench: Bench) -> Iterator[None]:
    """Replace MJX's error about an unsupported MJCF by one line.

    Raises:
        BenchError: MJX raised NotImplementedError.
    """
    try:
        yield
    except NotImplementedError as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise BenchError(
            f"{bench.source}: MJX, in which it is simulated, does not take it ({reason[:200]}); leave that out of the "
            "MJCF"
        ) from error
