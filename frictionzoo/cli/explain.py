"""One-line explanations of errors that a user can cause, including those of Hydra and OmegaConf."""

import itertools
import re
from collections.abc import Sequence
from typing import Any

from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from frictionzoo.cli.overrides import choices_named, is_group, read_arguments
from frictionzoo.core.config import compose_config, list_choices, suggest_option
from frictionzoo.core.errors import FrictionzooError, closest


def explain(error: Exception, overrides: Sequence[str] = ()) -> str | None:
    """Return one line for an error that a user can cause, else None; overrides help to explain an unknown option."""
    if isinstance(error, FrictionzooError):
        return str(error)
    if isinstance(error, HydraException | OmegaConfBaseException):
        return _explain_refusal(str(error), overrides)
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename or 'the disk'}: {error.strerror}; free space or set hydra.run.dir to another folder"
    if isinstance(error, MemoryError):
        return f"out of memory ({' '.join(str(error).split()) or 'nothing is free'}); lower the sizes that you set"
    return missing_plugin(error)


def missing_plugin(error: Exception) -> str | None:
    """Return one line for a launcher or sweeper whose package is not installed, None for any other error."""
    missing = re.search(r"Unknown plugin class : 'hydra_plugins\.hydra_(\w+?)_(launcher|sweeper)\.", str(error))
    if not missing:
        return None
    name, kind = missing.groups()
    return f"the {kind} {name} is not installed, expected hydra-{name}-{kind}; pip install 'frictionzoo[{name}]'"


def _explain_refusal(text: str, overrides: Sequence[str]) -> str:
    """Return one line for a refusal by Hydra or OmegaConf, with the closest name."""
    missing = re.search(r"Could not find '([\w/]+)/([^'/]*)'", text)
    if missing:
        group, name = missing.groups()
        return f"{group}={name}: no such {group}; {closest(name, list_choices(group))}"
    unknown = re.search(r"Could not override '([^']+)'", text)
    if unknown and not unknown[1].startswith("hydra."):
        return _explain_unknown(unknown[1], overrides)
    unfit = re.fullmatch(r"Error merging override (.*)", text.strip())
    if unfit:
        return f"{unfit[1]}: expected a value or section like the one it replaces; compare with --cfg all"
    return " ".join(text.split())


def _explain_unknown(option: str, overrides: Sequence[str]) -> str:
    """Return one line for an unknown option; in a sweep, for the first job that lacks it."""
    groups = [argument for argument in read_arguments(overrides) if is_group(argument.key_or_group)]
    chosen = [argument for argument in groups if argument.key_or_group != option]
    for names in itertools.product(*map(choices_named, chosen)):
        choices = [f"{override.key_or_group}={name}" for override, name in zip(chosen, names, strict=True)]
        try:
            config = compose_config(*choices)
        except HydraException as error:
            return _explain_refusal(str(error), overrides)
        if not _has(OmegaConf.to_container(config), option):
            swept = [choice for choice, override in zip(choices, chosen, strict=True) if override.is_sweep_override()]
            job = f" with {' '.join(swept)}" if swept else ""
            return f"{option}: unknown option{job}; {suggest_option(option, config)}"
    # Hydra first checks a sweep as a whole, with the default of each swept group.
    group = option.partition(".")[0]
    return f"{option}: the jobs of this sweep have it, but not the default {group}; write ++{option}=VALUE"


def _has(section: Any, option: str) -> bool:
    name, _, rest = option.partition(".")
    return isinstance(section, dict) and name in section and (not rest or _has(section[name], rest))
