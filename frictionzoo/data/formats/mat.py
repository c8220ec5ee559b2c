"""MATLAB files of version 4 to 7, read by SciPy."""

import io
import struct
import zlib
from typing import ClassVar

import scipy.io

from frictionzoo.core.errors import LogError
from frictionzoo.data.formats.base import Format, check_unpacked, parsing, register_format, tabulate
from frictionzoo.data.recording import Table

HDF5 = b"\x89HDF\r\n\x1a\n"
HEADER = 128  # bytes before the first variable of a version 5 file
COMPRESSED = 15  # type of a compressed variable
HEADER_4 = struct.Struct("5i")  # header of a version 4 variable: kind, rows, columns, complex or not, length of name
BYTES_4 = (8, 4, 4, 2, 2, 1)  # size of a number by its type [bytes]
BLOCK = 1 << 20  # bytes unpacked at a time


@register_format("mat")
class Mat(Format):
    """MATLAB file: a vector is a column, a matrix a column per signal, a scalar a field; objects are ignored."""

    suffixes: ClassVar[tuple[str, ...]] = (".mat",)
    magic: ClassVar[tuple[bytes, ...]] = (b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file")

    def parse(self, name: str, content: bytes) -> Table:
        """Return the table of a file's variables."""
        if HDF5 in content[:1024] or content.startswith(b"MATLAB 7.3"):
            raise LogError(f"{name}: a MATLAB 7.3 file, expected version 7 or below; in MATLAB: save(..., '-v7')")
        with parsing(name, "a MATLAB file"):
            _check_sizes(name, content)
            # Read numbers and texts only, never functions, objects or cells.
            names, refused = [], {}
            for variable, _, kind in scipy.io.whosmat(io.BytesIO(content)):
                if variable in names or variable in refused:
                    raise LogError(f"{name}: two variables {variable}, expected one of each name; save it again")
                if kind in KINDS:
                    names.append(variable)
                else:
                    refused[variable] = f"{name}: {variable} is of class {kind}, expected real numbers"
            stored = scipy.io.loadmat(io.BytesIO(content), variable_names=names)
            return tabulate(name, {variable: stored[variable] for variable in names}, refused=refused)


KINDS = frozenset(
    ("double", "single", "char", "logical", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)))
)


def _check_sizes(name: str, content: bytes) -> None:
    """Check that each variable has its declared size, and that compressed ones (version 5 and later) are intact."""
    if 0 in content[:4]:  # version 5 begins with text
        _check_sizes_4(name, content)
        return
    if len(content) < HEADER or content[126:128] not in (b"IM", b"MI"):
        raise LogError(f"{name}: no MATLAB file of version 4 to 7; expected one; in MATLAB: save(..., '-v7')")
    order = "<" if content[126:128] == b"IM" else ">"
    place, total = HEADER, 0
    while place < len(content):
        kind, size = struct.unpack_from(f"{order}II", content, place)
        if size > len(content) - place - 8:
            raise LogError(f"{name}: ends within a variable; expected {size} more bytes; copy or export it again")
        if kind == COMPRESSED:
            total += _unpacked_size(name, memoryview(content)[place + 8 : place + 8 + size], order)
            check_unpacked(name, total, len(content))
        place += 8 + size


def _check_sizes_4(name: str, content: bytes) -> None:
    """Check that each variable of a version 4 file has its declared size, in the byte order that SciPy uses."""
    order = "<" if struct.unpack_from("<i", content)[0] in range(5000) else ">"
    place = 0
    while place < len(content):
        header = content[place : place + HEADER_4.size]
        if len(header) < HEADER_4.size:
            raise LogError(f"{name}: ends within the header of a variable; copy or export it again")
        kind, rows, columns, is_complex, letters = struct.unpack(f"{order}5i", header)
        machine, numbers = kind // 1000, kind // 10 % 10
        is_known = kind >= 0 and kind % 10 <= 2 and not kind // 100 % 10
        if not is_known or numbers >= len(BYTES_4) or min(rows, columns) < 0 or is_complex not in (0, 1) or letters < 1:
            raise LogError(f"{name}: no MATLAB file of version 4 to 7; expected one; in MATLAB: save(..., '-v7')")
        if machine > 1:
            raise LogError(f"{name}: numbers of a VAX or a Cray, expected IEEE ones; in MATLAB: save(..., '-v7')")
        size = rows * columns * BYTES_4[numbers] * (1 + is_complex) + letters
        place += HEADER_4.size + size
        if place > len(content):
            raise LogError(f"{name}: ends within a variable; expected {place - len(content)} more bytes; copy it again")


def _unpacked_size(name: str, packed: memoryview, order: str) -> int:
    """Return a variable's unpacked size [bytes]; LogError if it differs from the declared size."""
    zipped = zlib.decompressobj()
    _, declared = struct.unpack(f"{order}II", zipped.decompress(packed, 8))
    check_unpacked(name, declared, len(packed))
    size, rest = 0, True
    # Unpack to the end: SciPy does not verify the checksum there.
    while rest and not zipped.eof and size <= declared:
        piece = zipped.decompress(zipped.unconsumed_tail, BLOCK)
        size, rest = size + len(piece), bool(piece or zipped.unconsumed_tail)
    if size != declared or not zipped.eof:
        raise LogError(f"{name}: a variable does not unpack to its {declared} bytes; copy or export it again")
    return declared
