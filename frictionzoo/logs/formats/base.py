"""The interface that every format fills, and what keeps a file from asking for more memory than it may."""

import hashlib
import importlib
import io
import json
import zipfile
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import numpy as np

from frictionzoo.core.errors import FrictionzooError, LogError
from frictionzoo.core.registry import KINDS, Registry
from frictionzoo.logs.recording import Table

LIMIT = 4 << 30  # bytes of one file
UNPACKED = 1 << 30  # bytes of what a file unpacks to: four signals at 1 kHz over nine hours
RATIO = 250  # to which a log may be compressed; text of numbers reaches 20, and what is made to fill a disk 1000
SMALL = 64 << 20  # bytes that may be compressed as far as they go, as columns of one value are
EXACT = 2**53  # up to which a float holds every whole number
WHOLE = 2**62  # below which the difference of two whole numbers fits into 64 bits
HEADER = 30  # least bytes of a zip member before its contents
WIDE = 256  # columns of a matrix that are still signals


class Format(ABC):
    """How one kind of file becomes tables.

    Attributes:
        name: Set by `register_format`.
        suffixes: How the names of its files end, in lower case.
        magic: First bytes of its files. A file without a suffix is known by them; one whose suffix and first bytes are
            of different formats is refused.
    """

    name: ClassVar[str]
    suffixes: ClassVar[tuple[str, ...]] = ()
    magic: ClassVar[tuple[bytes, ...]] = ()

    def claims(self, path: Path) -> bool:
        """Whether a path's name, or a folder's contents, say that it is of this format."""
        return path.is_file() and path.suffix.lower() in self.suffixes

    def read(self, path: Path) -> list[Table]:
        """The tables of a path; LogError where it cannot be read or is not of this format."""
        content = read_bytes(path)
        return [replace(self.parse(str(path), content), sha256=hashlib.sha256(content).hexdigest())]

    @abstractmethod
    def parse(self, name: str, content: bytes) -> Table:
        """The table in a file's bytes, which have this name in messages.

        Raises:
            LogError: They are not of this format, or damaged.
        """


REGISTRY = Registry(KINDS["formats"], Format, "parse")

register_format = REGISTRY.register
"""Class decorator that makes a format available as `data.format=NAME`, as `Registry.register`."""

format_names: Callable[[], list[str]] = REGISTRY.names
"""Names of all formats, sorted."""


def get_format(name: str) -> Format:
    """The format of that name; ConfigError where there is none, two packages bring it, or it is broken."""
    return REGISTRY.get(name)()


def read_bytes(path: Path) -> bytes:
    """A file's bytes; LogError where there are none or too many."""
    try:
        check_size(str(path), path.stat().st_size)
        return path.read_bytes()
    except FileNotFoundError:
        raise LogError(f"{path}: no such file (looked from {Path.cwd()}); check the path") from None
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror}); expected a recording") from None


def check_size(name: str, size: int) -> None:
    """LogError where a file's size cannot be that of a recording [bytes]."""
    if size > LIMIT:
        raise LogError(f"{name}: {size / 1e9:.1f} GB, expected at most {LIMIT / 1e9:.1f} GB; cut it into shorter logs")


def check_unpacked(name: str, size: int, packed: int | None = None) -> None:
    """LogError where what a file unpacks to [bytes] cannot be a recording; packed is None where many may be of few."""
    if size > UNPACKED:
        most = f"{UNPACKED / 1e9:.1f} GB"
        raise LogError(f"{name}: {size / 1e9:.1f} GB unpacked, expected at most {most}; cut it into shorter logs")
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


def unzip(name: str, content: bytes, suffix: str) -> Iterator[tuple[str, bytes]]:
    """The members of a zip archive whose names end in a suffix, such as `.npy`, in its order: their names and bytes.

    No more is unpacked than the archive says, and its checksums are checked.

    Raises:
        LogError: Two members have one name or share bytes, or it is or unpacks to too much.
        zipfile.BadZipFile: It is damaged.
    """
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        _refuse_overlaps(name, archive)
        for member in archive.infolist():
            archive.open(member).close()  # sees that its name is the same twice: a damaged one may end otherwise
        members = [member for member in archive.infolist() if member.filename.endswith(suffix)]
        twice = [member for member, count in Counter(member.filename for member in members).items() if count > 1]
        if twice:
            raise LogError(f"{name}: two members {twice[0]}, expected one of each name; write the archive again")
        check_unpacked(name, sum(member.file_size for member in members), len(content))
        for member in members:
            yield member.filename, _unpack(f"{name}!{member.filename}", archive, member)


