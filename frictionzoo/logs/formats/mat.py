"""MATLAB files up to version 7, through SciPy."""

import io
import struct
import zlib

import scipy.io

from frictionzoo.errors import LogError
from frictionzoo.logs.formats.base import Format, check_size, parsing, tabulate
from frictionzoo.logs.formats.registry import register_format
from frictionzoo.logs.recording import Table

HDF5 = b"\x89HDF\r\n\x1a\n"
HEADER = 128  # bytes before the first variable of a version 5 file
COMPRESSED = 15  # type of a variable that is packed


@register_format("mat")
class Mat(Format):
    """Each vector is a column, each matrix one column a signal, each single value a field; objects are left out."""

    suffixes = (".mat",)
    magic = (b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file")

    def parse(self, name: str, content: bytes) -> Table:
        """The variables in a file's bytes."""
        if HDF5 in content[:1024] or content.startswith(b"MATLAB 7.3"):
            raise LogError(f"{name}: a MATLAB 7.3 file, expected version 7 or below; in MATLAB: save(..., '-v7')")
        with parsing(name, "a MATLAB file"):
            _check_sizes(name, content)
            # Only numbers and texts: functions, objects and cells are never read.
            names = [n for n, _, kind in scipy.io.whosmat(io.BytesIO(content)) if kind in KINDS]
            stored = scipy.io.loadmat(io.BytesIO(content), variable_names=names)
            return tabulate(name, {n: values for n, values in stored.items() if n in names})


KINDS = frozenset(
    ("double", "single", "char", "logical", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)))
)


def _check_sizes(name: str, content: bytes) -> None:
    """See that each variable of a version 5 file has the bytes that it declares, and that packed ones stay small."""
    if len(content) < HEADER or content[126:128] not in (b"IM", b"MI"):
        raise LogError(f"{name}: no MATLAB file of version 5 to 7; expected one; in MATLAB: save(..., '-v7')")
    order = "<" if content[126:128] == b"IM" else ">"
    place, total = HEADER, 0
    while place < len(content):
        kind, size = struct.unpack_from(f"{order}II", content, place)
        if size > len(content) - place - 8:
            raise LogError(f"{name}: ends within a variable; expected {size} more bytes; copy or export it again")
        if kind == COMPRESSED:
            packed = memoryview(content)[place + 8 : place + 8 + size]
            _, unpacked = struct.unpack(f"{order}II", zlib.decompressobj().decompress(packed, 8))
            check_size(name, unpacked, size)
            total += unpacked
        place += 8 + size
    check_size(name, total)
