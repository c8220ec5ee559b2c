"""Recordings of ROS, as bags of ROS 1, rosbag2 folders or MCAP files, whose messages rosbags finds.

Messages are decoded by the definitions that the recording carries, otherwise by those of ROS's standard packages.
"""

import bz2
import hashlib
import re
import sqlite3
import struct
import sys
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import numpy as np

from frictionzoo.core.errors import LogError
from frictionzoo.data.formats import base
from frictionzoo.data.formats.base import Format, optional, parsing, register_format
from frictionzoo.data.formats.messages import Topic, Types
from frictionzoo.data.presets import MOTORS, find_preset
from frictionzoo.data.recording import Table

MAGIC = b"\x89MCAP0\r\n"
MESSAGE, CHUNK, CHUNK_INDEX = 5, 6, 8  # kinds of MCAP records
STORAGES = (".mcap", ".db3")  # suffixes by which rosbags recognises storages
FOOTER = struct.Struct("<BQQQI")  # kind, size, start of the summary, start of its index, checksum of the summary
BLOCK = 1 << 20  # bytes read at a time
ZSTD = "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd"  # as in rosbags
LZ4 = b"\x04\x22\x4d\x18"  # first bytes of an LZ4 frame
UNITS = {
    **dict.fromkeys(("position", "positions", "q"), "rad"),
    **dict.fromkeys(("velocity", "velocities", "dq"), "rad/s"),
    **dict.fromkeys(("effort", "tau", "tau_est", "tauEst"), "N m"),
}
"""Units of fields in the messages of `IN_SI`."""
IN_SI = ("sensor_msgs", "control_msgs", "trajectory_msgs", *MOTORS)


class Ros(Format):
    """Recording with a column `TOPIC/FIELD` for each number and `TOPIC/FIELD[NAME]` for each entry of an array.

    Each topic has a time column `TOPIC/time` [ns]: the header stamps if all messages have one, otherwise the times of
    reception. A column missing in some messages has a separate time column, `TOPIC/FIELD[NAME]/time`.
    """

    module: ClassVar[str] = "rosbags.rosbag2"

    def read(self, path: Path) -> list[Table]:
        """Read the table of a recording."""
        reader = optional(self.module, "rosbags", str(path))
        with parsing(str(path), "a ROS recording"):
            digests = []
            for file in self._list(path):
                self._check(file)
                with file.open("rb") as stream:
                    digests.append(hashlib.file_digest(stream, "sha256"))
            sha256 = digests[0] if path.is_file() else hashlib.sha256(b"".join(digest.digest() for digest in digests))
            with reader.Reader(path) as bag:
                self._check_open(str(path), bag)
                table = _read(str(path), bag, is_ros2=reader.__name__.endswith("2"))
                return [replace(table, sha256=sha256.hexdigest())]

    def _list(self, path: Path) -> list[Path]:
        if path.is_file() and path.suffix not in STORAGES:
            raise LogError(f"{path}: suffix {path.suffix or 'none'}, expected {' or '.join(STORAGES)}; rename it")
        return sorted(file for file in path.iterdir() if file.suffix in STORAGES) if path.is_dir() else [path]

    def _check(self, file: Path) -> None:
        _check(file)

    def _check_open(self, name: str, bag: Any) -> None:
        if bag.compression_mode:
            expected = "expected none, or compression of the storage; unpack it with `ros2 bag convert`"
            raise LogError(f"{name}: compressed by {bag.compression_mode}, {expected}")

    def parse(self, name: str, content: bytes) -> Table:
        """Raise LogError: only files and folders can be read."""
        raise LogError(f"{name}: a ROS recording in an archive, expected a file or a folder; unpack it")


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


