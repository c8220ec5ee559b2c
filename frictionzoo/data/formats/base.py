"""Interface of all formats, and limits on the memory that a file may need."""

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
from frictionzoo.data.recording import Table

LIMIT = 4 << 30  # largest size of a file [bytes]
UNPACKED = 1 << 30  # largest unpacked size [bytes]: four signals at 1 kHz over nine hours
RATIO = 250  # largest compression ratio of a log; numbers as text reach 20, zip bombs 1000
SMALL = 64 << 20  # unpacked size [bytes] up to which any ratio is allowed, as for constant columns
EXACT = 2**53  # a float represents all whole numbers up to this one
WHOLE = 2**62  # the difference of two whole numbers below this one fits into 64 bits
HEADER = 30  # least number of bytes before the contents of a zip member
WIDE = 256  # largest number of columns of a matrix of signals


class Format(ABC):
    """Reader of one file format.

    Attributes:
        name: Registered name, set by `register_format`.
        suffixes: Suffixes of its files, in lower case.
        magic: First bytes of its files. They identify files without a suffix; a file whose suffix and first bytes
            belong to different formats is refused.
    """

    name: ClassVar[str]
    suffixes: ClassVar[tuple[str, ...]] = ()
    magic: ClassVar[tuple[bytes, ...]] = ()

    def claims(self, path: Path) -> bool:
        """Return whether a path has this format by its name, or by its contents for a folder."""
        return path.is_file() and path.suffix.lower() in self.suffixes

    def read(self, path: Path) -> list[Table]:
        """Read the tables of a path; LogError if it cannot be read or has another format."""
        content = read_bytes(path)
        return [replace(self.parse(str(path), content), sha256=hashlib.sha256(content).hexdigest())]

    @abstractmethod
    def parse(self, name: str, content: bytes) -> Table:
        """Parse a file's bytes to a table; `name` is for messages.

        Raises:
            LogError: The bytes have another format or are damaged.
        """


REGISTRY = Registry(KINDS["formats"], Format, "parse")

register_format = REGISTRY.register
"""Class decorator that registers a format as `data.format=NAME`, see `Registry.register`."""

format_names: Callable[[], list[str]] = REGISTRY.names
"""Names of all formats, sorted."""


def get_format(name: str) -> Format:
    """Return a format by name; ConfigError if it is unknown, broken or registered by two packages."""
    return REGISTRY.get(name)()


def read_bytes(path: Path) -> bytes:
    """Read a file; LogError if it cannot be read or is too large."""
    try:
        check_size(str(path), path.stat().st_size)
        return path.read_bytes()
    except FileNotFoundError:
        raise LogError(f"{path}: no such file (looked from {Path.cwd()}); check the path") from None
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror}); expected a recording") from None


def check_size(name: str, size: int) -> None:
    """Raise LogError for a file size above `LIMIT` [bytes]."""
    if size > LIMIT:
        raise LogError(f"{name}: {size / 1e9:.1f} GB, expected at most {LIMIT / 1e9:.1f} GB; cut it into shorter logs")


def check_unpacked(name: str, size: int, packed: int | None = None) -> None:
    """Raise LogError for an implausible unpacked size [bytes]; `packed=None` allows any compression ratio."""
    if size > UNPACKED:
        most = f"{UNPACKED / 1e9:.1f} GB"
        raise LogError(f"{name}: {size / 1e9:.1f} GB unpacked, expected at most {most}; cut it into shorter logs")
    if packed is not None and size > SMALL and size > RATIO * packed:
        raise LogError(
            f"{name}: {packed} bytes would unpack to {size / 1e6:.0f} MB, expected at most {RATIO} times as many; "
            "this is not a recording"
        )


@contextmanager
def parsing(name: str, what: str) -> Iterator[None]:
    """Convert a library's errors on damaged bytes to a LogError of one line."""
    try:
        yield
    except FrictionzooError:
        raise
    except MemoryError:
        raise LogError(f"{name}: does not fit into memory; expected {what}; cut it into shorter logs") from None
    # Parsers raise many types of errors on damaged files: ValueError, zlib.error, RecursionError, ...
    except Exception as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise LogError(f"{name}: not readable as {what} ({reason}); copy or export it again") from None


