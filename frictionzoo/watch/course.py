"""Progress of a fit: the last iteration that its logger wrote, read without torch, JAX or the run's process."""

import contextlib
import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

LOSS, GRADIENT = "loss", "grad_norm"


@dataclass(frozen=True)
class Point:
    """State of a fit after an iteration.

    Attributes:
        iterations: Number of iterations so far.
        values: Loss, gradient norm and parameters of the last iteration, by the logger's names.
    """

    iterations: int = 0
    values: Mapping[str, float] = field(default_factory=dict)

    @property
    def loss(self) -> float | None:
        """Loss of the last iteration; None if unknown."""
        return self.values.get(LOSS)

    @property
    def parameters(self) -> dict[str, float]:
        """Parameters by `owner.name`; with several joints, by `owner.name/JOINT`."""
        return {name: value for name, value in self.values.items() if name not in (LOSS, GRADIENT)}


class Course:
    """Progress of one run; each read continues where the last one ended.

    Args:
        folder: Folder of the run. Only the files of `logger=tensorboard` and `logger=csv` are read.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._events: dict[Path, Events] = {}

    def look(self) -> Point:
        """Return the last iteration on disk; an empty `Point` if there is none."""
        paths = sorted(self._folder.glob("tensorboard/events.out.tfevents.*"))
        # A resumed run writes a new file with another name.
        self._events = {path: self._events.get(path) or Events(path) for path in paths}
        points = [events.read() for events in self._events.values()] or [read_csv(self._folder / "csv" / "metrics.csv")]
        return max(points, key=lambda point: point.iterations)


class Events:
    """TensorBoard event file."""

    def __init__(self, path: Path) -> None:
        # Imported here: finished runs do not need this slow import.
        from tensorboard.backend.event_processing.event_file_loader import RawEventFileLoader

        self._loader = RawEventFileLoader(str(path))
        self._point = Point()

    def read(self) -> Point:
        """Read new events, and return the last iteration."""
        from tensorboard.compat.proto.event_pb2 import Event

        steps: dict[int, dict[str, float]] = {}
        with contextlib.suppress(OSError):  # the file was removed for a new one
            for content in self._loader.Load():
                event = Event.FromString(content)
                for value in event.summary.value:
                    if value.HasField("simple_value") and _is_course(value.tag):
                        steps.setdefault(event.step, {})[value.tag] = value.simple_value
        if steps:
            last = max(steps)
            known = self._point.values if self._point.iterations == last + 1 else {}
            self._point = Point(last + 1, {**known, **steps[last]})
        return self._point


def read_csv(path: Path) -> Point:
    """Return the last iteration in Lightning's CSV file; an empty `Point` if there is none."""
    try:
        with open(path, newline="", encoding="utf-8") as file:
            rows = [row for row in csv.DictReader(file) if row.get(LOSS)]
        values = {name: float(text) for name, text in rows[-1].items() if text and name != "step" and _is_course(name)}
        return Point(
            int(rows[-1]["step"]) + 1, {name: value for name, value in values.items() if not math.isnan(value)}
        )
    except (OSError, ValueError, TypeError, KeyError, IndexError):  # not there yet, or being written
        return Point()


def _is_course(name: str) -> bool:
    """Return whether a value is logged at each iteration, unlike `MAE/test_position` at the end."""
    return name in (LOSS, GRADIENT) or "." in name.partition("/")[0]
