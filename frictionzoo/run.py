"""Command line: `python -m frictionzoo.run model=coulomb_stribeck`. Composes and calls; decides nothing."""

import contextlib
import os
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NoReturn

import hydra
import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from frictionzoo.config import (
    CONF_DIR,
    check_overrides,
    compose_config,
    forget_plugin_schemas,
    list_choices,
    register_resolvers,
    suggest_option,
)
from frictionzoo.errors import ConfigError, FrictionzooError, closest
from frictionzoo.sweep import SweepFolder, conclude_sweep, describe, objective_of, run_in_sweep
from frictionzoo.threads import limit_threads, threads_each

NOT_IDENTIFIED = 3
"""Exit status of a run that ended and whose result is not the drive."""

# What a resumed run takes over from its folder: an option of the job, not a flag or a way into Hydra's own settings.
_OVERRIDE = re.compile(r"(\+\+?|~)?\w[\w/.-]*(=|$)")


@hydra.main(version_base="1.3", config_path=str(CONF_DIR), config_name="config")
def _job(config: DictConfig) -> float:
    """One job of Hydra's; returns what a sweeper may minimise."""
    hydra_config = HydraConfig.get()
    model, folder = hydra_config.runtime.choices["model"], Path(hydra_config.runtime.output_dir)
    if hydra_config.mode == RunMode.MULTIRUN:
        options = hydra_config.overrides.task
        return run_in_sweep(lambda: _identify(config, model, folder), folder, model, options, _explain)
    # Ended inside, because Hydra adds a line of its own to an error that passes through it.
    with mistakes_in_one_line():
        result, complaint = _identify(config, model, folder)
    if complaint:
        _fail(complaint)
    if result["not_identified"]:
        sys.exit(NOT_IDENTIFIED)
    return objective_of(result)


def _identify(config: DictConfig, model: str, folder: Path) -> tuple[dict[str, Any], str | None]:
    hydra_config = HydraConfig.get()
    check_overrides(config, compose_config(*choices_of(hydra_config.runtime.choices)))
    alone = hydra_config.mode == RunMode.RUN or hydra_config.runtime.choices["hydra/launcher"] == "basic"
    limit_threads(config.threads if alone else threads_each(config.threads))
    # Imported here, so that --help and a typing error do not wait for torch and JAX, and that these meet the limit.
    from frictionzoo.job import run_job
    from frictionzoo.report.terminal import summarise

    result, complaint = run_job(config, model, folder)
    print(summarise(result, folder))
    return result, complaint


def main() -> None:
    """Entry point of `python -m frictionzoo.run` and of the console script `frictionzoo`.

    A user's mistake is one line on the standard error and exit status 2. In a sweep, it is one line for each job that
    failed, after the last one.
    """
    register_resolvers()
    forget_plugin_schemas()
    # Hydra would print its own page; with this it raises, and the line below is printed instead.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    SweepFolder.latest = None
    with mistakes_in_one_line():
        sys.argv[1:] = _restore_overrides(sys.argv[1:])
        refuse_no_choice(sys.argv[1:])
        complaint = _run_jobs()
        if SweepFolder.latest is not None:
            text, complaints = conclude_sweep(SweepFolder.latest)
            print(text)
            if complaint:
                complaints.append(complaint)
            if complaints:
                _fail(*complaints)


def _run_jobs() -> str | None:
    """All jobs; returns one line of complaint if a sweep ended early."""
    try:
        _job()
    except Exception as error:
        refused = isinstance(error, HydraException | OmegaConfBaseException) or _missing_plugin(error)
        if SweepFolder.latest is None or refused:
            raise
        return f"the sweep ended early ({describe(error)}); jobs that had not begun are not listed"
    return None


@contextlib.contextmanager
def mistakes_in_one_line() -> Iterator[None]:
    """Turn an error that a user can cause into one line and exit status 2."""
    try:
        yield
    except Exception as error:
        line = _explain(error)
        if line is None:
            raise
        _fail(line)


def _fail(*lines: str) -> NoReturn:
    for line in lines:
        print(f"frictionzoo: {line}", file=sys.stderr)
    sys.exit(2)


