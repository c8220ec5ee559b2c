"""Output of results: a file is written whole or not at all."""

import contextlib
import json
import logging
import math
import os
import shutil
import stat
import tempfile
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
from filelock import FileLock, Timeout

from frictionzoo.core.errors import OutputError, RunError
from frictionzoo.core.manifest import ABANDONED, FileState, Manifest, remove_if_empty, saying, show_path
from frictionzoo.core.records import Record

# Files in a job's folder that show its status.
RESULT = "result.json"  # done
FAILURE = "failure.json"  # failed, with the reason
SETTLED = "checkpoints/settled.safetensors"  # results of automatic settings
TEMPLATE = "template.xml"  # only a card has it: MJCF of its test stand without the drive
RUNNING = ".running"  # locked while a process runs the job; a killed process leaves it unlocked

_CLAIMED: ContextVar[tuple[tuple[Path, Manifest | None], ...]] = ContextVar("claimed", default=())
_log = logging.getLogger(__name__)
R = TypeVar("R", bound=Record)


RUN_FILES = (
    *(RESULT, FAILURE, "report.html", "curves.safetensors", "friction.safetensors"),
    *("identified.xml", "identified.urdf", "bench.xml", "checkpoints/last.ckpt", SETTLED),
    *(f"figures/{name}.png" for name in ("figure3_parameters", "figure4_trajectory", "figure5_error")),
    *(f".hydra/{name}.yaml" for name in ("config", "hydra", "overrides")),
    ".hydra/settings.json",
)
"""All files that a run may write, except those in its logger's subfolder."""
LOGGERS = frozenset({"tensorboard", "csv", "wandb"})
"""Subfolders that hold only the files of the logger of the same name."""


@contextlib.contextmanager
def claim(
    folder: Path, kind: str, names: Iterable[str] = (), inside: Collection[str] = (), *, undone: bool = False
) -> Iterator[Manifest]:
    """List every file written into a folder in this context in the folder's manifest for this kind of command.

    The folder need not exist. Foreign files under `names` or in the subfolders `inside` are refused at once. With
    `undone`, an error removes this program's files from the folder.

    Raises:
        OutputError: A foreign file is in the way.
    """
    if os.path.lexists(folder) and not folder.is_dir():
        raise OutputError(f"{show_path(folder)}: not a folder, expected one to write into; name another")
    manifest = manifest_of(folder, kind)
    manifest.refuse(names)
    for subfolder in inside:
        manifest.refuse_inside(subfolder)
    manifest.remove_parts(age=ABANDONED)
    token = _CLAIMED.set(((Path(os.path.abspath(folder)), manifest), *_CLAIMED.get()))
    try:
        yield manifest
    except BaseException:
        if undone:
            with contextlib.suppress(OutputError):  # the first error matters more
                manifest.clear()
            manifest.forget()
            remove_if_empty(folder)
        raise
    finally:
        _CLAIMED.reset(token)


def manifest_of(folder: Path, kind: str) -> Manifest:
    """Return the manifest of the context that claimed this folder, else a new one."""
    root = Path(os.path.abspath(folder))
    claimed = (manifest for place, manifest in _CLAIMED.get() if manifest and place == root and manifest.kind == kind)
    return next(claimed, None) or Manifest(folder, kind)


@contextlib.contextmanager
def scratch(folder: Path) -> Iterator[None]:
    """Write into a private folder of this process, without a manifest."""
    token = _CLAIMED.set(((Path(os.path.abspath(folder)), None), *_CLAIMED.get()))
    try:
        yield
    finally:
        _CLAIMED.reset(token)


def find_manifest(path: Path) -> tuple[Manifest | None, str]:
    """Return the manifest of the innermost claimed folder around a file (None: `scratch`), else of its folder."""
    absolute = Path(os.path.abspath(path))
    claims = [(root, claimed) for root, claimed in _CLAIMED.get() if absolute.is_relative_to(root)]
    if not claims:
        return Manifest(path.parent, "file"), path.name
    root, manifest = max(claims, key=lambda pair: len(pair[0].parts))
    return manifest, absolute.relative_to(root).as_posix()


