"""Manifest of the files written into a folder: only these are ever replaced or removed, and only while unchanged.

An output folder has one manifest, `MANIFEST`, with one JSON object a line. An entry is on the disk before its file, so
a process killed at any point leaves no file that looks foreign.
"""

import contextlib
import errno
import hashlib
import json
import os
import re
import secrets
import stat
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from frictionzoo.core.errors import OutputError

MANIFEST = ".frictionzoo.jsonl"
ABANDONED = 3600.0  # minimal age of an abandoned temporary file [s]
_TOKEN = re.compile(r"[0-9a-f]{16}")
_PART = r"\.[^/]+\.TOKEN\.part"
_UNFINISHED = (
    r"tensorboard/events\.out\.tfevents\.[^/]*\.TOKEN",
    r"wandb/offline-run-[\d_]+-TOKEN/(run-TOKEN\.wandb(\.synced)?|logs/debug[\w-]*\.log|tmp/.*)",
    r"wandb/offline-run-[\d_]+-TOKEN/files/(media/.*|requirements\.txt|config\.yaml|output\.log|wandb-[^/]*)",
)
"""Files that other programs name and keep writing; `TOKEN` stands for a token in the manifest."""
_LINKS = (
    r"wandb/(latest-run|debug[\w-]*\.log) -> (.*/)?offline-run-[\d_]+-TOKEN(/.*)?",
    r"wandb/offline-run-[\d_]+-TOKEN/logs/debug[\w-]*\.log -> .*",
)


class FileState(NamedTuple):
    """Content that this program gave a file: size in bytes and hash."""

    size: int
    sha256: str

    @classmethod
    def of(cls, content: bytes) -> "FileState":
        """Return the state of a file with this content."""
        return cls(len(content), hashlib.sha256(content).hexdigest())