def _refuse_overlaps(name: str, archive: zipfile.ZipFile) -> None:
    """LogError where members share bytes, so that few of them unpack to any number."""
    end = 0
    for member in sorted(archive.infolist(), key=lambda member: member.header_offset):
        if member.header_offset < end:
            raise LogError(f"{name}: {member.filename} begins within the member before it; write the archive again")
        end = member.header_offset + HEADER + member.compress_size
    if end > archive.start_dir:
        raise LogError(f"{name}: its last member does not end before the table of contents; write the archive again")


def _unpack(name: str, archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytes:
    """The bytes of one member."""
    # Others are unpacked by Python without a bound.
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise LogError(f"{name}: packed by method {member.compress_type}, expected deflate or none; zip it again")
    with archive.open(member) as stream:
        unpacked = stream.read(member.file_size + 1)
    if len(unpacked) != member.file_size:
        raise LogError(f"{name}: {len(unpacked)} bytes, expected {member.file_size}; copy or write the archive again")
    return unpacked


def parse_json(content: bytes) -> Any:
    """What JSON says; ValueError where an object has a key twice, of which Python would take the last."""
    return json.loads(content, object_pairs_hook=_unique)


def _unique(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        twice = next(key for key, count in Counter(key for key, _ in pairs).items() if count > 1)
        raise ValueError(f"key {twice[:40]!r} twice in one object")
    return found


def optional(module: str, package: str, name: str) -> ModuleType:
    """A module of a package that not every user needs; LogError where it is not installed, which says how to do it."""
    try:
        return importlib.import_module(module)
    except ImportError:
        raise LogError(f'{name}: reading it needs {package}; pip install "frictionzoo[formats]"') from None


def tabulate(
    name: str,
    variables: Mapping[str, Any],
    fields: Mapping[str, str | float] | None = None,
    refused: Mapping[str, str] | None = None,
) -> Table:
    """A table from named arrays, numbers and texts: columns from vectors and matrices, fields from single values.

    It has the given fields besides, and refuses what is refused already. LogError where two columns have one name.
    """
    columns, refused, units, kept = {}, dict(refused or {}), {}, dict(fields or {})
    for header, given in variables.items():
        values = np.asarray(given)
        if values.dtype.kind == "M":
            exact = values.astype("M8[ns]")
            if not (exact.astype(values.dtype) == values).all():
                refused[header] = f"{name}: {header} lacks a time, or has one beyond the years 1678 to 2262; mend it"
                continue
            values, units[header] = exact.astype(np.int64), "ns"
        if values.size == 1 and values.dtype.kind in "US":
            kept[header] = str(values.item())
        elif values.dtype.kind not in "biuf":
            refused[header] = f"{name}: {header} is of type {values.dtype}, expected real numbers"
        elif values.ndim == 0:
            kept[header] = float(values)
        elif values.ndim > 2 or sorted(values.shape)[:-1] > [WIDE]:
            refused[header] = f"{name}: {header} has shape {values.shape}, expected (time,) or (time, columns)"
        else:
            try:
                found = _columns(header, values)
            except ValueError as error:
                refused[header] = f"{name}: {header} {error}"
                continue
            for twice in columns.keys() & found.keys():
                raise LogError(f"{name}: two columns {twice}, expected one; rename the others")
            columns |= found
    return Table(name, columns, kept, refused=refused, units=units)


def _columns(header: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """A vector as it is, a matrix one column a signal, whichever way it stands."""
    if values.ndim == 1 or 1 in values.shape:
        return {header: to_numbers(values.ravel())}
    # Samples are many and signals few.
    rows = values.T if values.shape[0] >= values.shape[1] else values
    return {f"{header}[{place}]": to_numbers(row) for place, row in enumerate(rows)}


def to_numbers(values: np.ndarray) -> np.ndarray:
    """Numbers, or objects of Python's that are whole numbers, as float64, or as int64 where that would round them.

    Raises:
        ValueError: A whole number is too large for either; the text goes on from a column's name.
    """
    largest = max(int(values.max()), -int(values.min())) if values.dtype.kind in "iuO" and values.size else 0
    if largest >= WHOLE:
        raise ValueError(f"holds {largest}, expected whole numbers below {WHOLE}, which are exact; count from later on")
    return values.astype(np.int64 if largest > EXACT else np.float64)