@contextlib.contextmanager
def occupy(folder: Path, *, wait: bool, names: Iterable[str] = (), inside: Collection[str] = ()) -> Iterator[Manifest]:
    """Lock a job's folder, which must exist, for one process; `wait` for another one, or refuse.

    The operating system ends the lock with the process. Unfinished files of killed processes are removed. `names` and
    `inside` are as for `claim`.

    Raises:
        RunError: Another process is in it, and `wait` is false.
        OutputError: A foreign file is in the way.
        OSError: The folder cannot be written.
    """
    # The lock is a file too, listed before it exists.
    manifest = Manifest(folder, "run")
    manifest.refuse([RUNNING])
    manifest.record({RUNNING: FileState.of(b"")})
    lock = FileLock(folder / RUNNING)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        if not wait:
            raise RunError(
                f"{show_path(folder)}: another process works in it, expected a free folder; wait until it has ended, "
                "or set hydra.run.dir to another folder"
            ) from None
        _log.info("waiting for the process that works in %s", folder)
        lock.acquire()
    try:
        manifest = Manifest(folder, "run")
        manifest.record({RUNNING: FileState.of(b"")})  # the previous owner may have removed the manifest
        with claim(folder, "run", names, inside) as manifest:
            manifest.remove_parts()
            yield manifest
    finally:
        # Before the release: a waiting process checks again when the file is gone.
        with contextlib.suppress(OSError):
            (folder / RUNNING).unlink()
        manifest.forget()
        lock.release()


def refuse_existing(folder: Path) -> None:
    """Raise OutputError if the folder exists."""
    if os.path.lexists(folder):
        raise OutputError(f"{folder}: it exists already, expected a new folder; remove it or set output to another")


def is_lock(path: Path) -> bool:
    """Return whether a file can be a job's lock: it is empty, so locking it changes nothing."""
    with contextlib.suppress(OSError):
        status = os.lstat(path)
        return stat.S_ISREG(status.st_mode) and not status.st_size
    return False


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file under a temporary name, rename it, and list it in its manifest; missing folders are made.

    Raises:
        OutputError: A foreign or changed file is in the way, or the folder cannot be written. No new file stays.
    """
    manifest, name = find_manifest(path)
    if manifest:
        manifest.write(name, content)
        return
    with saying(path, len(content)):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


def write_json(path: Path, content: Any) -> None:
    """Write a record or plain content as `write_atomically` does; ValueError for NaN and infinities."""
    text = json.dumps(content, indent=2, allow_nan=False, default=msgspec.to_builtins)
    write_atomically(path, f"{text}\n".encode())


def complete(record: R) -> R:
    """Return a record after writing and reading: validated, with Python's numbers, and None instead of non-finite ones.

    Raises:
        msgspec.ValidationError: A value has another type than its field.
    """
    return msgspec.convert(to_json(record), type(record))


def remove_written(path: Path) -> None:
    """Remove a file that this program wrote, if it exists; OutputError for any other file of that name."""
    manifest, name = find_manifest(path)
    assert manifest  # nothing is removed from a scratch
    manifest.remove(name)


@contextlib.contextmanager
def take_place(place: Path, kind: str, names: Sequence[str]) -> Iterator[Path]:
    """Yield an empty folder whose files move to `place` only if no error occurs.

    `names` are the files that will be written, as far as known; the last one moves last. Older files of the same kind
    of command that are not written again are removed; all others stay.

    Raises:
        OutputError: A foreign file is in the way, before or after the work; or the folder cannot be written.
    """
    if RESULT not in names and (place / RESULT).exists():
        raise OutputError(f"{show_path(place)}: it holds a run, expected another folder; set output to one")
    with claim(place, kind, names) as manifest:
        try:
            place.parent.mkdir(parents=True, exist_ok=True)
            fresh = Path(tempfile.mkdtemp(prefix=f".{place.name}.", dir=place.parent))
        except OSError as error:
            raise _no_folder(place, error) from error
        try:
            with scratch(fresh):
                yield fresh
            try:
                _put_in_place(fresh, manifest, names[-1])
            except OSError as error:
                raise _no_folder(place, error) from error
        finally:
            shutil.rmtree(fresh, ignore_errors=True)


def _put_in_place(fresh: Path, manifest: Manifest, last: str) -> None:
    new = {path.relative_to(fresh).as_posix(): path for path in sorted(fresh.rglob("*")) if path.is_file()}
    manifest.refuse(new)
    old = manifest.list_files()
    manifest.record({name: FileState.of(path.read_bytes()) for name, path in new.items()})
    for name in sorted(new, key=lambda name: name == last):
        (manifest.root / name).parent.mkdir(parents=True, exist_ok=True)
        manifest.put(new[name], name)
    for name in old - {*new}:
        manifest.remove(name)


def _no_folder(place: Path, error: OSError) -> OutputError:
    return OutputError(f"{show_path(place)}: {error.strerror}; set output to a folder that can be written")


def to_json(value: Any) -> Any:
    """Return JSON-compatible mappings and lists, with Python numbers for numpy's and None for non-finite ones."""
    if isinstance(value, Record):
        return {field.encode_name: to_json(value[field.name]) for field in msgspec.structs.fields(value)}
    if isinstance(value, Mapping):
        return {key: to_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
