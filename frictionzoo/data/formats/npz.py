"""NumPy archives of named arrays; arrays of Python objects are refused."""

import io
from typing import ClassVar

import numpy as np

from frictionzoo.core.errors import LogError
from frictionzoo.data.formats.base import Format, parsing, register_format, tabulate, unzip
from frictionzoo.data.recording import Table

HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


@register_format("npz")
class Npz(Format):
    """NumPy archive: a vector is a column, a matrix a column per signal, a scalar a field."""

    suffixes: ClassVar[tuple[str, ...]] = (".npz",)
    magic: ClassVar[tuple[bytes, ...]] = (b"PK\x03\x04",)

    def parse(self, name: str, content: bytes) -> Table:
        """Return the table of an archive's arrays."""
        with parsing(name, "an .npz archive"):
            members = unzip(name, content, ".npy")
            arrays = {member[: -len(".npy")]: _array(f"{name}!{member}", array) for member, array in members}
            return tabulate(name, arrays)


def _array(name: str, content: bytes) -> np.ndarray:
    """Read one array whose declared shape must match the number of bytes."""
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    if version not in HEADERS:
        raise LogError(f"{name}: .npy version {version}, expected 1.0 or 2.0; save it again")
    shape, _, dtype = HEADERS[version](file)
    if dtype.hasobject:
        reason = "which could run any program when read"
        raise LogError(f"{name}: holds Python objects, {reason}; expected arrays of numbers")
    declared, size = int(np.prod([int(n) for n in shape], dtype=object)) * dtype.itemsize, len(content) - file.tell()
    if declared != size:
        raise LogError(f"{name}: {size} bytes, expected {declared} for shape {shape}; copy or save it again")
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)