@register_format("ros1bag")
class Ros1Bag(Ros):
    """Bag of ROS 1."""

    suffixes: ClassVar[tuple[str, ...]] = (".bag",)
    magic: ClassVar[tuple[bytes, ...]] = (b"#ROSBAG V2.0\n",)
    module: ClassVar[str] = "rosbags.rosbag1"

    def _list(self, path: Path) -> list[Path]:
        return [path]

    def _check(self, file: Path) -> None:
        base.check_size(str(file), file.stat().st_size)

    def _check_open(self, name: str, bag: Any) -> None:
        for index in bag.indexes.values():  # in the order of times
            written = sorted(index, key=lambda entry: (entry.chunk_pos, entry.offset))
            _refuse_backwards(name, ((0, entry.time) for entry in written))

        def unpack(content: bytes) -> bytes:
            if content.startswith(b"BZh"):
                content = bz2.BZ2Decompressor().decompress(content, base.UNPACKED + 1)
            elif content.startswith(LZ4):
                frame = optional("lz4.frame", "rosbags", name)
                content = frame.LZ4FrameDecompressor().decompress(content, base.UNPACKED + 1)
            base.check_unpacked(name, len(content))
            return content

        bag.chunks = {place: chunk._replace(decompressor=unpack) for place, chunk in bag.chunks.items()}


def _read(name: str, bag: Any, is_ros2: bool) -> Table:
    typesys = optional("rosbags.typesys", "rosbags", name)
    standard = typesys.get_typestore(typesys.Stores.LATEST).fielddefs
    topics: dict[str, Topic] = {}
    refused, expected, kinds = {}, Counter(), {}
    for connection in bag.connections:
        topic, kind = connection.topic, connection.msgtype
        if kinds.setdefault(topic, kind) != kind:
            raise LogError(f"{name}: {topic} is of type {kinds[topic]} and of {kind}, expected one; record it again")
        expected[topic] += connection.msgcount
        try:
            types = _define(typesys, connection, standard)
        except (typesys.TypesysError, AssertionError, ValueError, RecursionError):
            types = {}
        topics.setdefault(topic, Topic(types, kind, is_ros2))
    for connection, received, content in bag.messages() if bag.connections else ():
        try:
            topics[connection.topic].add(content, received)
        except TypeError as error:  # its definition is missing or beyond this reader
            topics[connection.topic].count += 1
            refused[connection.topic] = f"{name}: {connection.topic} is of type {connection.msgtype}, {error}"
    for topic, count in expected.items():
        if count and count != topics[topic].count:
            raise LogError(
                f"{name}: {topic} has {topics[topic].count} messages, expected {count}; copy or record it again"
            )
    return _tabulate(name, {topic: samples for topic, samples in topics.items() if topic not in refused}, refused)


def _define(typesys: Any, connection: Any, standard: Types) -> Types:
    """Return the definitions of a topic's type and of those within, parsed by rosbags."""
    kind, text = connection.msgdef.format.name, connection.msgdef.data
    if kind == "NONE":
        return standard
    # Text of IDL may join several definitions, each with a heading.
    parts = re.split(r"^=+\nIDL: .*\n", text, flags=re.MULTILINE) if kind == "IDL" else []
    found = typesys.get_types_from_msg(text, connection.msgtype) if kind == "MSG" else {}
    for part in filter(str.strip, parts):
        found |= typesys.get_types_from_idl(part)
    times = {name: standard[name] for name in ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")}
    return {**times, **found}


def _tabulate(name: str, topics: Mapping[str, Topic], refused: dict[str, str]) -> Table:
    columns, times, units, signals, motors = {}, {}, {}, {}, {}
    for topic, samples in topics.items():
        preset = find_preset(samples.kind)
        package = samples.kind.partition("/")[0]
        for header, time_header, time, values in samples.columns(topic):
            try:
                columns |= {time_header: base.to_numbers(time), header: base.to_numbers(np.array(values))}
            except ValueError as error:
                refused[header] = f"{name}: {header} {error}"
                continue
            times[header], units[time_header] = time_header, "ns"
            field = re.sub(r"\[[^]]*\]", "", header[len(topic) + 1 :])
            if package in IN_SI and (unit := UNITS.get(field.rpartition("/")[2])):
                units[header] = unit
            if preset is not None:
                signals[header] = preset.get(field, "")
                if signals[header] and package in MOTORS:
                    motors[header] = package
    return Table(*(name, columns), refused=refused, times=times, units=units, signals=signals, motors=motors)


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
