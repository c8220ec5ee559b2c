"""Numbers of ROS messages, decoded by their definitions; a definition is data here, no code is made from it."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from frictionzoo.data.formats import base

BASE, NAME, _, SEQUENCE = 1, 2, 3, 4  # kinds of fields in rosbags' definitions
FORMATS = {
    **{"bool": "u1", "byte": "u1", "char": "u1", "octet": "u1", "float32": "f4", "float64": "f8"},
    **{f"{sign}int{8 * size}": f"{sign or 'i'}{size}" for sign in ("", "u") for size in (1, 2, 4, 8)},
}
LONGEST = 2**20  # most elements of a message that are read one by one
ENCODINGS = {b"\0\0": ">", b"\0\1": "<"}  # of CDR, the first bytes of a message
JOINTS = (("name",), ("joint_names",))  # fields that name the joints of a message
OF_JOINTS = ("position", "velocity", "effort", "positions", "velocities", "accelerations")  # one entry a name, or empty
UNREAD = {"header", "layout", "time_from_start"}  # fields without columns

Path = tuple[str | int, ...]
"""Place of a value in a message: names of fields, and numbers of entries."""
Types = Mapping[str, tuple[Any, Sequence[tuple[str, Any]]]]
"""Definitions by type: constants, and name and description of each field, as rosbags parses them."""


@dataclass
class Layout:
    """Places of the numbers in messages that have the same lengths and names.

    Attributes:
        size: Length of the messages [bytes].
        fixed: Bytes that determine the layout, by offset: lengths and names.
        numbers: Offset and NumPy format of each number, by path.
        counts: Number of entries, by the path of an array.
        texts: Names, by path.
    """

    size: int = 0
    fixed: list[tuple[int, bytes]] = field(default_factory=list)
    numbers: dict[Path, tuple[int, str]] = field(default_factory=dict)
    counts: dict[Path, int] = field(default_factory=dict)
    texts: dict[Path, str] = field(default_factory=dict)

    def fits(self, content: bytes) -> bool:
        """Return whether a message has this layout."""
        return len(content) == self.size and all(content[at : at + len(part)] == part for at, part in self.fixed)

    def headers(self, within: Path = ()) -> dict[str, Path]:
        """Return the path of each number within a path, by header.

        Raises:
            ValueError: Two numbers have one header, or joints have more or fewer numbers than names.
        """
        names = next((names for names in map(self._list, JOINTS) if names), [])
        for path, count in self.counts.items():
            if names and path[-1] in OF_JOINTS and path[:-1] == within and count not in (0, len(names)):
                raise ValueError(f"{path[-1]} has {count} entries for {len(names)} names, {', '.join(names[:8])}")
        headers: dict[str, Path] = {}
        for path in self.numbers:
            if path[: len(within)] == within and UNREAD.isdisjoint(path):
                header = "".join(self._say(path, place) for place in range(len(within), len(path)))
                if header in headers:
                    raise ValueError(f"{header} twice in one message")
                headers[header] = path
        return headers

    def _say(self, path: Path, place: int) -> str:
        part, array = path[place], path[:place]
        if isinstance(part, str):
            return f"/{part}"
        own = self.texts.get((*path[: place + 1], "name"))
        if own and len({self.texts.get((*array, number, "name")) for number in range(self.counts[array])}) > 1:
            return f"[{own}]"
        for depth in range(len(array), -1, -1):
            for names in self._lists_in(array[:depth]):
                if len(names) == self.counts[array]:
                    return f"[{names[part]}]"
        return f"[{part}]"

    def _lists_in(self, message: Path) -> Iterator[list[str]]:
        """Yield the lists of names in a message: those of joints, then others without repetition."""
        own = [path for path in self.counts if path[:-1] == message and (*path, 0) in self.texts]
        for path in sorted(own, key=lambda path: path[-1:] not in JOINTS):
            names = self._list(path)
            if path[-1:] in JOINTS or len({*names}) == len(names):
                yield names

    def _list(self, path: Path) -> list[str]:
        return [self.texts[(*path, place)] for place in range(self.counts.get(path, 0)) if (*path, place) in self.texts]


class _Reader:
    """One pass over a message, to find its layout."""

    def __init__(self, types: Types, content: bytes, cdr: bool) -> None:
        if cdr and bytes(content[:2]) not in ENCODINGS:
            raise TypeError(f"with the encoding {bytes(content[:2]).hex()}, expected plain CDR")
        self.types, self.content, self.cdr = types, content, cdr
        self.order = ENCODINGS[bytes(content[:2])] if cdr else "<"
        self.begin = self.place = 4 if cdr else 0
        self.layout, self.steps = Layout(len(content), [(0, bytes(content[: self.begin]))]), 0

    def read(self, kind: str) -> Layout:
        self._message(kind, ())
        rest = len(self.content) - self.place
        if not 0 <= rest <= 3 * self.cdr:  # a writer may pad to 4 bytes
            raise ValueError(f"a message of {kind} has {len(self.content)} bytes, expected {self.place}")
        return self.layout

    def _message(self, kind: str, path: Path) -> None:
        if kind not in self.types:
            raise TypeError(
                f"and the recording has no definition of {kind}; convert it to MCAP where the messages are installed "
                "(`ros2 bag convert`), or export it as CSV"
            )
        if len(path) > 32:
            raise TypeError(f"and {kind} contains itself, expected a tree")
        fields = self.types[kind][1]
        self.place += self.cdr and not fields  # CDR has a byte for a message without fields
        for name, description in fields:
            self._value(description, (*path, name))

    def _value(self, description: Any, path: Path) -> None:
        self.steps += 1
        if self.steps > LONGEST:
            raise ValueError(f"{path[0]} has over {LONGEST} entries; leave it out of the recording")
        kind, detail = description
        if kind == NAME:
            self._message(detail, path)
        elif kind == BASE and detail[0] == "string":
            self._text(path)
        elif kind == BASE:
            self._numbers(detail[0], 1, [path])
        else:
            inner, count = detail
            count = self._length() if kind == SEQUENCE else count
            self.layout.counts[path] = count
            if inner[0] == BASE and inner[1][0] != "string":
                is_wide = count > base.WIDE
                self._numbers(inner[1][0], count, [] if is_wide else [(*path, place) for place in range(count)])
                return
            for place in range(count):
                self._value(inner, (*path, place))

    def _numbers(self, kind: str, count: int, paths: Sequence[Path]) -> None:
        if kind not in FORMATS:
            raise TypeError(f"with a field of type {kind}, expected numbers and texts")
        width = int(FORMATS[kind][1])
        if count:
            self._align(width)
        for number, path in enumerate(paths):
            self.layout.numbers[path] = self.place + number * width, self.order + FORMATS[kind]
        self._advance(count * width)

    def _text(self, path: Path) -> None:
        length = self._length()
        text = bytes(self.content[self.place : self.place + length])
        is_name = next(str(part) for part in reversed(path) if isinstance(part, str)).endswith(("name", "names"))
        if is_name:
            self.layout.texts[path] = text.removesuffix(b"\0").decode()
            self._fix(self.place, length)
        self._advance(length)

    def _length(self) -> int:
        self._align(4)
        self._fix(self.place, 4)
        self._advance(4)
        return int.from_bytes(self.content[self.place - 4 : self.place], "little" if self.order == "<" else "big")

    def _fix(self, at: int, length: int) -> None:
        part, (last, before) = bytes(self.content[at : at + length]), self.layout.fixed[-1]
        if last + len(before) == at:
            self.layout.fixed[-1] = last, before + part
        else:
            self.layout.fixed.append((at, part))

    def _align(self, width: int) -> None:
        if self.cdr:
            self.place += -(self.place - self.begin) % width

    def _advance(self, length: int) -> None:
        self.place += length
        if self.place > len(self.content):
            raise ValueError(f"a message ends after {len(self.content)} bytes, expected at least {self.place}")


@dataclass
class _Group:
    """Messages of one layout, with number and time of reception [ns] of each."""

    layout: Layout
    places: list[int] = field(default_factory=list)
    received: list[int] = field(default_factory=list)
    contents: list[bytes] = field(default_factory=list)


class Topic:
    """Messages of one topic of this type; `types` has its definition and those within, `cdr`: as in ROS 2."""

    def __init__(self, types: Types, kind: str, cdr: bool) -> None:
        self.types, self.kind, self.cdr = types, kind, cdr
        self.count = 0
        self._groups: dict[tuple[int, tuple[tuple[int, bytes], ...]], _Group] = {}
        self._last: _Group | None = None

    def add(self, content: bytes, received: int) -> None:
        """Add a message; ValueError if it does not match its definition."""
        if self._last is None or not self._last.layout.fits(content):
            layout = _Reader(self.types, content, self.cdr).read(self.kind)
            self._last = self._groups.setdefault((layout.size, tuple(layout.fixed)), _Group(layout))
        group = self._last
        group.places.append(self.count)
        group.received.append(received)
        group.contents.append(content)
        self.count += 1

    def columns(self, topic: str) -> Iterator[tuple[str, str, np.ndarray, np.ndarray]]:
        """Yield header, header of the time column, times [ns] and values of each column.

        Raises:
            ValueError: Numbers and names of a message do not match.
        """
        samples = [each for group in self._groups.values() for each in _sample(group)]
        if not samples:
            return
        order, received, stamped = (
            np.concatenate(parts) for parts in zip(*(each[:3] for each in samples), strict=True)
        )
        ranks = np.empty(len(order), int)
        ranks[np.argsort(order, kind="stable")] = np.arange(len(order))
        time = np.empty(len(order), np.int64)
        time[ranks] = stamped if (stamped != 0).all() else received
        columns: dict[str, list[tuple[np.ndarray, np.ndarray]]] = defaultdict(list)
        begin = 0
        for places, _, _, values in samples:
            for header, column in values.items():
                columns[header].append((ranks[begin : begin + len(places)], column))
            begin += len(places)
        for header, parts in columns.items():
            places, column = (np.concatenate(each) for each in zip(*parts, strict=True))
            sequence = np.argsort(places)
            is_complete = len(places) == len(time)
            time_header = f"{topic}/time" if is_complete else f"{topic}{header}/time"
            yield f"{topic}{header}", time_header, time[places[sequence]], column[sequence]


Samples = tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]
"""Order, time of reception [ns], header stamp [ns] (0: none) and columns of samples."""


def _sample(group: _Group) -> Iterator[Samples]:
    """Yield the messages of a group as samples; of a trajectory, one sample for each point."""
    layout, count = group.layout, len(group.contents)
    rows = np.frombuffer(b"".join(group.contents), np.uint8).reshape(count, layout.size)
    order, received = np.array(group.places, np.int64) * LONGEST, np.array(group.received, np.int64)

    def column(path: Path) -> np.ndarray:
        at, form = layout.numbers[path]
        values = np.ascontiguousarray(rows[:, at : at + int(form[-1])]).view(form)[:, 0]
        return values.astype(values.dtype.newbyteorder("="))

    def nanoseconds(path: Path) -> np.ndarray:
        if (*path, "sec") not in layout.numbers:
            return np.zeros(count, np.int64)
        return column((*path, "sec")).astype(np.int64) * 10**9 + column((*path, "nanosec"))

    stamped = nanoseconds(("header", "stamp"))
    points = layout.counts.get(("points",), 0)
    if not points or ("points", 0, "time_from_start", "sec") not in layout.numbers:
        yield order, received, stamped, {header: column(path) for header, path in layout.headers().items()}
        return
    for point in range(points):
        within = ("points", point)
        after = nanoseconds((*within, "time_from_start"))
        values = {header: column(path) for header, path in layout.headers(within).items()}
        yield order + point, received + after, np.where(stamped, stamped + after, 0), values
