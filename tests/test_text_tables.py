"""Text tables as tools write them: separators, decimal commas, lists in cells, comments and missing headers."""

import codecs
from pathlib import Path

import numpy as np
import pytest
from helpers.write_logs import signals

from frictionzoo.core.errors import LogError
from frictionzoo.core.log import Columns
from frictionzoo.data.columns import to_recording
from frictionzoo.data.files import Files
from frictionzoo.data.formats import read_tables
from frictionzoo.data.pairing import arrange
from frictionzoo.data.recording import Table

SEPARATORS = {"comma": ",", "comma-blank": ", ", "tab": "\t", "semicolon": ";", "blank": " ", "blanks": "   "}
HEADERS = {"named": ("time", "qpos", "qvel", "ctrl"), "spelt": ("timestamp", "actual_q_0", "actual_qd_0", "target_q_0")}
COMMAS = "commas in numbers are read as decimal points"
NUMBERED = "no header row: columns are numbered from 0"


def write(
    path: Path,
    columns: dict[str, np.ndarray],
    separator: str = ",",
    decimal: str = ".",
    headers: tuple[str, ...] | None = (),
    before: str = "",
    end: str = "\n",
) -> Path:
    """Write columns as text; `headers` None writes no header row, () the names of the columns."""
    rows = [] if headers is None else [separator.join(headers or columns)]
    rows += [separator.join(repr(x).replace(".", decimal) for x in row) for row in zip(*columns.values(), strict=True)]
    path.write_text(before + end.join(rows) + end, encoding="utf-8", newline="")
    return path


def plain(samples: int = 30) -> dict[str, np.ndarray]:
    """A recording of Python's floats, some of them whole, as at rest."""
    columns = {name: values.copy() for name, values in signals(samples).items()}
    columns["qpos"][:3] = columns["ctrl"][:2] = 0
    return {name: values.astype(object) for name, values in columns.items()}


def read(path: Path) -> Table:
    (table,) = read_tables(str(path), "auto")
    return table


@pytest.mark.parametrize("suffix", [".csv", ".txt", ".tsv", ".dat"])
@pytest.mark.parametrize("separator", SEPARATORS.values(), ids=SEPARATORS)
@pytest.mark.parametrize("headers", HEADERS.values(), ids=HEADERS)
def test_separators_are_recognised(tmp_path, suffix, separator, headers):
    columns = plain()
    table = read(write(tmp_path / f"a{suffix}", columns, separator, headers=headers))
    assert tuple(table.columns) == headers and not table.notes
    for name, values in zip(headers, columns.values(), strict=True):
        np.testing.assert_array_equal(table.columns[name], values.astype(float))


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("separator", ["\t", ";", " "])
@pytest.mark.parametrize("before", ["", "sep=;\r\n", "\n"], ids=["plain", "excel", "empty-line"])
def test_decimal_commas_are_read_and_said(tmp_path, separator, end, before):
    columns = plain()
    table = read(write(tmp_path / "a.csv", columns, separator, ",", before=before, end=end))
    assert table.notes == (COMMAS,)
    recording = to_recording(table, {}, {}, simulated=None)
    assert recording.notes == (COMMAS,)
    np.testing.assert_array_equal(recording.signals["qpos"][:, 0], columns["qpos"].astype(float))


@pytest.mark.parametrize("text", ["1.234,5", "1,234,567", "0,5x"])
def test_commas_that_are_no_decimal_commas_are_refused(tmp_path, text):
    (tmp_path / "a.csv").write_text(f"time;qpos;ctrl\n0;{text};1\n1;2;3\n")
    assert "line 2: qpos" in read(tmp_path / "a.csv").refused["qpos"]
    # Where other numbers have points, a comma may separate thousands.
    (tmp_path / "a.csv").write_text("time;qpos;ctrl\n0.5;1,234;1\n1;2;3\n")
    assert "line 2: qpos" in read(tmp_path / "a.csv").refused["qpos"]


@pytest.mark.parametrize("separator", SEPARATORS.values(), ids=SEPARATORS)
def test_columns_without_a_header_are_numbered(tmp_path, separator):
    columns = plain()
    path = write(tmp_path / "a.csv", columns, separator, headers=None)
    with pytest.raises(LogError, match=rf"data\.columns\.time is missing.* 0, 1, 2, 3 \({NUMBERED}\)"):
        to_recording(read(path), {}, {}, simulated=None)
    named = {"time": 0, "qpos": [1], "qvel": ["2"], "ctrl": 3}
    (recording,) = Files(train=[str(path)], columns=named).recordings()
    assert recording.notes == (NUMBERED,)
    for signal, values in recording.signals.items():
        np.testing.assert_array_equal(values[:, 0], columns[signal].astype(float))


