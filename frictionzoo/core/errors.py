"""The errors that a user can cause: one line each, with what came, what was expected and what to do."""

import difflib
from collections.abc import Iterable

from frictionzoo.core.telling import escape_controls


class FrictionzooError(Exception):
    """Base of every error that is the input's fault; the command line prints its message without a traceback."""

    def __str__(self) -> str:
        """One line, with control characters of names in it escaped."""
        return escape_controls(super().__str__())


class LogError(FrictionzooError):
    """A recording that cannot be read or does not make sense."""


class BenchError(FrictionzooError):
    """An MJCF bench that does not fit its description or the recording."""


class ModelError(FrictionzooError):
    """A friction model that does not keep the plug-in contract."""


class UnknownModelError(ModelError):
    """A friction model's name that is not registered."""


class ConfigError(FrictionzooError):
    """An option that is unknown or has an impossible value."""


class MissingValueError(ConfigError):
    """A parameter has no value and no file that states one."""


class FitError(FrictionzooError):
    """A fit that cannot go on."""


class CheckpointError(FrictionzooError):
    """A checkpoint that cannot be read or belongs to another run."""


class RunError(FrictionzooError):
    """A run's folder that cannot be read or is another process's, or runs that cannot be compared."""


class ExportError(FrictionzooError):
    """A drive that another program cannot hold, or an export target that does not keep the plug-in contract."""


class OutputError(FrictionzooError):
    """A result that cannot be written."""


def refuse_outside(option: str, value: int | float, low: int | float, high: int | float) -> None:
    """Refuse a number outside a range, by the dotted key of what a user sets: ConfigError, for NaN too."""
    if not low <= value <= high:
        raise ConfigError(f"{option}={value:g}: expected {low:g} to {high:g}")


def refuse_unlike(name: str, value: object, kind: type | tuple[type, ...], expected: str) -> None:
    """Refuse a value of another kind.

    Args:
        name: Of the argument.
        value: What came.
        kind: What is meant.
        expected: The same in words, and what to do.

    Raises:
        ConfigError: It is of another kind.
    """
    if not isinstance(value, kind):
        raise ConfigError(f"{name}: {type(value).__name__}, expected {expected}")


def closest(name: str, options: Iterable[str]) -> str:
    """Hint for an unknown name: the closest of the options that would have been understood, then all of them."""
    options = sorted(options)
    near = difflib.get_close_matches(name, options, n=1, cutoff=0.6)
    listed = f"expected one of {', '.join(options)}" if options else "none is available"
    return f"did you mean {near[0]}? ({listed})" if near else listed