def unzip(name: str, content: bytes, suffix: str) -> Iterator[tuple[str, bytes]]:
    """Yield name and bytes of each member of a zip archive with a suffix such as `.npy`, in the archive's order.

    Unpacking stops at the size that the archive declares; checksums are verified.

    Raises:
        LogError: Two members have one name or share bytes, or a member's compression or size is not allowed.
        zipfile.BadZipFile: The archive is damaged.
    """
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        _refuse_overlaps(name, archive)
        for member in archive.infolist():
            archive.open(member).close()  # raises if index and header differ: a damaged name may lose its suffix
        members = [member for member in archive.infolist() if member.filename.endswith(suffix)]
        duplicates = [member for member, count in Counter(member.filename for member in members).items() if count > 1]
        if duplicates:
            raise LogError(f"{name}: two members {duplicates[0]}, expected one of each name; write the archive again")
        check_unpacked(name, sum(member.file_size for member in members), len(content))
        for member in members:
            yield member.filename, _unpack(f"{name}!{member.filename}", archive, member)


def _refuse_overlaps(name: str, archive: zipfile.ZipFile) -> None:
    """Raise LogError if members share bytes, which would allow any unpacked size."""
    end = 0
    for member in sorted(archive.infolist(), key=lambda member: member.header_offset):
        if member.header_offset < end:
            raise LogError(f"{name}: {member.filename} begins within the member before it; write the archive again")
        end = member.header_offset + HEADER + member.compress_size
    if end > archive.start_dir:
        raise LogError(f"{name}: its last member does not end before the table of contents; write the archive again")


def _unpack(name: str, archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytes:
    # Python unpacks other methods without a size limit.
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise LogError(f"{name}: packed by method {member.compress_type}, expected deflate or none; zip it again")
    with archive.open(member) as stream:
        unpacked = stream.read(member.file_size + 1)
    if len(unpacked) != member.file_size:
        raise LogError(f"{name}: {len(unpacked)} bytes, expected {member.file_size}; copy or write the archive again")
    return unpacked


def parse_json(content: bytes) -> Any:
    """Parse JSON; ValueError for a repeated key, where Python would keep the last."""
    return json.loads(content, object_pairs_hook=_unique)


def _unique(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    mapping = dict(pairs)
    if len(mapping) < len(pairs):
        duplicate = next(key for key, count in Counter(key for key, _ in pairs).items() if count > 1)
        raise ValueError(f"key {duplicate[:40]!r} twice in one object")
    return mapping


def optional(module: str, package: str, name: str) -> ModuleType:
    """Import a module of an optional package; LogError with installation advice if it is missing."""
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
    """Return a table of named values: vectors and matrices become columns, single numbers and texts become fields.

    `fields` and `refused` are added to the table's. LogError if two columns have one name.
    """
    columns, refused, units, all_fields = {}, dict(refused or {}), {}, dict(fields or {})
    for header, value in variables.items():
        values = np.asarray(value)
        if values.dtype.kind == "M":
            exact = values.astype("M8[ns]")
            if not (exact.astype(values.dtype) == values).all():
                refused[header] = f"{name}: {header} lacks a time, or has one beyond the years 1678 to 2262; fix it"
                continue
            values, units[header] = exact.astype(np.int64), "ns"
        if values.size == 1 and values.dtype.kind in "US":
            all_fields[header] = str(values.item())
        elif values.dtype.kind not in "biuf":
            refused[header] = f"{name}: {header} is of type {values.dtype}, expected real numbers"
        elif values.ndim == 0:
            all_fields[header] = float(values)
        elif values.ndim > 2 or sorted(values.shape)[:-1] > [WIDE]:
            refused[header] = f"{name}: {header} has shape {values.shape}, expected (time,) or (time, columns)"
        else:
            try:
                new_columns = _columns(header, values)
            except ValueError as error:
                refused[header] = f"{name}: {header} {error}"
                continue
            for duplicate in columns.keys() & new_columns.keys():
                raise LogError(f"{name}: two columns {duplicate}, expected one; rename the others")
            columns |= new_columns
    return Table(name, columns, all_fields, refused=refused, units=units)


def _columns(header: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Return a vector as one column, and a matrix as one column a signal, in either orientation."""
    if values.ndim == 1 or 1 in values.shape:
        return {header: to_numbers(values.ravel())}
    # Assume more samples than signals.
    rows = values.T if values.shape[0] >= values.shape[1] else values
    return {f"{header}[{place}]": to_numbers(row) for place, row in enumerate(rows)}


def to_numbers(values: np.ndarray) -> np.ndarray:
    """Convert numbers or Python integers to float64, or to int64 if float64 would round them.

    Raises:
        ValueError: A whole number is too large for both; the message continues after a column's name.
    """
    largest = max(int(values.max()), -int(values.min())) if values.dtype.kind in "iuO" and values.size else 0
    if largest >= WHOLE:
        raise ValueError(f"holds {largest}, expected whole numbers below {WHOLE}, which are exact; count from later on")
    return values.astype(np.int64 if largest > EXACT else np.float64)
