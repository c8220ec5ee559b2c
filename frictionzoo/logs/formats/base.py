"""The interface that every format fills, and what keeps a file from asking for more memory than it may."""

import hashlib
import importlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import numpy as np

from frictionzoo.errors import FrictionzooError, LogError
from frictionzoo.logs.recording import Table

LIMIT = 4 << 30  # bytes of one file or of what it unpacks to; a drive's log of a day at 1 kHz has a tenth of it
RATIO = 250  # to which a log may be compressed; text of numbers reaches 20, and what is made to fill a disk 1000
SMALL = 64 << 20  # bytes that may be compressed as far as they go, as columns of one value are
EXACT = 2**53  # up to which a float holds every whole number
WIDE = 256  # columns of a matrix that are still signals


class Format(ABC):
    """How one kind of file becomes tables.

    Attributes:
        name: Set by `register_format`.
        suffixes: How the names of its files end, in lower case.
        magic: First bytes of its files, for names that end otherwise.
    """

    name: ClassVar[str]
    suffixes: ClassVar[tuple[str, ...]] = ()
    magic: ClassVar[tuple[bytes, ...]] = ()

    def claims(self, path: Path) -> bool:
        """Whether a path's name, or a folder's contents, say that it is of this format."""
        return path.is_file() and path.suffix.lower() in self.suffixes

    def read(self, path: Path) -> list[Table]:
        """The tables of a path.

        Raises:
            LogError: It cannot be read or is not of this format.
        """
        content = read_bytes(path)
        return [replace(self.parse(str(path), content), sha256=hashlib.sha256(content).hexdigest())]

    @abstractmethod
    def parse(self, name: str, content: bytes) -> Table:
        """The table in a file's bytes.

        Args:
            name: Where they came from, for messages.
            content: All of them.

        Raises:
            LogError: They are not of this format, or damaged.
        """


def read_bytes(path: Path) -> bytes:
    """A file's bytes; LogError where there are none or too many."""
    try:
        check_size(str(path), path.stat().st_size)
        return path.read_bytes()
    except FileNotFoundError:
        raise LogError(f"{path}: no such file (looked from {Path.cwd()}); check data.train and data.test") from None
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror}); expected a recording") from None


def check_size(name: str, size: int, packed: int | None = None) -> None:
    """See that a file's size, or the size that it says it unpacks to, can be that of a recording.

    Args:
        name: The file's name, for messages.
        size: [bytes].
        packed: Bytes from which it would unpack.

    Raises:
        LogError: It cannot.
    """
    if size > LIMIT:
        raise LogError(f"{name}: {size / 1e9:.1f} GB, expected at most {LIMIT / 1e9:.1f} GB; cut it into shorter logs")
    if packed is not None and size > SMALL and size > RATIO * packed:
        raise LogError(
            f"{name}: {packed} bytes would unpack to {size / 1e6:.0f} MB, expected at most {RATIO} times as many; "
            "this is no recording"
        )


@contextmanager
def parsing(name: str, what: str) -> Iterator[None]:
    """Turn whatever a library raises on damaged bytes into one line."""
    try:
        yield
    except FrictionzooError:
        raise
    except MemoryError:
        raise LogError(f"{name}: does not fit into memory; expected {what}; cut it into shorter logs") from None
    # Parsers raise errors of many kinds on damaged files (ValueError, TypeError, zlib.error, RecursionError, ...).
    except Exception as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise LogError(f"{name}: not readable as {what} ({reason}); copy or export it again") from None


def optional(module: str, package: str, name: str) -> ModuleType:
    """A module of a package that not every user needs.

    Raises:
        LogError: It is not installed; the line says how to install it.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise LogError(f'{name}: reading it needs {package}; pip install "frictionzoo[formats]"') from None


def tabulate(name: str, variables: Mapping[str, Any], fields: Mapping[str, str | float] | None = None) -> Table:
    """A table from named arrays: columns from vectors and matrices, fields from single values.

    Args:
        name: Where they came from, for messages.
        variables: Arrays, numbers or texts.
        fields: More fields.
    """
    columns, refused, units, kept = {}, {}, {}, dict(fields or {})
    for header, given in variables.items():
        values = np.asarray(given)
        if values.dtype.kind == "M":
            values, units[header] = values.astype("M8[ns]").astype(np.int64), "ns"
        if values.size == 1 and values.dtype.kind in "US":
            kept[header] = str(values.item())
        elif values.dtype.kind not in "biuf":
            refused[header] = f"{name}: {header} is of type {values.dtype}, expected real numbers"
        elif values.ndim == 0:
            kept[header] = float(values)
        elif values.ndim > 2 or sorted(values.shape)[:-1] > [WIDE]:
            refused[header] = f"{name}: {header} has shape {values.shape}, expected (time,) or (time, columns)"
        else:
            columns |= _columns(header, values)
    return Table(name, columns, kept, refused=refused, units=units)


def _columns(header: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """A vector as it is, a matrix one column a signal, whichever way it stands."""
    if values.ndim == 1 or 1 in values.shape:
        return {header: to_numbers(values.ravel())}
    # Samples are many and signals few.
    rows = values.T if values.shape[0] >= values.shape[1] else values
    return {f"{header}[{place}]": to_numbers(row) for place, row in enumerate(rows)}


def to_numbers(values: np.ndarray) -> np.ndarray:
    """Numbers as float64, or as int64 where that would round them: nanoseconds since 1970 do not fit."""
    if values.dtype.kind in "iu" and values.size and max(int(values.max()), -int(values.min())) > EXACT:
        return values.astype(np.int64 if int(values.max()) < 2**63 else np.float64)
    return values.astype(np.float64)
