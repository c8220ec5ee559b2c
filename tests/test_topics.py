"""Topics with times of their own, in one table over the union of all times or in several files."""

import json
import logging
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from helpers.write_logs import EPOCH, command, joint_state, write_csv, write_messages
from omegaconf import OmegaConf
from rosbags.rosbag2 import StoragePlugin

import frictionzoo as fz
from frictionzoo.core.config import check_overrides, compose_config
from frictionzoo.core.errors import ConfigError, LogError
from frictionzoo.core.log import Log
from frictionzoo.data.files import Files
from frictionzoo.data.recording import Table
from frictionzoo.data.topics import is_sparse, separate

STATE, COMMAND = ("/js/position[knee]", "/js/velocity[knee]"), "/u/data[0]"
Topics = dict[str, tuple[np.ndarray, dict[str, np.ndarray]]]
"""Times [s] and columns of each topic."""


def topics(state: float, command: float, jitter: float, seed: int = 0) -> Topics:
    """A joint that moves and its command, with rates in Hz, over 4 s; a joint state comes first."""
    rng = np.random.default_rng(seed)

    def times(rate: float, start: float) -> np.ndarray:
        even = np.arange(round(4 * rate)) / rate
        return start + np.round(even + jitter / rate * rng.uniform(-0.4, 0.4, len(even)), 6) - jitter

    at, of = times(state, 0.0), times(command, 3e-4)
    state_columns = dict(zip(STATE, (np.sin(3 * at), 3 * np.cos(3 * at)), strict=True))
    return {"/js": (at - min(at), state_columns), "/u": (of - min(at), {COMMAND: np.sin(3 * of + 0.2)})}


def unite(of: Topics) -> dict[str, np.ndarray]:
    """The table over the union of all times, with NaN where a topic has no sample."""
    union = np.unique(np.concatenate([times for times, _ in of.values()]))
    table = {"__time": union}
    for times, columns in of.values():
        for header, values in columns.items():
            table[header] = np.full(len(union), np.nan)
            table[header][np.searchsorted(union, times)] = values
    return table


def write_union(path: Path, table: dict[str, np.ndarray]) -> Path:
    if path.suffix == ".parquet":
        pyarrow.parquet.write_table(pa.table(table), path)
        return path
    rows = ["" if np.isnan(x) else repr(x) for x in np.stack([*table.values()], axis=1).ravel().tolist()]
    lines = [",".join(rows[i : i + len(table)]) for i in range(0, len(rows), len(table))]
    path.write_text("\n".join([",".join(f'"{header}"' for header in table), *lines]))
    return path


def write_two(folder: Path, of: Topics) -> dict[str, str]:
    """A file per topic, with plain headers."""
    (at, state), (then, commands) = of.values()
    write_csv(folder / "a.csv", {"stamp": at, "position": state[STATE[0]], "velocity": state[STATE[1]]})
    write_csv(folder / "b.csv", {"t": then, "position": commands[COMMAND]})
    return {"state": str(folder / "a.csv"), "command": str(folder / "b.csv")}


def write_ros(folder: Path, of: Topics) -> Path:
    (at, state), (then, commands) = of.values()
    nanoseconds = (EPOCH + np.round(times * 1e9).astype(int) for times in (at, then))
    states, sent = (list(map(int, times)) for times in nanoseconds)
    messages = [("/js", joint_state(t, q, v), t) for t, q, v in zip(states, *state.values(), strict=True)]
    messages += [("/u", command(u), t) for t, u in zip(sent, commands[COMMAND], strict=True)]
    return write_messages(folder, sorted(messages, key=lambda message: message[2]), StoragePlugin.MCAP)


def load(*train: object, **options: object) -> Log:
    (log,) = Files(train=train, **options).for_joints(["knee"]).read()
    return log


RATES = {
    **{"fast-state": (200, 20, 0), "same": (50, 50, 0), "fast-command": (50, 200, 0), "rare": (100, 2, 0)},
    **{"same-jitter": (50, 50, 0.5), "odd-jitter": (50, 30, 0.5)},
}


@pytest.mark.parametrize(("state", "sent", "jitter"), RATES.values(), ids=RATES)
def test_a_table_over_the_union_of_times_is_read_as_a_bag(tmp_path, state, sent, jitter):
    of = topics(state, sent, jitter)
    bag = load(str(write_ros(tmp_path / "bag", of)))
    logs = [load(str(write_union(tmp_path / name, unite(of)))) for name in ("a.csv", "a.parquet")]
    logs.append(load(write_two(tmp_path, of)))
    for log in logs:
        assert log.repairs == bag.repairs and any(note.startswith("ctrl held from") for note in log.repairs)
        for signal in ("time", "qpos", "qvel", "ctrl"):
            np.testing.assert_allclose(getattr(log, signal), getattr(bag, signal), rtol=0, atol=1e-6)


