"""NumPy archives of named arrays; what would have to be unpickled is left out."""

import io
import zipfile

import numpy as np

from frictionzoo.errors import LogError
from frictionzoo.logs.formats.base import Format, check_size, parsing, tabulate
from frictionzoo.logs.formats.registry import register_format
from frictionzoo.logs.recording import Table

HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


@register_format("npz")
class Npz(Format):
    """Each vector is a column, each matrix one column a signal, each single value a field."""

    suffixes = (".npz",)

    def parse(self, name: str, content: bytes) -> Table:
        """The arrays in an archive's bytes."""
        with parsing(name, "an .npz archive"), zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
            check_size(name, sum(member.file_size for member in members))
            return tabulate(name, {m.filename[: -len(".npy")]: _array(name, archive, m) for m in members})


def _array(name: str, archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """One array, once its declared shape is seen to fit the bytes that there are."""
    check_size(f"{name}!{member.filename}", member.file_size, member.compress_size)
    content = archive.read(member)
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    if version not in HEADERS:
        raise LogError(f"{name}!{member.filename}: .npy version {version}, expected 1.0 or 2.0; save it again")
    shape, _, dtype = HEADERS[version](file)
    if dtype.hasobject:
        raise LogError(
            f"{name}!{member.filename}: holds Python objects, which reading could let run any program; "
            "expected arrays of numbers"
        )
    declared = int(np.prod([int(n) for n in shape], dtype=object)) * dtype.itemsize
    if declared != len(content) - file.tell():
        raise LogError(
            f"{name}!{member.filename}: {len(content) - file.tell()} bytes, expected {declared} for shape {shape}; "
            "copy or save it again"
        )
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)
