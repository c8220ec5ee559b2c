"""ROS 2 recordings, rosbag2 folders and MCAP files, through rosbags.

Messages are read by the definitions of ROS's own packages only. A recording brings definitions of its own, but rosbags
makes program code of them and runs it, which no recording may ask for.
"""

import hashlib
import sqlite3
import struct
import sys
from collections import defaultdict
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from frictionzoo.errors import LogError
from frictionzoo.logs.formats.base import WIDE, Format, check_size, optional, parsing, to_numbers
from frictionzoo.logs.formats.registry import register_format
from frictionzoo.logs.recording import Table

MAGIC = b"\x89MCAP0\r\n"
CHUNK, CHUNK_INDEX = 6, 8  # kinds of MCAP records
JOINT_UNITS = {"position": "rad", "velocity": "rad/s", "effort": "N m"}  # what sensor_msgs/JointState lays down
ZSTD = "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd"  # as rosbags has it
LONGEST = 2**20  # entries of one array in one message


class Ros(Format):
    """One table a recording: a column `TOPIC/FIELD` for each number, `TOPIC/FIELD[NAME]` for each entry of an array.

    Each topic has its own time [ns], `TOPIC/time`: that of the messages' headers where all of them have one, else when
    they were received. A column that only some of its messages hold has its own, `TOPIC/FIELD[NAME]/time`.
    """

    def read(self, path: Path) -> list[Table]:
        """The table of a recording."""
        reader = optional("rosbags.rosbag2", "rosbags", str(path))
        typesys = optional("rosbags.typesys", "rosbags", str(path))
        with parsing(str(path), "a ROS 2 recording"):
            sha256 = hashlib.sha256()
            for file in _files(path):
                _check(file)
                with file.open("rb") as stream:
                    sha256.update(hashlib.file_digest(stream, "sha256").digest())
            store = typesys.get_typestore(typesys.Stores.LATEST)
            store.max_sequence_length = LONGEST
            with reader.Reader(path) as bag:
                if bag.compression_mode:
                    raise LogError(
                        f"{path}: compressed by {bag.compression_mode}, expected a bag that is not or whose storage "
                        "is; unpack it with `ros2 bag convert`"
                    )
                return [replace(_read(str(path), bag, store), sha256=sha256.hexdigest())]

    def parse(self, name: str, content: bytes) -> Table:
        """Recordings are read from their files only."""
        raise LogError(f"{name}: a ROS 2 recording in an archive, expected a file or a folder; unpack it")


@register_format("mcap")
class Mcap(Ros):
    """A single MCAP file."""

    suffixes = (".mcap",)


@register_format("ros2bag")
class Ros2Bag(Ros):
    """A rosbag2 folder, or one of its SQLite files."""

    suffixes = (".db3",)

    def claims(self, path: Path) -> bool:
        """A folder with `metadata.yaml`, or a database of one."""
        return super().claims(path) or (path / "metadata.yaml").is_file()


@dataclass
class Topic:
    """What was read of one topic.

    Attributes:
        received: When each sample was received [ns].
        stamped: When each was measured by its header [ns], 0 where that is not set.
        samples: By column: the places in these lists, and the values.
    """

    received: list[int] = field(default_factory=list)
    stamped: list[int] = field(default_factory=list)
    samples: dict[str, tuple[list[int], list[float]]] = field(default_factory=lambda: defaultdict(lambda: ([], [])))

    def add(self, message: Any, received: int) -> None:
        """Take a message's numbers as one sample; a trajectory's points as one each."""
        stamped = _nanoseconds(message.header.stamp) if hasattr(message, "header") else 0
        names = _names(message)
        points = getattr(message, "points", None) if names else None
        if not points:
            self._append(_numbers(message, "", names), received, stamped)
            return
        for point in points:
            after = _nanoseconds(point.time_from_start)
            self._append(_numbers(point, "", names), received + after, stamped + after if stamped else 0)

    def _append(self, numbers: Iterator[tuple[str, float]], received: int, stamped: int) -> None:
        for header, value in numbers:
            places, values = self.samples[header]
            places.append(len(self.received))
            values.append(value)
        self.received.append(received)
        self.stamped.append(stamped)

    def columns(self, topic: str) -> Iterator[tuple[str, str, np.ndarray, np.ndarray]]:
        """For each column its header, that of its time, its time and its values."""
        time = np.array(self.stamped if all(self.stamped) else self.received, dtype=np.int64)
        for header, (places, values) in self.samples.items():
            whole = len(places) == len(time)
            own = f"{topic}/time" if whole else f"{topic}{header}/time"
            yield f"{topic}{header}", own, time[places], to_numbers(np.array(values))


