"""Writing of results: a file is there whole, or not at all."""

import contextlib
import logging
import math
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from frictionzoo.core.errors import OutputError, RunError

# Files by which the folder of a job tells how it stands.
RESULT = "result.json"  # done
FAILURE = "failure.json"  # it failed, and why
RUNNING = ".running"  # locked while it runs, in whatever process; left behind unlocked by a job that was killed

_log = logging.getLogger(__name__)


@contextlib.contextmanager
def occupy(folder: Path, *, wait: bool) -> Iterator[None]:
    """Have a job's folder to oneself: no other process is in it that occupies it too.

    The lock is the operating system's and ends with its process, however that ends. What a killed process had begun to
    write is removed. The folder exists.

    Raises:
        RunError: Another process is in it, and this one is not to wait for it.
        OSError: The folder cannot be written.
    """
    lock = FileLock(folder / RUNNING)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        if not wait:
            raise RunError(
                f"{folder}: another process works in it, expected a folder of this run's own; wait until that one has "
                "ended, or set hydra.run.dir to another folder"
            ) from None
        _log.info("waiting for the process that works in %s", folder)
        lock.acquire()
    try:
        for part in folder.rglob(".*.part"):
            part.unlink(missing_ok=True)
        yield
    finally:
        # Before it is released: who waits for a file that is gone looks anew.
        with contextlib.suppress(OSError):
            (folder / RUNNING).unlink()
        lock.release()


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file under a temporary name in the same folder, then rename it.

    Missing folders are made, an older file of that name is replaced.

    Raises:
        OutputError: The disk is full or the folder cannot be written; nothing new is left behind.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise OutputError(
            f"{path}: {error.strerror} while writing {len(content)} bytes, expected a folder that can be written; "
            "free space or name another folder"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


@contextlib.contextmanager
def take_place(place: Path) -> Iterator[Path]:
    """An empty folder that takes its place, with all that is in it, only if nothing went wrong."""
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        fresh = Path(tempfile.mkdtemp(prefix=f".{place.name}.", dir=place.parent))
        fresh.chmod(0o755)
    except OSError as error:
        raise _no_folder(place, error) from error
    try:
        yield fresh
        try:
            if place.exists():
                shutil.rmtree(place)
            fresh.rename(place)
        except OSError as error:
            raise _no_folder(place, error) from error
    finally:
        shutil.rmtree(fresh, ignore_errors=True)


def _no_folder(place: Path, error: OSError) -> OutputError:
    return OutputError(f"{place}: {error.strerror}; set output to a folder that can be written")


def to_json(value: Any) -> Any:
    """The same mappings, lists, numbers and text with Python's numbers for numpy's, and None for non-finite ones."""
    if isinstance(value, Mapping):
        return {key: to_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
