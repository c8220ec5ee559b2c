"""Damaged and hostile recordings: every format answers with tables or one line, and never runs what a file holds."""

import pickle
import re
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
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.rosbag2 import StoragePlugin, Writer
from write_logs import OPTIONS, STORE, WRITERS, command, signals, write_bag, write_bam, write_log, write_npz

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
    """The files of a recording."""
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


def flip(draw: np.random.Generator, content: bytes) -> bytes:
    """Some bytes are others."""
    damaged = bytearray(content)
    for place in draw.integers(len(content), size=draw.integers(1, 4)):
        damaged[place] ^= int(draw.integers(1, 256))
    return bytes(damaged)


def cut(draw: np.random.Generator, content: bytes) -> bytes:
    """The end is missing."""
    return content[: draw.integers(len(content))]


def insert(draw: np.random.Generator, content: bytes) -> bytes:
    """Garbage lies within."""
    place = draw.integers(len(content) + 1)
    return content[:place] + draw.bytes(int(draw.integers(1, 40))) + content[place:]


def enlarge(draw: np.random.Generator, content: bytes) -> bytes:
    """What may be a size is a large one."""
    place = draw.integers(len(content))
    return content[:place] + draw.choice([b"\xff" * 8, (10**10).to_bytes(8, "little")]) + content[place + 8 :]


def swap(draw: np.random.Generator, content: bytes) -> bytes:
    """Two stretches have changed places, as when columns are taken for each other."""
    a, b, c, d = np.sort(draw.integers(len(content) + 1, size=4))
    return content[:a] + content[c:d] + content[b:c] + content[a:b] + content[d:]


def double(draw: np.random.Generator, content: bytes) -> bytes:
    """A stretch is there twice."""
    first, last = np.sort(draw.integers(len(content) + 1, size=2))
    return content[:last] + content[first:]


def empty(draw: np.random.Generator, content: bytes) -> bytes:
    """Nothing is left."""
    return b""


