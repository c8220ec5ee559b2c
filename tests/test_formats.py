"""One recording in every format, and what each format says about its columns."""

import contextlib
import dataclasses
import hashlib
import json
import shlex
import shutil
import struct
import sys
import zipfile
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
import scipy.io
import torch
from conftest import DATA, needs_data
from helpers.write_logs import (
    EPOCH,
    OPTIONS,
    STORE,
    WRITERS,
    command,
    joint_state,
    signals,
    write_bam,
    write_csv,
    write_log,
    write_messages,
)
from hydra.core.override_parser.overrides_parser import OverridesParser
from rosbags.rosbag2 import StoragePlugin

from frictionzoo.core.errors import ConfigError, LogError
from frictionzoo.data.columns import to_recording
from frictionzoo.data.formats import base, format_names, read_tables, register_format
from frictionzoo.data.formats.csv import Csv
from frictionzoo.data.propose import propose
from frictionzoo.data.recording import Table, refuse_incomplete


def test_every_format_is_tested():
    assert set(format_names()) == set(WRITERS)


@pytest.mark.parametrize("name", sorted(WRITERS))
def test_a_recording_comes_back_bit_for_bit(tmp_path, name):
    columns = signals()
    path = write_log(tmp_path, name, columns)
    tables = read_tables(str(path), "auto")
    assert len(tables) == len(read_tables(str(path), name)) == (2 if name == "lerobot" else 1)
    if name == "lerobot":  # single precision
        assert [table.name[-15:] for table in tables] == ["!episode_000000", "!episode_000001"]
        assert tables[0].fields["fps"] == 100
        columns = {signal: values.astype(np.float32) for signal, values in columns.items()}
    for table in tables:
        recording = to_recording(table, OPTIONS[name], {}, simulated=True)
        np.testing.assert_array_equal(recording.time, columns["time"])
        assert set(recording.signals) == {"qpos", "qvel", "ctrl"}
        for signal, values in recording.signals.items():
            np.testing.assert_array_equal(values, columns[signal][:, None])
        assert recording.simulated and len(recording.sha256) == 64 and recording.notes == ()
        proposal = propose(table)
        proposed = {signal: headers[0] for signal, headers in proposal.columns.items()}
        assert not proposal.units and proposal.certain == (not OPTIONS[name])
        assert proposed == (OPTIONS[name] or proposed)
    if path.is_file() and path.suffix != ".zip":
        assert tables[0].sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    if name in ("parquet", "mat"):  # recognised by the first bytes
        assert read_tables(str(path.rename(tmp_path / "recording")), "auto")


def test_an_unknown_format_and_an_unknown_file(tmp_path):
    path = write_csv(tmp_path / "a.csv", signals())
    with pytest.raises(ConfigError, match=r"cvs: .* did you mean csv"):
        read_tables(str(path), "cvs")
    refuse(path.rename(tmp_path / "a.abc"), r"a\.abc: .*data\.format")
    refuse(tmp_path, r"data\.format")
    refuse(tmp_path / "nowhere.csv", r"nowhere\.csv: no such file")


def test_another_package_brings_a_format(tmp_path, monkeypatch):
    monkeypatch.setattr(base.REGISTRY, "entries", dict(base.REGISTRY.entries))

    class Semicolons(Csv):
        suffixes = (".ssv",)

        def parse(self, name, content):
            return super().parse(name, content.replace(b";", b","))

    register_format("semicolons")(Semicolons)
    path = tmp_path / "a.ssv"
    path.write_text("time;qpos\n0;1\n1;2\n")
    assert read_tables(str(path), "auto")[0].columns["qpos"].tolist() == [1, 2]


def test_a_missing_package_gets_the_command_that_installs_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    (tmp_path / "a.parquet").write_bytes(b"PAR1")
    refuse(tmp_path / "a.parquet", r'pyarrow; pip install "frictionzoo\[formats\]"')


def test_matrices_texts_and_single_values(tmp_path):
    time = np.arange(5) / 100
    path = tmp_path / "a.mat"
    scipy.io.savemat(
        path, {"t": time, "q": np.ones((5, 2)), "wide": np.ones((2, 5)), "gain": 4.0, "who": "me", "z": 1j * time}
    )
    (table,) = read_tables(str(path), "auto")
    assert set(table.columns) == {"t", "q[0]", "q[1]", "wide[0]", "wide[1]", "gain"}
    assert table.fields["who"] == "me"
    with pytest.raises(LogError, match=r"a\.mat: z is of type complex128, expected real numbers"):
        to_recording(table, {"time": "t", "qpos": "z", "ctrl": "t"}, {}, simulated=False)


