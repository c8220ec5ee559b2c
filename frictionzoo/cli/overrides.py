"""Overrides on the command line: the files that they choose, and corrections where Hydra would misread them."""

import contextlib
import math
import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser, create_functions
from hydra.core.override_parser.types import ChoiceSweep, Glob, Override, QuotedString, RangeSweep
from hydra.errors import HydraException

from frictionzoo.core.config import CONF_DIR, is_choice, list_choices
from frictionzoo.core.errors import ConfigError, closest

MOST_JOBS = 100_000  # in one range of a sweep
_RAISE = "HYDRA_FULL_ERROR"
_FOLDERS = ("hydra.run.dir", "hydra.sweep.dir", "hydra.sweep.subdir")
_OPTIONAL_GROUPS = ("experiment", "variant", "start")
# Beginnings of lists, sections, quoted texts, references and Hydra's functions.
_FORMED = re.compile(rf"""[\[{{"']|\$\{{|({"|".join(create_functions().functions)})\(""")


@contextlib.contextmanager
def given_to_hydra(arguments: Sequence[str]) -> Iterator[None]:
    """Let Hydra read these arguments in `sys.argv`, and raise its errors, not print them; then restore both."""
    argv, full_error = sys.argv, os.environ.get(_RAISE)
    # Hydra refuses overrides on both sides of a flag.
    flags_first = sorted(arguments, key=lambda each: each.startswith("~") or ("=" in each and each[0] != "-"))
    sys.argv, os.environ[_RAISE] = [argv[0], *flags_first], "1"
    try:
        yield
    finally:
        sys.argv = argv
        if full_error is None:
            del os.environ[_RAISE]
        else:
            os.environ[_RAISE] = full_error


def refuse_no_choice(arguments: Sequence[str]) -> None:
    """Refuse overrides that cannot be read, or that choose no file of their group, several, or an unknown one.

    Raises:
        ConfigError: There is such an override.
    """
    for override in read_arguments(arguments):
        group = override.key_or_group
        _refuse_no_setting(override)
        if not ("/" in group or is_group(group)):
            continue
        names = choices_named(override)
        if group != "variant" and all(isinstance(name, str) and is_choice(group, name) for name in names):
            continue
        valid_names = [*list_choices(group), *_list_added(group, arguments)]
        is_valid = all(name in valid_names or (name is None and group == "start") for name in names)
        if group in _OPTIONAL_GROUPS and (override.is_delete() or is_valid):
            continue
        text = str(override.input_line)
        if override.is_delete() or not all(isinstance(name, str) for name in names) or group == "variant":
            needed = "expected one name, or leave it out" if group in _OPTIONAL_GROUPS else f"a job needs one {group}"
            raise ConfigError(f"{text}: {needed}; {closest(text.partition('=')[2], valid_names)}")
        for name in names:
            if name not in valid_names:
                raise ConfigError(f"{group}={name}: no such {group}; {closest(name, valid_names)}")


def _list_added(group: str, arguments: Sequence[str]) -> list[str]:
    """Return the names of a group's files in the folder of Hydra's flag --config-dir."""
    flags = [index for index, argument in enumerate(arguments) if argument.partition("=")[0] in ("--config-dir", "-cd")]
    folders = [arguments[index].partition("=")[2] or "".join(arguments[index + 1 : index + 2]) for index in flags]
    return sorted(path.stem for folder in folders for path in Path(folder, group).glob("*.yaml"))


def _refuse_no_setting(override: Override) -> None:
    """Refuse a Hydra setting that it would misread as the working directory, or crash on."""
    name, value = override.key_or_group, override.value()
    if name in _FOLDERS and value in (None, ""):
        raise ConfigError(f"{override.input_line}: expected a folder; name one, or leave it out")
    if name == "hydra.verbose" and not isinstance(value, bool | str | list):
        raise ConfigError(f"{override.input_line}: expected true, false, or names of loggers")
    # Hydra would list all jobs before the first one begins.
    if isinstance(value, RangeSweep) and not 0 < _count(value) <= MOST_JOBS:
        message = f"{override.input_line}: {_count(value):.3g} jobs"
        raise ConfigError(f"{message}, expected 1 to {MOST_JOBS}; range(start,stop,step) ends before stop")


