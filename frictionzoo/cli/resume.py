"""Resuming of a stopped run or sweep from the resolved settings in its folder."""

import contextlib
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from frictionzoo.cli.mistakes import NOTHING_KEPT
from frictionzoo.cli.overrides import choices_of, last_value
from frictionzoo.core.config import CONF_DIR, check_overrides, compose_config, list_choices, merge_saved
from frictionzoo.core.errors import ConfigError, FrictionzooError, OutputError, RunError, closest
from frictionzoo.core.jobs import read_json, refuse_links
from frictionzoo.core.manifest import remove_if_empty
from frictionzoo.core.output import RESULT, SETTLED, remove_written, to_json, write_atomically, write_json

SETTINGS = Path(".hydra", "settings.json")
GROUPS = frozenset(path.name for path in CONF_DIR.iterdir() if path.is_dir()) - {"experiment", "hydra"}
_OF_HYDRA = re.compile(r"[+~]*hydra\b|-")
LOCAL_LOGGERS = ("csv", "tensorboard")  # only write files, and only into the run's folder


class SavedRequest(NamedTuple):
    """Request for a run, as saved in its folder.

    Attributes:
        choices: File of each configuration group.
        options: Options of the command as `KEY=VALUE`, for display only.
        settings: All options, resolved.
    """

    choices: Mapping[str, str | None]
    options: Sequence[str]
    settings: Mapping[str, Any]

    def save(self, folder: Path) -> None:
        """Write `SETTINGS` into a run's folder, without Hydra's choices; OutputError if it cannot be written."""
        chosen = {
            group: name for group, name in self.choices.items() if group in GROUPS and name in list_choices(group)
        }
        write_json(folder / SETTINGS, to_json({**self._asdict(), "choices": chosen, "options": list(self.options)}))

    @classmethod
    def read(cls, folder: Path) -> "SavedRequest":
        """Read `SETTINGS` of a run's folder, which may come from a stranger.

        Raises:
            ConfigError: The file is missing or invalid, or chooses a file that does not exist.
        """
        path = folder / SETTINGS
        if not path.exists():
            hint = f"; resume a sweep with -m hydra.sweep.dir={folder} resume=true" if _holds_jobs(folder) else ""
            raise ConfigError(f"resume={folder}: no {path}, expected the folder of a run; name one{hint}")
        try:
            refuse_links(folder, files=True)
            saved: Any = read_json(path)
        except RunError as error:
            raise ConfigError(f"resume={folder}: {error}") from None
        choices, options, settings = map(saved.get, cls._fields)
        are_sections = isinstance(choices, dict) and isinstance(settings, dict) and isinstance(options, list)
        if not are_sections or not all(isinstance(text, str) and not _OF_HYDRA.match(text) for text in options):
            raise ConfigError(f"{path}: expected choices, options and settings; name a run that this program made")
        for group, name in choices.items():
            valid_names = list_choices(group) if group in GROUPS else []
            if name not in valid_names:
                raise ConfigError(f"{path}: {group}={name}: no such {group}; {closest(str(name), valid_names)}")
        return cls(choices, options, settings)


def restore_overrides(arguments: Sequence[str]) -> list[str]:
    """Return the overrides of a command; with `resume=FOLDER`, preceded by that run's choices.

    Raises:
        ConfigError: There is no such run or sweep to resume, or its logger needs consent.
    """
    resume = last_value("resume", arguments)
    if resume in (None, "null"):
        return [*arguments]
    if not resume:
        raise ConfigError("resume=: expected the folder of a run; name one, or leave it out")
    if resume.lower() == "true" or {"-m", "--multirun"} & set(arguments):
        _refuse_no_sweep(resume, arguments)
        return [*arguments]
    choices = SavedRequest.read(Path(resume)).choices
    logger = choices.get("logger")
    if logger not in (None, *LOCAL_LOGGERS) and last_value("logger", arguments) is None:
        reason = f"it was recorded with logger={logger}, which starts a program or follows a database in that folder"
        raise ConfigError(f"resume={resume}: {reason}, expected your consent; add logger={logger}, or logger=csv")
    return [*choices_of(choices), *arguments]


