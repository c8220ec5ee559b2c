"""Cache on disk for arrays that are slow to compute."""

import hashlib
import io
import logging
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import platformdirs

from frictionzoo.core.errors import OutputError
from frictionzoo.core.output import claim, write_atomically

_log = logging.getLogger(__name__)


def cache_folder(setting: str | None) -> Path | None:
    """Return the folder for `cache_dir`: `user` for the system's user cache, a path, or None for no cache."""
    if setting is None:
        return None
    return Path(platformdirs.user_cache_dir("frictionzoo") if setting == "user" else setting).expanduser()


def digest(arrays: Mapping[str, np.ndarray]) -> str:
    """Return the SHA-256 of the arrays' bytes, in their order."""
    total = hashlib.sha256()
    for values in arrays.values():
        total.update(np.ascontiguousarray(values).tobytes())
    return total.hexdigest()


def cached(path: Path | None, names: Sequence[str], make: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Read named arrays from an .npz file (None: no cache); if it is missing or damaged, make and save them."""
    arrays = None if path is None else _read(path, names)
    if arrays is None:
        arrays = make()
        if path is not None:
            _write(path, arrays)
    return arrays


def _read(path: Path, names: Sequence[str]) -> dict[str, np.ndarray] | None:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in names}
            if digest(arrays) == str(stored["sha256"]):
                return arrays
            _log.warning("%s: contents do not match their hash; rebuilt", path)
    except FileNotFoundError:
        pass
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        _log.warning("%s: cannot be read (%s); rebuilt", path, error)
    return None


def _write(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, sha256=np.array(digest(arrays)), **arrays)
    try:
        with claim(path.parent, "cache"):
            write_atomically(path, content.getvalue())
    except OutputError as error:
        _log.warning("%s; the cache cannot be written, the data will be rebuilt next time", error)
