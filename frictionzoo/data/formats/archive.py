"""Zip archives of recordings in one other format."""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

from frictionzoo.core.errors import LogError
from frictionzoo.data.formats.base import Format, get_format, parsing, read_bytes, register_format, unzip
from frictionzoo.data.recording import Table

MEMBERS = {".json": "bam", ".csv": "csv"}
"""Format of an archive's members by suffix; only members of the first suffix found are read."""


@register_format("zip")
class Archive(Format):
    """Zip archive with one table per member: BAM logs in JSON, or CSV files if there are none."""

    suffixes: ClassVar[tuple[str, ...]] = (".zip",)
    magic: ClassVar[tuple[bytes, ...]] = (b"PK\x03\x04",)

    def read(self, path: Path) -> list[Table]:
        """Read the tables of an archive's members, sorted by name."""
        with parsing(str(path), "a zip of logs"):
            tables = self._read_members(str(path), read_bytes(path))
        return sorted(tables, key=lambda table: table.name)

    def parse(self, name: str, content: bytes) -> Table:
        """Return the table of an archive's only member."""
        tables = self._read_members(name, content)
        if len(tables) != 1:
            raise LogError(f"{name}: {len(tables)} recordings, expected one; unpack it")
        return tables[0]

    def _read_members(self, name: str, content: bytes) -> list[Table]:
        for suffix, format in MEMBERS.items():
            reader = get_format(format)
            tables = [
                replace(reader.parse(f"{name}!{member}", inner), sha256=hashlib.sha256(inner).hexdigest())
                for member, inner in unzip(name, content, suffix)
            ]
            if tables:
                return tables
        raise LogError(f"{name}: no member ends in {' or '.join(MEMBERS)}, expected logs in such files; unpack it")
