"""Which files a user's paths, globs and folders mean."""

import glob
from collections.abc import Sequence
from pathlib import Path

from frictionzoo.core.errors import LogError
from frictionzoo.logs.formats import format_names, get_format


def find_files(names: Sequence[str], folder: str | None, source: str | None) -> list[str]:
    """The files that are meant, each once, in the order in which they are named; those of a glob or folder by name.

    Args:
        names: Paths of files, of folders, or globs, in which `**` means any depth.
        folder: What relative paths begin at; None for the working directory.
        source: Where a user obtains files that the package does not bring; None for a user's own.

    Raises:
        LogError: A path leads to no file.
    """
    if source is not None and folder is None:
        raise LogError(
            f"data.folder=null: the recordings are not part of the package; set FRICTIONZOO_DATA or data.folder to the "
            f"folder that holds {names[0]} (from {source})"
        )
    base = Path() if folder is None else Path(folder).expanduser()
    found = [path for name in names for path in _expand(name, base / Path(name).expanduser(), source)]
    return list(dict.fromkeys(map(str, found)))


def _expand(name: str, path: Path, source: str | None) -> list[Path]:
    """The files of one path; LogError where there is none."""
    if path.is_dir() and any(get_format(name).claims(path) for name in format_names()):
        found = [path]
    elif path.is_dir():
        found = [inner for inner in path.iterdir() if inner.is_file() and not inner.name.startswith(".")]
    elif path.exists():
        found = [path]
    else:
        found = [Path(match) for match in glob.glob(str(path), recursive=True) if Path(match).is_file()]
    if not found:
        came = "no file in this folder" if path.is_dir() else "no such file"
        raise LogError(f"{path}: {came}{_advise(name, source)}")
    return sorted(found)


def _advise(name: str, source: str | None) -> str:
    if source is None:
        return f" (looked from {Path.cwd()}); check the path"
    return f"; set FRICTIONZOO_DATA or data.folder to the folder that holds {name} (from {source})"
