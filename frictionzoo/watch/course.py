"""How far a fit has come: the last of what its logger wrote, without torch, JAX or the run's own process."""

import contextlib
import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

LOSS, GRADIENT = "loss", "grad_norm"


@dataclass(frozen=True)
class Point:
    """One iteration.

    Attributes:
        iterations: Made so far.
        values: Loss, gradient norm and parameters of the last one, by the names that the logger has.
    """

    iterations: int = 0
    values: Mapping[str, float] = field(default_factory=dict)

    @property
    def loss(self) -> float | None:
        """Of the last iteration."""
        return self.values.get(LOSS)

    @property
    def parameters(self) -> dict[str, float]:
        """What is being identified, by `owner.name`, of several joints `owner.name/JOINT`."""
        return {name: value for name, value in self.values.items() if name not in (LOSS, GRADIENT)}


class Course:
    """The course of one run, which is read on from where the last look ended.

    Args:
        folder: The run's; what `logger=tensorboard` or `logger=csv` leave there is read, and of other loggers nothing.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._events: dict[Path, Events] = {}

    def look(self) -> Point:
        """The last iteration that is on the disk; an empty one where there is none."""
        paths = sorted(self._folder.glob("tensorboard/events.out.tfevents.*"))
        # A run that goes on begins its record anew, under another name.
        self._events = {path: self._events.get(path) or Events(path) for path in paths}
        points = [events.read() for events in self._events.values()] or [read_csv(self._folder / "csv" / "metrics.csv")]
        return max(points, key=lambda point: point.iterations)


class Events:
    """One file of TensorBoard's events."""

    def __init__(self, path: Path) -> None:
        # Imported here, so that finished runs do not wait for it.
        from tensorboard.backend.event_processing.event_file_loader import RawEventFileLoader

        self._loader = RawEventFileLoader(str(path))
        self._point = Point()

    def read(self) -> Point:
        """The last iteration in it, with what has come since the last time."""
        from tensorboard.compat.proto.event_pb2 import Event

        steps: dict[int, dict[str, float]] = {}
        with contextlib.suppress(OSError):  # it was removed, for a record that begins anew
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
    """The last iteration in Lightning's table; an empty one where there is none."""
    try:
        with open(path, newline="", encoding="utf-8") as file:
            rows = [row for row in csv.DictReader(file) if row.get(LOSS)]
        values = {name: float(text) for name, text in rows[-1].items() if text and name != "step" and _is_course(name)}
        return Point(
            int(rows[-1]["step"]) + 1, {name: value for name, value in values.items() if not math.isnan(value)}
        )
    except (OSError, ValueError, TypeError, KeyError, IndexError):  # it is not there yet, or being written
        return Point()


def _is_course(name: str) -> bool:
    """Whether it is of each iteration, and not of the end, as `MAE/test_position` is."""
    return name in (LOSS, GRADIENT) or "." in name.partition("/")[0]
