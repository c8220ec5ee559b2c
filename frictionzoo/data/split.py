"""Division of recordings into training and test data: by time, by file or by a field."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from typing import Any

import numpy as np
from jaxtyping import Bool

from frictionzoo.core.errors import ConfigError, LogError
from frictionzoo.core.log import Log
from frictionzoo.core.segments import split_by_time
from frictionzoo.data.recording import Recording
from frictionzoo.data.select import is_among, refuse_absent

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Split:
    """Rule that divides recordings into training and test data.

    Args:
        by: `time` trains on the first block of every log and tests on the last; `file` divides whole recordings; any
            other value is a field.
        test: By file, names or patterns of the test recordings, or their share, evenly spread; by a field, its test
            values; by time, empty.
        test_share: By time, test share of each log's samples.
        gap: By time, length of the unused block between the parts [s]; None for 1 s, but at most a tenth of each log.

    Raises:
        ConfigError: `test` does not fit `by`.
    """

    by: str = "time"
    test: Sequence[Any] | float = ()
    test_share: float | int = 0.2
    gap: float | int | None = None

    def __post_init__(self) -> None:
        if self.by == "time" and self._tested:
            raise ConfigError(
                f"data.split.test={self.test} with by=time; expected by=file or a field, as in by=kp test=[16]"
            )
        if self.by != "time" and not self._tested:
            raise ConfigError(f"data.split.test=[] with by={self.by}; expected names or values of test recordings")

    @property
    def _tested(self) -> list[Any]:
        return list(self.test) if isinstance(self.test, Sequence) and not isinstance(self.test, str) else [self.test]

    def divide(self, recordings: Sequence[Recording], logs: Sequence[Sequence[Log]]) -> tuple[list[Log], list[Log]]:
        """Divide the logs of each recording into training and test logs.

        By time, a log too short for two parts is a training log, unless all are.

        Raises:
            LogError: No recording matches `test`, or all do; by time, all logs are too short.
            ConfigError: An option is impossible.
        """
        if self.by == "time":
            return self._divide_by_time([log for cleaned in logs for log in cleaned])
        is_test = self._choose_files(recordings) if self.by == "file" else self._choose_by_field(recordings)
        if is_test.all():
            problem = f"data.split.by={self.by} test={self.test}: all {len(is_test)} recordings are test recordings"
            raise LogError(f"{problem}, none remain for training; select fewer")
        train, test = [], []
        for chosen, cleaned in zip(is_test, logs, strict=True):
            (test if chosen else train).extend(cleaned)
        return train, test

    def _divide_by_time(self, logs: Sequence[Log]) -> tuple[list[Log], list[Log]]:
        train, test, errors = [], [], []
        gap = None if self.gap is None else float(self.gap)
        for log in logs:
            try:
                first, last = split_by_time(log, float(self.test_share), gap)
            except LogError as error:
                train.append(log)
                errors.append(error)
            else:
                train.append(first)
                test.append(last)
        if errors and not test:
            raise errors[0]
        for error in errors:
            _log.warning("%s; all of it is training data", error)
        return train, test

    def _choose_by_field(self, recordings: Sequence[Recording]) -> Bool[np.ndarray, "recordings"]:
        refuse_absent(recordings, self.by, self._tested, "data.split.by", f"data.split.by={self.by} test")
        for recording in recordings:
            if self.by not in recording.fields:
                problem = f"{recording.name}: no field {self.by} for data.split"
                raise LogError(f"{problem}; add it with data.fields or leave the recording out")
        return np.array([is_among(recording.fields[self.by], self._tested) for recording in recordings])

    def _choose_files(self, recordings: Sequence[Recording]) -> Bool[np.ndarray, "recordings"]:
        share = self._tested[0]
        if isinstance(share, int | float) and len(self._tested) == 1:
            return _spread(float(share), len(recordings))
        is_test = np.zeros(len(recordings), dtype=bool)
        for pattern in map(str, self._tested):
            names = ((recording.name, _last_part(recording.name)) for recording in recordings)
            matches = np.array([any(pattern == n or fnmatch(n, pattern) for n in pair) for pair in names])
            if not matches.any():
                raise LogError(
                    f"data.split.test={pattern}: none of {len(matches)} recordings has that name; expected a name or a "
                    f"pattern such as {_last_part(recordings[0].name)}"
                )
            is_test |= matches
        return is_test


def _spread(share: float, count: int) -> Bool[np.ndarray, "recordings"]:
    """Choose a share of the recordings, evenly spread, at least one."""
    if not 0 < share < 1:
        raise ConfigError(f"data.split.test={share:g} with by=file; expected names or a share between 0 and 1")
    chosen = np.zeros(count, dtype=bool)
    number = max(1, round(share * count))
    chosen[(2 * np.arange(number) + 1) * count // (2 * number)] = True
    return chosen


def _last_part(name: str) -> str:
    return name.rpartition("!")[2].replace("\\", "/").rpartition("/")[2]
