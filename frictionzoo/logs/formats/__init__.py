"""Log formats, one a file; the files are looked through, not listed."""

from pathlib import Path

from frictionzoo.core.errors import LogError
from frictionzoo.logs.formats.base import Format, parsing
from frictionzoo.logs.formats.registry import format_names, get_format, register_format
from frictionzoo.logs.recording import Table

__all__ = ["Format", "format_names", "get_format", "read_tables", "register_format"]


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
    """The format of a path: by its name or a folder's contents, by a file's first bytes where it has no suffix.

    Raises:
        LogError: Neither tells, or name and first bytes contradict each other.
    """
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