@pytest.mark.parametrize("order", "<>")
def test_matlab_files_of_version_4(tmp_path, order):
    columns = {**signals(30), "arm": np.arange(60.0).reshape(30, 2), "robot": "leg"}
    scipy.io.savemat(tmp_path / "a.mat", columns, format="4")
    if order == ">":
        (tmp_path / "a.mat").write_bytes(write_mat_4({"q": np.arange(9.0), "i": np.arange(9, dtype="i2")}, order))
        columns = {"q": np.arange(9.0), "i": np.arange(9.0)}
    (came,) = read_tables(str(tmp_path / "a.mat"), "auto")
    for name in columns.keys() - {"arm", "robot"}:
        np.testing.assert_array_equal(came.columns[name], columns[name])
    if order == "<":
        assert came.fields == {"robot": "leg"}
        np.testing.assert_array_equal(came.columns["arm[1]"], columns["arm"][:, 1])


def test_damaged_matlab_files_of_version_4_get_one_line(tmp_path):
    content = write_mat_4({"time": np.arange(50.0), "qpos": np.ones(50)}, "<")
    rng = np.random.default_rng(0)
    for _ in range(80):
        damaged = bytearray(content[: rng.integers(1, len(content))] if rng.random() < 0.5 else content)
        damaged[rng.integers(0, len(damaged))] = rng.integers(0, 256)
        (tmp_path / "a.mat").write_bytes(damaged)
        with contextlib.suppress(LogError):
            read_tables(str(tmp_path / "a.mat"), "auto")
    for kind in (2000, 60, 3, 100, -1):
        (tmp_path / "a.mat").write_bytes(struct.pack("<5i", kind, 3, 1, 0, 2) + b"q\0" + bytes(24))
        refuse(tmp_path / "a.mat", "version 4 to 7|VAX")


def write_mat_4(columns, order):
    """A file of version 4 in either byte order."""
    content = b""
    for name, values in columns.items():
        kind = {"f": 0, "i": 30}[values.dtype.kind] + (1000 if order == ">" else 0)
        header = struct.pack(f"{order}5i", kind, len(values), 1, 0, len(name) + 1)
        content += header + name.encode() + b"\0" + values.astype(values.dtype.newbyteorder(order)).tobytes()
    return content


def test_parquet_has_times_lists_gaps_and_texts(tmp_path):
    path = tmp_path / "a.parquet"
    stamps = np.datetime64(EPOCH, "ns") + np.arange(3) * np.timedelta64(10_000_001, "ns")
    columns = {
        "stamp": stamps,
        "q": pa.array([[1.0, 2.0]] * 3, pa.list_(pa.float64(), 2)),
        "u": pa.array([1, None, 3]),
        "on": [True, False, True],
        "note": ["a", "b", "c"],
        "ragged": [[1.0], [], [1.0, 2.0]],
    }
    pyarrow.parquet.write_table(pa.table(columns), path)
    (table,) = read_tables(str(path), "auto")
    assert set(table.columns) == {"stamp", "q[0]", "q[1]", "u", "on"}
    recording = to_recording(table, {"time": "stamp", "qpos": ["q[0]", "q[1]"], "ctrl": "u"}, {}, simulated=False)
    assert recording.time.tolist() == [0, 0.010000001, 0.020000002]  # exact, though 1.7e9 s leave a double 2e-7 s
    assert recording.signals["qpos"].shape == (3, 2)
    np.testing.assert_array_equal(recording.signals["ctrl"][:, 0], [1, np.nan, 3])


def test_whole_nanoseconds_and_empty_cells_of_a_csv_file(tmp_path):
    rows = [f"{EPOCH + 1_000_001 * i},{i},{i if i else ''}" for i in range(4)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["time,qpos,ctrl", *rows]))
    (table,) = read_tables(str(path), "auto")
    recording = to_recording(table, {"time": "time", "qpos": "qpos", "ctrl": "ctrl"}, {"time": "ns"}, simulated=False)
    assert recording.time.tolist() == [0, 0.001000001, 0.002000002, 0.003000003]
    np.testing.assert_array_equal(recording.signals["ctrl"][:, 0], [np.nan, 1, 2, 3])


