"""Overrides on the command line: which files they choose, and those that Hydra would misread."""

import contextlib
import math
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Glob, Override, QuotedString, RangeSweep
from hydra.errors import HydraException

from frictionzoo.core.config import CONF_DIR, list_choices
from frictionzoo.core.errors import ConfigError, closest

MOST_JOBS = 100_000  # of one range in a sweep
_RAISE = "HYDRA_FULL_ERROR"
_FOLDERS = ("hydra.run.dir", "hydra.sweep.dir", "hydra.sweep.subdir")
_OPTIONAL_GROUPS = ("experiment", "variant", "start")


@contextlib.contextmanager
def given_to_hydra(arguments: Sequence[str]) -> Iterator[None]:
    """Let Hydra read these arguments, and raise what it refuses instead of printing a page of its own.

    It takes both from the process, which is afterwards as it was.
    """
    given, full = sys.argv, os.environ.get(_RAISE)
    # It refuses overrides on both sides of a flag.
    flags_first = sorted(arguments, key=lambda each: each.startswith("~") or ("=" in each and each[0] != "-"))
    sys.argv, os.environ[_RAISE] = [given[0], *flags_first], "1"
    try:
        yield
    finally:
        sys.argv = given
        if full is None:
            del os.environ[_RAISE]
        else:
            os.environ[_RAISE] = full


def refuse_no_choice(arguments: Sequence[str]) -> None:
    """Refuse what is no override, and what does not choose one file of a group.

    Raises:
        ConfigError: One cannot be read, or chooses none, several, or something that is no name.
    """
    for override in read_arguments(arguments):
        group = override.key_or_group
        _refuse_no_setting(override)
        if not ("/" in group or is_group(group)):
            continue
        names = choices_named(override)
        known = all(isinstance(name, str) for name in names)
        if group in _OPTIONAL_GROUPS and (override.is_delete() or _may_be(group, names)):
            continue
        if override.is_delete() or not known or group == "variant":
            asked, needed = str(override.input_line), f"a job needs one {group}"
            if group in _OPTIONAL_GROUPS:
                needed = "expected one name, or to leave it out"
            raise ConfigError(f"{asked}: {needed}; {closest(asked.partition('=')[2], list_choices(group))}")


def _may_be(group: str, names: Sequence[Any]) -> bool:
    """Whether a group that may be left out takes each of these; null is what `start` is where it is left out."""
    choices = [*list_choices(group), *([None] if group == "start" else [])]
    return all(name in choices for name in names)


def _refuse_no_setting(override: Override) -> None:
    """ConfigError for a setting of Hydra's that it would take for the working directory, or fail over."""
    name, value = override.key_or_group, override.value()
    if name in _FOLDERS and value in (None, ""):
        raise ConfigError(f"{override.input_line}: expected a folder; name one, or leave it out")
    if name == "hydra.verbose" and not isinstance(value, bool | str | list):
        raise ConfigError(f"{override.input_line}: expected true, false, or names of loggers")
    # Hydra would write them all down before the first one begins.
    if isinstance(value, RangeSweep) and not 0 < _count(value) <= MOST_JOBS:
        came = f"{override.input_line}: {_count(value):.3g} jobs"
        raise ConfigError(f"{came}, expected 1 to {MOST_JOBS}; range(start,stop,step) ends before stop")


def _count(values: RangeSweep) -> float:
    """How many values a range has; below 0 or infinite where it leads nowhere."""
    start, stop, step = (float(number or 0) for number in (values.start, values.stop, values.step))
    steps = (stop - start) / step if step else math.inf
    return float(math.ceil(steps)) if math.isfinite(steps) else math.inf


def read_arguments(arguments: Sequence[str]) -> Iterator[Override]:
    """The arguments that are overrides; ConfigError where Hydra cannot read one, and would not name it."""
    parser = OverridesParser.create()
    for argument in arguments:
        if argument.startswith("-") or not ("=" in argument or argument.startswith("~")):
            continue
        if argument.startswith("="):
            raise ConfigError(f"{argument}: expected KEY=VALUE")
        try:
            yield parser.parse_override(argument)
        except HydraException as error:
            reason = " ".join(str(error).partition("\nSee ")[0].split())
            came = f"{argument}: cannot be read ({reason})"
            raise ConfigError(f"{came}; expected KEY=VALUE, quoted for the shell") from None


def choices_named(override: Override) -> list[Any]:
    """What an override chooses of a group: names, one for each job of a sweep, or whatever stands in their place."""
    value = override.value()
    if isinstance(value, Glob):
        return value.filter(list_choices(override.key_or_group))
    chosen = value.list if isinstance(value, ChoiceSweep) else [value]
    return [name.text if isinstance(name, QuotedString) else name for name in chosen]


def last_value(option: str, arguments: Sequence[str]) -> str | None:
    """What an option is set to last on the command line, without quotes; None where it is not set."""
    values = [argument.partition("=")[2] for argument in arguments if argument.startswith(f"{option}=")]
    return values[-1].strip("'\"") if values else None


def choices_of(chosen: Mapping[str, str | None]) -> Iterator[str]:
    """Overrides that choose the same files of the configuration groups, which Hydra tells, and nothing else."""
    for group, name in chosen.items():
        if name is not None and group != "experiment" and not group.startswith("hydra/"):
            yield f"{group}={name}"


def is_group(name: str) -> bool:
    """Whether a key of the command line chooses a file of conf/."""
    return bool(name) and (CONF_DIR / name).is_dir()
