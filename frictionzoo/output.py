"""Writing of results: a file is there whole, or not at all."""

import contextlib
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from frictionzoo.errors import OutputError

# Files by which the folder of a job tells how it stands.
RESULT = "result.json"  # done
FAILURE = "failure.json"  # it failed, and why
RUNNING = ".running"  # locked while it runs, in whatever process; left behind unlocked by a job that was killed


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file under a temporary name in the same folder, then rename it.

    Args:
        path: The file; missing folders are made, an older file of that name is replaced.
        content: All of it.

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
            "free space or set hydra.run.dir to another folder"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def to_json(value: Any) -> Any:
    """The same with numpy numbers as Python's and non-finite numbers as None, which JSON calls null.

    Args:
        value: Mappings, lists, tuples, numbers and text.
    """
    if isinstance(value, Mapping):
        return {key: to_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
