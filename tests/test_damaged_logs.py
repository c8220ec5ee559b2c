"""Damaged and hostile recordings: every format answers with tables or one line, and never runs what a file holds."""

import pickle
import signal
import sqlite3
import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import scipy.io
from helpers.write_logs import OPTIONS, STORE, WRITERS, command, signals, write_bag, write_bam, write_log, write_npz
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.rosbag2 import StoragePlugin, Writer

from frictionzoo.core.errors import FrictionzooError, LogError
from frictionzoo.data.clean import Cleaning, clean
from frictionzoo.data.columns import to_recording
from frictionzoo.data.formats import base, read_tables
from frictionzoo.data.formats.ros import _unpack
from frictionzoo.data.propose import propose
from frictionzoo.data.recording import Table

NAMES = sorted(WRITERS)
# The same examples in every run, so that a library's fault in a file nobody has does not fail another's change.
EXAMPLES = settings(
    max_examples=40, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def parts(path: Path) -> list[Path]:
    return [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())


def read(path: Path) -> list[Table] | str:
    """Tables, or the one line that says why there are none; whatever else is raised fails the test."""
    try:
        tables = read_tables(str(path), "auto")
    except LogError as error:
        assert "\n" not in str(error) and len(str(error)) < 1000
        return str(error)
    for table in tables:
        assert all(column.ndim == 1 for column in table.columns.values())
        propose(table)
    return tables


@pytest.fixture(scope="module", params=NAMES)
def sound(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[Path, bytes]]:
    """A recording, and what its files held before anybody damaged them."""
    path = write_log(tmp_path_factory.mktemp("sound"), request.param, signals(12))
    return path, {file: file.read_bytes() for file in parts(path)}


def damage(draw: np.random.Generator, content: bytes) -> bytes:
    """Some bytes are others, missing, inserted, a large number in place of a size, swapped or doubled; or all are."""
    place, flipped = draw.integers(len(content) + 1), bytearray(content)
    a, b, c, d = np.sort(draw.integers(len(content) + 1, size=4))
    for at in draw.integers(len(content), size=draw.integers(1, 4)):
        flipped[at] ^= int(draw.integers(1, 256))
    large = (b"\xff" * 8, (10**10).to_bytes(8, "little"))[draw.integers(2)]
    changed = (
        *[bytes(flipped)] * 3,
        *(content[:place], content[:place] + draw.bytes(int(draw.integers(1, 40))) + content[place:], b""),
        content[:place] + large + content[place + 8 :],
        content[:a] + content[c:d] + content[b:c] + content[a:b] + content[d:],
        content[:d] + content[a:],
    )
    return changed[draw.integers(len(changed))]


SUFFIXES = (".csv", ".json", ".zip", ".npz", ".mat", ".parquet", ".mcap", ".db3", ".txt", "")
# The others have no checksums, so that a damaged number is another number.
GUARDED = {"mat", "mcap", "npz"}
CLEANING = Cleaning(
    **{"step": None, "resample": "linear", "gap": 5.0, "spikes": "repair", "velocity": "auto", "cutoff": 20.0},
    **{"order": 2, "velocity_lag": None, "shortest": 0.0, "wrap": None},
)


class Hangs(BaseException):
    """No reader may take this for a fault of the file."""


@contextmanager
def guard(seconds: int) -> Iterator[None]:
    """End what does not end by itself."""

    def stop(*_: object) -> None:
        raise Hangs

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def outcome(path: Path, name: str) -> list[np.ndarray] | None:
    """The arrays of a recording's logs, or None where it is refused; whatever else is raised fails the test."""
    try:
        tables = read_tables(str(path), "auto")
        recordings = [to_recording(table, OPTIONS[name], {}, simulated=False) for table in tables]
        logs = [log for recording in recordings for log in clean(recording, CLEANING)]
    except FrictionzooError as error:
        assert "\n" not in str(error) and len(str(error)) < 1000
        return None
    return [values for log in logs for values in (log.time, log.qpos, log.qvel, log.ctrl)]


def is_kept(name: str, sound: tuple[Path, dict[Path, bytes]], number: int) -> bool:
    """Damage one file of a recording; returns whether it is refused, or read as it was in every bit."""
    path, contents = sound
    draw, expected = np.random.default_rng([number, *name.encode()]), outcome(path, name)
    assert expected is not None
    file = sorted(contents)[draw.integers(len(contents))]
    renamed = file.with_suffix(SUFFIXES[draw.integers(len(SUFFIXES))]) if draw.random() < 0.1 else file
    file.unlink()
    renamed.write_bytes(contents[file] if renamed != file else damage(draw, contents[file]))
    try:
        with guard(10):
            came = outcome(renamed if path == file else path, name)
    finally:
        renamed.unlink()
        file.write_bytes(contents[file])
    same = came is not None and len(came) == len(expected)
    return came is None or (same and all(map(np.array_equal, came, expected)))


@pytest.mark.parametrize(
    "numbers", [range(8), pytest.param(range(8, 133), marks=pytest.mark.slow)], ids=["few", "many"]
)
def test_damage_is_refused_or_changes_nothing(sound, numbers, request):
    """Or changes numbers, in formats without checksums."""
    name = request.node.callspec.params["sound"]
    for number in numbers:
        assert is_kept(name, sound, number) or name not in GUARDED, number


@given(content=st.binary(max_size=300))
@EXAMPLES
def test_any_bytes_give_tables_or_one_line(sound, content):
    path, contents = sound
    for file, before in contents.items():
        file.write_bytes(before[:8] + content if len(content) % 2 else content)
        try:
            read(path)
        finally:
            file.write_bytes(before)


@given(text=st.text(alphabet='[]{}":,.0123456789eE-naNtrufls\n" ', max_size=200))
@EXAMPLES
def test_any_text_gives_tables_or_one_line(tmp_path, text):
    for name in ("a.csv", "a.json"):
        (tmp_path / name).write_text(text)
        read(tmp_path / name)


@pytest.mark.parametrize("name", NAMES)
def test_a_recording_cut_in_the_middle(tmp_path, name):
    path = write_log(tmp_path, name, signals())
    file = max(parts(path), key=lambda file: file.stat().st_size)
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    line = read(path)
    if name == "csv":  # a row that ends in its last cell looks like a whole one
        assert isinstance(line, str) or len(line[0].columns["time"]) < 50
    else:
        assert isinstance(line, str) and str(path) in line


def test_the_order_of_columns_does_not_matter(tmp_path):
    columns = signals()
    path = tmp_path / "a.npz"
    write_npz(path, dict(reversed(columns.items())))
    recording = to_recording(read_tables(str(path), "auto")[0], {}, {}, simulated=False)
    np.testing.assert_array_equal(recording.signals["qvel"][:, 0], columns["qvel"])


@pytest.mark.parametrize("name", sorted(set(NAMES) - {"lerobot", "mcap", "ros1bag", "ros2bag"}))
def test_gaps_and_time_that_starts_again_are_left_to_cleaning(tmp_path, name):
    columns = signals()
    columns["qpos"][10:20] = np.nan
    columns["time"][30:] -= 0.3
    table, *_ = read_tables(str(write_log(tmp_path, name, columns)), "auto")
    recording = to_recording(table, OPTIONS[name], {}, simulated=False)
    np.testing.assert_array_equal(recording.time, columns["time"])
    np.testing.assert_array_equal(recording.signals["qpos"][:, 0], columns["qpos"])


def pack(path: Path, *members: str, content: bytes = b"{}", method: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for member in members:
            archive.writestr(member, content)
    return path


def put(path: Path, value: int, offset: int, mark: bytes = b"PK\x01\x02", size: str = "<I") -> Path:
    """Write a number into a file, so many bytes behind the last mark: an entry in a zip's table of contents."""
    content = bytearray(path.read_bytes())
    struct.pack_into(size, content, content.rindex(mark) + offset, value)
    path.write_bytes(content)
    return path


def craft(folder: Path) -> Iterator[tuple[Path, str]]:
    """Files whose maker knew the formats, and what is said of each."""
    for suffix in ("csv", "parquet", "npz", "mat", "json", "zip", "mcap", "db3"):
        with (folder / f"large.{suffix}").open("wb") as file:
            file.truncate(10 << 30)  # takes no room on the disk
        yield folder / f"large.{suffix}", "10.7 GB, expected at most 4.3 GB; cut it into shorter logs"
    # Of a zip's entry: 20 is how many bytes it has, 24 how many unpacked, 42 where it begins.
    file, deflated = folder / "a.zip", zipfile.ZIP_DEFLATED
    yield pack(file, "a.json", content=b" " * (base.SMALL + 1), method=deflated), "would unpack to 67 MB, expected at"
    yield put(file, 0xFFFFFFF0, 24), "4.3 GB unpacked, expected at most 1.1 GB"
    bam = write_bam(folder / "bam.json", signals()).read_bytes()
    yield put(pack(file, "a.json", content=bam, method=deflated), 40, 24), "not readable as a zip of logs"
    yield put(pack(file, "a.json", content=b" " * (64 << 20), method=deflated), 40, 24), "Bad CRC-32"
    yield put(pack(file, "a.json", "b.json"), 0, 42), "b.json begins within the member before it"
    yield put(pack(file, "a.json", "b.json"), 1000, 20), "last member does not end before the table of contents"
    yield pack(file, "a.json", method=zipfile.ZIP_BZIP2), "packed by method 12, expected deflate or none"
    npz = write_npz(folder / "a.npz", signals(5))
    yield put(npz, ord("z"), 7, b"qvel.npy", "B"), "'qvel.npz' and header b'qvel.npy' differ"
    for shape in ("(1250000000,)", "(3,)", "(99999999999, 99999999999)", "(-1,)"):
        header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
        array = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(16)
        yield pack(npz, "qpos.npy", content=array), "qpos.npy: 16 bytes, expected "
    mcap = write_log(folder, "mcap", signals(5))
    yield put(mcap, mcap.read_bytes()[-60] ^ 1, -52, b"\x89MCAP", "B"), "its index does not match its checksum"
    scipy.io.savemat(mat := folder / "a.mat", {"q": np.ones(9)})
    header, bomb = mat.read_bytes()[:128], struct.pack("<II", 14, 0xFFFFFFF0) + bytes(100)
    packed = zlib.compress(bomb)
    for content, line in (
        (header + struct.pack("<II", 15, len(packed)) + packed, "4.3 GB unpacked, expected at most 1.1 GB"),
        (header + bomb, "ends within a variable; expected 4294967280 more bytes"),
        (b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n" + bytes(100), "MATLAB: save(..., '-v7')"),
    ):
        mat.write_bytes(content)
        yield mat, line
    for text in ("[" * 100_000, '{"entries": [{"timestamp": 1' + "0" * 5000 + "}]}"):
        (folder / "a.json").write_text(text)
        yield folder / "a.json", "not readable as a BAM log in JSON"
    bag = write_bag(folder / "bag", signals(5), StoragePlugin.SQLITE3)
    about = (bag / "metadata.yaml").read_text()
    compressed = about.replace("_mode: ''", "_mode: MESSAGE").replace("_format: ''", "_format: zstd")
    (bag / "metadata.yaml").write_text(compressed)
    yield bag, "compressed by message, expected none"
    (bag / "metadata.yaml").write_text(about)
    with closing(sqlite3.connect(bag / "bag.db3")) as database:
        database.execute("DROP TABLE message_definitions")
        database.execute(
            "CREATE VIEW message_definitions AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n) "
            "SELECT id, '' AS topic_type, '' AS encoding, '' AS encoded_message_definition, "
            "'' AS type_description_hash FROM n"
        )
        database.commit()
    yield bag, "a database with views, expected the tables of rosbag2"
    chunks = write_bag(folder / "packed", signals(), StoragePlugin.MCAP, compress=True)
    for size, line in ((10**10, "10.0 GB unpacked, expected"), (100, "a chunk does not unpack to the 100 bytes")):
        content = (chunks / "packed.mcap").read_bytes()
        first = content.index(b"\x04\x00\x00\x00zstd") - 12  # the chunk's declared size
        (chunks / "packed.mcap").write_bytes(content[:first] + struct.pack("<Q", size) + content[first + 8 :])
        yield chunks, line


def test_a_crafted_file_is_refused_in_little_memory(tmp_path):
    for path, line in craft(tmp_path):
        tracemalloc.start()
        try:
            assert line in str(read(path)), path
            assert tracemalloc.get_traced_memory()[1] < 32 << 20, (path, line)
        finally:
            tracemalloc.stop()


def test_more_rows_than_fit(tmp_path, monkeypatch):
    """The limit is lowered: a Parquet file that declares 10 GB in few bytes takes long to make."""
    path = write_log(tmp_path, "parquet", {name: np.zeros(20000) for name in signals()})
    assert path.stat().st_size < 10_000
    monkeypatch.setattr(base, "UNPACKED", 100_000)
    assert "0.0 GB unpacked, expected at most" in str(read(path))


def test_packed_chunks_are_read(tmp_path):
    plain = write_bag(tmp_path / "plain", signals(), StoragePlugin.MCAP)
    packed = write_bag(tmp_path / "packed", signals(), StoragePlugin.MCAP, compress=True)
    (first,), (second,) = (read_tables(str(folder), "auto") for folder in (plain, packed))
    assert first.columns.keys() == second.columns.keys() and first.sha256 != second.sha256
    held = bytes(1000)
    lz4_packed = lz4.frame.compress(held)
    for size in (1000, 999, 1001):
        chunk = struct.pack("<QQQII", 0, 0, size, 0, 3) + b"lz4" + struct.pack("<Q", len(lz4_packed)) + lz4_packed
        if size == 1000:
            assert _unpack("a.mcap", chunk) == held
        else:
            with pytest.raises(LogError, match=rf"a\.mcap: a chunk does not unpack to the {size} bytes"):
                _unpack("a.mcap", chunk)


class Marker:
    """Writes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_pickled_objects_are_not_unpickled(tmp_path):
    marker = tmp_path / "marker"
    pickled = pickle.dumps(Marker(marker))
    pickle.loads(pickled)
    assert marker.exists()  # so that the test would see it
    marker.unlink()
    np.savez(tmp_path / "a.npz", allow_pickle=True, time=np.arange(3.0), qpos=np.array([Marker(marker)], dtype=object))
    assert "a.npz!qpos.npy: holds Python objects" in str(read(tmp_path / "a.npz"))
    assert isinstance(read(pack(tmp_path / "b.npz", "qpos.npy", content=pickled)), str)
    for name in ("a.csv", "a.parquet", "a.mat", "a.json", "a.mcap", "a.db3"):
        (tmp_path / name).write_bytes(pickled)
        assert isinstance(read(tmp_path / name), str)
    assert not marker.exists()


def test_matlab_objects_are_not_read(tmp_path):
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"t": np.arange(3.0), "s": {"a": 1}, "c": np.array([1, "a"], dtype=object)})
    (table,) = read_tables(str(path), "auto")
    assert set(table.columns) == {"t"}


def test_message_definitions_are_not_run(tmp_path):
    marker = tmp_path / "marker"
    evil = f"x/msg/A'] + [__import__('pathlib').Path({str(marker)!r}).touch()] + ['"
    for plugin in (StoragePlugin.MCAP, StoragePlugin.SQLITE3):
        folder = tmp_path / plugin.name
        with Writer(folder, version=9, storage_plugin=plugin) as bag:
            connection = bag.add_connection("/evil", evil, msgdef=f"string A={evil}\nfloat64 data\n", rihs01="x")
            bag.write(connection, 1, STORE.serialize_cdr(command(1.0), "std_msgs/msg/Float64MultiArray"))
        (table,) = read_tables(str(folder), "auto")
        assert "/evil" in table.refused and not table.columns
    assert not marker.exists()