class Manifest:
    """Manifest of one folder for one kind of command, such as `run` or `export`; files of another kind are foreign.

    Raises:
        OutputError: The folder, if it exists, has a file with the manifest's name that is not a manifest.
    """

    def __init__(self, root: Path, kind: str) -> None:
        self.root, self.kind, self.token = root, kind, secrets.token_hex(8)
        self._unchanged: dict[str, tuple[int, ...]] = {}
        self._began = False
        self._read()

    def refuse(self, names: Iterable[str]) -> None:
        """Refuse to write under these names if a file there is not this program's or has changed.

        Raises:
            OutputError: The message names the first such file.
        """
        for name in names:
            if self._in_the_way(name) is None:
                continue
            self._read()  # another process may have written it meanwhile
            if (path := self._in_the_way(name)) is not None:
                raise OutputError(
                    f"{show_path(path)}: {self._describe(name, path)}, expected nothing there or an unchanged file of "
                    "this kind of output; move it away or write to another folder"
                )

    def refuse_inside(self, folder: str) -> None:
        """Refuse a subfolder with a file that is not this program's or has changed: OutputError names it."""
        self.refuse([folder] if not _is_folder(self.root / folder) else self._walk(folder))

    def owns(self, name: str) -> bool:
        """Return whether a file exists that this program wrote and nobody has changed."""
        return os.path.lexists(self.root / name) and self._in_the_way(name) is None

    def write(self, name: str, content: bytes) -> None:
        """Write a file whole or not at all; an older one of this program's is replaced.

        Raises:
            OutputError: A foreign file is in the way, or the folder cannot be written or is full. No new file stays.
        """
        self.refuse([name])
        path, temporary = self.root / name, self.root / f".{Path(name).name}.{self.token}.part"
        try:
            with saying(path, len(content)):
                path.parent.mkdir(parents=True, exist_ok=True)
                self.begin()  # its token identifies the temporary file
                self.record({name: FileState.of(content)})
                with open(temporary, "xb") as file:
                    file.write(content)
                    file.flush()
                    os.fsync(file.fileno())
                self.put(temporary, name)
        finally:
            with contextlib.suppress(OSError):
                temporary.unlink()
            self.forget()

    def put(self, source: Path, name: str) -> None:
        """Move a file with a recorded state to its name, in one step."""
        os.replace(source, self.root / name)
        self._unchanged[name] = _fingerprint(os.lstat(self.root / name))

    def append(self, name: str, content: bytes) -> None:
        """Append to a file that this program wrote; the longer file replaces it whole, see `write`."""
        if content:
            self.refuse([name])
            with saying(self.root / name):
                before = (self.root / name).read_bytes()
            self.write(name, before + content)

    def remove(self, name: str) -> None:
        """Remove a file that this program wrote, if it exists; OutputError for any other file of that name."""
        self.refuse([name])
        with saying(self.root / name):
            (self.root / name).unlink(missing_ok=True)

    def clear(self, folder: str = "") -> None:
        """Remove all files of this program from a subfolder or from all, and folders that become empty."""
        names = [name for name in self._walk(folder) if self.owns(name)]
        for name in names:
            self.remove(name)
        emptied = {self.root / parent for name in names for parent in Path(name).parents} - {self.root}
        for place in sorted(emptied, key=lambda path: -len(path.parts)):
            remove_if_empty(place)

    def forget(self) -> None:
        """Remove the manifest if none of the files that it lists exists."""
        if self._tokens and not any(os.path.lexists(self.root / name) for name in self._listed):
            with contextlib.suppress(OSError):
                (self.root / MANIFEST).unlink()
            self._states.clear()  # `record` lists them again
            self._began = False

    def record(self, states: Mapping[str, FileState]) -> None:
        """List the contents that files are about to have; OSError if the disk is full."""
        new = {name: state for name, state in states.items() if state not in self._states.get(name, [])}
        if not new:
            return
        self.begin()
        self._write([{"file": name, **state._asdict()} for name, state in new.items()])
        for name, state in new.items():
            self._states.setdefault(name, []).append(state)
        self._listed |= {*states}

    def mark(self, name: str, at: int, content: bytes) -> None:
        """List bytes at a position that identify as ours a file that another program keeps writing."""
        self.begin()
        self._write([{"file": name, "at": at, "bytes": content.hex()}])
        self._marks[name] = at, content
        self._listed.add(name)

    def adopt(self, folder: str) -> None:
        """List the contents of the files in a subfolder that are now finished."""
        finished = (name for name in self._walk(folder) if name not in self._states and self.owns(name))
        paths = {name: path for name in finished if not (path := self.root / name).is_symlink()}
        with saying(self.root / folder):
            self.record({name: FileState.of(path.read_bytes()) for name, path in paths.items()})

    def begin(self) -> None:
        """Create the manifest if needed and add this process's token, which marks its unfinished files."""
        if self._began:
            return
        self.root.mkdir(parents=True, exist_ok=True)
        self._write([{"session": self.token}])
        self._tokens.add(self.token)
        self._began = True

    def remove_parts(self, *, age: float = 0.0) -> None:
        """Remove unfinished files that killed processes of this program left at least `age` seconds ago."""
        with contextlib.suppress(OSError):
            for path in self.root.glob(".*.part"):
                status = os.lstat(path)
                is_ours = stat.S_ISREG(status.st_mode) and _matches((_PART,), path.name, self._tokens)
                if is_ours and time.time() - status.st_mtime >= age:
                    path.unlink()

    def list_files(self) -> set[str]:
        """Return the names of all unchanged files that this kind of command wrote here."""
        inside = (n for n in self._states if n and not Path(n).is_absolute() and ".." not in Path(n).parts)
        return {name for name in inside if self.owns(name)}

    def _in_the_way(self, name: str) -> Path | None:
        """Return the path that blocks a file of this name: itself, or a parent that is not a folder; else None."""
        for parent in [self.root / part for part in list(Path(name).parents)[-2::-1]]:
            if os.path.lexists(parent) and not _is_folder(parent):
                return parent
        path = self.root / name
        return path if os.path.lexists(path) and not self._is_ours(name, path) else None

    def _is_ours(self, name: str, path: Path) -> bool:
        status = os.lstat(path)
        if stat.S_ISLNK(status.st_mode):
            return _matches(_LINKS, f"{name} -> {os.readlink(path)}", self._tokens)
        if not stat.S_ISREG(status.st_mode):
            return False
        if self._unchanged.get(name) == _fingerprint(status):
            return True
        if name in self._marks:
            position, content = self._marks[name]
            return _read_at(path, position, len(content)) == content
        is_listed = name in self._states
        ours = _is_one_of(path, self._states[name]) if is_listed else _matches(_UNFINISHED, name, self._tokens)
        if ours:
            self._unchanged[name] = _fingerprint(status)
        return ours

    def _describe(self, name: str, path: Path) -> str:
        if path.is_symlink():
            return "a symbolic link"
        if path != self.root / name:
            return "not a folder"
        if path.is_dir():
            return "a folder"
        if name in self._states:
            return "changed since it was written"
        return "written by another command" if name in self._listed else "not written by this program"

    def _walk(self, folder: str) -> Iterator[str]:
        """Yield the names of all files and links in a subfolder, recursively, without following links."""
        if not _is_folder(self.root / folder):
            return
        for place, folders, files in os.walk(self.root / folder):
            links = [name for name in folders if os.path.islink(os.path.join(place, name))]
            for name in sorted([*files, *links]):
                yield Path(place, name).relative_to(self.root).as_posix()

    def _read(self) -> None:
        self._states: dict[str, list[FileState]] = {}
        self._marks: dict[str, tuple[int, bytes]] = {}
        self._tokens: set[str] = set()
        self._listed: set[str] = set()  # by all kinds of commands
        path = self.root / MANIFEST
        if not os.path.lexists(path):
            return
        lines = path.read_bytes().splitlines() if stat.S_ISREG(os.lstat(path).st_mode) else []
        entries = [entry for line in lines if (entry := _parse(line))]
        if not entries:
            raise OutputError(
                f"{show_path(path)}: not a list of files of this program; move it away or write to another folder"
            )
        self._listed = {name for _, name, _ in entries if name}
        for kind, name, content in entries:
            if kind != self.kind:
                continue
            if isinstance(content, FileState):
                self._states.setdefault(name, []).append(content)
            elif isinstance(content, str):
                self._tokens.add(content)
            else:
                self._marks[name] = content

    def _write(self, entries: Iterable[Mapping[str, Any]]) -> None:
        path = self.root / MANIFEST
        content = "".join(json.dumps({"kind": self.kind, **entry}) + "\n" for entry in entries).encode()
        new = not os.path.lexists(path)
        try:
            with open(path, "x+b" if new else "a+b", buffering=0) as file:
                if not new and _read_at(path, path.stat().st_size - 1, 1) != b"\n":  # a killed process left half a line
                    content = b"\n" + content
                if file.write(content) != len(content):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                os.fsync(file.fileno())
        except OSError:
            if new:
                with contextlib.suppress(OSError):
                    path.unlink()
            raise


