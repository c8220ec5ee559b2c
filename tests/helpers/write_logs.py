"""One recording in every format that is read, for the tests of them."""

import csv
import dataclasses
import json
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import scipy.io
import torch
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

Columns = Mapping[str, np.ndarray]
EPOCH = 1_700_000_000 * 10**9  # ns, in November 2023
STORE = get_typestore(Stores.LATEST)
STORE_1 = get_typestore(Stores.ROS1_NOETIC)
JOINT_STATE, COMMAND = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"


def signals(samples: int = 50) -> dict[str, np.ndarray]:
    """A recording at 100 samples/s whose values use every bit of a double."""
    noise = np.random.default_rng(7)
    return {
        "time": np.arange(samples) / 100,
        "qpos": noise.normal(size=samples),
        "qvel": noise.normal(size=samples),
        "ctrl": noise.normal(size=samples),
    }


def write_csv(path: Path, columns: Columns) -> Path:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(np.stack(list(columns.values()), axis=1).tolist())
    return path


def write_parquet(path: Path, columns: Columns) -> Path:
    pyarrow.parquet.write_table(pa.table(dict(columns)), path)
    return path


def write_npz(path: Path, columns: Columns) -> Path:
    with path.open("wb") as file:
        np.savez(file, allow_pickle=False, **columns)
    return path


def write_pt(path: Path, columns: Columns) -> Path:
    torch.save({name: torch.from_numpy(values) for name, values in columns.items()}, path)
    return path


def write_mat(path: Path, columns: Columns) -> Path:
    scipy.io.savemat(path, dict(columns), do_compression=True)
    return path


def write_bam(path: Path, columns: Columns) -> Path:
    names = ("timestamp", "position", "speed", "goal_position")
    entries = [dict(zip(names, row, strict=True)) for row in zip(*(v.tolist() for v in columns.values()), strict=True)]
    path.write_text(json.dumps({"mass": 0.5, "motor": "xl330", "entries": entries}))
    return path


def write_messages(
    folder: Path,
    messages: Iterable[tuple[str, Any, int]],
    plugin: StoragePlugin,
    compress: bool = False,
    store: Typestore = STORE,
) -> Path:
    """A rosbag2 folder of (topic, message, time of reception [ns])."""
    bag = Writer(folder, version=9, storage_plugin=plugin)
    if compress:
        bag.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    return _fill(bag, messages, store, store.serialize_cdr, folder)


def _fill(
    bag: Writer | Writer1, messages: Iterable[tuple[str, Any, int]], store: Typestore, encode: Callable, path: Path
) -> Path:
    with bag:
        known: dict[str, Any] = {}
        for topic, message, received in messages:
            kind = message.__msgtype__
            if topic not in known:
                known[topic] = bag.add_connection(topic, kind, typestore=store)
            bag.write(known[topic], received, encode(message, kind))
    return path


def write_ros1(
    path: Path, messages: Iterable[tuple[str, Any, int]], compression: str = "", store: Typestore = STORE_1
) -> Path:
    """A bag of ROS 1 of (topic, message, time of reception [ns])."""
    bag = Writer1(path)
    if compression:
        bag.set_compression(Writer1.CompressionFormat[compression])
    return _fill(bag, messages, store, store.serialize_ros1, path)


def write_bag(folder: Path, columns: Columns, plugin: StoragePlugin, compress: bool = False) -> Path:
    """Joint states stamped by their headers, received later; commands without a header."""
    return write_messages(folder, _list_messages(columns), plugin, compress)


def write_bag_1(path: Path, columns: Columns) -> Path:
    return write_ros1(path, ((topic, _to_ros1(message), at) for topic, message, at in _list_messages(columns)))


def _to_ros1(message: Any) -> Any:
    header = getattr(message, "header", None)
    if header is None:
        return message
    kind = STORE_1.types["std_msgs/msg/Header"]
    return dataclasses.replace(message, header=kind(seq=0, stamp=header.stamp, frame_id=header.frame_id))


def _list_messages(columns: Columns) -> list[tuple[str, Any, int]]:
    rows = [(EPOCH + round(time * 1e9), *row) for time, *row in zip(*columns.values(), strict=True)]
    states = [("/joint_states", joint_state(now, q, v), now + 1_234_567) for now, q, v, _ in rows]
    commands = [("/command", command(u), now) for now, _, _, u in rows]
    return [message for pair in zip(states, commands, strict=True) for message in pair]


def joint_state(stamp: int, qpos: float, qvel: float, name: str = "knee"):
    """The state of one joint; a stamp of 0 is none."""
    return joint_states(stamp, {name: qpos}, {name: qvel}, {})


def joint_states(stamp: int, qpos: Mapping[str, float], qvel: Mapping[str, float], effort: Mapping[str, float]):
    types = STORE.types
    time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    numbers = (np.array([*values.values()], dtype=float) for values in (qpos, qvel, effort))
    return types[JOINT_STATE](types["std_msgs/msg/Header"](stamp=time, frame_id=""), [*qpos], *numbers)


def command(value: float):
    layout = STORE.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    return STORE.types[COMMAND](layout=layout, data=np.array([value], dtype=float))


def write_sqlite_bag(path: Path, columns: Columns) -> Path:
    return write_bag(path, columns, StoragePlugin.SQLITE3)


def write_mcap(path: Path, columns: Columns) -> Path:
    """A single MCAP file, with the checksums that ROS writes and rosbags leaves out."""
    folder = write_bag(path.with_suffix(".folder"), columns, StoragePlugin.MCAP)
    (file,) = folder.glob("*.mcap")
    content, place = bytearray(file.read_bytes()), 8
    while place < len(content) - 8:
        kind, size = struct.unpack_from("<BQ", content, place)
        if kind == 6:  # a chunk, which is not compressed
            struct.pack_into("<I", content, place + 33, zlib.crc32(content[place + 49 : place + 9 + size]))
        place += 9 + size
    (summary,) = struct.unpack_from("<Q", content, len(content) - 28)
    struct.pack_into("<I", content, len(content) - 12, zlib.crc32(content[summary:-12]))
    path.write_bytes(content)
    return path


