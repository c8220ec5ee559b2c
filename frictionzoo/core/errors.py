"""Errors that a user can cause: one line each, with what came, what was expected and what to do."""

import difflib
import math
from collections.abc import Iterable
from typing import Any

from frictionzoo.core.telling import escape_controls


class FrictionzooError(Exception):
    """Base of every error caused by the input; the command line prints its message without a traceback."""

    def __str__(self) -> str:
        return escape_controls(super().__str__())


class LogError(FrictionzooError):
    """Recording that cannot be read or is inconsistent."""


class FaultError(LogError):
    """Recording with a definite fault, found before the fit."""


class BenchError(FrictionzooError):
    """MJCF bench that does not fit its description or the recording."""


class ModelError(FrictionzooError):
    """Friction model that breaks the plug-in contract."""


class UnknownModelError(ModelError):
    """Friction model name that is not registered."""


class ConfigError(FrictionzooError):
    """Option that is unknown or has an impossible value."""


class MissingValueError(ConfigError):
    """Parameter with no value in the configuration or in the robot's file."""


class FitError(FrictionzooError):
    """Fit that cannot continue."""


class CheckpointError(FrictionzooError):
    """Checkpoint that cannot be read or belongs to another run."""


class RunError(FrictionzooError):
    """Run folder that cannot be read or that another process uses, or runs that cannot be compared."""


class ExportError(FrictionzooError):
    """Drive that another program cannot represent, or an export target that breaks the plug-in contract."""


class OutputError(FrictionzooError):
    """Result that cannot be written."""


def read_number(option: str, text: Any, kind: type[int] | type[float] = float) -> Any:
    """Read an option as a number of this kind.

    Raises:
        ConfigError: It is no finite number.
    """
    try:
        number = kind(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ConfigError(f"{option}={text}: expected a {'whole ' if kind is int else ''}number; change it")
    return number


def refuse_outside(option: str, value: int | float, low: int | float, high: int | float) -> None:
    """Refuse a number outside a range, and NaN.

    Raises:
        ConfigError: It lies outside; the message names the option by its dotted key.
    """
    if not low <= value <= high:
        raise ConfigError(f"{option}={value:g}: expected {low:g} to {high:g}")


def refuse_unlike(name: str, value: object, kind: type | tuple[type, ...], expected: str) -> None:
    """Refuse a value of the wrong type; `expected` says which value is right, and what to do.

    Raises:
        ConfigError: The value has another type.
    """
    if not isinstance(value, kind):
        raise ConfigError(f"{name}: {type(value).__name__}, expected {expected}")


def closest(name: str, options: Iterable[str]) -> str:
    """Return a hint for an unknown name: the closest of the valid options, then all of them."""
    options = sorted(options)
    matches = difflib.get_close_matches(name, options, n=1, cutoff=0.6)
    listed = f"expected one of {', '.join(options)}" if options else "none is available"
    return f"did you mean {matches[0]}? ({listed})" if matches else listed
