"""LeRobot data sets: folders of Parquet files with consecutive episodes."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from frictionzoo.core.errors import LogError
from frictionzoo.data.formats.base import Format, parse_json, parsing, read_bytes, register_format, tabulate
from frictionzoo.data.formats.parquet import read_columns
from frictionzoo.data.recording import Table

INFO = Path("meta") / "info.json"


@register_format("lerobot")
class LeRobot(Format):
    """LeRobot data set, one table per episode; `meta/info.json` names the entries of `observation.state` and `action`.

    Supports versions 2 and 3, which differ in the number of episodes a file.
    """

    def claims(self, path: Path) -> bool:
        """Return whether a path is a folder with `meta/info.json`."""
        return (path / INFO).is_file()

    def read(self, path: Path) -> list[Table]:
        """Read the episodes of a folder, in the order of its files."""
        names, fields = _info(path)
        files = sorted(path.glob("data/chunk-*/*.parquet"))
        if not files:
            raise LogError(f"{path}: no data/chunk-*/*.parquet, expected a LeRobot data set; download its data as well")
        return [table for file in files for table in _episodes(path, file, names, fields)]

    def parse(self, name: str, content: bytes) -> Table:
        """Return one table of all frames in a file."""
        columns, refused = read_columns(name, content)
        return tabulate(name, columns, refused=refused)


def _info(path: Path) -> tuple[dict[str, list[str]], dict[str, str | float]]:
    file = path / INFO
    with parsing(str(file), "the description of a LeRobot data set"):
        info = parse_json(read_bytes(file))
        names = {feature: _names(about.get("names")) for feature, about in info["features"].items()}
        fields = {key: value for key, value in info.items() if isinstance(value, str)}
        return names, fields | {"fps": float(info["fps"])}


def _names(given: Any) -> list[str]:
    """Return a list of names; older data sets store them under an axis name, in a nested list, or with numbers."""
    if isinstance(given, dict):
        if given and all(isinstance(place, int) for place in given.values()):
            return [str(name) for name in sorted(given, key=given.__getitem__)]
        given = next(iter(given.values()), None)
    if isinstance(given, list) and len(given) == 1 and isinstance(given[0], list):
        given = given[0]
    return [str(name) for name in given] if isinstance(given, list) else []


def _episodes(
    path: Path, file: Path, names: Mapping[str, Sequence[str]], fields: Mapping[str, str | float]
) -> Iterator[Table]:
    content = read_bytes(file)
    with parsing(str(file), "episodes of a LeRobot data set"):
        stored, refused = read_columns(str(file), content)
        columns = _named(str(file), stored, names)
        episode = columns.pop("episode_index", np.zeros(len(next(iter(columns.values()), ()))))
        for number in np.unique(episode):
            episode_columns = {header: values[episode == number] for header, values in columns.items()}
            table = tabulate(f"{path}!episode_{int(number):06d}", episode_columns, fields, refused)
            yield replace(table, sha256=hashlib.sha256(content).hexdigest())


def _named(file: str, columns: Mapping[str, np.ndarray], names: Mapping[str, Sequence[str]]) -> dict[str, np.ndarray]:
    named = {}
    for header, values in columns.items():
        listed = names.get(header, ())
        if values.ndim != 2:
            entries = {header: values}
        else:
            labels = listed if len(listed) == values.shape[1] else range(values.shape[1])
            entries = {f"{header}[{label}]": entry for label, entry in zip(labels, values.T, strict=True)}
            if len(entries) < values.shape[1]:
                raise LogError(f"{file}: {header} has the names {', '.join(listed)}, expected each once; fix {INFO}")
        named |= entries
    return named
