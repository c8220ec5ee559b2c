"""Cleaned recordings before the division into training and test data."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NoReturn

from frictionzoo.core.described import describe
from frictionzoo.core.errors import ConfigError, LogError, refuse_unlike
from frictionzoo.core.log import Dataset, Log
from frictionzoo.data.recording import Recording
from frictionzoo.data.source import Source
from frictionzoo.data.split import Split


class InMemory(Source):
    """Placeholder in a run's configuration for recordings from memory, not readable again; `options` are unused."""

    def __init__(self, names: Sequence[str], **options: Any) -> None:
        self.names: Sequence[str] = names

    def load(self) -> NoReturn:
        """Raise LogError: the recordings are in no file."""
        raise LogError(
            f"{self.names[0]}: the run had it in memory, expected a file; save its arrays as CSV, "
            "read it with read('a.csv') and identify the drive again"
        )


@dataclass(frozen=True, eq=False, repr=False)
class Logs:
    """Recordings with their cleaned logs; iteration yields the logs.

    Attributes:
        recordings: Recordings before cleaning, test-only recordings last.
        cleaned: Logs of each recording, one for each stretch without a gap.
        held_out: Number of test-only recordings; 0 if `split` divides the recordings.
        split: Division into training and test data, used if `held_out` is 0.
        section: Configuration that reads the same recordings again.
    """

    name: str
    recordings: tuple[Recording, ...]
    cleaned: tuple[tuple[Log, ...], ...]
    held_out: int
    split: Split
    section: Mapping[str, Any]

    @classmethod
    def of(cls, logs: "Logs | Log | Iterable[Log]") -> "Logs":
        """Collect logs in memory, each as one recording; `Logs` stay as they are.

        Raises:
            LogError: There are no logs.
            ConfigError: An element is not a `Log`.
        """
        if isinstance(logs, Logs):
            return logs
        items: list[Any] = list(logs) if isinstance(logs, Iterable) and not isinstance(logs, str) else [logs]
        if not items:
            raise LogError("logs: none, expected at least one recording")
        for log in items:
            refuse_unlike("logs", log, Log, "a Log, or the result of read('a.csv')")
        recordings = tuple(Recording(log.name, log.time, {}, log.metadata, log.sha256, log.simulated) for log in items)
        section = describe(InMemory([log.name for log in items]))
        return cls("logs in memory", recordings, tuple((log,) for log in items), 0, Split(), section)

    def __iter__(self) -> Iterator[Log]:
        return (log for pieces in self.cleaned for log in pieces)

    def __len__(self) -> int:
        return sum(map(len, self.cleaned))

    def __repr__(self) -> str:
        return "\n".join(line for log in self for line in (repr(log), *(f"  {repair}" for repair in log.repairs)))

    def dividing(self, test: float | Split | None) -> "Logs":
        """Return the recordings with another division: a test share at the end of each, or a `Split`; None: no change.

        Raises:
            ConfigError: `test` is invalid, or some recordings are test-only.
        """
        if test is None:
            return self
        refuse_unlike("test", test, (int, float, Split), "a share between 0 and 1, or a Split")
        if not isinstance(test, Split) and not 0 < test < 1:
            raise ConfigError(f"test={test:g}; expected a share between 0 and 1, or a Split")
        if self.held_out:
            reason = f"because {self.held_out} of the recordings were read as test data"
            raise ConfigError(f"test={test}: expected None, {reason}; omit one of the two")
        split = test if isinstance(test, Split) else Split(test_share=test)
        return replace(self, split=split, section={**self.section, "split": describe(asdict(split))})

    def divide(self) -> Dataset:
        """Divide the logs into training and test logs.

        Raises:
            LogError: A part has no recording.
            ConfigError: The split is impossible.
        """
        if not self.held_out:
            return Dataset(self.name, *map(tuple, self.split.divide(self.recordings, self.cleaned)))
        parts = self.cleaned[: -self.held_out], self.cleaned[-self.held_out :]
        return Dataset(self.name, *(tuple(log for pieces in part for log in pieces) for part in parts))
