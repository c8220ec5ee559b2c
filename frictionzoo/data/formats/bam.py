"""Logs of Rhoban BAM: JSON with a header and one entry a sample, in one file or a folder."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from frictionzoo.core.errors import LogError
from frictionzoo.data.formats.base import Format, parse_json, parsing, register_format, tabulate
from frictionzoo.data.recording import Table


@register_format("bam")
class Bam(Format):
    """BAM log, one table per JSON file; the entries become columns, the header becomes fields.

    Source: github.com/Rhoban/bam, Better Actuator Models.
    """

    suffixes: ClassVar[tuple[str, ...]] = (".json",)

    def claims(self, path: Path) -> bool:
        """Return whether a path is a JSON file or a folder with JSON files."""
        return super().claims(path) or (path.is_dir() and any(path.glob("*.json")))

    def read(self, path: Path) -> list[Table]:
        """Read the tables of a file, or of a folder's files sorted by name."""
        if path.is_dir():
            return [table for file in sorted(path.glob("*.json")) for table in super(Bam, self).read(file)]
        return super().read(path)

    def parse(self, name: str, content: bytes) -> Table:
        """Return the table of one JSON file."""
        with parsing(name, "a BAM log in JSON"):
            log = parse_json(content)
            entries = log.get("entries") if isinstance(log, dict) else None
            if not entries or not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
                advice = "expected JSON with a list of them, as BAM writes it"
                raise LogError(f"{name}: no samples under `entries`, {advice}")
            columns, refused = {}, {}
            for header in dict.fromkeys(header for entry in entries for header in entry):
                try:
                    columns[header] = _array([entry.get(header) for entry in entries])
                except ValueError as error:
                    refused[header] = f"{name}: {header} {error}"
            return tabulate(name, columns, dict(_fields(log)), refused)


def _array(values: Sequence[Any]) -> np.ndarray:
    """Return an array with NaN for null and missing entries; ValueError unless all are numbers or all booleans."""
    kinds = set(map(type, values)) - {type(None)}
    # Booleans among numbers are an error; a column of booleans only is a switch.
    if not (kinds <= {int, float} or kinds == {bool}):
        place, value = next((i, v) for i, v in enumerate(values) if v is not None and type(v) not in (int, float))
        raise ValueError(f"is {str(value)[:40]!r} ({type(value).__name__}) in entry {place}, expected a number")
    numbers = np.array(values, dtype=np.float64)
    return np.array(values) if kinds == {int} and None not in values else numbers


def _fields(log: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str | float]]:
    """Return the header's single values, with `OUTER.INNER` as the name inside an object."""
    fields = []
    for key, value in log.items():
        if isinstance(value, dict):
            fields += _fields(value, f"{prefix}{key}.")
        elif isinstance(value, str):
            fields.append((prefix + key, value))
        elif isinstance(value, int | float):
            fields.append((prefix + key, float(value)))
    return fields
