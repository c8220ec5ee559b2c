"""Command line: `python -m frictionzoo.run model=coulomb_stribeck`. Composes and calls; decides nothing."""

import os
import re
import sys
from pathlib import Path
from typing import NoReturn

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from frictionzoo.config import CONF_DIR, check_overrides, compose_config, register_resolvers, suggest_option
from frictionzoo.errors import ConfigError, FrictionzooError, closest


@hydra.main(version_base="1.3", config_path=str(CONF_DIR), config_name="config")
def _job(config: DictConfig) -> float:
    """One job of Hydra's; returns the training loss, which a sweeper may minimise."""
    hydra_config = HydraConfig.get()
    overrides = list(hydra_config.overrides.task)
    try:
        check_overrides(overrides, config, compose_config(*filter(_is_choice, overrides)))
        # Imported here, so that --help and a typing error do not wait for torch and JAX.
        from frictionzoo.job import run_job

        model, folder = hydra_config.runtime.choices["model"], Path(hydra_config.runtime.output_dir)
        result, complaint = run_job(config, model, folder)
    except FrictionzooError as error:
        # Ended here, because Hydra adds a line of its own to an error that passes through it.
        _fail(str(error))
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
    try:
        sys.argv[1:] = _restore_overrides(sys.argv[1:])
        _job()
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
    except (OSError, OmegaConfBaseException, ValueError):
        raise ConfigError(
            f"resume={folders[-1]}: no {saved} that can be read, expected a run folder; name one"
        ) from None
    if not isinstance(overrides, list) or not all(isinstance(item, str) for item in overrides):
        raise ConfigError(f"{saved}: expected a list of overrides; name a run folder that this program made")
    kept = [item for item in overrides if not item.startswith(("resume=", "hydra"))]
    return kept + arguments


def _is_choice(override: str) -> bool:
    """Whether an override chooses a file of a configuration group."""
    name = override.lstrip("+").partition("=")[0]
    return (CONF_DIR / name).is_dir()


def _explain(error: Exception) -> str:
    """One line for what Hydra or OmegaConf refuses, with the closest name."""
    text = str(error)
    if missing := re.search(r"(?:Could not find|In '.*?': Could not find) '(\w+)/([^']*)'", text):
        group, name = missing.groups()
        available = (path.stem for path in (CONF_DIR / group).glob("*.yaml"))
        return f"{group}={name}: no such {group}; {closest(name, available)}"
    if unknown := re.search(r"Could not override '([^']+)'", text):
        return f"{unknown[1]}: unknown option; {suggest_option(unknown[1], _config_of_choices())}"
    return " ".join(text.split())


def _config_of_choices() -> DictConfig:
    return compose_config(*(argument for argument in sys.argv[1:] if "=" in argument and _is_choice(argument)))


if __name__ == "__main__":
    main()