def write_lerobot(folder: Path, columns: Columns) -> Path:
    """Two episodes of the recording in one file, in single precision as LeRobot keeps it."""
    time, qpos, qvel, ctrl = (np.concatenate([values, values]) for values in columns.values())
    features = {"observation.state": {"knee.pos": qpos, "knee.vel": qvel}, "action": {"knee.pos": ctrl}}
    names = {"action": {"motors": ["knee.pos"]}}
    return _write_lerobot(folder, time, np.repeat([0, 1], len(columns["time"])), features, names)


def _write_lerobot(
    folder: Path, time: np.ndarray, episode: np.ndarray, features: Mapping[str, Columns], names: Mapping[str, object]
) -> Path:
    table: dict[str, object] = {"timestamp": time.astype(np.float32), "episode_index": episode}
    described = {}
    for feature, entries in features.items():
        values = np.stack([*entries.values()], axis=1).astype(np.float32)
        table[feature] = pa.array(values.tolist(), pa.list_(pa.float32()))
        listed = names.get(feature, [*entries])
        described[feature] = {"dtype": "float32", "shape": [len(entries)], "names": listed}
    file = folder / "data" / "chunk-000" / "file-000.parquet"
    file.parent.mkdir(parents=True)
    pyarrow.parquet.write_table(pa.table(table), file)
    (folder / "meta").mkdir()
    info = {"codebase_version": "v3.0", "fps": 100, "features": described}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    return folder


def write_robot_bag(
    path: Path, messages: Sequence[tuple[int, Mapping[str, Mapping[str, float]], Mapping[str, float]]], storage: str
) -> Path:
    """A recording of several joints: each message has its time [ns], states by signal and name, and commands by name.

    A folder of SQLite for `ros2bag`, a single file for `mcap`.
    """
    sent = []
    for now, state, commands in messages:
        sent.append(("/joint_states", joint_states(now, state["qpos"], state["qvel"], state["torque"]), now))
        sent.append(("/cmd", joint_states(now, commands, {}, {}), now))
    write_messages(path, sent, StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3)
    return path if storage == "ros2bag" else next(path.glob("*.mcap"))


def write_robot_lerobot(folder: Path, time: np.ndarray, features: Mapping[str, Columns], nested: bool = False) -> Path:
    """One episode of features whose entries have these names, as a list or as a list in a list."""
    names = {feature: [[*entries]] for feature, entries in features.items()} if nested else {}
    return _write_lerobot(folder, time, np.zeros(len(time), int), features, names)


def write_degrees(path: Path, columns: Columns) -> Path:
    """The recording as a CSV file in the units of a workshop."""
    scales = {"time_ms": 1e3, "angle": 180 / np.pi, "speed": 30 / np.pi, "goal": 180 / np.pi}
    return write_csv(path, {h: f * v for (h, f), v in zip(scales.items(), columns.values(), strict=True)})


def write_ticks(path: Path, columns: Columns) -> Path:
    """The recording as a CSV file of a servo's raw registers, with sign bits."""
    step = 2 * np.pi / 4096
    headers = ("timestamp", "present_position", "present_speed", "goal_position")
    time, *angles = (columns[name] for name in ("time", "qpos", "qvel", "ctrl"))
    ticks = [np.round(angle / step) + zero for angle, zero in zip(angles, (2048, 0, 2048), strict=True)]
    coded = [time, *(np.where(values < 0, 2**15 - values, values) for values in ticks)]
    return write_csv(path, dict(zip(headers, coded, strict=True)))


def write_zip(path: Path, columns: Columns) -> Path:
    """An archive of one CSV file."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.write(write_csv(path.with_suffix(".inner"), columns), "log.csv")
    path.with_suffix(".inner").unlink()
    return path


WRITERS: dict[str, tuple[str, Callable[[Path, Columns], Path]]] = {
    **{"csv": ("log.csv", write_csv), "parquet": ("log.parquet", write_parquet), "npz": ("log.npz", write_npz)},
    **{"pt": ("log.pt", write_pt), "mat": ("log.mat", write_mat), "bam": ("log.json", write_bam)},
    **{"zip": ("log.zip", write_zip), "mcap": ("log.mcap", write_mcap), "ros2bag": ("bag", write_sqlite_bag)},
    **{"ros1bag": ("log.bag", write_bag_1), "lerobot": ("dataset", write_lerobot)},
}
"""For each format the name of a file or folder, and what writes one."""

ROS_COLUMNS = {
    **{"time": "/joint_states/time", "qpos": "/joint_states/position[knee]", "qvel": "/joint_states/velocity[knee]"},
    "ctrl": "/command/data[0]",
}
OPTIONS: dict[str, dict[str, str]] = {
    **{name: {} for name in ("csv", "parquet", "npz", "pt", "mat", "bam", "zip")},
    **{name: ROS_COLUMNS for name in ("mcap", "ros1bag", "ros2bag")},
    "lerobot": {
        **{"time": "timestamp", "qpos": "observation.state[knee.pos]", "qvel": "observation.state[knee.vel]"},
        "ctrl": "action[knee.pos]",
    },
}
"""For each format the columns that have to be named."""


def write_log(folder: Path, name: str, columns: Columns) -> Path:
    """The recording as a format of that name."""
    file, write = WRITERS[name]
    return write(folder / file, columns)
