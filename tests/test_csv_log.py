"""CSV recordings: what is read, and the line that each kind of bad file gets."""

import hashlib
from pathlib import Path

import hydra
import numpy as np
import pytest
from omegaconf import OmegaConf

from frictionzoo.errors import ConfigError, LogError
from frictionzoo.logs.csv import CsvLogs

COLUMNS = {"time": "time", "qpos": ["qpos"], "qvel": ["qvel"], "ctrl": ["ctrl"]}
SPLIT = {"test_share": 0.4, "gap": 0.1}


def table(samples: int = 20, offset: float = 0.0) -> str:
    """A CSV text at 100 samples/s with an exact value in every cell."""
    rows = [f"{i / 100},{offset + i / 8},{-i / 4},{i}" for i in range(samples)]
    return "\n".join(["time,qpos,qvel,ctrl", *rows]) + "\n"


def load(tmp_path, text, columns=COLUMNS):
    """Load one file, split by time, and give its train log."""
    path = tmp_path / "a.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return CsvLogs("mine", [str(path)], [], columns, SPLIT, payload=[], simulated=False).load().train[0]


def test_train_and_test_by_file(tmp_path):
    for name, offset in (("a.csv", 0.0), ("b.csv", 5.0), ("c.csv", 9.0)):
        (tmp_path / name).write_text(table(offset=offset))
    paths = [str(tmp_path / name) for name in ("a.csv", "b.csv", "c.csv")]
    dataset = CsvLogs("mine", paths[:2], paths[2:], COLUMNS, SPLIT, payload=[], simulated=False).load()
    assert dataset.name == "mine"
    assert [log.name for log in dataset.logs] == paths
    assert [log.qpos[0, 0] for log in dataset.logs] == [0.0, 5.0, 9.0]
    log = dataset.train[0]
    np.testing.assert_array_equal(log.qpos[:, 0], np.arange(20) / 8)
    np.testing.assert_array_equal(log.qvel[:, 0], -np.arange(20) / 4)
    np.testing.assert_array_equal(log.ctrl[:, 0], np.arange(20))
    assert log.timestep == pytest.approx(0.01, rel=1e-12)
    assert log.sha256 == hashlib.sha256(table().encode()).hexdigest()
    assert not log.simulated


def test_a_simulator_s_files_are_called_simulated(tmp_path):
    (tmp_path / "a.csv").write_text(table())
    dataset = CsvLogs("mine", [str(tmp_path / "a.csv")], [], COLUMNS, SPLIT, payload=[], simulated=True).load()
    assert all(log.simulated for log in dataset.logs)


def test_the_configuration_reads_files_that_the_user_names(tmp_path):
    (tmp_path / "a.csv").write_text(table(500))
    config = OmegaConf.load(Path(__file__).parent.parent / "conf" / "data" / "csv.yaml")
    dataset = hydra.utils.instantiate(config, train=[str(tmp_path / "a.csv")]).load()
    assert (dataset.name, dataset.train[0].samples, dataset.test[0].samples) == ("csv", 300, 100)
    with pytest.raises(LogError, match=r"data\.train=\[\]: no recording"):
        hydra.utils.instantiate(config).load()