def test_a_table_in_memory_and_further_topics(tmp_path):
    of = topics(100, 100, 0)
    slow = np.arange(0.0051, 4, 0.5)
    of["/t"] = (
        slow,
        {"temperature": 20 + slow, "/js/effort[knee]": np.ones(len(slow)), "empty": np.full(len(slow), np.nan)},
    )
    table = unite(of)
    (log,) = fz.read(table, columns={"temperature": "temperature"})
    assert "temperature interpolated linearly from 8 samples to the 400 times of qpos" in log.repairs
    assert log.samples == 400
    np.testing.assert_allclose(log.extras["temperature"][2:350, 0], 20 + log.time[2:350], atol=1e-9)


def test_a_log_with_missing_samples_is_no_union():
    rng = np.random.default_rng(5)
    time, rare = np.arange(1000) / 100, np.full(1000, np.nan)
    rare[::50] = 1
    columns = {"time": time, "qpos": np.sin(time), "ctrl": np.cos(time), "note": rare}
    for missing in (rng.choice(1000, 100, replace=False), np.arange(300, 500), np.arange(900, 1000)):
        for signal in ("qpos", "ctrl"):
            values = columns[signal].copy()
            values[missing] = np.nan
            table = Table("a", {**columns, signal: values})
            assert not is_sparse(values) and is_sparse(rare)
            assert separate(table, {"time": ("time",), "qpos": ("qpos",), "ctrl": ("ctrl",)}) is table


def test_gaps_of_the_positions_stay_gaps(tmp_path):
    table = unite(topics(100, 30, 0))
    kept = ~((table["__time"] > 1) & (table["__time"] < 2) & np.isfinite(table[STATE[0]]))
    path = write_union(tmp_path / "a.csv", {header: values[kept] for header, values in table.items()})
    logs = list(Files(train=[str(path)]).for_joints(["knee"]).read())
    assert [round(log.samples / 100) for log in logs] == [1, 2]


def test_two_files_take_their_times_by_name_or_by_option(tmp_path):
    files = write_two(tmp_path, topics(200, 50, 0))
    known = load(files)
    assert known.columns["ctrl"].headers == ("command/position",) and len(known.sha256) == 64
    columns = {"qpos": "state/position", "qvel": "state/velocity", "ctrl": "command/position"}
    for time in (["stamp", "t"], ["state/stamp", "command/t"], ["command/t"], None):
        log = load(files, columns={**columns, "time": time})
        for signal in ("time", "qpos", "qvel", "ctrl"):
            np.testing.assert_array_equal(getattr(log, signal), getattr(known, signal))
    (log,) = fz.read({key: Path(path) for key, path in files.items()})
    assert log.sha256 == known.sha256 and log.name == f"{tmp_path / 'a.csv'} + {tmp_path / 'b.csv'}"


def test_patterns_pair_the_files_of_several_recordings(tmp_path):
    for number, seed in enumerate((3, 4)):
        (tmp_path / str(number)).mkdir()
        write_two(tmp_path / str(number), topics(100, 20, 0.5, seed))
    train = [{"state": f"{tmp_path}/*/a.csv", "command": f"{tmp_path}/*/b.csv"}]
    names = [recording.name for recording in Files(train=train).recordings()]
    assert names == [f"{tmp_path}/{n}/a.csv + {tmp_path}/{n}/b.csv" for n in (0, 1)]
    (tmp_path / "1" / "b.csv").unlink()
    with pytest.raises(LogError, match="2 of state, 1 of command, expected as many"):
        Files(train=train).find()


def test_files_without_a_time_or_of_other_clocks_are_refused(tmp_path):
    of = topics(100, 20, 0)
    files = write_two(tmp_path, of)
    times, commands = of["/u"]
    for shifted in (times + 1.7e9, times * 1e3, times - 3.99):
        write_csv(tmp_path / "b.csv", {"t": shifted, "position": commands[COMMAND]})
        with pytest.raises(LogError, match=r"state/stamp from 0 .* command/t from .*one clock"):
            load(files)
    write_csv(tmp_path / "b.csv", {"x": times, "position": commands[COMMAND]})
    with pytest.raises(LogError, match=r"b\.csv: no time column among x, position.*data\.columns\.time=command/"):
        load(files)
    assert load(files, columns={"time": "command/x"}).samples == 400


@pytest.mark.parametrize(
    "entry", [3, "", {}, {"state": "a.csv"}, {"state": "a.csv", "command": 3}, {"": "a.csv", "b": "b.csv"}, ["a.csv"]]
)
def test_entries_that_are_neither_paths_nor_files_are_refused(entry):
    with pytest.raises(ConfigError, match=r"data\.train"):
        Files(train=[entry])


def test_the_command_line_takes_several_files(tmp_path, caplog):
    files = write_two(tmp_path, topics(100, 20, 0))
    option = f"data.train=[{{state: {files['state']}, command: {files['command']}}}]"
    config = compose_config("data=files", option)
    check_overrides(config, compose_config("data=files"))
    with caplog.at_level(logging.INFO):
        source = Files(train=OmegaConf.to_container(config.data.train))
        (recording,) = source.recordings()
    assert "ctrl held from 80 samples to the 400 times of qpos" in caplog.text
    assert recording.signals["ctrl"].shape == (400, 1)
    assert json.loads(json.dumps(source.read().section))["train"] == [files]
