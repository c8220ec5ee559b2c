"""A user's own recordings: CSV files with a header row, in SI units."""

import csv
import hashlib
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from frictionzoo.errors import ConfigError, LogError, closest
from frictionzoo.segments import split_by_time
from frictionzoo.types import Dataset, Log, Payload

SIGNALS = ("qpos", "qvel", "ctrl")


class CsvLogs:
    """CSV files as a data set: train and test by file, or every file split by time.

    Args:
        name: The data set's name.
        train: Paths of the training recordings.
        test: Paths of the test recordings; empty to cut the test part out of every training recording.
        columns: Header of `time` [s], and lists of the headers of `qpos` [rad or m], `qvel` [rad/s or m/s] and `ctrl`.
        split: `test_share` and `gap` of `split_by_time`, for an empty `test`.
        payload: For each recording, train first, what the drive carried: mass [kg], centre of mass x, y, z [m] and
            inertia ixx, iyy, izz [kg m^2] in the frame of the bench's `payload` body; empty for none.
        simulated: Whether a simulator made the files; results and the terminal say so.

    Raises:
        ConfigError: `columns` does not name the four signals.
    """

    def __init__(
        self,
        name: str,
        train: Sequence[str],
        test: Sequence[str],
        columns: Mapping[str, Any],
        split: Mapping[str, Any],
        payload: Sequence[Any],
        simulated: bool,
    ) -> None:
        self.simulated = simulated
        self.name, self.train, self.test = name, _names("train", train), _names("test", test)
        for key in set(columns) - {"time", *SIGNALS}:
            raise ConfigError(f"data.columns.{key}: unknown signal; {closest(str(key), ('time', *SIGNALS))}")
        for key in {"time", *SIGNALS} - set(columns):
            raise ConfigError(f"data.columns.{key}: missing; give the header of {key}")
        self.columns = {key: _names(f"columns.{key}", columns[key]) for key in ("time", *SIGNALS)}
        for key, headers in self.columns.items():
            if not headers or (key == "time" and len(headers) > 1):
                raise ConfigError(
                    f"data.columns.{key}={headers}: expected {'one header' if key == 'time' else 'headers'}"
                )
        self.split, self.payload = dict(split), payload

    def load(self) -> Dataset:
        """All recordings, in the order in which they are named.

        Raises:
            LogError: No file is named, one cannot be read, or one does not hold what `columns` names.
            ConfigError: A payload is none, or there are more or fewer than recordings.
        """
        if not self.train:
            raise LogError("data.train=[]: no recording; name CSV files, as in data.train=[a.csv] data.test=[b.csv]")
        twice = set(self.train) & set(self.test)
        if twice:
            raise LogError(f"{min(twice)}: in data.train and in data.test; expected recordings that no fit has seen")
        names = [*self.train, *self.test]
        payloads = _read_payloads(self.payload, names)
        logs = [self._log(name, payload) for name, payload in zip(names, payloads, strict=True)]
        train, test = logs[: len(self.train)], logs[len(self.train) :]
        if test:
            return Dataset(self.name, tuple(train), tuple(test))
        parts = [split_by_time(log, **self.split) for log in train]
        return Dataset(self.name, tuple(first for first, _ in parts), tuple(last for _, last in parts))

    def _log(self, name: str, payload: Payload | None) -> Log:
        content = _read(name)
        table = read_table(name, _decode(name, content), [h for headers in self.columns.values() for h in headers])
        qpos, qvel, ctrl = (np.stack([table[header] for header in self.columns[key]], axis=1) for key in SIGNALS)
        sha256 = hashlib.sha256(content).hexdigest()
        return Log(name, table[self.columns["time"][0]], qpos, qvel, ctrl, sha256, self.simulated, payload)


