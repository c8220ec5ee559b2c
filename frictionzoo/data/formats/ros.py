"""ROS 2 recordings, as rosbag2 folders or MCAP files, read by rosbags.

Only message definitions of ROS's standard packages are used: rosbags would turn those in a recording into Python code
and run it.
"""

import hashlib
import sqlite3
import struct
import sys
import zlib
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import numpy as np

from frictionzoo.core.errors import LogError
from frictionzoo.data.formats import base
from frictionzoo.data.formats.base import Format, optional, parsing, register_format
from frictionzoo.data.recording import Table

MAGIC = b"\x89MCAP0\r\n"
MESSAGE, CHUNK, CHUNK_INDEX = 5, 6, 8  # kinds of MCAP records
STORAGES = (".mcap", ".db3")  # suffixes by which rosbags recognises storages
FOOTER = struct.Struct("<BQQQI")  # kind, size, start of the summary, start of its index, checksum of the summary
BLOCK = 1 << 20  # bytes read at a time
JOINT_UNITS = {"position": "rad", "velocity": "rad/s", "effort": "N m"}  # as sensor_msgs/JointState specifies
OF_JOINTS = (*JOINT_UNITS, "positions", "velocities", "accelerations")  # one entry a name, or empty
ZSTD = "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd"  # as in rosbags
LONGEST = 2**20  # most entries of an array in a message


class Ros(Format):
    """ROS 2 recording with a column `TOPIC/FIELD` for each number and `TOPIC/FIELD[NAME]` for each entry of an array.

    Each topic has a time column `TOPIC/time` [ns]: the header stamps if all messages have one, otherwise the times of
    reception. A column missing in some messages has a separate time column, `TOPIC/FIELD[NAME]/time`.
    """

    def read(self, path: Path) -> list[Table]:
        """Read the table of a recording."""
        reader = optional("rosbags.rosbag2", "rosbags", str(path))
        typesys = optional("rosbags.typesys", "rosbags", str(path))
        with parsing(str(path), "a ROS 2 recording"):
            if path.is_file() and path.suffix not in STORAGES:
                raise LogError(f"{path}: suffix {path.suffix or 'none'}, expected {' or '.join(STORAGES)}; rename it")
            files = sorted(file for file in path.iterdir() if file.suffix in STORAGES) if path.is_dir() else [path]
            digests = []
            for file in files:
                _check(file)
                with file.open("rb") as stream:
                    digests.append(hashlib.file_digest(stream, "sha256"))
            sha256 = digests[0] if path.is_file() else hashlib.sha256(b"".join(digest.digest() for digest in digests))
            store = typesys.get_typestore(typesys.Stores.LATEST)
            store.max_sequence_length = LONGEST
            with reader.Reader(path) as bag:
                if bag.compression_mode:
                    expected = "expected a bag that is not or whose storage is; unpack it with `ros2 bag convert`"
                    raise LogError(f"{path}: compressed by {bag.compression_mode}, {expected}")
                return [replace(_read(str(path), bag, store), sha256=sha256.hexdigest())]

    def parse(self, name: str, content: bytes) -> Table:
        """Raise LogError: only files and folders can be read."""
        raise LogError(f"{name}: a ROS 2 recording in an archive, expected a file or a folder; unpack it")


@register_format("mcap")
class Mcap(Ros):
    """MCAP file."""

    suffixes: ClassVar[tuple[str, ...]] = (".mcap",)
    magic: ClassVar[tuple[bytes, ...]] = (MAGIC,)


@register_format("ros2bag")
class Ros2Bag(Ros):
    """Rosbag2 folder, or a SQLite file of one."""

    suffixes: ClassVar[tuple[str, ...]] = (".db3",)
    magic: ClassVar[tuple[bytes, ...]] = (b"SQLite format 3\0",)

    def claims(self, path: Path) -> bool:
        """Return whether a path is a folder with `metadata.yaml` or a SQLite file."""
        return super().claims(path) or (path / "metadata.yaml").is_file()


