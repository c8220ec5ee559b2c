"""Logs of Rhoban BAM: JSON with a header and one entry a sample; one file or a folder of them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from frictionzoo.core.errors import LogError
from frictionzoo.logs.formats.base import Format, parse_json, parsing, register_format, tabulate
from frictionzoo.logs.recording import Table


@register_format("bam")
class Bam(Format):
    """One table a JSON file: its entries are the columns, its header the fields.

    Source: github.com/Rhoban/bam, Better Actuator Models.
    """

    suffixes: ClassVar[tuple[str, ...]] = (".json",)

    def claims(self, path: Path) -> bool:
        """A JSON file, or a folder that holds JSON files."""
        return super().claims(path) or (path.is_dir() and any(path.glob("*.json")))

    def read(self, path: Path) -> list[Table]:
        """The tables of a file or of a folder's files, in the order of their names."""
        if path.is_dir():
            return [table for file in sorted(path.glob("*.json")) for table in super(Bam, self).read(file)]
        return super().read(path)

    def parse(self, name: str, content: bytes) -> Table:
        """The entries of one JSON file."""
        with parsing(name, "a BAM log in JSON"):
            log = parse_json(content)
            entries = log.get("entries") if isinstance(log, dict) else None
            if not entries or not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
                wanted = "expected JSON with a list of them, as BAM writes it"
                raise LogError(f"{name}: no samples under `entries`, {wanted}")
            columns, refused = {}, {}
            for header in dict.fromkeys(header for entry in entries for header in entry):
                try:
                    columns[header] = _array([entry.get(header) for entry in entries])
                except ValueError as error:
                    refused[header] = f"{name}: {header} {error}"
            return tabulate(name, columns, dict(_fields(log)), refused)


def _array(values: Sequence[Any]) -> np.ndarray:
    """Numbers, NaN for null and for entries that lack them; ValueError where they are neither that nor all booleans."""
    kinds = set(map(type, values)) - {type(None)}
    # True is no number among others, but a column of nothing else is a switch.
    if not (kinds <= {int, float} or kinds == {bool}):
        place, value = next((i, v) for i, v in enumerate(values) if v is not None and type(v) not in (int, float))
        raise ValueError(f"is {str(value)[:40]!r} ({type(value).__name__}) in entry {place}, expected a number")
    numbers = np.array(values, dtype=np.float64)
    return np.array(values) if kinds == {int} and None not in values else numbers


def _fields(log: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str | float]]:
    """The header's single values; those of an inner object under `OUTER.INNER`."""
    found = []
    for key, value in log.items():
        if isinstance(value, dict):
            found += _fields(value, f"{prefix}{key}.")
        elif isinstance(value, str):
            found.append((prefix + key, value))
        elif isinstance(value, int | float):
            found.append((prefix + key, float(value)))
    return found
