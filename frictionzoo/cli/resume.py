"""How a run or a sweep that was stopped goes on: what its folder keeps, and the overrides with which it began."""

import contextlib
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from frictionzoo.cli.mistakes import NOTHING_KEPT
from frictionzoo.cli.overrides import last_value
from frictionzoo.core.errors import ConfigError, FrictionzooError, OutputError
from frictionzoo.core.manifest import remove_if_empty
from frictionzoo.core.output import RESULT, remove_written, write_atomically

# What a resumed run takes over from its folder: an option of the job, not a flag or a way into Hydra's own settings.
_OVERRIDE = re.compile(r"(\+\+?|~)?\w[\w/.-]*(=|$)")


def restore_overrides(arguments: Sequence[str]) -> list[str]:
    """For `resume=FOLDER`, the overrides with which that run began, before those of today.

    Raises:
        ConfigError: There is no such run, or no such sweep, to go on with.
    """
    named = last_value("resume", arguments)
    if named in (None, "null"):
        return [*arguments]
    if not named:
        raise ConfigError("resume=: expected the folder of a run; name one, or leave it out")
    if named.lower() == "true" or {"-m", "--multirun"} & set(arguments):
        _refuse_no_sweep(named, arguments)
        return [*arguments]
    return [*_read_overrides(Path(named)), *arguments]


def _read_overrides(folder: Path) -> list[str]:
    """The overrides with which the run in a folder began."""
    saved = folder / ".hydra" / "overrides.yaml"
    try:
        overrides = OmegaConf.to_container(OmegaConf.load(saved))
    except (OSError, OmegaConfBaseException, ValueError, yaml.YAMLError):
        hint = f"; a sweep goes on with -m hydra.sweep.dir={folder} resume=true" if _holds_jobs(folder) else ""
        came = f"resume={folder}: no {saved} that can be read"
        raise ConfigError(f"{came}, expected a run folder; name one{hint}") from None
    if not isinstance(overrides, list) or not all(isinstance(item, str) for item in overrides):
        raise ConfigError(f"{saved}: expected a list of overrides; name a run folder that this program made")
    kept = [item for item in overrides if not re.match(r"[+~]*(resume|hydra)\b", item)]
    for item in kept:
        if not _OVERRIDE.match(item):
            raise ConfigError(f"{saved}: {item}; expected an override; name a run folder that this program made")
    return kept


def _refuse_no_sweep(resume: str, arguments: Sequence[str]) -> None:
    """Refuse to go on with a sweep that is not there."""
    if resume.lower() != "true":
        expected = "expected true, as a run goes on without -m; name a sweep's folder in hydra.sweep.dir"
        raise ConfigError(f"resume={resume}: {expected}")
    folder = last_value("hydra.sweep.dir", arguments)
    if not {"-m", "--multirun"} & set(arguments) or folder is None:
        expected = "expected the command of a sweep, -m and hydra.sweep.dir=FOLDER; or name the folder of a run"
        raise ConfigError(f"resume=true: {expected}")
    if not _holds_jobs(Path(folder)):
        raise ConfigError(f"hydra.sweep.dir={folder}: no job in it, expected a sweep's folder; leave resume=true out")


def _holds_jobs(sweep: Path) -> bool:
    return any(sweep.rglob(".hydra"))


def record_job(config: DictConfig) -> dict[Path, bytes]:
    """How a job begins, as Hydra writes it: the files of its record and their contents."""
    hydra: Any = HydraConfig.instance().cfg
    folder = Path(hydra.hydra.runtime.output_dir) / ".hydra"
    parts = {"config": config, "hydra": hydra, "overrides": hydra.hydra.overrides.task}
    return {folder / f"{name}.yaml": OmegaConf.to_yaml(part).encode() for name, part in parts.items()}


def write_record(record: Mapping[Path, bytes]) -> None:
    """Write the record of a job into its folder; OutputError if that fails."""
    for path, content in record.items():
        write_atomically(path, content)


@contextlib.contextmanager
def recorded(record: Mapping[Path, bytes]) -> Iterator[None]:
    """Have the record of a job in its folder; if the job is refused, an earlier one, or none as before."""
    before = {path: path.read_bytes() for path in record if path.exists()}
    write_record(record)
    try:
        yield
    except (FrictionzooError, OmegaConfBaseException, HydraException) as error:
        if not isinstance(error, OutputError):  # of a disk that is full, a run goes on with its record
            write_record(before)
            for path in {*record} - {*before}:
                remove_written(path)
                remove_if_empty(path.parent)
        raise


@contextlib.contextmanager
def nothing_of_a_refused_run(made: Sequence[Path]) -> Iterator[None]:
    """Remove folders that Hydra made for a run whose input is at fault, if nothing is in them; the innermost first."""
    try:
        yield
    except FrictionzooError:
        for folder in made:
            remove_if_empty(folder)
        raise


def say_how_a_run_goes_on(folder: Path) -> str:
    """What an unfinished run keeps in its folder, and how it goes on."""
    try:
        _read_overrides(folder)
    except ConfigError:  # it had not come so far
        return NOTHING_KEPT
    kept = "the fit up to its last checkpoint" if (folder / "checkpoints" / "last.ckpt").exists() else "its options"
    return f"{folder} keeps {kept}; go on with resume={folder}"


def say_how_a_sweep_goes_on(folder: Path | None = None) -> str:
    """The same for a sweep; None before it has begun, when nothing is kept."""
    if folder is None or not _holds_jobs(folder):
        return NOTHING_KEPT
    done = len(list(folder.rglob(RESULT)))
    return f"{folder} keeps {done} finished jobs; go on with the same command and hydra.sweep.dir={folder} resume=true"
