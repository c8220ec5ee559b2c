"""Names of files in place of their paths, which tell of the machine on which they were made."""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path, PureWindowsPath
from typing import Any

_PART = r"""[^\s\\/'"\],;:()<>]"""
_PATH = re.compile(rf"(?<![\w./~\\:<-])(?:~|[A-Za-z]:)?[\\/](?:{_PART}+[\\/])*({_PART}+)")


def list_paths(value: Any) -> Iterator[str]:
    """Options that are a whole absolute path, which may have blanks in it."""
    if isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, list):
        for part in value:
            yield from list_paths(part)
    elif isinstance(value, str) and (Path(value).is_absolute() or PureWindowsPath(value).is_absolute()):
        yield value


def without_paths(value: Any, known: tuple[str, ...] = (), below: Path | None = None) -> Any:
    """The same mappings, lists and text with the last part of every absolute path in place of it.

    Args:
        value: Of JSON.
        known: Paths, as `list_paths` gives them, by which those with blanks are found in the midst of a sentence.
        below: A folder; of what lies in it, the path from there is left.
    """
    if value is None or isinstance(value, float | int):  # of which there are by far the most
        return value
    if isinstance(value, Mapping):
        return {without_paths(key, known, below): without_paths(part, known, below) for key, part in value.items()}
    if isinstance(value, list):
        return [without_paths(part, known, below) for part in value]
    if not isinstance(value, str) or not ("/" in value or "\\" in value):
        return value
    for path in sorted(known, key=len, reverse=True):
        value = value.replace(path, _shorten(path, below))
    return _PATH.sub(lambda match: _shorten(match[0], below), value)


def _shorten(path: str, below: Path | None) -> str:
    if below is None or not Path(path).is_relative_to(below):
        return last_of(path)
    return str(Path(path).relative_to(below))


def find_paths(text: str) -> list[str]:
    """Absolute paths in the midst of a text, each once."""
    return list(dict.fromkeys(match[0] for match in _PATH.finditer(text)))


def last_of(path: str) -> str:
    """The last part of a path of any system."""
    return PureWindowsPath(path).name or "root"