def _count(values: RangeSweep) -> float:
    """Return the number of values of a range; negative or infinite for an invalid one."""
    start, stop, step = (float(number or 0) for number in (values.start, values.stop, values.step))
    steps = (stop - start) / step if step else math.inf
    return float(math.ceil(steps)) if math.isfinite(steps) else math.inf


def read_arguments(arguments: Sequence[str]) -> Iterator[Override]:
    """Yield the arguments that are overrides.

    Raises:
        ConfigError: Hydra cannot read one; its error would not name it.
    """
    for argument in arguments:
        if not _is_override(argument):
            continue
        if argument.startswith("="):
            raise ConfigError(f"{argument}: expected KEY=VALUE")
        try:
            yield _parse(argument)
        except HydraException as error:
            reason = " ".join(str(error).partition("\nSee ")[0].split())
            message = f"{argument}: cannot be read ({reason})"
            hint = (
                """close brackets, and put text with commas or brackets into quotes within the shell's: 'KEY="a(b)"'"""
            )
            raise ConfigError(f"{message}; expected KEY=VALUE; {hint}") from None


def quote_values(arguments: Sequence[str]) -> list[str]:
    """Quote values that Hydra cannot read and that can only be text, such as `bench.joint=.*_(hip|knee)`.

    Values that Hydra can read, such as sweeps and lists, keep their meaning. In a list, the elements are quoted. Values
    that begin like a section, a quoted text, a reference or a function stay, as do possible sweeps (values with commas
    outside brackets).
    """
    return [_quote(text) if _is_override(text) and not _is_readable(text) else text for text in arguments]


def _quote(argument: str) -> str:
    key, _, value = argument.partition("=")
    is_list = value.startswith("[") and value.endswith("]")
    parts = _split(value[1:-1] if is_list else value)
    if not is_list and len(parts) > 1:
        return argument
    texts = [part if _is_readable(f"key={part}") else _quote_text(part.strip()) for part in parts]
    quoted = f"{key}=[{','.join(texts)}]" if is_list else f"{key}={texts[0]}"
    return quoted if _is_readable(quoted) else argument


def _quote_text(text: str) -> str:
    if _FORMED.match(text):
        return text
    # In Hydra's grammar, a backslash is literal unless it precedes a quote.
    doubled = re.sub(r'(\\*)("|$)', lambda found: 2 * found[1] + ('\\"' if found[2] else ""), text)
    return f'"{doubled}"'


def _split(value: str) -> list[str]:
    """Split a value at commas outside brackets."""
    parts, depth = [""], 0
    for char in value:
        depth += (char in "([{") - (char in ")]}")
        if char == "," and depth <= 0:
            parts.append("")
        else:
            parts[-1] += char
    return parts


def _is_override(argument: str) -> bool:
    return not argument.startswith("-") and ("=" in argument or argument.startswith("~"))


def _is_readable(argument: str) -> bool:
    try:
        _parse(argument)
    except HydraException:
        return False
    return True


def _parse(argument: str) -> Override:
    return OverridesParser.create().parse_override(argument)


def choices_named(override: Override) -> list[Any]:
    """Return the names that an override chooses, one for each job of a sweep, or the values in their place."""
    value = override.value()
    if isinstance(value, Glob):
        return value.filter(list_choices(override.key_or_group))
    chosen = value.list if isinstance(value, ChoiceSweep) else [value]
    return [name.text if isinstance(name, QuotedString) else name for name in chosen]


def last_value(option: str, arguments: Sequence[str]) -> str | None:
    """Return the last value of an option on the command line, without quotes; None if it is not set."""
    values = [argument.partition("=")[2] for argument in arguments if argument.startswith(f"{option}=")]
    return values[-1].strip("'\"") if values else None


def choices_of(chosen: Mapping[str, str | None]) -> Iterator[str]:
    """Yield overrides that choose the same files of the configuration groups as Hydra's `runtime.choices`."""
    for group, name in chosen.items():
        if name is not None and group != "experiment" and not group.startswith("hydra/"):
            yield f"{group}={name}"


def is_group(name: str) -> bool:
    """Return whether a key of the command line is a configuration group of conf/."""
    return bool(name) and (CONF_DIR / name).is_dir()