def test_bam_logs_in_a_folder_and_in_a_zip(tmp_path):
    folder = tmp_path / "logs"
    folder.mkdir()
    files = [write_bam(folder / name, signals(9)) for name in ("b.json", "a.json")]
    tables = read_tables(str(folder), "auto")
    assert [table.name for table in tables] == [str(folder / "a.json"), str(folder / "b.json")]
    with zipfile.ZipFile(tmp_path / "logs.zip", "w") as archive:
        for file in files:
            archive.write(file, file.name)
    zipped = read_tables(str(tmp_path / "logs.zip"), "auto")
    assert [table.name for table in zipped] == [f"{tmp_path / 'logs.zip'}!{name}" for name in ("a.json", "b.json")]
    assert {table.sha256 for table in tables + zipped} == {hashlib.sha256(files[0].read_bytes()).hexdigest()}
    assert zipped[0].fields == {"mass": 0.5, "motor": "xl330"}


@needs_data
@pytest.mark.parametrize(("place", "count"), [("xl330", 16), ("sts3215_12v/sts3215_12v_raw.zip", 12)])
def test_real_bam_logs_need_no_option(place, count, tmp_path):
    path = Path(str(DATA)) / place
    if path.suffix == ".zip":
        with zipfile.ZipFile(path) as archive, zipfile.ZipFile(tmp_path / path.name, "w") as some:
            for name in archive.namelist()[::80]:
                some.writestr(name, archive.read(name))
        path = tmp_path / path.name
    tables = read_tables(str(path), "auto")
    assert len(tables) == count
    for table in tables:
        recording = to_recording(table, {}, {}, simulated=False)
        assert set(recording.signals) == {"qpos", "qvel", "ctrl", "supply", "enable", "temperature"}
        assert 5.9 < recording.time[-1] < 6.1  # s, by the recordings' description
        assert table.fields["mass"] and table.fields["trajectory"]


@needs_data
def test_a_real_matlab_file():
    (table,) = read_tables(str(Path(str(DATA)) / "emps" / "DATA_EMPS.mat"), "auto")
    assert propose(table).overrides() == ["data.columns.time=t", "data.columns.qpos=[qm]", "data.columns.ctrl=[vir]"]
    assert to_recording(table, {"time": "t", "qpos": "qm", "ctrl": "vir"}, {}, simulated=False).time[-1] == 24.84


def ros_log(folder: Path, messages, plugin=StoragePlugin.MCAP) -> Table:
    """The table of a bag with (topic, message, received) in it."""
    (table,) = read_tables(str(write_messages(folder, messages, plugin)), "auto")
    return table


ROS = {"qpos": "/js/position[knee]", "ctrl": "/u/data[0]"}


def test_signals_of_other_times_are_brought_to_those_of_qpos(tmp_path):
    states = [("/js", joint_state(EPOCH + i * 10**7, i, 0.0), EPOCH) for i in range(5)]
    commands = [("/u", command(value), EPOCH + at) for value, at in ((1.0, 15 * 10**6), (2.0, 30 * 10**6))]
    volts = [("/v", command(value), EPOCH + at) for value, at in ((10.0, 0), (14.0, 4 * 10**7))]
    table = ros_log(tmp_path / "bag", states + commands + volts)
    recording = to_recording(table, {**ROS, "supply": "/v/data[0]"}, {}, simulated=False)
    np.testing.assert_array_equal(recording.time, np.arange(5) / 100)
    # Held from 15 ms on; the first command before itself; the one at 30 ms acts at 30 ms.
    assert recording.signals["ctrl"][:, 0].tolist() == [1, 1, 1, 2, 2]
    np.testing.assert_allclose(recording.signals["supply"][:, 0], [10, 11, 12, 13, 14], rtol=1e-15)
    assert recording.notes == (
        "ctrl held from 2 samples to the 5 times of qpos",
        "supply interpolated linearly from 2 samples to the 5 times of qpos",
    )


def test_without_stamps_the_time_is_that_of_receiving(tmp_path):
    table = ros_log(tmp_path / "bag", [("/js", joint_state(0, i, 0.0), EPOCH + i * 10**7) for i in range(3)])
    np.testing.assert_array_equal(table.columns["/js/time"], EPOCH + np.arange(3) * 10**7)


def test_two_publishers_of_one_topic_have_separate_times(tmp_path):
    states = [("/js", joint_state(EPOCH + i, i, 0.0, ("knee", "hip")[i % 2]), EPOCH + i) for i in range(6)]
    table = ros_log(tmp_path / "bag", states)
    assert table.columns["/js/position[hip]"].tolist() == [1, 3, 5]
    np.testing.assert_array_equal(table.columns[table.times["/js/position[hip]"]] - EPOCH, [1, 3, 5])


