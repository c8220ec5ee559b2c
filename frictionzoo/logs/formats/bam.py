"""Logs of Rhoban BAM: JSON with a header and one entry a sample; one file, a folder of them or a zip of them."""

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from frictionzoo.errors import LogError
from frictionzoo.logs.formats.base import EXACT, Format, check_size, parsing, read_bytes, tabulate
from frictionzoo.logs.formats.registry import register_format
from frictionzoo.logs.recording import Table


@register_format("bam")
class Bam(Format):
    """One table a JSON file: its entries are the columns, its header the fields.

    Source: github.com/Rhoban/bam, Better Actuator Models.
    """

    suffixes = (".json", ".zip")

    def claims(self, path: Path) -> bool:
        """A JSON file or a zip, or a folder that holds JSON files."""
        return super().claims(path) or (path.is_dir() and any(path.glob("*.json")))

    def read(self, path: Path) -> list[Table]:
        """The tables of a file, of a folder's files or of an archive's members, in the order of their names."""
        if path.is_dir():
            return [table for file in sorted(path.glob("*.json")) for table in super(Bam, self).read(file)]
        if path.suffix.lower() != ".zip":
            return super().read(path)
        content = read_bytes(path)
        with parsing(str(path), "a zip of JSON files"), zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = sorted((m for m in archive.infolist() if m.filename.endswith(".json")), key=lambda m: m.filename)
            check_size(str(path), sum(member.file_size for member in members))
            return [self._member(path, archive, member) for member in members]

    def parse(self, name: str, content: bytes) -> Table:
        """The entries of one JSON file."""
        with parsing(name, "a BAM log in JSON"):
            log = json.loads(content)
            entries = log.get("entries") if isinstance(log, dict) else None
            if not entries or not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
                raise LogError(
                    f"{name}: no samples under `entries`, expected JSON with a list of them, as BAM writes it"
                )
            return tabulate(name, _columns(entries), dict(_fields(log)))

    def _member(self, path: Path, archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> Table:
        name = f"{path}!{member.filename}"
        check_size(name, member.file_size, member.compress_size)
        content = archive.read(member)
        return replace(self.parse(name, content), sha256=hashlib.sha256(content).hexdigest())


def _columns(entries: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """Values of each key; NaN for null and for entries that lack it."""
    headers = dict.fromkeys(header for entry in entries for header in entry)
    return {header: _array([entry.get(header) for entry in entries]) for header in headers}


def _array(values: Sequence[Any]) -> np.ndarray:
    """Numbers, or what came where it is not."""
    try:
        numbers = np.array(values, dtype=np.float64)  # None becomes NaN
    except (TypeError, ValueError):
        return np.array([str(value) for value in values])
    whole = np.abs(numbers).max() > EXACT and all(isinstance(value, int) for value in values)
    return np.array(values) if whole else numbers


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