@dataclass
class Topic:
    """Samples of one topic.

    Attributes:
        received: Time of reception of each sample [ns].
        stamped: Header stamp of each sample [ns]; 0 if not set.
        samples: Indices into these lists and values, by column.
    """

    received: list[int] = field(default_factory=list)
    stamped: list[int] = field(default_factory=list)
    samples: dict[str, tuple[list[int], list[float]]] = field(default_factory=lambda: defaultdict(lambda: ([], [])))

    def add(self, message: Any, received: int) -> None:
        """Add a message as one sample, or a trajectory as one sample per point."""
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
            if places and places[-1] == len(self.received):
                raise ValueError(f"{header} twice in one message")
            places.append(len(self.received))
            values.append(value)
        self.received.append(received)
        self.stamped.append(stamped)

    def columns(self, topic: str) -> Iterator[tuple[str, str, np.ndarray, list[float]]]:
        """Yield header, header of the time column, times [ns] and values of each column."""
        time = np.array(self.stamped if all(self.stamped) else self.received, dtype=np.int64)
        for header, (places, values) in self.samples.items():
            is_complete = len(places) == len(time)
            time_header = f"{topic}/time" if is_complete else f"{topic}{header}/time"
            yield f"{topic}{header}", time_header, time[places], values


def _read(name: str, bag: Any, store: Any) -> Table:
    readable = [connection for connection in bag.connections if connection.msgtype in store.types]
    advice = "expected one of ROS's own packages; record it as JointState or Float64MultiArray, or export it as CSV"
    refused = {
        connection.topic: f"{name}: {connection.topic} is of type {connection.msgtype}, {advice}"
        for connection in bag.connections
        if connection.msgtype not in store.types
    }
    topics, counts, expected = defaultdict(Topic), Counter(), Counter()
    for connection, received, content in bag.messages(readable) if readable else ():
        topics[connection.topic].add(store.deserialize_cdr(content, connection.msgtype), received)
        counts[connection.topic] += 1
    for connection in readable:
        expected[connection.topic] += connection.msgcount
    for topic, count in expected.items():
        if count and count != counts[topic]:
            raise LogError(f"{name}: {topic} has {counts[topic]} messages, expected {count}; copy or record it again")
    columns, times, units = {}, {}, {}
    joints = {connection.topic for connection in readable if connection.msgtype == "sensor_msgs/msg/JointState"}
    for topic, samples in topics.items():
        for header, time_header, time, values in samples.columns(topic):
            try:
                columns |= {time_header: base.to_numbers(time), header: base.to_numbers(np.array(values))}
            except ValueError as error:
                refused[header] = f"{name}: {header} {error}"
                continue
            times[header], units[time_header] = time_header, "ns"
            if topic in joints:
                units[header] = JOINT_UNITS[header[len(topic) + 1 :].partition("[")[0]]
    return Table(name, columns, refused=refused, times=times, units=units)


def _nanoseconds(stamp: Any) -> int:
    return stamp.sec * 10**9 + stamp.nanosec


def _names(message: Any) -> list[str]:
    names = getattr(message, "name", None) or getattr(message, "joint_names", None)
    return names if isinstance(names, list) else []


def _numbers(value: Any, path: str, names: list[str]) -> Iterator[tuple[str, float]]:
    """Yield a message's numbers with their field paths; skip texts, headers and wide arrays."""
    if isinstance(value, int | float | np.number):
        yield path, value.item() if isinstance(value, np.number) else value
    elif isinstance(value, np.ndarray) and value.ndim == 1 and len(value) <= base.WIDE:
        if names and len(value) not in (0, len(names)) and path[1:] in OF_JOINTS:
            raise ValueError(f"{path[1:]} has {len(value)} entries for {len(names)} names, {', '.join(names[:8])}")
        labels = names if len(names) == len(value) else range(len(value))
        yield from ((f"{path}[{label}]", number) for label, number in zip(labels, value.tolist(), strict=True))
    elif hasattr(value, "__msgtype__"):
        for inner in value.__dataclass_fields__:
            if inner not in ("header", "layout", "time_from_start") and not inner.startswith("__"):
                yield from _numbers(getattr(value, inner), f"{path}/{inner}", names)