def _parse(line: bytes) -> tuple[str, str, FileState | tuple[int, bytes] | str] | None:
    """Return kind, name and content (state, mark, or token of a session without a name); None for an invalid line."""
    with contextlib.suppress(ValueError, KeyError, TypeError, AttributeError, RecursionError):
        entry = json.loads(line)
        kind, name = entry["kind"], "" if "session" in entry else entry["file"]
        if "session" in entry:
            content = entry["session"]
            is_valid = bool(_TOKEN.fullmatch(content))
        elif "bytes" in entry:
            content = entry["at"], bytes.fromhex(entry["bytes"])
            is_valid = type(content[0]) is int and len(content[1]) >= 8
        else:
            content = FileState(entry["size"], entry["sha256"])
            is_valid = type(content.size) is int and isinstance(content.sha256, str)
        return (kind, name, content) if is_valid and isinstance(kind, str) and isinstance(name, str) else None
    return None


def _matches(patterns: Iterable[str], name: str, tokens: Iterable[str]) -> bool:
    alternatives = "|".join(tokens)
    filled = (pattern.replace("TOKEN", f"({alternatives})") for pattern in patterns)
    return bool(alternatives) and any(re.fullmatch(pattern, name) for pattern in filled)


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


def _fingerprint(found: os.stat_result) -> tuple[int, ...]:
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns


def _is_one_of(path: Path, states: Sequence[FileState]) -> bool:
    size = path.stat().st_size
    if size not in {state.size for state in states}:
        return False
    with open(path, "rb") as file:
        return FileState(size, hashlib.file_digest(file, "sha256").hexdigest()) in states


def _read_at(path: Path, at: int, size: int) -> bytes:
    with open(path, "rb") as file:
        file.seek(at)
        return file.read(size)


def show_path(path: Path) -> str:
    """Return a path for a one-line message, whatever its characters."""
    return str(path) if str(path).isprintable() else ascii(str(path))


def remove_if_empty(path: Path) -> None:
    """Remove a folder if it is empty."""
    with contextlib.suppress(OSError):
        path.rmdir()


@contextlib.contextmanager
def saying(path: Path, size: int | None = None) -> Iterator[None]:
    """Turn an error of the operating system into one line."""
    try:
        yield
    except OSError as error:
        doing = "" if size is None else f" while writing {size} bytes"
        raise OutputError(
            f"{show_path(path)}: {error.strerror}{doing}, expected a folder that can be written; free space or name "
            "another folder"
        ) from error