def test_scalars_whole_numbers_and_trajectories_are_commands(tmp_path):
    types, empty = STORE.types, np.array([])
    stamp = types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
    later = [types["builtin_interfaces/msg/Duration"](sec=after, nanosec=5) for after in (0, 1)]
    point = types["trajectory_msgs/msg/JointTrajectoryPoint"]
    points = [point(np.array([q]), empty, empty, empty, after) for q, after in zip((0.5, 0.75), later, strict=True)]
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="")
    messages = {
        "/plan": types["trajectory_msgs/msg/JointTrajectory"](header=header, joint_names=["knee"], points=points),
        "/torque": types["std_msgs/msg/Float64"](data=2.5),
        "/count": types["std_msgs/msg/Int64"](data=2**53 + 1),
    }
    logged = [(topic, message, EPOCH) for topic, message in messages.items()]
    columns = ros_log(tmp_path / "bag", logged, StoragePlugin.SQLITE3).columns
    assert columns["/plan/positions[knee]"].tolist() == [0.5, 0.75]
    assert (columns["/plan/time"] - EPOCH).tolist() == [5, 10**9 + 5]
    assert columns["/torque/data"].tolist() == [2.5] and columns["/count/data"].tolist() == [2**53 + 1]


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3], ids=["mcap", "sqlite"])
def test_messages_out_of_order_are_not_sorted(tmp_path, plugin):
    states = [("/js", joint_state(0, i, 0.0), EPOCH + at) for i, at in enumerate((0, 10, 20, 5, 15))]
    with pytest.raises(LogError, match=rf"{EPOCH + 5} ns.*{EPOCH + 20}"):
        ros_log(tmp_path / "bag", states, plugin)


def test_stamps_that_run_backwards_are_brought_to_no_other_times(tmp_path):
    states = [("/js", joint_state(EPOCH + i * 10**7, i, 0.0), EPOCH + i) for i in range(5)]
    efforts = [("/e", joint_state(EPOCH + at * 10**6, i, 0.0), EPOCH + i) for i, at in enumerate((0, 20, 10))]
    came = ros_log(tmp_path / "bag", states + efforts)
    with pytest.raises(LogError, match=r"/e/time runs backwards at sample 2"):
        to_recording(came, {"qpos": ROS["qpos"], "ctrl": "/e/position[knee]"}, {}, simulated=False)


@pytest.mark.parametrize("field", ["name", "position", "velocity", "effort"])
def test_a_message_that_contradicts_its_names(tmp_path, field):
    two = dataclasses.replace(joint_state(0, 1.0, 0.0), name=["hip", "knee"], position=np.ones(2), velocity=np.ones(2))
    wrong = {"name": ["knee", "knee"]} if field == "name" else {field: np.ones(3)}
    with pytest.raises(LogError, match="twice in one message" if field == "name" else f"{field} has 3 entries"):
        ros_log(tmp_path / "bag", [("/js", dataclasses.replace(two, **wrong), EPOCH)])


def table(**columns) -> Table:
    return Table("a.csv", {name: np.asarray(values, dtype=float) for name, values in columns.items()})


NAMED = {"time": "t", "qpos": ["q"], "qvel": ["v"], "ctrl": ["u"]}


def test_units_raw_registers_exact_milliseconds_and_days():
    came = table(t=[3, 10], q=[0, 2], v=[0, 3], u=[0, 5])
    recording = to_recording(
        came, NAMED, {"time": "ms", "qpos": "0.0015", "qvel": "rpm", "ctrl": "Nm"}, simulated=False
    )
    assert recording.time.tolist() == [0, 0.007]
    found = [recording.signals[signal][1, 0] for signal in ("qpos", "qvel", "ctrl")]
    assert found == pytest.approx([0.003, np.pi / 10, 5], rel=1e-15)  # one rounding
    came = table(t=738_000 + np.arange(3) / 2**20, q=[0, 1, 2], v=[0, 1, 2], u=[0, 1, 2])
    days = to_recording(came, NAMED, {"time": "86400"}, simulated=False).time
    assert days.tolist() == [0, 86400 / 2**20, 86400 / 2**19]


BAD_OPTIONS = {
    "unit": (NAMED, {"qpos": "degr"}, ConfigError, r"data\.units\.qpos=degr: .* did you mean deg\?"),
    "other-unit": (NAMED, {"time": "deg"}, ConfigError, r"data\.units\.time=deg"),
    "signal": ({**NAMED, "qvle": "v"}, {}, ConfigError, r"data\.columns\.qvle: .* did you mean qvel"),
    "two-times": ({**NAMED, "time": ["t", "q"]}, {}, ConfigError, r"data\.columns\.time"),
    "number": ({**NAMED, "qpos": 3.5}, {}, ConfigError, r"data\.columns\.qpos=3\.5"),
    "missing": ({**NAMED, "qpos": ["qq"]}, {}, LogError, r"a\.csv: no column qq; did you mean q\?"),
    "unnamed": ({"time": "t"}, {}, LogError, r"columns\.qpos .*perhaps data\.columns\.time=t .*t, q, v, u, short"),
    "length": ({**NAMED, "ctrl": "short"}, {}, LogError, r"a\.csv: short has 1 samples and t 2"),
}