def _check(file: Path) -> None:
    """Check a file's size and each topic's time order; rosbags sorts messages, which hides a clock set back."""
    name, size = str(file), file.stat().st_size
    base.check_size(name, size)
    if file.suffix == ".mcap":
        with file.open("rb") as stream:
            _check_summary(name, stream, size)
            _refuse_backwards(name, _scan(name, stream, size))
    else:
        with closing(sqlite3.connect(f"{file.absolute().as_uri()}?immutable=1", uri=True)) as database:
            # Reading a view may never end, and no recorder creates one.
            if database.execute("SELECT count(*) FROM sqlite_master WHERE type = 'view'").fetchone()[0]:
                raise LogError(f"{file}: a database with views, expected the tables of rosbag2; record it again")
            _refuse_backwards(name, database.execute("SELECT topic_id, timestamp FROM messages ORDER BY id"))


def _refuse_backwards(name: str, messages: Iterable[tuple[int, int]]) -> None:
    """Raise LogError if messages (topic number, time [ns]) go backwards within a topic."""
    last: dict[int, int] = {}
    for topic, received in messages:
        previous = last.get(topic, received)
        if received < previous:
            raise LogError(
                f"{name}: a message was received at {received} ns, after one of its topic at {previous} ns; expected "
                "times that do not run backwards; cut it there, or order it by `mcap sort` or `ros2 bag convert`"
            )
        last[topic] = received


def _check_summary(name: str, stream: BinaryIO, size: int) -> None:
    """Verify the checksum of the index at a file's end, if it has one; rosbags does not."""
    if size < len(MAGIC) + FOOTER.size or stream.read(len(MAGIC)) != MAGIC:
        raise LogError(f"{name}: does not begin as an MCAP file, expected one; copy or record it again")
    stream.seek(size - len(MAGIC) - FOOTER.size)
    start, _, expected = FOOTER.unpack(stream.read(FOOTER.size))[2:]
    place, checksum = start, 0
    stream.seek(min(start, size))
    while start and expected and place < size - len(MAGIC) - 4:
        block = stream.read(min(BLOCK, size - len(MAGIC) - 4 - place))
        place, checksum = place + len(block), zlib.crc32(block, checksum)
    if start and expected and checksum != expected:
        raise LogError(f"{name}: its index does not match its checksum; copy or record it again")


def _scan(name: str, stream: BinaryIO, size: int) -> Iterator[tuple[int, int]]:
    """Yield channel and time [ns] of each message of an MCAP file; LogError if bytes or chunks are missing."""
    place, total, indices = len(MAGIC), 0, 0
    while place < size - len(MAGIC):
        stream.seek(place)
        kind, length = struct.unpack("<BQ", stream.read(9))
        if length > size - place - 9:
            raise LogError(f"{name}: ends within a record; expected {length} more bytes; copy or record it again")
        if kind == CHUNK:
            records = _unpack(name, stream.read(length))
            total += len(records)
            base.check_size(name, total)
            yield from _messages(records)
        elif kind == MESSAGE:
            yield struct.unpack("<H4xQ", stream.read(14))
        indices += (kind == CHUNK_INDEX) - (kind == CHUNK)
        place += 9 + length
    if indices > 0:
        raise LogError(f"{name}: its index names more chunks than it has; copy or record it again")


def _messages(records: bytes) -> Iterator[tuple[int, int]]:
    place = 0
    while place < len(records):
        kind, length = struct.unpack_from("<BQ", records, place)
        if kind == MESSAGE:
            yield struct.unpack_from("<H4xQ", records, place + 9)
        place += 9 + length


def _unpack(name: str, chunk: bytes) -> bytes:
    """Unpack a chunk; LogError if its size differs from the declared one."""
    size, _, letters = struct.unpack_from("<QII", chunk, 16)
    compression = chunk[32 : 32 + letters].decode()
    packed = chunk[40 + letters :]
    base.check_unpacked(name, size, len(packed))
    if compression == "zstd":
        decompressor = optional(ZSTD, "rosbags", name).ZstdDecompressor()
    elif compression == "lz4":
        decompressor = optional("lz4.frame", "rosbags", name).LZ4FrameDecompressor()
    else:
        return packed  # rosbags refuses any other compression
    unpacked = decompressor.decompress(packed, size + 1)
    if len(unpacked) != size or decompressor.unused_data:
        raise LogError(f"{name}: a chunk does not unpack to the {size} bytes that it declares; copy or record it again")
    return unpacked
