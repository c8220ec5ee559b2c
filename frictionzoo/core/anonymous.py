"""Removal of file paths that reveal the machine on which they were made."""

import re
import shlex
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path, PurePath, PurePosixPath, PureWindowsPath
from typing import Any
from xml.parsers import expat

from frictionzoo.core.records import map_texts

_PART = r"""[^\s\\/'"\],;:()<>]"""
_PATH = re.compile(rf"(?<![\w./~\\:<-])(?:~|[A-Za-z]:)?[\\/](?:{_PART}+[\\/])*({_PART}+)")
_FILES = {
    *("mjcf", "folder", "train", "test", "run", "teacher", "resume"),
    *("compilation_cache", "cache_dir", "save_dir", "dir"),
}
"""Options that hold files or folders, by the last part of their key."""


def list_paths(settings: Any, key: str = "") -> Iterator[str]:
    """Yield the absolute paths among nested options, which the option `key` holds.

    The option decides, since joints and columns may be called `/leg/knee`. A value of an unknown option, such as one of
    another package's data source, is a path if such a file exists.
    """
    if isinstance(settings, Mapping):
        for name, part in settings.items():
            yield from list_paths(part, str(name))
    elif isinstance(settings, list):
        for part in settings:
            yield from list_paths(part, key)
    elif isinstance(settings, str) and (settings.startswith("~") or _as_path(settings).is_absolute()):
        yield from [settings] if key.rpartition(".")[2] in _FILES or _exists(settings) else []


def list_paths_of(result: Any, command: str | None = None) -> set[str]:
    """Return the paths of a run, from its `result.json` and its command."""
    recordings = [log["name"] for log in result["data"]["logs"]]
    commands = [command, *(row["command"] for row in result["verdict"]["commands"])]
    paths = [*list_paths(result["settings"]), *list_paths(recordings, "train")]
    return {*paths, *(path for text in commands for path in list_paths_in(text))}


def list_paths_in(command: str | None) -> Iterator[str]:
    """Yield the absolute paths among a command's options, `KEY=VALUE` or `KEY=[VALUE,VALUE]`."""
    for option in shlex.split(command or ""):
        key, _, value = option.partition("=")
        yield from list_paths([part.strip(" '\"") for part in value.strip("[]").split(",")], key)


def without_paths(value: Any, paths: Collection[str], names: Collection[str] = (), below: Path | None = None) -> Any:
    """Return a record or JSON value with each path of this machine shortened to its last part.

    These are `paths` and everything in their folders, in the user's home folder and in the current folder. Paths in the
    folder `below` become relative to it. Other text stays, even if it looks like a path; so do `names` of joints.
    """
    files = {path for path in paths if _as_path(path).name}
    # The folder of a file, or of all files that a pattern matches.
    folders = {str(_as_path(re.split(r"[*?\[]", path)[0] + "x").parent) for path in files}
    folders |= {str(Path.home()), str(Path.cwd())}
    patterns = {name: re.escape(name) for name in names if "/" in name or "\\" in name}
    patterns |= {path: rf"(?<![\w.~]){re.escape(path)}(?![\w-])" for path in files - patterns.keys()}
    for folder in folders - patterns.keys():
        if _as_path(folder).name:  # "/" is in every path
            patterns[folder] = rf"(?<![\w.~]){re.escape(folder)}(?![\w-])(?:[\\/]{_PART}+)*"
    longest_first = [patterns[path] for path in sorted(patterns, key=len, reverse=True)]
    pattern = re.compile("|".join(longest_first) or "(?!)")

    def shorten(match: re.Match[str]) -> str:
        path = Path(match[0])
        if match[0] in names:
            return match[0]
        return str(path.relative_to(below)) if below and path.is_relative_to(below) else last_of(match[0])

    return map_texts(value, lambda text: pattern.sub(shorten, text) if "/" in text or "\\" in text else text)


def _as_path(text: str) -> PurePath:
    return PurePosixPath(text) if text.startswith(("/", "~/")) else PureWindowsPath(text)


def _exists(path: str) -> bool:
    try:
        return Path(path).expanduser().exists()
    except (OSError, RuntimeError, ValueError):  # too long, an unknown user, or a NUL in it
        return False


def find_paths(content: bytes) -> list[str]:
    """Return the distinct absolute paths in attributes, text and comments of an XML file, without element names.

    Raises:
        expat.ExpatError: The content is not XML.
    """
    parser, texts, names = expat.ParserCreate(), list[str](), set[str]()

    def begin(tag: str, attributes: dict[str, str]) -> None:
        texts.extend(attributes.values())
        names.update({attributes.get("name", ""), attributes.get("class", "")})

    parser.StartElementHandler, parser.CommentHandler, parser.CharacterDataHandler = begin, texts.append, texts.append
    parser.Parse(content, True)
    paths = (match[0] for text in texts if text not in names for match in _PATH.finditer(text))
    return [path for path in dict.fromkeys(paths) if path not in names]


def last_of(path: str) -> str:
    """Return the last part of a path of any operating system."""
    return PureWindowsPath(path).name or "root"