@pytest.mark.parametrize(("columns", "units", "kind", "line"), BAD_OPTIONS.values(), ids=BAD_OPTIONS)
def test_options_that_make_no_sense(columns, units, kind, line):
    with pytest.raises(kind, match=line) as caught:
        to_recording(table(t=[0, 1], q=[0, 1], v=[0, 1], u=[0, 1], short=[1]), columns, units, simulated=False)
    assert "\n" not in str(caught.value)


ABSURD = {
    "time": ([0, 1, 2, 1e13], [0] * 4, [0] * 4, r"time \(t\) is 1e\+13 .* sample 3"),
    "qpos": ([0, 1], [0, 1], [1e300, 1], r"qpos \(q\) is 1e\+300 .* sample 0"),
    "ctrl": ([0, 1], [0, -np.inf], [0, 1], r"ctrl \(u\) is -inf .* sample 1"),
    "days": (738_000 + np.arange(3) / 864e4, [0] * 3, [0] * 3, r"t advances by 1\.16e-07 s .*data\.units\.time"),
    "nanoseconds": ([0, 1e7], [0, 1], [0, 1], r"t advances by 1e\+07 s .*data\.units\.time"),
    "date": ([20240131, 20240201], [0, 1], [0, 1], r"t is a date \(20240131\)"),
    "date-and-time": ([20240131235959, 20240201000000], [0, 1], [0, 1], r"t is a date \(20240131235959\)"),
}


@pytest.mark.parametrize(("t", "u", "q", "line"), ABSURD.values(), ids=ABSURD)
def test_absurd_samples(t, u, q, line):
    with pytest.raises(LogError, match=rf"^a\.csv: {line}"):
        to_recording(table(t=t, q=q, u=u), {"time": "t", "qpos": "q", "ctrl": "u"}, {}, simulated=False)


def test_numbers_at_the_end_of_all_numbers():
    came = table(time=[-1.7e308, 0, 1.7e308], qpos=[0, -1e308, 1e308], ctrl=[np.inf, -np.inf, 0])
    assert propose(came).units["time"] == "ns"
    with pytest.raises(LogError, match="time"):
        to_recording(came, {}, {"time": "86400"}, simulated=False)


def refuse(path: Path, line: str) -> None:
    """Reading the file and taking its columns by their names ends in this line."""
    with pytest.raises(LogError, match=line) as caught:
        for came in read_tables(str(path), "auto"):
            to_recording(came, {}, {}, simulated=False)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("cell", ["1_000", "١٢", "１２", "\u00a05", "0x10", "5,5", "1d3", "n/a"])
def test_cells_that_are_no_plain_numbers(tmp_path, cell):
    path = tmp_path / "a.csv"
    path.write_text(f'time,qpos,qvel,ctrl\n0,0,0,0\n0.1,1,"{cell}",1\n', encoding="utf-8")
    refuse(path, r"a\.csv, line 3: qvel .*data\.columns\.qvel")
    (came,) = read_tables(str(path), "auto")
    assert set(to_recording(came, {"qvel": []}, {}, simulated=False).signals) == {"qpos", "ctrl"}


def test_cells_that_are_plain_numbers(tmp_path):
    cells = [" 5", "+5", "5.", "5e0", "5E+00", "nan", ""]
    (tmp_path / "a.csv").write_text("\n".join(["time,qpos", *(f"{i},{cell}" for i, cell in enumerate(cells))]))
    (came,) = read_tables(str(tmp_path / "a.csv"), "auto")
    np.testing.assert_array_equal(came.columns["qpos"], [5, 5, 5, 5, 5, np.nan, np.nan])


@pytest.mark.parametrize("text", ['"7"', "true", "[1, [2]]", "{}", '1, "position": 2'])
def test_json_that_is_no_number(tmp_path, text):
    first = '{"timestamp": 0, "position": 0, "goal_position": 0, "torque_enable": true}'
    path = tmp_path / "a.json"
    second = first.replace('"position": 0', f'"position": {text}')
    path.write_text(f'{{"entries": [{first}, {second}]}}')
    refuse(path, "position.*(entry 1|twice)")
    path.write_text(f'{{"entries": [{first}, {first}]}}')
    (came,) = read_tables(str(path), "auto")
    assert to_recording(came, {}, {}, simulated=False).signals["enable"].tolist() == [[1], [1]]