def test_one_file_is_split_by_time(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(table(100))
    dataset = CsvLogs("mine", [str(path)], [], COLUMNS, SPLIT, payload=[], simulated=False).load()
    assert (dataset.train[0].samples, dataset.test[0].samples) == (50, 40)
    assert dataset.test[0].name.endswith("a.csv[test]")


def test_columns_are_found_by_name_and_others_may_hold_anything(tmp_path):
    text = "note, u ,p2,p1,t,w1,w2\n" + "".join(f'"a, b",{i},{i + 2},{i + 1},{i / 10},3,4\r\n' for i in range(9))
    columns = {"time": "t", "qpos": ["p1", "p2"], "qvel": ["w1", "w2"], "ctrl": ["u"]}
    log = load(tmp_path, b"\xef\xbb\xbf" + text.encode(), columns)  # with the byte-order mark that spreadsheets write
    np.testing.assert_array_equal(log.qpos[1], [2, 3])
    np.testing.assert_array_equal(log.qvel[1], [3, 4])
    assert log.ctrl.shape[1] == 1


BAD = {
    "empty": ("", r"a\.csv: no column time; none is available"),
    "header-only": ("time,qpos,qvel,ctrl\n", r"a\.csv: a header and no samples"),
    "missing-column": (
        table().replace("qvel", "qvle"),
        r"a\.csv: no column qvel; did you mean qvle\? \(expected one of ctrl, qpos, qvle, time\)",
    ),
    "double-column": (table().replace("ctrl", "qpos"), r"a\.csv: 2 columns qpos, expected one"),
    "text-cell": (table().replace("0.03,0.375", "0.03,n/a"), r"a\.csv, line 5: qpos is 'n/a', expected a number"),
    "short-row": (table().replace(",-0.75,3\n", "\n"), r"a\.csv, line 5: 2 cells, expected 4"),
    "nan": (
        table().replace("0.03,0.375", "0.03,nan"),
        r"qpos is NaN or infinite in 1 of 20 samples, first at sample 3",
    ),
    "infinite": (table().replace(",-0.75,3\n", ",-inf,3\n"), r"qvel is NaN or infinite in 1 of 20 samples"),
    "backwards": (table().replace("\n0.05,", "\n0.01,"), r"time runs backwards at sample 5"),
    "repeats": (table().replace("\n0.05,", "\n0.04,"), r"time repeats at sample 5"),
    "uneven": (table().replace("\n0.05,", "\n0.055,"), r"0\.015 s between samples 4 and 5, expected 0\.01 s"),
    "one-sample": (table(1), r"1 samples, expected at least 2"),
    "not-utf8": (b"time,qpos\xff,qvel,ctrl\n", r"a\.csv: byte 9 is not UTF-8 text"),
    "zero-byte": (b"time\0,qpos,qvel,ctrl\n", r"a\.csv: holds a zero byte"),
    "open-quote": ('time,qpos,qvel,ctrl\n0,"0', r"a\.csv, line 2: not a CSV table"),
}


@pytest.mark.parametrize(("text", "line"), BAD.values(), ids=BAD)
def test_a_bad_file_gets_one_line(tmp_path, text, line):
    with pytest.raises(LogError, match=line) as caught:
        load(tmp_path, text)
    assert "\n" not in str(caught.value)


def test_a_missing_file_and_a_folder(tmp_path):
    with pytest.raises(LogError, match=r"nowhere\.csv: no such file"):
        CsvLogs("mine", [str(tmp_path / "nowhere.csv")], [], COLUMNS, SPLIT, payload=[], simulated=False).load()
    with pytest.raises(LogError, match=r"cannot be read \(Is a directory\)"):
        CsvLogs("mine", [str(tmp_path)], [], COLUMNS, SPLIT, payload=[], simulated=False).load()


def test_a_file_cannot_be_in_both_parts(tmp_path):
    with pytest.raises(LogError, match=r"a\.csv: in data\.train and in data\.test"):
        CsvLogs("mine", ["a.csv"], ["a.csv"], COLUMNS, SPLIT, payload=[], simulated=False).load()


def test_no_file_is_named():
    with pytest.raises(LogError, match=r"data\.train=\[\]: no recording"):
        CsvLogs("mine", [], [], COLUMNS, SPLIT, payload=[], simulated=False).load()


@pytest.mark.parametrize(
    ("columns", "line"),
    [
        ({**COLUMNS, "qvle": ["a"]}, r"data\.columns\.qvle: unknown signal; did you mean qvel"),
        ({k: v for k, v in COLUMNS.items() if k != "ctrl"}, r"data\.columns\.ctrl: missing"),
        ({**COLUMNS, "qpos": []}, r"data\.columns\.qpos=\[\]: expected headers"),
        ({**COLUMNS, "time": ["a", "b"]}, r"data\.columns\.time=.*expected one header"),
        ({**COLUMNS, "qpos": 3}, r"data\.columns\.qpos=3: expected a list of names"),
    ],
    ids=["unknown", "missing", "empty", "two-times", "number"],
)
def test_columns_that_make_no_sense(columns, line):
    with pytest.raises(ConfigError, match=line):
        CsvLogs("mine", ["a.csv"], [], columns, SPLIT, payload=[], simulated=False)
