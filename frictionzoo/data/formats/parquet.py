"""Parquet files, read by Arrow."""

import io
from typing import Any, ClassVar

import numpy as np

from frictionzoo.core.errors import LogError
from frictionzoo.data.formats.base import Format, check_unpacked, optional, parsing, register_format, tabulate
from frictionzoo.data.recording import Table

LISTS = ("list", "large_list", "fixed_size_list")


@register_format("parquet")
class Parquet(Format):
    """Parquet file: numeric columns, and lists of equal length as one column per entry."""

    suffixes: ClassVar[tuple[str, ...]] = (".parquet", ".pq")
    magic: ClassVar[tuple[bytes, ...]] = (b"PAR1",)

    def parse(self, name: str, content: bytes) -> Table:
        """Return the table of a file's columns."""
        columns, refused = read_columns(name, content)
        return tabulate(name, columns, refused=refused)


def read_columns(name: str, content: bytes) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Read the columns of a Parquet file as arrays, lists as matrices; return error messages for unusable columns.

    Raises:
        LogError: The file is damaged, or pyarrow is not installed.
    """
    parquet = optional("pyarrow.parquet", "pyarrow", name)
    with parsing(name, "a Parquet file"):
        file = parquet.ParquetFile(io.BytesIO(content), page_checksum_verification=True)
        groups = [file.metadata.row_group(place) for place in range(file.metadata.num_row_groups)]
        rows, sizes = file.metadata.num_rows, [group.total_byte_size for group in groups]
        # Count rows too: a constant column of any length needs only a few bytes.
        check_unpacked(name, max(sum(sizes), 8 * rows * file.metadata.num_columns))
        if min([rows, *sizes]) < 0 or rows != sum(group.num_rows for group in groups):
            raise LogError(f"{name}: its sizes contradict each other, expected a Parquet file; export it again")
        fields = [(field.name, field.type, _is_numeric(field.type)) for field in file.schema_arrow]
        refused = {
            n: f"{name}: {n} is of type {kind}, expected real numbers" for n, kind, is_read in fields if not is_read
        }
        table = file.read(columns=[header for header, _, is_read in fields if is_read])
        columns = {header: table.column(header).combine_chunks() for header in table.column_names}
        for header, column in columns.items():
            if len(column) != rows:
                raise LogError(f"{name}: {header} has {len(column)} rows, expected {rows}; export it again")
        return {header: _array(column) for header, column in columns.items()}, refused


def _is(kind: Any, *names: str) -> bool:
    types = optional("pyarrow.types", "pyarrow", "parquet")
    return any(getattr(types, f"is_{name}")(kind) for name in names)


def _is_numeric(kind: Any) -> bool:
    """Return whether an Arrow type is a number, a time, or a list of either."""
    return _is(kind.value_type if _is(kind, *LISTS) else kind, "integer", "floating", "boolean", "timestamp")


def _array(column: Any) -> np.ndarray:
    """Return a column as a vector, or lists of equal length as a matrix; missing numbers are NaN."""
    if not _is(column.type, *LISTS):
        return _vector(column)
    entries = _vector(column.flatten())
    width, rest = divmod(len(entries), max(len(column), 1))
    same = column.null_count == 0 and all(n == width for n in column.value_lengths().to_pylist())
    return entries.reshape(len(column), width) if same and not rest else np.array(column.to_pylist(), dtype=object)


def _vector(column: Any) -> np.ndarray:
    if column.null_count and not _is(column.type, "timestamp"):
        column = column.cast("float64")
    elif _is(column.type, "boolean"):
        column = column.cast("uint8")
    return column.to_numpy(zero_copy_only=False)