@pytest.mark.parametrize(
    ("name", "suffix", "line"),
    [
        ("parquet", ".txt", r"suffix \.txt, .* parquet; .*data\.format=parq"),
        ("mat", ".csv", r"suffix \.csv, .* mat"),
        ("npz", ".mat", r"suffix \.mat, .* npz or pt or zip"),
        ("npz", "", r"suffix none, .* npz or pt or zip"),
        ("npz", ".zip", r"no member ends in \.json"),
        ("mcap", ".db3", r"suffix \.db3, .* mcap"),
        ("mcap", "", r"suffix none, expected \.mcap or \.db3"),
    ],
)
def test_a_name_that_its_contents_contradict(tmp_path, name, suffix, line):
    path = write_log(tmp_path, name, signals(5))
    refuse(path.rename(tmp_path / f"a{suffix}"), line)


class Touch:
    """An object whose unpickling writes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_pytorch_files_of_tensors_and_of_anything_else(tmp_path):
    path, time = tmp_path / "a.pt", torch.arange(4, dtype=torch.float64) / 100
    columns = {"time": time, "qpos": torch.ones(4, 1, requires_grad=True), "half": time.bfloat16()}
    columns["q"] = torch.ones(4, 2)
    torch.save({**columns, "gain": 4.0, "name": "leg", "inner": {"x": time}, "on": time > 0}, path)
    (came,) = read_tables(str(path), "auto")
    assert set(came.columns) == {"time", "qpos", "half", "q[0]", "q[1]", "on"} and "inner" in came.refused
    assert came.fields == {"gain": 4.0, "name": "leg"}
    np.testing.assert_array_equal(came.columns["time"], time.numpy())
    for stored, line in (
        ({"time": time, "x": Touch(tmp_path / "touched")}, "holds Python objects"),
        ({"time": np.arange(3.0)}, "holds Python objects"),
        (time, "holds one Tensor, expected tensors by name"),
        ({"time": torch.zeros(1).expand(2**40)}, "GB unpacked"),
    ):
        torch.save(stored, path)
        refuse(path, rf"a\.pt: .*{line}")
    torch.save({"time": time}, path, _use_new_zipfile_serialization=False)
    refuse(path, r"a\.pt: .*torch\.save")
    assert not (tmp_path / "touched").exists()


def test_two_of_one_name(tmp_path):
    np.save(tmp_path / "qpos.npy", np.arange(3.0))
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive, pytest.warns(UserWarning, match="Duplicate name"):
        for _ in range(2):
            archive.write(tmp_path / "qpos.npy", "qpos.npy")
    refuse(tmp_path / "a.npz", r"a\.npz: two members qpos\.npy, expected one of each name")
    np.savez(tmp_path / "b.npz", **{"qpos": np.ones((5, 2)), "qpos[0]": np.ones(5)})
    refuse(tmp_path / "b.npz", r"b\.npz: two columns qpos\[0\], expected one")
    content = write_log(tmp_path, "mat", signals(5)).read_bytes()
    (tmp_path / "a.mat").write_bytes(content + content[128:])
    refuse(tmp_path / "a.mat", r"a\.mat: two variables time, expected one of each name")
    folder = write_log(tmp_path, "lerobot", signals(5))
    about = folder / "meta" / "info.json"
    about.write_text(about.read_text().replace("knee.vel", "knee.pos"))
    refuse(folder, r"observation\.state has the names knee\.pos, knee\.pos, expected each once")


def test_velocities_of_other_joints_than_the_positions(tmp_path):
    recording = to_recording(
        table(t=[0, 1], a=[0, 1], b=[0, 1], u=[0, 1]),
        {"time": "t", "qpos": ["a", "b"], "qvel": "a", "ctrl": "u"},
        {},
        simulated=False,
    )
    with pytest.raises(LogError, match=r"a\.csv: qvel has 1 columns and qpos 2, expected as many"):
        refuse_incomplete(recording)


def test_a_velocity_that_is_no_number_is_not_estimated_instead(tmp_path):
    columns, words = signals(5), ["1"] * 5
    pyarrow.parquet.write_table(pa.table({**columns, "qvel": words}), tmp_path / "a.parquet")
    scipy.io.savemat(tmp_path / "a.mat", {**columns, "qvel": np.array(words, dtype=object)})
    refuse(tmp_path / "a.parquet", "qvel is of type string")
    refuse(tmp_path / "a.mat", "qvel is of class cell")


def test_times_that_no_number_holds(tmp_path):
    columns = signals(3)
    late = np.array([2**63 + 1, 2**63 + 2, 2**63 + 3], dtype=np.uint64)
    for name, values, line in (
        ("a", late, r"time holds 9223372036854775811, expected whole numbers below 4611686018427387904"),
        ("b", np.array(["2024", "NaT", "2024"], dtype="M8[ns]"), r"time lacks a time"),
        ("c", np.array(["2024", "3000", "3001"], dtype="M8[D]"), r"or has one beyond the years 1678 to 2262"),
    ):
        np.savez(tmp_path / f"{name}.npz", **{**columns, "time": values})
        refuse(tmp_path / f"{name}.npz", line)
    (tmp_path / "a.csv").write_text("\n".join(["time,qpos,ctrl", *(f"{value},0,0" for value in late.tolist())]))
    refuse(tmp_path / "a.csv", r"time holds 9223372036854775811")


def motion(samples: int = 400) -> dict[str, np.ndarray]:
    """A joint that follows its command, in SI units."""
    time = np.arange(samples) / 100
    return {"time": time, "position": np.sin(time), "velocity": np.cos(time), "goal": 1.05 * np.sin(time + 0.05)}


SCALES = {
    "position-in-degrees": ({"position": 180 / np.pi}, {"qpos": "deg"}),
    "velocity-in-degrees": ({"velocity": 180 / np.pi}, {"qvel": "deg/s"}),
    "velocity-in-rpm": ({"velocity": 30 / np.pi}, {"qvel": "rpm"}),
    "command-in-degrees": ({"goal": 180 / np.pi}, {"ctrl": "deg"}),
    "all-in-degrees": (
        dict.fromkeys(("position", "velocity", "goal"), 180 / np.pi),
        {"qpos": "deg", "qvel": "deg/s", "ctrl": "deg"},
    ),
    "milliseconds": ({"time": 1e3}, {"time": "ms"}),
    "microseconds": ({"time": 1e6}, {"time": "us"}),
    "si": ({}, {}),
}


@pytest.mark.parametrize(("scales", "units"), SCALES.values(), ids=SCALES)
def test_a_wrong_unit_shows_in_the_numbers(scales, units):
    columns = {name: values * scales.get(name, 1) for name, values in motion().items()}
    # A full turn and a bit, so that degrees of all signals look like many turns.
    columns |= {name: 1.5 * columns[name] for name in ("position", "velocity", "goal")}
    proposal = propose(table(**columns))
    assert proposal.units == units
    found = {signal: headers[0] for signal, headers in proposal.columns.items()}
    assert found == {"time": "time", "qpos": "position", "qvel": "velocity", "ctrl": "goal"}


HEADERS = {
    **{"time_ms": ("time", "ms"), "timestamp [us]": ("time", "us"), "position_deg": ("qpos", "deg")},
    **{"Joint Position (rev)": ("qpos", "rev"), "jointPosition": ("qpos", None), "dq [rad/s]": ("qvel", None)},
    **{"speed_rpm": ("qvel", "rpm"), "goal_position_deg": ("ctrl", "deg"), "torque_cmd [N m]": ("ctrl", None)},
    **{"pwm_%": ("ctrl", "%"), "input_volts": ("supply", None), "torque_enable": ("enable", None)},
    "motor_temp": ("temperature", None),
}


@pytest.mark.parametrize("header", HEADERS)
def test_names_show_signals_and_units(header):
    proposal, (signal, unit) = propose(table(**{header: [0, 0.01, 0.02]})), HEADERS[header]
    assert dict(proposal.columns) == {signal: (header,)} and proposal.units.get(signal) == unit


HIP, KNEE = "FL_hip", "FL_knee"
ROBOTS = {  # the signal of each header
    "mit": {"t": "time", "q": "qpos", "dq": "qvel", "q_des": "ctrl", "dq_des": "ctrl_velocity", "ddq_des": None}
    | {"tau_ff": "ctrl_torque", "tau_est": "torque", "kp": "kp", "kd": "kd"},
    "joint-states": {"/state/position[a]": "qpos", "/state/effort[a]": "torque", "/cmd/position[a]": "ctrl"}
    | {"/cmd/velocity[a]": "ctrl_velocity", "/cmd/effort[a]": "ctrl_torque"},
    # Without a desired position, a torque or a velocity is the command; two torques leave doubt.
    "velocity": {"time": "time", "pos": "qpos", "target_velocity": "ctrl"},
    "torque": {"time": "time", "pos": "qpos", "tau": "ctrl"},
    "doubt": {"time": "time", "q": "qpos", "qcmd": "ctrl", "tau": None, "tau2_raw": None},
    "external": {"time": "time", "q": "qpos", "qcmd": "ctrl", "tau_ext": None},
    "motor": {"time": "time", "pos": "qpos", "vel": "qvel", "torDes": "ctrl_torque", "velDes": "ctrl_velocity"}
    | {"posDes": "ctrl", "torEst": None, "torKdEst": None},
    "no-gain": {"time": "time", "pos": "qpos", "posDes": "ctrl", "torKdEst": "torque"},
    "spelt-out": {"time": "time", "q": "qpos", "q_dot": "qvel", "dQ_des": "ctrl_velocity", "qCmd": "ctrl"},
    # Two encoders of one joint are not two joints.
    "encoders": {"time": "time", "motor_pos": "qpos", "load_pos": None, "motor_cmd": "ctrl"},
}


@pytest.mark.parametrize("headers", ROBOTS.values(), ids=ROBOTS)
def test_commands_of_a_robot_are_distinguished(headers):
    proposal = propose(table(**{header: [0, 0.01, 0.02] for header in headers}))
    expected = {signal: header for header, signal in headers.items() if signal}
    assert {signal: found[0] for signal, found in proposal.columns.items()} == expected


@pytest.mark.parametrize("form", ["{}_{}", "{1}_{0}"])
def test_names_of_joints_make_lists_in_the_order_of_the_positions(form):
    order = {"qpos": (HIP, KNEE), "ctrl": (KNEE, HIP), "ctrl_vel": (HIP, KNEE), "tau_est": (KNEE, HIP), "qvel": (HIP,)}
    headers = ["time", *(form.format(signal, joint) for signal, joints in order.items() for joint in joints)]
    columns = propose(table(**{header: [0, 0.01, 0.02] for header in headers})).columns
    names = {"qpos": "qpos", "ctrl": "ctrl", "ctrl_velocity": "ctrl_vel", "torque": "tau_est"}
    for signal, name in names.items():
        assert columns[signal] == (form.format(name, HIP), form.format(name, KNEE))


@pytest.mark.parametrize("still", ["limit_ref", "goal", "gripper_cmd"])
def test_a_command_that_never_changes_is_not_the_one_that_is_followed(still):
    columns = motion()
    headers = {"time": columns["time"], "q": columns["position"], still: np.zeros(400), "qdes": columns["goal"]}
    assert propose(table(**headers)).columns["ctrl"] == ("qdes",)
    assert propose(table(**headers | {"qdes": np.zeros(400)})).columns["ctrl"]  # at rest, one of them is as good


def test_a_torque_that_would_cost_samples_is_not_proposed():
    columns = {"time": [0, 0.01, 0.02], "q": [0, 1, 2], "qcmd": [0, 1, 2], "tau": [0, np.nan, 1]}
    assert "torque" not in propose(table(**columns)).columns
    assert "torque" not in propose(table(time=[0, 0.01], qpos=[0, 1], ctrl=[0, 1], torque=[np.nan, 0])).columns


def test_a_desired_velocity_in_degrees_shows_in_the_numbers():
    columns = motion()
    degrees = 180 / np.pi * np.cos(columns["time"])
    assert propose(table(**columns, velocity_des=degrees)).units == {"ctrl_velocity": "deg/s"}


def test_overrides_survive_a_shell_and_hydra(tmp_path):
    headers = ["t [ms]", "joint's position[knee]", "joint's position[hip]", "goal, left $HOME", "x=y speed"]
    proposal = propose(table(**{header: [0, 1, 2] for header in headers}))
    words = shlex.split(" ".join(proposal.overrides()))
    parsed = {o.key_or_group: o.value() for o in OverridesParser.create().parse_overrides(words)}
    assert parsed == {
        "data.columns.time": headers[0],
        "data.columns.qpos": headers[1:3],
        "data.columns.ctrl": headers[3:4],
        "data.columns.qvel": headers[4:],
        "data.units.time": "ms",
    }


def test_degrees_in_a_bam_log_are_not_taken_for_radians(tmp_path):
    columns = motion()
    columns["position"] = columns["position"] * 180 / np.pi
    refuse(write_bam(tmp_path / "a.json", columns), r"perhaps .* data\.units\.qpos=deg")


def test_a_lerobot_folder_without_data(tmp_path):
    folder = write_log(tmp_path, "lerobot", signals())
    shutil.rmtree(folder / "data")
    refuse(folder, r"no data/chunk-\*/\*\.parquet")
    (folder / "meta" / "info.json").write_text(json.dumps({"fps": 30}))
    refuse(folder, r"info\.json: ")
