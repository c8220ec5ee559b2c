"""CSV files: comma-separated text with one header row."""

import csv
import io
import re
from collections import Counter
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from jaxtyping import Real

from frictionzoo.core.errors import LogError
from frictionzoo.data.formats.base import EXACT, Format, register_format, to_numbers
from frictionzoo.data.recording import Table

DIGITS = re.compile(r"\s*[+-]?\d{1,40}\s*")  # a whole number


@register_format("csv")
class Csv(Format):
    """CSV file with columns of numbers; an empty cell is a missing sample; text columns are ignored."""

    suffixes: ClassVar[tuple[str, ...]] = (".csv",)

    def parse(self, name: str, content: bytes) -> Table:
        """Return the table of a file's text, whose first row is the header."""
        reader = csv.reader(io.StringIO(_decode(name, content), newline=""), strict=True)
        lines, rows = [], []
        try:
            headers = [header.strip() for header in next(reader, [])]
            for row in filter(None, reader):
                if len(row) != len(headers):
                    problem = f"{name}, line {reader.line_num}: {len(row)} cells"
                    raise LogError(f"{problem}, expected {len(headers)} as in the header")
                lines.append(reader.line_num)
                rows.append(row)
        except csv.Error as error:
            problem = f"{name}, line {reader.line_num}: not a CSV table ({error})"
            raise LogError(f"{problem}; expected comma-separated rows") from None
        if headers and not rows:
            raise LogError(f"{name}: a header and no samples, expected at least 2; record a longer log")
        return _sort_out(name, headers, lines, list(zip(*rows, strict=True)))


def _sort_out(name: str, headers: Sequence[str], lines: Sequence[int], cells: Sequence[Sequence[str]]) -> Table:
    columns, refused = {}, {}
    counts = Counter(headers)
    for header, column in zip(headers, cells, strict=True):
        if counts[header] > 1:
            refused[header] = f"{name}: {counts[header]} columns {header}, expected one; rename the others"
            continue
        try:
            columns[header] = _numbers(column)
        except ValueError as error:
            bad_row = next((place for place, cell in enumerate(column) if not _is_number(cell)), None)
            refused[header] = (
                f"{name}: {header} {error}"
                if bad_row is None
                else f"{name}, line {lines[bad_row]}: {header} is {column[bad_row][:40]!r}, expected a number"
            )
    return Table(name, columns, refused=refused)


def _decode(name: str, content: bytes) -> str:
    """Decode UTF-8 text without the byte-order mark that spreadsheets write."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        problem = f"{name}: byte {error.start} is not UTF-8 text"
        raise LogError(f"{problem}; expected a CSV file, export it as UTF-8") from None
    if "\0" in text:
        raise LogError(f"{name}: holds a zero byte; expected a CSV file as UTF-8 text")
    return text


def _numbers(cells: Sequence[str]) -> Real[np.ndarray, "rows"]:
    """Convert cells to numbers; ValueError if one is not a number, or a whole number is too large to be exact."""
    if not _is_plain("".join(cells)):
        raise ValueError
    values = np.array([float(cell or "nan") for cell in cells])
    # A float would round whole numbers such as nanoseconds since 1970.
    if (np.abs(values) > EXACT).any() and all(DIGITS.fullmatch(cell) for cell in cells):
        return to_numbers(np.array([int(cell) for cell in cells], dtype=object))
    return values


def _is_plain(text: str) -> bool:
    """Return whether a text is free of numbers that only Python reads: 1_000, or digits of other scripts."""
    return text.isascii() and "_" not in text


def _is_number(cell: str) -> bool:
    try:
        float(cell or "nan")
    except ValueError:
        return False
    return _is_plain(cell)
