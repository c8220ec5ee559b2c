"""Text tables: cells between commas, semicolons, tabs or blanks, with or without a header row."""

import codecs
import csv
import io
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import ClassVar

import numpy as np
from jaxtyping import Real

from frictionzoo.core.errors import LogError
from frictionzoo.data.formats.base import EXACT, Format, register_format, to_numbers
from frictionzoo.data.recording import Table

DIGITS = re.compile(r"\s*[+-]?\d{1,40}\s*")  # a whole number
COMMENTS = re.compile(r"(?:[#%].*\n|sep=.\r?\n)*")  # before a table; Excel names the separator as in `sep=;`
POINT = r"(?m)(?:^|[{0}])[+-]?\d*\.\d+(?:[eE][+-]?\d+)?(?:[{0}\r]|$)"  # a cell with a decimal point
LIST = re.compile(r"\s*[\[(](.*)[\])]\s*", re.DOTALL)
SEPARATORS = {",": "commas", "\t": "tabs", ";": "semicolons", " ": "blanks"}
"""Separators of cells with their names; the first one in case of doubt."""

Row = tuple[int, list[str]]
"""Cells of a row, and the number of its last line."""


@register_format("csv")
class Csv(Format):
    """Text table with columns of numbers or lists of numbers; an empty cell is a missing sample."""

    suffixes: ClassVar[tuple[str, ...]] = (".csv", ".tsv", ".txt", ".dat")

    def parse(self, name: str, content: bytes) -> Table:
        """Return the table of a file's text, with the notes of what it does not state."""
        text, comment = _cut_comments(_decode(name, content))
        separator = _find_separator(text)
        try:
            rows = list(_read_rows(text, separator))
        except csv.Error as error:
            raise LogError(f"{name}, {error}; expected rows of cells between {SEPARATORS[separator]}") from None
        if not rows:
            return Table(name, {})
        headers, origin = _find_headers(rows[0][1], comment.split(None if separator == " " else separator))
        if len(headers) < 2:
            expected = "expected several between commas, semicolons, tabs or blanks, in the header too"
            raise LogError(f"{name}: one cell in a row, {headers[0][:40]!r}; {expected}")
        rows = rows[origin == "header" :]
        if not rows:
            raise LogError(f"{name}: a header and no samples, expected at least 2; record a longer log")
        for line, row in rows:
            if len(row) != len(headers):
                problem = f"{name}, line {line}: {len(row)} cells between {SEPARATORS[separator]}"
                raise LogError(f"{problem}, expected {len(headers)} as in the {origin}")
        cells = list(zip(*(row for _, row in rows), strict=True))
        # Where numbers have points, commas could separate thousands.
        has_decimal_commas = separator != "," and re.search(POINT.format(separator), text) is None
        columns, refused = _sort_out(name, headers, [line for line, _ in rows], cells, has_decimal_commas)
        notes = ["no header row: columns are numbered from 0"] if origin == "first row" else []
        numbers = (column for header, column in zip(headers, cells, strict=True) if header in columns)
        if has_decimal_commas and any("," in cell for column in numbers for cell in column):
            notes.append("commas in numbers are read as decimal points")
        return Table(name, columns, refused=refused, notes=tuple(notes))


def _cut_comments(text: str) -> tuple[str, str]:
    """Return a text with empty lines in place of leading comments, and the last comment, which may be a header."""
    match = COMMENTS.match(text)
    comments = match[0] if match else ""
    last = comments.rstrip().rpartition("\n")[2]
    header = last.lstrip("#% ") if last.startswith(("#", "%")) else ""
    return "\n" * comments.count("\n") + text[len(comments) :], header


def _find_separator(text: str) -> str:
    """Return the separator with the most numbers in the second row; a comma if none gives a table."""
    ratings = {separator: _rate(text, separator) for separator in SEPARATORS}
    best = max(ratings, key=ratings.__getitem__)
    return best if ratings[best] > 0 else ","


def _rate(text: str, separator: str) -> int:
    """Return how many more numbers than texts the second row has; 0 if it differs from the first in length."""
    try:
        rows = [row for _, row in islice(_read_rows(text, separator), 2)]
    except csv.Error:
        return 0
    if len({len(row) for row in rows}) != 1 or len(rows[0]) < 2:
        return 0
    return sum(1 if _is_value(cell, separator != ",") else -1 for cell in rows[-1] if cell.strip())


def _read_rows(text: str, separator: str) -> Iterator[Row]:
    """Yield the rows that are not empty; csv.Error with the line if a quote is misplaced or not closed."""
    stream = io.StringIO(text, newline="")
    if separator == " ":
        yield from ((number, line.split()) for number, line in enumerate(stream, 1) if line.strip())
        return
    reader = csv.reader(stream, delimiter=separator, strict=True)
    try:
        yield from ((reader.line_num, row) for row in reader if row)
    except csv.Error as error:
        raise csv.Error(f"line {reader.line_num}: not a CSV table ({error})") from None


