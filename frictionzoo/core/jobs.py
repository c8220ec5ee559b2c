"""Folders of runs and sweeps: where each job lies and its status."""

import json
import re
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

import msgspec
import yaml

from frictionzoo.core.errors import RunError
from frictionzoo.core.output import FAILURE, RESULT, RUNNING, TEMPLATE
from frictionzoo.core.records import Failure, Record

R = TypeVar("R", bound=Record)
_DEEPEST = 60  # levels of nesting; this program's files have a dozen


def find_runs(folder: Path) -> list[Path]:
    """Return the job folders in a folder without cards, in order, or the folder itself if it is a job's.

    Raises:
        RunError: There is no job.
    """
    names = (RESULT, FAILURE, RUNNING, ".hydra")
    if any((folder / name).exists() for name in names):
        return [folder]
    folders = {path.parent for name in names for path in folder.rglob(name) if not path.with_name(TEMPLATE).exists()}
    if not folders:
        raise RunError(f"{folder}: no run in it, expected the folder of a run or of a sweep; name one")
    # By the numbers in the names: 2_coulomb before 10_neural.
    return sorted(folders, key=lambda path: [int(s) if s.isdigit() else s for s in re.split(r"(\d+)", str(path))])


def read_failure(folder: Path) -> Failure | None:
    """Return why the job in a folder has no result, None if it has one; RunError if its files cannot be read."""
    if (folder / RESULT).exists():
        return None
    if not (folder / FAILURE).exists():
        model = read_begun(folder, "hydra", "hydra", "runtime", "choices", "model")  # None if the file was cut short
        return Failure(folder.name, str(model or ""), "no result: its process ended before it was done")
    saved = read_json(folder / FAILURE)
    model, reason = (" ".join(str(saved.get(key, "")).split()) for key in ("model", "reason"))
    return Failure(folder.name, model, reason)


def refuse_unfinished(folder: Path) -> None:
    """Refuse a folder without a finished run, before slow imports: RunError."""
    if not (folder / RESULT).exists():
        raise RunError(f"{folder}: no {RESULT} in it, expected the folder of a finished run; name one")


def read_begun(folder: Path, file: str, *keys: str) -> Any:
    """Return a value from `config`, `hydra` or `overrides`, which Hydra writes before a job begins; None if missing."""
    try:
        value = yaml.safe_load((folder / ".hydra" / f"{file}.yaml").read_text(encoding="utf-8"))
        for key in keys:
            value = value[key]
        return value
    except (OSError, ValueError, yaml.YAMLError, KeyError, TypeError, IndexError):
        return None


def refuse_links(folder: Path, *, files: bool) -> None:
    """Refuse links that lead out of a folder of runs: writing through them would overwrite other files.

    Links to files count only with `files`: files are replaced, not written through.

    Raises:
        RunError: There is such a link.
    """
    home = folder.resolve()
    for path in folder.rglob("*"):
        in_wandb = path.relative_to(folder).parts[0] == "wandb"  # the manifest judges wandb's links to its logs
        counts = path.is_dir() or (files and not in_wandb)
        if path.is_symlink() and counts and not path.resolve().is_relative_to(home):
            raise RunError(f"{path}: a link out of {folder}, expected files of the run; remove it, or copy its target")


def read_json(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file; RunError if the file cannot be read, or holds something else."""

    def refuse(constant: str) -> None:
        raise ValueError(f"{constant}, which is not a JSON number")

    try:
        content = json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)
    except OSError as error:
        raise RunError(f"{path}: {error.strerror}; expected a file that can be read") from None
    except (ValueError, RecursionError) as error:
        raise RunError(f"{path}: not JSON ({error}); expected the file that this version writes") from None
    _refuse_deep(path, content)
    if not isinstance(content, dict):
        raise RunError(f"{path}: {type(content).__name__}, expected an object; name a folder that this program made")
    return content


def read_record(path: Path, kind: type[R]) -> R:
    """Read a JSON file of this program with the `schema_version` of its record, and validate it.

    Raises:
        RunError: The file cannot be read or is invalid.
    """
    content, (version,) = read_json(path), get_args(get_type_hints(kind)["schema_version"])
    if (saved := content.get("schema_version")) != version:
        raise RunError(f"{path}: schema_version {saved}, expected {version}; run it again with this version")
    return parse_record(path, kind, content)


def parse_record(path: Path, kind: type[R], content: Any) -> R:
    """Return the record in the content of a JSON file; RunError with the file's path if it is invalid."""
    try:
        return msgspec.convert(content, kind)
    except (msgspec.ValidationError, UnicodeError) as error:  # UnicodeError: half of a surrogate pair
        reason = " ".join(str(error).split())[:200]
        raise RunError(f"{path}: {reason}; expected the file that this version writes") from None


def _refuse_deep(path: Path, content: Any) -> None:
    """Refuse content nested too deeply for recursive functions."""
    level = [content]
    for _ in range(_DEEPEST):
        sections = [part for part in level if isinstance(part, dict | list)]
        level = [part for each in sections for part in (each.values() if isinstance(each, dict) else each)]
        if not level:
            return
    raise RunError(
        f"{path}: more than {_DEEPEST} sections within each other; expected the file that this version writes"
    )
