"""Log formats, one a file; the files are looked through, not listed."""

import glob
from collections.abc import Sequence
from pathlib import Path

from frictionzoo.core.errors import LogError
from frictionzoo.logs.formats.base import Format, format_names, get_format, parsing, register_format
from frictionzoo.logs.recording import Table

__all__ = ["Format", "find_files", "format_names", "get_format", "read_tables", "register_format"]


def find_files(names: Sequence[str], folder: str | None, source: str | None) -> list[str]:
    """The files that are meant, each once, in the order in which they are named; those of a glob or folder by name.

    Args:
        names: Paths of files, of folders, or globs, in which `**` means any depth.
        folder: What relative paths begin at; None for the working directory.
        source: Where a user obtains files that the package does not bring; None for a user's own.

    Raises:
        LogError: A path leads to no file.
    """
    obtain = "set FRICTIONZOO_DATA or data.folder to the folder that holds {} (from {})".format
    if source is not None and folder is None:
        raise LogError(f"data.folder=null: the recordings are not part of the package; {obtain(names[0], source)}")
    found = []
    for name in names:
        path = Path(folder or "").expanduser() / Path(name).expanduser()
        files = _expand(path)
        if not files:
            came = "no file in this folder" if path.is_dir() else "no such file"
            advice = (
                f"; {obtain(name, source)}" if source is not None else f" (looked from {Path.cwd()}); check the path"
            )
            raise LogError(f"{path}: {came}{advice}")
        found += map(str, sorted(files))
    return list(dict.fromkeys(found))


def _expand(path: Path) -> list[Path]:
    """The files of one path, folder or glob."""
    if path.is_dir() and not any(get_format(name).claims(path) for name in format_names()):
        return [inner for inner in path.iterdir() if inner.is_file() and not inner.name.startswith(".")]
    if path.exists():
        return [path]
    return [Path(match) for match in glob.glob(str(path), recursive=True) if Path(match).is_file()]


def read_tables(path: str, format: str) -> list[Table]:
    """The recordings at a path.

    Args:
        path: A file, a folder or an archive.
        format: A registered name, or `auto` to go by the name and the contents.

    Raises:
        LogError: It cannot be read, holds nothing, or no format is known for it.
        ConfigError: No such format.
    """
    place = Path(path).expanduser()
    with parsing(path, "a recording"):
        if not place.exists():
            raise LogError(f"{path}: no such file (looked from {Path.cwd()}); check data.train and data.test")
        reader = _recognise(place) if format == "auto" else get_format(format)
        tables = reader.read(place)
        if not any(table.columns or table.refused for table in tables):
            raise LogError(f"{path}: no columns, expected a recording as {reader.name}")
        return tables


def _recognise(path: Path) -> Format:
    """The format of a path: by its name or a folder's contents, by a file's first bytes where it has no suffix."""
    formats = [get_format(name) for name in format_names()]
    head = b""
    if path.is_file():
        with path.open("rb") as file:
            head = file.read(128)
    named = [each for each in formats if each.claims(path)]
    alike = [each.name for each in formats if head.startswith(each.magic)]
    if named and (not alike or any(each.name in alike for each in named)):
        return named[0]
    if len(alike) == 1 and not path.suffix:
        return get_format(alike[0])
    what = "a folder" if path.is_dir() else f"suffix {path.suffix or 'none'}"
    if alike:
        raise LogError(
            f"{path}: {what}, but its first bytes are those of {' or '.join(alike)}; rename it or set "
            f"data.format={alike[0]}"
        )
    raise LogError(f"{path}: {what} of no known format; set data.format to one of {', '.join(format_names())}")