def test_columns_by_number_keep_their_order_whatever_the_joints_are_called():
    columns = {"qpos": Columns(("2", "1"), listed=True), "ctrl": Columns(("4", "3"), listed=True)}
    for joints in (("joint1", "joint2"), ("1", "2"), ("hip", "knee")):
        assert {pairing.order for pairing in arrange("a", columns, joints).values()} == {(0, 1)}


def test_numbers_that_pandas_writes_as_headers_are_headers(tmp_path):
    (tmp_path / "a.csv").write_text(",0,1,2\n0,0.5,1,2\n1,1.5,2,3\n")
    table = read(tmp_path / "a.csv")
    assert table.columns["0"].tolist() == [0.5, 1.5] and not table.notes


@pytest.mark.parametrize(("before", "names"), [("# time qpos qvel ctrl\n", None), ("# made by hand\n", "0123")])
def test_comments_before_a_table(tmp_path, before, names):
    columns = plain()
    table = read(write(tmp_path / "a.txt", columns, " ", headers=None, before=before))
    assert list(table.columns) == list(names or columns) and table.notes == ((NUMBERED,) if names else ())
    table = read(write(tmp_path / "a.txt", columns, ",", before="# a stand\n% 3\n"))
    assert list(table.columns) == list(columns)
    (tmp_path / "a.txt").write_text("# a stand\ntime,qpos,ctrl\n0,x,0\n1,1,1\n")
    assert "line 3" in read(tmp_path / "a.txt").refused["qpos"]


LISTS = {"json": "[{}, {}]", "numpy": "[{} {}]", "wrapped": "[ {}\n {}]", "tuple": "({}, {})", "tight": "[{},{}]"}


@pytest.mark.parametrize("form", LISTS.values(), ids=LISTS)
@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_lists_in_cells_are_several_columns(tmp_path, form, separator):
    rng = np.random.default_rng(3)
    positions, times = rng.normal(size=(20, 2)).tolist(), np.arange(20.0).tolist()
    quote = '"' if separator == "," or "\n" in form else ""
    cells = [f"{quote}{form.format(*pair)}{quote}" for pair in positions]
    cells[4] = ""
    rows = [separator.join(("STATE", repr(time), cell)) for time, cell in zip(times, cells, strict=True)]
    (tmp_path / "a.csv").write_text("\n".join([separator.join(("type", "timestamp", "positions")), *rows]))
    table = read(tmp_path / "a.csv")
    assert set(table.columns) == {"timestamp", "positions[0]", "positions[1]"} and set(table.refused) == {"type"}
    positions[4] = [np.nan] * 2
    np.testing.assert_array_equal(np.stack([table.columns[f"positions[{i}]"] for i in (0, 1)], axis=1), positions)


@pytest.mark.parametrize("cell", ["[1, 2, 3]", "5", "[1, x]", "[1, [2]]", "[1, ... 2]", "[1_0, 2]"])
def test_lists_that_are_no_numbers_of_one_length_are_refused(tmp_path, cell):
    (tmp_path / "a.csv").write_text(f't,q\n0,"[1, 2]"\n1,"{cell}"\n')
    table = read(tmp_path / "a.csv")
    assert list(table.columns) == ["t"] and "q" in table.refused["q"]


def test_tables_that_cannot_be_read_say_what_is_in_the_way(tmp_path):
    for text, line in (
        ("time,qpos,ctrl\n0,5,1,5,2,5\n", r"line 2: 6 cells between commas, expected 3 as in the header"),
        ("0.5;1;2\n0.6;1;2\n0.7;1\n", r"line 3: 2 cells between semicolons, expected 3 as in the first row"),
        ("time qpos\n0|1\n", r"one cell in a row, 'time qpos'"),
        ('time,qpos\n0,"1\n', r"line 2: not a CSV table"),
    ):
        (tmp_path / "a.csv").write_text(text)
        with pytest.raises(LogError, match=line):
            read(tmp_path / "a.csv")


def test_text_of_sixteen_bits_as_spreadsheets_write_it(tmp_path):
    text = "time\tqpos\tctrl\r\n0\t0,5\t1\r\n1\t1,5\t2\r\n"
    for mark, encoding in ((codecs.BOM_UTF16_LE, "utf-16-le"), (codecs.BOM_UTF16_BE, "utf-16-be")):
        (tmp_path / "a.txt").write_bytes(mark + text.encode(encoding))
        assert read(tmp_path / "a.txt").columns["qpos"].tolist() == [0.5, 1.5]


@pytest.mark.parametrize("suffix", [".xlsx", ".ods", ".pkl", ".h5", ".npy", ".bag"])
def test_files_that_are_not_read_say_how_to_convert_them(tmp_path, suffix):
    (tmp_path / f"a{suffix}").write_bytes(b"PK\x03\x04 or anything")
    with pytest.raises(LogError, match=rf"a\{suffix}: (a|HDF5)") as caught:
        read(tmp_path / f"a{suffix}")
    assert "data.format" not in str(caught.value) and "\n" not in str(caught.value)