DAMAGES = (flip, flip, flip, cut, insert, enlarge, swap, double, empty)
SUFFIXES = (".csv", ".json", ".zip", ".npz", ".mat", ".parquet", ".mcap", ".db3", ".txt", "")
# The others have no checksums, so that a damaged number is another number.
GUARDED = {"mat", "mcap", "npz"}
CLEANING = Cleaning(
    step=None,
    resample="linear",
    gap=5.0,
    spikes="repair",
    velocity="auto",
    cutoff=20.0,
    order=2,
    velocity_lag=None,
    shortest=0.0,
    wrap=None,
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


def outcome(path: Path, name: str) -> list[dict[str, np.ndarray]] | str:
    """The arrays of a recording's logs, or why there are none; whatever else is raised fails the test."""
    try:
        recordings = [
            to_recording(table, OPTIONS[name], {}, simulated=False) for table in read_tables(str(path), "auto")
        ]
        logs = [log for recording in recordings for log in clean(recording, CLEANING)]
    except FrictionzooError as error:
        assert "\n" not in str(error) and len(str(error)) < 1000
        return str(error)
    return [{"time": log.time, "qpos": log.qpos, "qvel": log.qvel, "ctrl": log.ctrl} for log in logs]


def same(first: list[dict[str, np.ndarray]], second: list[dict[str, np.ndarray]]) -> bool:
    """Whether two outcomes are equal in every bit."""
    return len(first) == len(second) and all(
        one.keys() == other.keys() and all(np.array_equal(one[signal], other[signal]) for signal in one)
        for one, other in zip(first, second, strict=True)
    )


def judge(name: str, sound: tuple[Path, dict[Path, bytes]], number: int) -> str:
    """Damage one file of a recording, and tell what reading it gives: refused, identical or different."""
    path, contents = sound
    draw = np.random.default_rng([number, *name.encode()])
    expected = outcome(path, name)
    assert not isinstance(expected, str)
    file = sorted(contents)[draw.integers(len(contents))]
    suffix = SUFFIXES[draw.integers(len(SUFFIXES))]
    renamed = file.with_suffix(suffix) if draw.random() < 0.1 else file
    file.unlink()
    renamed.write_bytes(contents[file] if renamed != file else draw.choice(DAMAGES)(draw, contents[file]))
    try:
        with guard(10):
            came = outcome(renamed if path == file else path, name)
    finally:
        renamed.unlink()
        file.write_bytes(contents[file])
    return "refused" if isinstance(came, str) else "identical" if same(came, expected) else "different"


@pytest.mark.parametrize(
    "numbers", [range(8), pytest.param(range(8, 133), marks=pytest.mark.slow)], ids=["few", "many"]
)
def test_damage_is_refused_or_changes_nothing(sound, numbers, request):
    """Or changes numbers, in formats without checksums."""
    name = request.node.callspec.params["sound"]
    for number in numbers:
        found = judge(name, sound, number)
        assert found in ("refused", "identical") or name not in GUARDED, number


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


@pytest.mark.parametrize("name", sorted(set(NAMES) - {"lerobot", "mcap", "ros2bag"}))
def test_gaps_and_time_that_starts_again_are_left_to_cleaning(tmp_path, name):
    columns = signals()
    columns["qpos"][10:20] = np.nan
    columns["time"][30:] -= 0.3
    table, *_ = read_tables(str(write_log(tmp_path, name, columns)), "auto")
    recording = to_recording(table, OPTIONS[name], {}, simulated=False)
    np.testing.assert_array_equal(recording.time, columns["time"])
    np.testing.assert_array_equal(recording.signals["qpos"][:, 0], columns["qpos"])


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".npz", ".mat", ".json", ".zip", ".mcap", ".db3"])
def test_a_file_that_no_memory_holds(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    with path.open("wb") as file:
        file.truncate(10 << 30)  # takes no room on the disk
    line = read(path)
    assert isinstance(line, str) and re.search(r"10\.7 GB, expected at most 4\.3 GB; cut it into shorter logs", line)


def test_a_zip_that_unpacks_to_much_more(tmp_path):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.json", b" " * (base.SMALL + 1))
    assert re.search(r"a\.zip: \d+ bytes would unpack to 67 MB, expected at most 250 times", str(read(path)))
    # What the table of contents says of the size is what counts, before anything is unpacked.
    content = bytearray(path.read_bytes())
    struct.pack_into("<I", content, content.rindex(b"PK\x01\x02") + 24, 0xFFFFFFF0)
    path.write_bytes(content)
    assert "4.3 GB unpacked, expected at most 1.1 GB" in str(read(path))


def test_a_zip_that_says_less_than_it_holds(tmp_path):
    path = write_bam(tmp_path / "a.json", signals())
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(path, "a.json")
    content = bytearray((tmp_path / "a.zip").read_bytes())
    struct.pack_into("<I", content, content.rindex(b"PK\x01\x02") + 24, 40)
    (tmp_path / "a.zip").write_bytes(content)
    assert "not readable as a zip of logs" in str(read(tmp_path / "a.zip"))


def test_a_zip_that_says_much_less_than_it_holds(tmp_path):
    """It is not unpacked to the end, which would take as much memory as its writer likes."""
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.json", b" " * (64 << 20))
    content = bytearray((tmp_path / "a.zip").read_bytes())
    struct.pack_into("<I", content, content.rindex(b"PK\x01\x02") + 24, 40)
    (tmp_path / "a.zip").write_bytes(content)
    tracemalloc.start()
    try:
        assert "Bad CRC-32" in str(read(tmp_path / "a.zip"))
        assert tracemalloc.get_traced_memory()[1] < 4 << 20
    finally:
        tracemalloc.stop()


def test_a_zip_whose_members_share_bytes(tmp_path):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.json", b"{}")
        archive.writestr("b.json", b"{}")
    content = path.read_bytes()
    second = bytearray(content)
    struct.pack_into("<I", second, content.rindex(b"PK\x01\x02") + 42, 0)  # where b.json begins
    path.write_bytes(second)
    assert "b.json begins within the member before it" in str(read(path))
    long = bytearray(content)
    struct.pack_into("<I", long, content.rindex(b"PK\x01\x02") + 20, 1000)  # how many bytes it has
    path.write_bytes(long)
    assert "its last member does not end before the table of contents" in str(read(path))


def test_a_member_whose_name_is_damaged_is_not_left_out(tmp_path):
    path = write_npz(tmp_path / "a.npz", signals(5))
    content = path.read_bytes()
    place = content.rindex(b"qvel.npy")
    path.write_bytes(content[:place] + b"qvel.npz" + content[place + 8 :])
    assert "File name in directory 'qvel.npz' and header b'qvel.npy' differ" in str(read(path))


def test_a_zip_that_python_unpacks_without_a_bound(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_BZIP2) as archive:
        archive.writestr("a.json", b"{}")
    assert "a.zip!a.json: packed by method 12, expected deflate or none" in str(read(tmp_path / "a.zip"))


def test_an_index_that_its_checksum_contradicts(tmp_path):
    path = write_log(tmp_path, "mcap", signals(5))
    content = bytearray(path.read_bytes())
    content[-60] ^= 1
    path.write_bytes(content)
    assert "log.mcap: its index does not match its checksum" in str(read(path))


@pytest.mark.parametrize("shape", ["(1250000000,)", "(3,)", "(99999999999, 99999999999)", "(-1,)"])
def test_an_array_that_declares_another_size(tmp_path, shape):
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    array = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(16)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("qpos.npy", array)
    assert re.search(r"a\.npz!qpos\.npy: 16 bytes, expected -?\d+ for shape", str(read(tmp_path / "a.npz")))


def test_a_matlab_variable_that_unpacks_to_much_more(tmp_path):
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"q": np.ones(9)})
    header = path.read_bytes()[:128]
    packed = zlib.compress(struct.pack("<II", 14, 0xFFFFFFF0) + bytes(100))
    path.write_bytes(header + struct.pack("<II", 15, len(packed)) + packed)
    assert "4.3 GB unpacked, expected at most 1.1 GB" in str(read(path))
    path.write_bytes(header + struct.pack("<II", 14, 0xFFFFFFF0) + bytes(100))
    assert "ends within a variable; expected 4294967280 more bytes" in str(read(path))


