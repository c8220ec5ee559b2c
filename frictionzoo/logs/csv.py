"""A user's own recordings: CSV files with a header row, in SI units."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from frictionzoo.errors import ConfigError, LogError, closest
from frictionzoo.logs.columns import pick
from frictionzoo.logs.formats import Csv
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
        (table,) = Csv().read(Path(name).expanduser())
        time = pick(table, self.columns["time"][0])
        qpos, qvel, ctrl = (np.stack([pick(table, header) for header in self.columns[key]], axis=1) for key in SIGNALS)
        return Log(name, time, qpos, qvel, ctrl, table.sha256, self.simulated, payload)


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
