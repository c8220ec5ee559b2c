"""ROS 2 recordings, rosbag2 folders and MCAP files, through rosbags.

Messages are read by the definitions of ROS's own packages only. A recording brings definitions of its own, but rosbags
makes program code of them and runs it, which no recording may ask for.
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
from frictionzoo.logs.formats import base
from frictionzoo.logs.formats.base import Format, optional, parsing, register_format
from frictionzoo.logs.recording import Table

MAGIC = b"\x89MCAP0\r\n"
MESSAGE, CHUNK, CHUNK_INDEX = 5, 6, 8  # kinds of MCAP records
STORAGES = (".mcap", ".db3")  # by which rosbags tells them apart
FOOTER = struct.Struct("<BQQQI")  # kind and size, where the summary and its index begin, checksum of the summary
BLOCK = 1 << 20  # bytes that are read at a time
JOINT_UNITS = {"position": "rad", "velocity": "rad/s", "effort": "N m"}  # what sensor_msgs/JointState lays down
OF_JOINTS = (*JOINT_UNITS, "positions", "velocities", "accelerations")  # which have an entry a name, or none
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
            if path.is_file() and path.suffix not in STORAGES:
                raise LogError(f"{path}: suffix {path.suffix or 'none'}, expected {' or '.join(STORAGES)}; rename it")
            files = sorted(file for file in path.iterdir() if file.suffix in STORAGES) if path.is_dir() else [path]
            digests = []
            for file in files:
                _check(file)
                with file.open("rb") as stream:
                    digests.append(hashlib.file_digest(stream, "sha256"))
            sha256 = digests[0] if path.is_file() else hashlib.sha256(b"".join(each.digest() for each in digests))
            store = typesys.get_typestore(typesys.Stores.LATEST)
            store.max_sequence_length = LONGEST
            with reader.Reader(path) as bag:
                if bag.compression_mode:
                    wanted = "expected a bag that is not or whose storage is; unpack it with `ros2 bag convert`"
                    raise LogError(f"{path}: compressed by {bag.compression_mode}, {wanted}")
                return [replace(_read(str(path), bag, store), sha256=sha256.hexdigest())]

    def parse(self, name: str, content: bytes) -> Table:
        """Recordings are read from their files only."""
        raise LogError(f"{name}: a ROS 2 recording in an archive, expected a file or a folder; unpack it")


@register_format("mcap")
class Mcap(Ros):
    """A single MCAP file."""

    suffixes: ClassVar[tuple[str, ...]] = (".mcap",)
    magic: ClassVar[tuple[bytes, ...]] = (MAGIC,)


@register_format("ros2bag")
class Ros2Bag(Ros):
    """A rosbag2 folder, or one of its SQLite files."""

    suffixes: ClassVar[tuple[str, ...]] = (".db3",)
    magic: ClassVar[tuple[bytes, ...]] = (b"SQLite format 3\0",)

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
            if places and places[-1] == len(self.received):
                raise ValueError(f"{header} twice in one message")
            places.append(len(self.received))
            values.append(value)
        self.received.append(received)
        self.stamped.append(stamped)

    def columns(self, topic: str) -> Iterator[tuple[str, str, np.ndarray, list[float]]]:
        """For each column its header, that of its time, its time and its values."""
        time = np.array(self.stamped if all(self.stamped) else self.received, dtype=np.int64)
        for header, (places, values) in self.samples.items():
            whole = len(places) == len(time)
            own = f"{topic}/time" if whole else f"{topic}{header}/time"
            yield f"{topic}{header}", own, time[places], values


def _read(name: str, bag: Any, store: Any) -> Table:
    """The numbers of all messages whose type is known."""
    known = [connection for connection in bag.connections if connection.msgtype in store.types]
    wanted = "expected one of ROS's own packages; record it as JointState or Float64MultiArray, or export it as CSV"
    refused = {
        connection.topic: f"{name}: {connection.topic} is of type {connection.msgtype}, {wanted}"
        for connection in bag.connections
        if connection.msgtype not in store.types
    }
    topics, counts, expected = defaultdict(Topic), Counter(), Counter()
    for connection, received, content in bag.messages(known) if known else ():
        topics[connection.topic].add(store.deserialize_cdr(content, connection.msgtype), received)
        counts[connection.topic] += 1
    for connection in known:
        expected[connection.topic] += connection.msgcount
    for topic, count in expected.items():
        if count and count != counts[topic]:
            raise LogError(f"{name}: {topic} has {counts[topic]} messages, expected {count}; copy or record it again")
    columns, times, units = {}, {}, {}
    joints = {connection.topic for connection in known if connection.msgtype == "sensor_msgs/msg/JointState"}
    for topic, kept in topics.items():
        for header, time_header, time, values in kept.columns(topic):
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
    """Names of the joints of a message; none where it has none."""
    names = getattr(message, "name", None) or getattr(message, "joint_names", None)
    return names if isinstance(names, list) else []


def _numbers(value: Any, path: str, names: list[str]) -> Iterator[tuple[str, float]]:
    """The numbers in a message, with the path of their fields; texts, headers and what is too wide are left out."""
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
    """See that reading a file stays within bounds and that the messages of each topic are in the order of their times.

    rosbags sorts them, which leaves no trace of a clock that was set back.
    """
    name, size = str(file), file.stat().st_size
    base.check_size(name, size)
    if file.suffix == ".mcap":
        with file.open("rb") as stream:
            _check_summary(name, stream, size)
            _refuse_backwards(name, _scan(name, stream, size))
    else:
        with closing(sqlite3.connect(f"{file.absolute().as_uri()}?immutable=1", uri=True)) as database:
            # A view may take forever to read, and no recorder makes one.
            if database.execute("SELECT count(*) FROM sqlite_master WHERE type = 'view'").fetchone()[0]:
                raise LogError(f"{file}: a database with views, expected the tables of rosbag2; record it again")
            _refuse_backwards(name, database.execute("SELECT topic_id, timestamp FROM messages ORDER BY id"))


def _refuse_backwards(name: str, messages: Iterable[tuple[int, int]]) -> None:
    """LogError where a topic's messages, each with the topic's number, were received before those before them [ns]."""
    last: dict[int, int] = {}
    for topic, received in messages:
        before = last.get(topic, received)
        if received < before:
            raise LogError(
                f"{name}: a message was received at {received} ns, after one of its topic at {before} ns; expected "
                "times that do not run backwards; cut it there, or order it by `mcap sort` or `ros2 bag convert`"
            )
        last[topic] = received


def _check_summary(name: str, stream: BinaryIO, size: int) -> None:
    """See that the index at a file's end is what its checksum says, where it has one; rosbags does not."""
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
    """Channel and time of each message of an MCAP file [ns]; LogError where bytes or chunks that it names lack."""
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
    """Channel and time of each message in a chunk [ns]."""
    place = 0
    while place < len(records):
        kind, length = struct.unpack_from("<BQ", records, place)
        if kind == MESSAGE:
            yield struct.unpack_from("<H4xQ", records, place + 9)
        place += 9 + length


def _unpack(name: str, chunk: bytes) -> bytes:
    """A chunk's contents, once they are seen to unpack to no more than they say."""
    size, _, letters = struct.unpack_from("<QII", chunk, 16)
    compression = chunk[32 : 32 + letters].decode()
    packed = chunk[40 + letters :]
    base.check_unpacked(name, size, len(packed))
    if compression == "zstd":
        decompressor = optional(ZSTD, "rosbags", name).ZstdDecompressor()
    elif compression == "lz4":
        decompressor = optional("lz4.frame", "rosbags", name).LZ4FrameDecompressor()
    else:
        return packed  # which rosbags refuses unless it is not compressed at all
    unpacked = decompressor.decompress(packed, size + 1)
    if len(unpacked) != size or decompressor.unused_data:
        raise LogError(f"{name}: a chunk does not unpack to the {size} bytes that it declares; copy or record it again")
    return unpacked