def restore_settings(
    folder: Path, config: DictConfig, plain: DictConfig, options: Sequence[str]
) -> tuple[DictConfig, list[str]]:
    """Return the settings and options of a stored run, with the changes of the new command.

    `config` and its overrides `options` combine both; `plain` has only the choices of groups.

    Raises:
        ConfigError: The run's settings do not fit its configuration files, or refer to something outside them.
    """
    begun = SavedRequest.read(folder)
    choices = [*choices_of(begun.choices)]
    before = compose_config(*choices)
    settings = merge_saved(begun.settings, before, config)
    check_overrides(settings, plain)
    return settings, [*begun.options, *(option for option in options if option not in choices)]


def _refuse_no_sweep(resume: str, arguments: Sequence[str]) -> None:
    if resume.lower() != "true":
        expected = "expected true; name a sweep's folder in hydra.sweep.dir, or resume a run without -m"
        raise ConfigError(f"resume={resume}: {expected}")
    folder = last_value("hydra.sweep.dir", arguments)
    if not {"-m", "--multirun"} & set(arguments) or folder is None:
        expected = "expected the command of a sweep, -m and hydra.sweep.dir=FOLDER; or name the folder of a run"
        raise ConfigError(f"resume=true: {expected}")
    if not _holds_jobs(Path(folder)):
        raise ConfigError(f"hydra.sweep.dir={folder}: no job in it, expected a sweep's folder; leave resume=true out")


def _holds_jobs(sweep: Path) -> bool:
    return any(path.parent != sweep for path in sweep.rglob(".hydra"))


def record_job(config: DictConfig) -> dict[Path, bytes]:
    """Return the files of a job's record, with the content that Hydra would write."""
    hydra: Any = HydraConfig.instance().cfg
    folder = Path(hydra.hydra.runtime.output_dir) / ".hydra"
    parts = {"config": config, "hydra": hydra, "overrides": hydra.hydra.overrides.task}
    return {folder / f"{name}.yaml": OmegaConf.to_yaml(part).encode() for name, part in parts.items()}


def write_record(record: Mapping[Path, bytes]) -> None:
    """Write the record of a job into its folder; OutputError if it cannot be written."""
    for path, content in record.items():
        write_atomically(path, content)


@contextlib.contextmanager
def recorded(record: Mapping[Path, bytes]) -> Iterator[None]:
    """Write the record of a job into its folder; if the job is refused, restore the previous state."""
    files = {*record, *(path.with_name(SETTINGS.name) for path in record)}
    files |= {path.parents[1] / SETTLED for path in record}
    before = {path: path.read_bytes() for path in files if path.exists()}
    write_record(record)
    try:
        yield
    except (FrictionzooError, OmegaConfBaseException, HydraException) as error:
        if not isinstance(error, OutputError):  # after a full disk, a run resumes with its record
            write_record(before)
            for path in files - {*before}:
                remove_written(path)
                remove_if_empty(path.parent)
        raise


@contextlib.contextmanager
def nothing_of_a_refused_run(folders: Sequence[Path]) -> Iterator[None]:
    """Remove those of these folders, the innermost first, that a refused run leaves empty."""
    try:
        yield
    except FrictionzooError:
        for folder in folders:
            remove_if_empty(folder)
        raise


def say_how_a_run_goes_on(folder: Path) -> str:
    """Return which parts of an unfinished run its folder has, and how to resume it."""
    try:
        SavedRequest.read(folder)
    except ConfigError:  # it ended before it saved anything
        return NOTHING_KEPT
    saved = "its options and automatic settings" if (folder / SETTLED).exists() else "its options"
    saved = "the fit up to its last checkpoint" if (folder / "checkpoints" / "last.ckpt").exists() else saved
    return f"{folder} keeps {saved}; go on with resume={folder}"


def say_how_a_sweep_goes_on(folder: Path | None = None) -> str:
    """Return how many jobs an unfinished sweep has saved, and how to resume it; `folder` is None before it begins."""
    if folder is None or not _holds_jobs(folder):
        return NOTHING_KEPT
    done = len(list(folder.rglob(RESULT)))
    return f"{folder} keeps {done} finished jobs; go on with the same command and hydra.sweep.dir={folder} resume=true"