def _restore_overrides(arguments: list[str]) -> list[str]:
    """For `resume=FOLDER`, the overrides with which that run began, before those of today."""
    folders = [argument.partition("=")[2] for argument in arguments if argument.startswith("resume=")]
    if not folders or folders[-1] in ("null", ""):
        return arguments
    saved = Path(folders[-1]) / ".hydra" / "overrides.yaml"
    try:
        overrides = OmegaConf.to_container(OmegaConf.load(saved))
    except (OSError, OmegaConfBaseException, ValueError, yaml.YAMLError):
        raise ConfigError(
            f"resume={folders[-1]}: no {saved} that can be read, expected a run folder; name one"
        ) from None
    if not isinstance(overrides, list) or not all(isinstance(item, str) for item in overrides):
        raise ConfigError(f"{saved}: expected a list of overrides; name a run folder that this program made")
    kept = [item for item in overrides if not re.match(r"[+~]*(resume|hydra)\b", item)]
    for item in kept:
        if not _OVERRIDE.match(item):
            raise ConfigError(f"{saved}: {item}; expected an override; name a run folder that this program made")
    # Hydra would replace the folder's record of how the run began by today's command, which may be a mistaken one.
    return [*kept, *arguments, "hydra.output_subdir=null"]


def refuse_no_choice(arguments: list[str]) -> None:
    """Refuse to go without a file of a group that a job needs, or to take several.

    Args:
        arguments: Those of the command line.

    Raises:
        ConfigError: One chooses none or several.
    """
    for argument in arguments:
        group, _, name = argument.lstrip("+~").partition("=")
        needed = group != "experiment" and _is_group(group)
        if needed and (argument.startswith("~") or name == "null" or name.startswith("[")):
            raise ConfigError(f"{argument}: a job needs one {group}; {closest(name, list_choices(group))}")


def choices_of(chosen: Mapping[str, str | None]) -> Iterator[str]:
    """Overrides that choose the same files of the configuration groups, and nothing else.

    Args:
        chosen: File by group, as Hydra tells it.
    """
    for group, name in chosen.items():
        if name is not None and group != "experiment" and not group.startswith("hydra/"):
            yield f"{group}={name}"


def _is_group(name: str) -> bool:
    return bool(name) and (CONF_DIR / name).is_dir()


def _explain(error: Exception) -> str | None:
    """One line for an error that a user can cause, None for any other."""
    if isinstance(error, FrictionzooError):
        return str(error)
    if isinstance(error, HydraException | OmegaConfBaseException):
        return _explain_refusal(str(error))
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename or 'the disk'}: {error.strerror}; free space or set hydra.run.dir to another folder"
    return _missing_plugin(error)


def _missing_plugin(error: Exception) -> str | None:
    """One line for a launcher or sweeper whose package is not installed."""
    missing = re.search(r"Unknown plugin class : 'hydra_plugins\.hydra_(\w+?)_(launcher|sweeper)\.", str(error))
    if not missing:
        return None
    name, kind = missing.groups()
    return f"the {kind} {name} is not installed, expected hydra-{name}-{kind}; pip install 'frictionzoo[{name}]'"


def _explain_refusal(text: str) -> str:
    """One line for what Hydra or OmegaConf refuses, with the closest name."""
    missing = re.search(r"(?:Could not find|In '.*?': Could not find) '(\w+)/([^']*)'", text)
    if missing and missing[1] != "hydra":
        group, name = missing.groups()
        return f"{group}={name}: no such {group}; {closest(name, list_choices(group))}"
    unknown = re.search(r"Could not override '([^']+)'", text)
    if unknown and not unknown[1].startswith("hydra."):
        return f"{unknown[1]}: unknown option; {suggest_option(unknown[1], _config_of_choices())}"
    return " ".join(text.split())


def _config_of_choices() -> DictConfig:
    return compose_config(*(argument for argument in sys.argv[1:] if _is_group(argument.partition("=")[0])))


if __name__ == "__main__":
    # By this name, processes that launchers start can import the job; what lies in __main__ would be copied to them.
    from frictionzoo import run

    run.main()