def test_a_matlab_7_3_file(tmp_path):
    path = tmp_path / "a.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512) + b"\x89HDF\r\n\x1a\n" + bytes(100))
    assert "a.mat: a MATLAB 7.3 file, expected version 7 or below; in MATLAB: save(..., '-v7')" in str(read(path))


def test_more_rows_than_fit(tmp_path, monkeypatch):
    """The limit is lowered: a Parquet file that declares 10 GB in few bytes takes long to make."""
    path = write_log(tmp_path, "parquet", {name: np.zeros(20000) for name in signals()})
    assert path.stat().st_size < 10_000
    monkeypatch.setattr(base, "UNPACKED", 100_000)
    assert "0.0 GB unpacked, expected at most" in str(read(path))


def test_deep_json(tmp_path):
    (tmp_path / "a.json").write_text("[" * 100_000)
    assert "a.json: not readable as a BAM log in JSON" in str(read(tmp_path / "a.json"))
    (tmp_path / "a.json").write_text('{"entries": [{"timestamp": 1' + "0" * 5000 + "}]}")
    assert "a.json: not readable as a BAM log in JSON" in str(read(tmp_path / "a.json"))


def test_packed_chunks(tmp_path):
    columns = signals()
    plain = write_bag(tmp_path / "plain", columns, StoragePlugin.MCAP)
    packed = write_bag(tmp_path / "packed", columns, StoragePlugin.MCAP, compress=True)
    (first,), (second,) = (read_tables(str(folder), "auto") for folder in (plain, packed))
    assert first.columns.keys() == second.columns.keys() and first.sha256 != second.sha256
    file = packed / "packed.mcap"
    content = bytearray(file.read_bytes())
    place = content.index(b"\x04\x00\x00\x00zstd") - 12  # the chunk's declared size
    struct.pack_into("<Q", content, place, 10**10)
    file.write_bytes(content)
    assert "10.0 GB unpacked, expected at most" in str(read(packed))
    struct.pack_into("<Q", content, place, 100)
    file.write_bytes(content)
    assert "a chunk does not unpack to the 100 bytes that it declares" in str(read(packed))


def test_lz4_chunks():
    held = bytes(1000)
    packed = lz4.frame.compress(held)
    for size in (1000, 999, 1001):
        chunk = struct.pack("<QQQII", 0, 0, size, 0, 3) + b"lz4" + struct.pack("<Q", len(packed)) + packed
        if size == 1000:
            assert _unpack("a.mcap", chunk) == held
        else:
            with pytest.raises(LogError, match=rf"a\.mcap: a chunk does not unpack to the {size} bytes"):
                _unpack("a.mcap", chunk)


def test_a_bag_whose_files_are_packed(tmp_path):
    folder = write_bag(tmp_path / "bag", signals(5), StoragePlugin.SQLITE3)
    about = folder / "metadata.yaml"
    about.write_text(
        about.read_text()
        .replace("compression_mode: ''", "compression_mode: MESSAGE")
        .replace("compression_format: ''", "compression_format: zstd")
    )
    assert "compressed by message, expected a bag that is not" in str(read(folder))


def test_a_database_with_a_view_without_end(tmp_path):
    folder = write_bag(tmp_path / "bag", signals(5), StoragePlugin.SQLITE3)
    with closing(sqlite3.connect(folder / "bag.db3")) as database:
        database.execute("DROP TABLE message_definitions")
        database.execute(
            "CREATE VIEW message_definitions AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n) "
            "SELECT id, '' AS topic_type, '' AS encoding, '' AS encoded_message_definition, "
            "'' AS type_description_hash FROM n"
        )
        database.commit()
    assert "a database with views, expected the tables of rosbag2" in str(read(folder))


class Marker:
    """Writes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_pickled_objects_are_not_unpickled(tmp_path):
    marker = tmp_path / "marker"
    pickle.loads(pickle.dumps(Marker(marker)))
    assert marker.exists()  # so that the test would see it
    marker.unlink()
    np.savez(tmp_path / "a.npz", allow_pickle=True, time=np.arange(3.0), qpos=np.array([Marker(marker)], dtype=object))
    assert "a.npz!qpos.npy: holds Python objects" in str(read(tmp_path / "a.npz"))
    with zipfile.ZipFile(tmp_path / "b.npz", "w") as archive:
        archive.writestr("qpos.npy", pickle.dumps(Marker(marker)))
    assert "not readable as an .npz archive" in str(read(tmp_path / "b.npz"))
    for name in ("a.csv", "a.parquet", "a.mat", "a.json", "a.mcap", "a.db3"):
        (tmp_path / name).write_bytes(pickle.dumps(Marker(marker)))
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