def _find_headers(first: Sequence[str], comment: Sequence[str]) -> tuple[list[str], str]:
    """Return the headers and their origin, `header`, `comment` or `first row`, which then gives their number only."""
    cells = [cell.strip() for cell in first]
    numbers = [str(number) for number in range(len(cells))]
    filled = [cell for cell in cells if cell]
    # pandas calls columns without names 0, 1, 2.
    if filled == numbers[: len(filled)] or not all(_is_value(cell, True) for cell in filled):
        return cells, "header"
    if len(comment) == len(cells):
        return [cell.strip() for cell in comment], "comment"
    return numbers, "first row"


def _sort_out(
    name: str, headers: Sequence[str], lines: Sequence[int], cells: Sequence[Sequence[str]], has_decimal_commas: bool
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return the columns of numbers, and error messages for the others."""
    columns: dict[str, np.ndarray] = {}
    refused: dict[str, str] = {}
    counts = Counter(headers)
    for header, column in zip(headers, cells, strict=True):
        if counts[header] > 1:
            refused[header] = f"{name}: {counts[header]} columns {header}, expected one; rename the others"
            continue
        try:
            read = _read_column(header, column, has_decimal_commas)
        except ValueError as error:
            bad = ((n, cell) for n, cell in zip(lines, column, strict=True) if not _is_value(cell, has_decimal_commas))
            line, cell = next(bad, (None, ""))
            reason = f"{name}: {header} {error}"
            reason = reason if line is None else f"{name}, line {line}: {header} is {cell[:40]!r}, expected a number"
            refused[header] = reason
            continue
        for duplicate in columns.keys() & read.keys():
            raise LogError(f"{name}: two columns {duplicate}, expected one; rename the others")
        columns |= read
    return columns, refused


def _read_column(header: str, cells: Sequence[str], has_decimal_commas: bool) -> dict[str, np.ndarray]:
    """Return a column of numbers, or lists as a column an entry; ValueError as `_numbers`, or for unequal lists."""
    if not any(LIST.fullmatch(cell) for cell in cells):
        return {header: _numbers([cell.replace(",", ".") for cell in cells] if has_decimal_commas else cells)}
    entries = [_split_list(cell) for cell in cells]
    lengths = {len(numbers) for numbers, cell in zip(entries, cells, strict=True) if cell.strip()}
    if len(lengths) != 1:
        raise ValueError(f"has lists of {min(lengths)} and {max(lengths)} numbers, expected one length")
    entries = [numbers or [""] * max(lengths) for numbers in entries]
    return {f"{header}[{place}]": _numbers(column) for place, column in enumerate(zip(*entries, strict=True))}


def _decode(name: str, content: bytes) -> str:
    """Decode UTF-8 text, or UTF-16 text, without the byte-order mark that spreadsheets write."""
    encoding = "utf-16" if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig"
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError as error:
        problem = f"{name}: byte {error.start} is not {encoding[:6].rstrip('-').upper()} text"
        raise LogError(f"{problem}; expected a CSV file, export it as UTF-8") from None
    if "\0" in text:
        raise LogError(f"{name}: holds a zero byte; expected a CSV file as UTF-8 text")
    return text


def _numbers(cells: Sequence[str]) -> Real[np.ndarray, "rows"]:
    """Convert cells to numbers; ValueError if one is not a number, or a whole number is too large to be exact."""
    if not _is_plain("".join(cells)):
        raise ValueError
    values = np.array([float(cell.strip() or "nan") for cell in cells])
    # A float would round whole numbers such as nanoseconds since 1970.
    if (np.abs(values) > EXACT).any() and all(DIGITS.fullmatch(cell) for cell in cells):
        return to_numbers(np.array([int(cell) for cell in cells], dtype=object))
    return values


def _is_plain(text: str) -> bool:
    """Return whether a text is free of numbers that only Python reads: 1_000, or digits of other scripts."""
    return text.isascii() and "_" not in text


def _is_value(cell: str, has_decimal_commas: bool = False) -> bool:
    numbers = _split_list(cell) or [cell.replace(",", ".") if has_decimal_commas else cell]
    try:
        return bool([float(number.strip() or "nan") for number in numbers]) and _is_plain(cell)
    except ValueError:
        return False


def _split_list(cell: str) -> list[str]:
    """Return the entries of a list such as `[0.1, 0.2]`, `(0.1, 0.2)` or `[0.1 0.2]`; none if a cell is no list."""
    found = LIST.fullmatch(cell)
    return re.split(r"[,\s]+", found[1].strip(", \t\r\n")) if found else []