def _read(name: str, bag: Any, store: Any) -> Table:
    """The numbers of all messages whose type is known."""
    topics, refused, units = defaultdict(Topic), {}, {}
    for connection in bag.connections:
        topic, kind = connection.topic, connection.msgtype
        if kind not in store.types:
            refused[topic] = (
                f"{name}: {topic} is of type {kind}, expected one of ROS's own packages; record it as JointState or "
                "Float64MultiArray, or export it as CSV"
            )
    known = [connection for connection in bag.connections if connection.msgtype in store.types]
    for connection, received, content in bag.messages(known) if known else ():
        topics[connection.topic].add(store.deserialize_cdr(content, connection.msgtype), received)
    columns, times = {}, {}
    joints = {connection.topic for connection in known if connection.msgtype == "sensor_msgs/msg/JointState"}
    for topic, kept in topics.items():
        for header, time_header, time, values in kept.columns(topic):
            columns |= {time_header: time, header: values}
            times[header], units[time_header] = time_header, "ns"
            if topic in joints:
                units[header] = JOINT_UNITS[header[len(topic) + 1 :].partition("[")[0]]
    return Table(name, columns, refused=refused, times=times, units=units)


def _nanoseconds(stamp: Any) -> int:
    return stamp.sec * 10**9 + stamp.nanosec


def _names(message: Any) -> list[str]:
    """Names of the joints of a message; none where it has none."""
    names = getattr(message, "name", None) or getattr(message, "joint_names", None)
    return names if isinstance(names, list) else []


def _numbers(value: Any, path: str, names: list[str]) -> Iterator[tuple[str, float]]:
    """The numbers in a message, with the path of their fields; texts, headers and what is too wide are left out."""
    if isinstance(value, int | float | np.number):
        yield path, float(value)
    elif isinstance(value, np.ndarray) and value.ndim == 1 and len(value) <= WIDE:
        labels = names if len(names) == len(value) else range(len(value))
        yield from ((f"{path}[{label}]", number) for label, number in zip(labels, value.tolist(), strict=True))
    elif hasattr(value, "__msgtype__"):
        for inner in value.__dataclass_fields__:
            if inner not in ("header", "layout", "time_from_start") and not inner.startswith("__"):
                yield from _numbers(getattr(value, inner), f"{path}/{inner}", names)


def _files(path: Path) -> list[Path]:
    """The files with messages of a recording."""
    if not path.is_dir():
        return [path]
    return sorted(file for file in path.iterdir() if file.suffix in (".db3", ".mcap"))


def _check(file: Path) -> None:
    """See that reading a file stays within bounds."""
    check_size(str(file), file.stat().st_size)
    if file.suffix == ".mcap":
        with file.open("rb") as stream:
            _check_mcap(str(file), stream, file.stat().st_size)
    else:
        with closing(sqlite3.connect(f"{file.absolute().as_uri()}?immutable=1", uri=True)) as database:
            # A view may take forever to read, and no recorder makes one.
            if database.execute("SELECT count(*) FROM sqlite_master WHERE type = 'view'").fetchone()[0]:
                raise LogError(f"{file}: a database with views, expected the tables of rosbag2; record it again")


def _check_mcap(name: str, stream: BinaryIO, size: int) -> None:
    """See that an MCAP file has the bytes that its records declare, and that chunks unpack to what they say."""
    place, total, indices = len(MAGIC), 0, 0
    while place < size - len(MAGIC):
        stream.seek(place)
        kind, length = struct.unpack("<BQ", stream.read(9))
        if length > size - place - 9:
            raise LogError(f"{name}: ends within a record; expected {length} more bytes; copy or record it again")
        if kind == CHUNK:
            total += _check_chunk(name, stream.read(length))
            check_size(name, total)
            indices -= 1
        indices += kind == CHUNK_INDEX
        place += 9 + length
    if indices > 0:
        raise LogError(f"{name}: its index names more chunks than it has; copy or record it again")


def _check_chunk(name: str, chunk: bytes) -> int:
    """Size of a chunk's contents [bytes], once they are seen to unpack to no more than they say."""
    size, _, letters = struct.unpack_from("<QII", chunk, 16)
    compression = chunk[32 : 32 + letters].decode()
    packed = chunk[40 + letters :]
    check_size(name, size, len(packed))
    if compression == "zstd":
        decompressor = optional(ZSTD, "rosbags", name).ZstdDecompressor()
    elif compression == "lz4":
        decompressor = optional("lz4.frame", "rosbags", name).LZ4FrameDecompressor()
    else:
        return size
    unpacked = decompressor.decompress(packed, size + 1)
    if len(unpacked) != size or decompressor.unused_data:
        raise LogError(f"{name}: a chunk does not unpack to the {size} bytes that it declares; copy or record it again")
    return size