def read_table(name: str, text: str, headers: Sequence[str]) -> dict[str, Float[np.ndarray, "rows"]]:
    """Columns of numbers from the text of a CSV file; columns that nobody asked for may hold anything.

    Args:
        name: The file's name, for messages.
        text: Its text; the first row is the header.
        headers: The wanted columns.

    Raises:
        LogError: It is no CSV table, lacks a column, or a cell is not a number.
    """
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        came = [header.strip() for header in next(reader, [])]
        places = [_place(name, header, came) for header in headers]
        rows = [_numbers(name, reader.line_num, row, came, places) for row in reader if row]
    except csv.Error as error:
        raise LogError(
            f"{name}, line {reader.line_num}: not a CSV table ({error}); expected comma-separated rows"
        ) from None
    if not rows:
        raise LogError(f"{name}: a header and no samples, expected at least 2; record a longer log")
    return dict(zip(headers, np.array(rows).T, strict=True))


def _read_payloads(given: Sequence[Any], names: Sequence[str]) -> list[Payload | None]:
    """The payload of each recording; ConfigError where the numbers make none."""
    if not given:
        return [None] * len(names)
    if len(given) != len(names):
        raise ConfigError(f"data.payload has {len(given)} entries, expected {len(names)}, one a recording, train first")
    payloads = []
    for name, numbers in zip(names, given, strict=True):
        if not isinstance(numbers, Sequence) or len(numbers) != 7 or not all(_is_finite(x) for x in numbers):
            raise ConfigError(
                f"data.payload of {name} is {numbers}; expected 7 numbers: mass, centre x, y, z, inertia ixx, iyy, izz"
            )
        mass, x, y, z, ixx, iyy, izz = map(float, numbers)
        if min(mass, ixx, iyy, izz) < 0 or 2 * max(ixx, iyy, izz) > (ixx + iyy + izz) * (1 + 1e-9):
            raise ConfigError(
                f"data.payload of {name} is {numbers}; expected mass and inertia of at least 0, and no inertia above "
                "the sum of the other two, which no body has"
            )
        payloads.append(Payload(mass, (x, y, z), (ixx, iyy, izz)))
    return payloads


def _is_finite(number: Any) -> bool:
    return isinstance(number, int | float) and not isinstance(number, bool) and math.isfinite(number)


def _names(option: str, given: Any) -> list[str]:
    """A name or a list of names as a list."""
    if isinstance(given, str):
        return [given]
    if not isinstance(given, Sequence):
        raise ConfigError(f"data.{option}={given}: expected a list of names, as in [a, b]")
    return [str(name) for name in given]


def _read(name: str) -> bytes:
    """The file's bytes; LogError where there are none."""
    try:
        return Path(name).expanduser().read_bytes()
    except FileNotFoundError:
        raise LogError(f"{name}: no such file (looked from {Path.cwd()}); check data.train and data.test") from None
    except OSError as error:
        raise LogError(f"{name}: cannot be read ({error.strerror}); expected a CSV file") from None


def _decode(name: str, content: bytes) -> str:
    """The file's text, without the byte-order mark that spreadsheets write."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise LogError(
            f"{name}: byte {error.start} is not UTF-8 text; expected a CSV file, export it as UTF-8"
        ) from None
    if "\0" in text:
        raise LogError(f"{name}: holds a zero byte; expected a CSV file as UTF-8 text")
    return text


def _place(name: str, header: str, came: Sequence[str]) -> int:
    """Index of a column; LogError where it is missing or ambiguous."""
    if header not in came:
        raise LogError(
            f"{name}: no column {header}; {closest(header, [c for c in came if c])}; rename it or set data.columns"
        )
    if came.count(header) > 1:
        raise LogError(f"{name}: {came.count(header)} columns {header}, expected one; rename the others")
    return came.index(header)


def _numbers(name: str, line: int, row: Sequence[str], came: Sequence[str], places: Sequence[int]) -> list[float]:
    """The wanted cells of one row as numbers."""
    if len(row) != len(came):
        raise LogError(f"{name}, line {line}: {len(row)} cells, expected {len(came)} as in the header")
    try:
        return [float(row[place]) for place in places]
    except ValueError:
        bad = next(place for place in places if not _is_number(row[place]))
        raise LogError(f"{name}, line {line}: {came[bad]} is {row[bad]!r}, expected a number") from None


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
