"""Command line: `python -m frictionzoo.run model=coulomb_stribeck`. Composes and calls; decides nothing."""

import contextlib
import os
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NoReturn

import hydra
import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from frictionzoo.config import CONF_DIR, check_overrides, compose_config, register_resolvers, suggest_option
from frictionzoo.errors import ConfigError, FrictionzooError, closest

# What a resumed run takes over from its folder: an option of the job, not a flag or a way into Hydra's own settings.
_OVERRIDE = re.compile(r"(\+\+?|~)?\w[\w/.-]*(=|$)")


@hydra.main(version_base="1.3", config_path=str(CONF_DIR), config_name="config")
def _job(config: DictConfig) -> float:
    """One job of Hydra's; returns the training loss, which a sweeper may minimise."""
    # Ended inside, because Hydra adds a line of its own to an error that passes through it.
    with _mistakes_in_one_line():
        hydra_config = HydraConfig.get()
        check_overrides(config, compose_config(*_choices(hydra_config.runtime.choices)))
        # Imported here, so that --help and a typing error do not wait for torch and JAX.
        from frictionzoo.job import run_job
        from frictionzoo.report.terminal import summarise

        model, folder = hydra_config.runtime.choices["model"], Path(hydra_config.runtime.output_dir)
        result, complaint = run_job(config, model, folder)
        print(summarise(result, folder))
    if complaint:
        _fail(complaint)
    return result["fit"]["loss"]


def main() -> None:
    """Entry point of `python -m frictionzoo.run` and of the console script `frictionzoo`.

    A user's mistake is one line on the standard error and exit status 2.
    """
    register_resolvers()
    # Hydra would print its own page; with this it raises, and the line below is printed instead.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    with _mistakes_in_one_line():
        sys.argv[1:] = _restore_overrides(sys.argv[1:])
        _refuse_no_choice(sys.argv[1:])
        _job()


@contextlib.contextmanager
def _mistakes_in_one_line() -> Iterator[None]:
    try:
        yield
    except FrictionzooError as error:
        _fail(str(error))
    except (HydraException, OmegaConfBaseException) as error:
        _fail(_explain(error))
    except OSError as error:
        if not error.strerror:
            raise
        _fail(f"{error.filename or 'the disk'}: {error.strerror}; free space or set hydra.run.dir to another folder")


def _fail(line: str) -> NoReturn:
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


def _refuse_no_choice(arguments: list[str]) -> None:
    """Refuse to go without a file of a group that a job needs, or to take several."""
    for argument in arguments:
        group, _, name = argument.lstrip("+~").partition("=")
        needed = group != "experiment" and _is_group(group)
        if needed and (argument.startswith("~") or name == "null" or name.startswith("[")):
            raise ConfigError(f"{argument}: a job needs one {group}; {closest(name, _names(group))}")


def _choices(chosen: Mapping[str, str | None]) -> Iterator[str]:
    """Overrides that choose the same files of the configuration groups, and nothing else."""
    for group, name in chosen.items():
        if name is not None and group != "experiment" and not group.startswith("hydra/"):
            yield f"{group}={name}"


def _is_group(name: str) -> bool:
    return bool(name) and (CONF_DIR / name).is_dir()


def _names(group: str) -> list[str]:
    return [path.stem for path in (CONF_DIR / group).glob("*.yaml")]


def _explain(error: Exception) -> str:
    """One line for what Hydra or OmegaConf refuses, with the closest name."""
    text = str(error)
    missing = re.search(r"(?:Could not find|In '.*?': Could not find) '(\w+)/([^']*)'", text)
    if missing and missing[1] != "hydra":
        group, name = missing.groups()
        return f"{group}={name}: no such {group}; {closest(name, _names(group))}"
    unknown = re.search(r"Could not override '([^']+)'", text)
    if unknown and not unknown[1].startswith("hydra."):
        return f"{unknown[1]}: unknown option; {suggest_option(unknown[1], _config_of_choices())}"
    return " ".join(text.split())


def _config_of_choices() -> DictConfig:
    return compose_config(*(argument for argument in sys.argv[1:] if _is_group(argument.partition("=")[0])))


if __name__ == "__main__":
    main()
