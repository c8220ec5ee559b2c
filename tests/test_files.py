"""Files as a data set: which are read, what they are told apart by, what they carried, and what tests."""

import hashlib
import json
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from conftest import DATA, needs_data
from omegaconf import DictConfig, OmegaConf

from frictionzoo.core.build import build
from frictionzoo.core.config import compose_config
from frictionzoo.core.errors import ConfigError, LogError
from frictionzoo.data.files import Files
from frictionzoo.data.units import UNITS as SI
from frictionzoo.data.units import ratio, to_si

Make = Callable[..., Files]
NAMES = ("a.csv", "b.csv", "c.csv")
LETTER = r"(?P<letter>[abc])\.csv"
COLUMNS = "data.columns={time: time, qpos: [qpos], qvel: [qvel], ctrl: [ctrl]}"
UNITS = "data.units={time: s, qpos: rad, qvel: rad/s, ctrl: rad}"


def table(samples: int = 20, offset: float = 0.0) -> str:
    """A CSV text at 100 samples/s with an exact value in every cell."""
    rows = [f"{i / 100},{offset + i / 8},{-i / 4},{i}" for i in range(samples)]
    return "\n".join(["time,qpos,qvel,ctrl", *rows]) + "\n"


@pytest.fixture(scope="module")
def plain() -> DictConfig:
    """The configuration of a user's own files."""
    config = compose_config("data=files")
    OmegaConf.set_struct(config, False)
    return config


@pytest.fixture
def files(plain: DictConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Make:
    """The data set of these overrides, in a folder that holds a.csv, b.csv and c.csv."""
    monkeypatch.chdir(tmp_path)
    for place, name in enumerate(NAMES):
        (tmp_path / name).write_text(table(100, 5.0 * place))

    def files(*options: str, **more: Any) -> Files:
        config = OmegaConf.merge(plain, OmegaConf.from_dotlist([COLUMNS, UNITS, "data.split.gap=0", *options]))
        return build({**section_of(config), **more})

    return files


def section_of(config: Any) -> dict[str, Any]:
    return cast(dict[str, Any], OmegaConf.to_container(config, resolve=True))["data"]


def names(logs: Any) -> list[str]:
    return [log.name for log in logs]


def test_train_and_test_by_file(files: Make) -> None:
    dataset = files("data.train=[a.csv,b.csv]", "data.test=[c.csv]").load()
    assert (dataset.name, names(dataset.train), names(dataset.test)) == ("files", ["a.csv", "b.csv"], ["c.csv"])
    assert [log.qpos[0, 0] for log in dataset.logs] == [0.0, 5.0, 10.0]
    log = dataset.train[0]
    np.testing.assert_allclose(log.qpos[:, 0], np.arange(100) / 8, atol=1e-12)
    np.testing.assert_allclose(log.qvel[:, 0], -np.arange(100) / 4, atol=1e-12)
    np.testing.assert_allclose(log.ctrl[:, 0], np.arange(100), atol=1e-12)
    assert log.timestep == pytest.approx(0.01, rel=1e-12)
    assert log.sha256 == hashlib.sha256(table(100).encode()).hexdigest()
    assert not log.simulated


def test_recordings_come_raw_and_in_order(files: Make) -> None:
    recordings = files("data.train=[c.csv,a.csv]", "data.test=b.csv").recordings()
    assert names(recordings) == ["c.csv", "a.csv", "b.csv"]
    np.testing.assert_array_equal(recordings[1].signals["qpos"][:, 0], np.arange(100) / 8)
    (turned,) = files("data.train=a.csv", "data.sign.qpos=-1").recordings()
    np.testing.assert_array_equal(turned.signals["qpos"], -recordings[1].signals["qpos"])
    np.testing.assert_array_equal(turned.signals["ctrl"], recordings[1].signals["ctrl"])


def test_one_file_is_split_by_time(files: Make, tmp_path: Path) -> None:
    options = ("data.train=a.csv", "data.split.test_share=0.4", "data.split.gap=0.1", f"data.folder={tmp_path}")
    dataset = files(*options, "data.origin=simulated").load()
    assert (dataset.train[0].samples, dataset.test[0].samples) == (50, 40)
    assert dataset.test[0].name == f"{tmp_path / 'a.csv'}[test]" and all(log.simulated for log in dataset.logs)


def test_globs_folders_and_archives_name_many(files: Make, tmp_path: Path) -> None:
    (tmp_path / "more").mkdir()
    (tmp_path / "more" / "d.csv").write_text(table(100, 15.0))
    entries = [{"timestamp": 0.01 * i, "position": 0.1 * i, "goal_position": 1.0} for i in range(100)]
    with zipfile.ZipFile(tmp_path / "e.zip", "w") as archive:
        for name in ("y.json", "x.json"):
            archive.writestr(name, json.dumps({"kp": 16, "entries": entries}))
    found = {given: names(files(f"data.train={given}").recordings()) for given in ("'[ab].csv'", "more")}
    assert found == {"'[ab].csv'": ["a.csv", "b.csv"], "more": ["more/d.csv"]}
    assert names(files("data.train=e.zip", columns={}, units={}).recordings()) == ["e.zip!x.json", "e.zip!y.json"]
    assert names(files("data.train='**/*.csv'").recordings()) == [*NAMES, "more/d.csv"]
    # A file that two paths lead to is read once.
    assert names(files("data.train=['*.csv',a.csv]").recordings()) == list(NAMES)


def test_fields_come_from_names_and_options(files: Make, tmp_path: Path) -> None:
    (tmp_path / "kp16.csv").write_text(table(100))
    source = files("data.train=kp16.csv", "data.fields={rig: left}", fields_from_name=r"kp(?P<kp>\d+)")
    assert source.recordings()[0].fields == {"kp": 16.0, "rig": "left"}
    with pytest.raises(LogError, match=r"a\.csv: data\.fields_from_name=.* does not match"):
        files("data.train=a.csv", fields_from_name=r"kp(?P<kp>\d+)").recordings()


def test_recordings_are_chosen_by_their_fields(files: Make) -> None:
    for options, kept in {
        ("data.where={letter: [a,c]}",): ["a.csv", "c.csv"],
        ("data.exclude={letter: [a]}",): ["b.csv", "c.csv"],
        ("data.where={letter: [a,b]}", "data.exclude={letter: [b]}"): ["a.csv"],
    }.items():
        assert names(files("data.train='*.csv'", *options, fields_from_name=LETTER).recordings()) == kept


@pytest.mark.parametrize(
    ("by", "test", "tested"),
    [
        *(("file", "[b.csv]", "b"), ("file", "['[bc].csv']", "bc"), ("file", "0.34", "b")),
        *(("letter", "[a,c]", "ac"), ("letter", "[b]", "b")),
    ],
)
def test_files_and_fields_divide(files: Make, by: str, test: str, tested: str) -> None:
    options = "data.train='*.csv'", f"data.split.by={by}", f"data.split.test={test}"
    dataset = files(*options, fields_from_name=LETTER).load()
    assert names(dataset.test) == [f"{letter}.csv" for letter in tested]
    assert {*names(dataset.train), *names(dataset.test)} == {*NAMES}
    assert [log.metadata["letter"] for log in dataset.test] == [*tested]


REFUSED = {
    "none": (["data.train=[]"], r"data\.train=\[\]"),
    "missing": (["data.train=nowhere.csv"], r"nowhere\.csv: no such file"),
    "no match": (["data.train='*.npz'"], r"\*\.npz: no such file"),
    "both parts": (["data.test=a.csv"], r"a\.csv: in data\.train and in data\.test"),
    "header": (["data.columns.qpos=5.5"], r"data\.columns\.qpos=5"),
    "two rules": (["data.test=b.csv", "data.split.by=file", "data.split.test=[a.csv]"], r"data\.split.*data\.test"),
    "by time": (["data.split.test=[16]"], r"data\.split\.test=\[16\] with by=time"),
    "nothing tests": (["data.split.by=letter"], r"data\.split\.test=\[\] with by=letter"),
    "no field": (["data.split.by=leter", "data.split.test=[a]"], r"field leter; did you mean letter"),
    "no value": (["data.split.by=letter", "data.split.test=[d]"], r"test=d: .* a, b, c"),
    "no file": (["data.split.by=file", "data.split.test=[d.csv]"], r"test=d\.csv"),
    "share": (["data.split.by=file", "data.split.test=1.5"], r"data\.split\.test=1\.5 with by=file"),
    "nothing trains": (["data.split.by=letter", "data.split.test=[a,b,c]"], r"data\.split.* all 3 recordings are test"),
    "where": (["data.where={letter: [d]}"], r"data\.where\.letter=d: .* a, b, c"),
    "where field": (["data.where={lettre: [a]}"], r"data\.where: .*field lettre; did you mean letter"),
    "nothing kept": (["data.exclude={letter: [a,b,c]}"], r"data\.exclude leave none of 3 recordings"),
    "input": (["data.inputs={gain: kp}"], r"a\.csv: data\.inputs\.gain=kp"),
    "text input": (["data.inputs={gain: letter}"], r"a\.csv: data\.inputs\.gain"),
    "nothing left": (["data.clean.shortest=5.0"], r"a\.csv: .* change data\.clean"),
}


@pytest.mark.parametrize(("options", "line"), REFUSED.values(), ids=REFUSED)
def test_a_mistake_gets_one_line(files: Make, options: list[str], line: str) -> None:
    train = ["data.train='[abc].csv'"] if not options[0].startswith("data.train") else []
    with pytest.raises((LogError, ConfigError), match=line) as caught:
        files(*train, *options, fields_from_name=LETTER).load()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"columns": {"qvle": "a"}}, r"data\.columns\.qvle: .*did you mean qvel"),
        ({"units": {"qvle": "a"}}, r"data\.units\.qvle"),
        ({"sign": {"ctrl": 0}}, r"data\.sign\.ctrl=0"),
        ({"sign": {"time": -1}}, r"data\.sign\.time"),
        ({"where": {"kp": 16}}, r"data\.where\.kp=16"),
        ({"where": 3}, r"data\.where=3"),
        ({"train": 3}, r"data\.train=3"),
        ({"fields_from_name": "("}, r"data\.fields_from_name=\("),
        ({"fields_from_name": "kp"}, r"data\.fields_from_name=kp"),
    ],
)
def test_options_that_make_no_sense(plain: DictConfig, options: dict[str, Any], line: str) -> None:
    section = section_of(plain)
    with pytest.raises(ConfigError, match=line):
        build({**section, **options})


def test_inputs_become_constant_signals(files: Make) -> None:
    log = files("data.train=a.csv", "data.fields={kp: 16}", "data.inputs={gain: kp, supply: 12.0}")
    first = log.load().train[0]
    np.testing.assert_array_equal(first.extras["gain"], np.full((first.samples, 1), 16.0))
    np.testing.assert_array_equal(first.extras["supply"], np.full((first.samples, 1), 12.0))


def entry(letter: str, mass: float) -> dict[str, Any]:
    return {"when": {"letter": letter}, "payload": [mass, 0, 0, -0.1, 1e-3, 1e-3, 1e-3]}


def test_a_table_tells_what_was_carried(files: Make) -> None:
    source = files(
        "data.train='*.csv'",
        "data.split.gap=0",
        payload=[entry("a", 1.0), entry("b", 2.0), entry("c", 3.0)],
        fields_from_name=LETTER,
    )
    carried = {log.name: log.payload for log in source.load().test}
    assert [payload.mass for payload in carried.values() if payload] == [1.0, 2.0, 3.0]


@pytest.mark.parametrize(
    ("payload", "line"),
    [
        ([entry("a", 1.0), entry("b", 2.0)], r"c\.csv: no entries of data\.payload"),
        ([entry("a", 1.0), entry("a", 2.0)], r"a\.csv: 2 entries of data\.payload"),
        ([{"when": {"letter": "a"}}], r"data\.payload\[0\]"),
    ],
)
def test_a_table_that_does_not_fit_is_refused(files: Make, payload: list[Any], line: str) -> None:
    with pytest.raises(ConfigError, match=line):
        files("data.train='*.csv'", payload=payload, fields_from_name=LETTER).load()


def test_headers_and_units_are_proposed_once(files: Make, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for name in NAMES:
        (tmp_path / name).write_text(table(100).replace("time,qpos,qvel,ctrl", "t [ms],angle,speed,command"))
    nothing = {"columns": {}, "units": {}}
    with caplog.at_level("INFO", "frictionzoo.data.files"):
        recordings = files("data.train='*.csv'", **nothing).recordings()
    (line,) = (record.getMessage() for record in caplog.records)
    assert "in a.csv: " in line and "data.columns.qpos=[angle]" in line and "data.units.time=ms" in line
    assert recordings[0].time[-1] == pytest.approx(0.99e-3, rel=1e-9)
    caplog.clear()
    # What the options say goes before what is proposed.
    told = {"columns": {"qpos": "speed"}, "units": {"time": "s"}}
    assert files("data.train=a.csv", **told).recordings()[0].signals["qpos"][1, 0] == -0.25
    # Signals that are called by their own names need no line.
    (tmp_path / "plain.csv").write_text(table(100))
    caplog.clear()
    files("data.train=plain.csv", **nothing).recordings()
    assert not caplog.records


def test_what_cleaning_changed_is_said_once(files: Make, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for name in NAMES[:2]:
        (tmp_path / name).write_text(table(100).replace("\n0.05,", "\n0.055,"))
    with caplog.at_level("INFO", "frictionzoo.data.files"):
        dataset = files("data.train='*.csv'").load()
    (line,) = (record.getMessage() for record in caplog.records)
    assert "2 of 3 logs: resampled" in line
    assert [len(log.repairs) for log in dataset.train] == [1, 1, 0]
    np.testing.assert_allclose(np.diff(dataset.train[0].time), 0.01, rtol=1e-9)


@pytest.mark.parametrize("name", ["sts3215", "xl330"])
def test_recordings_that_are_not_there_get_a_line_on_where_to_obtain_them(make, monkeypatch, tmp_path, name):
    monkeypatch.delenv("FRICTIONZOO_DATA", raising=False)
    with pytest.raises(LogError, match=rf"data\.folder=null: .*FRICTIONZOO_DATA.* holds {name}.*https://github\.com"):
        make("data", f"data={name}").load()
    with pytest.raises(LogError, match=rf"{name}.*: no such file; set FRICTIONZOO_DATA.*https://github\.com"):
        make("data", f"data={name}", f"data.folder={tmp_path}").load()


@pytest.fixture(scope="module")
def few_servos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a small part of the recordings of the large bench: of every payload, at kp 8 and 16."""
    folder = tmp_path_factory.mktemp("servos")
    (folder / "sts3215_12v").mkdir()
    with (
        zipfile.ZipFile(Path(str(DATA)) / "sts3215_12v" / "sts3215_12v_raw.zip") as all_of_them,
        zipfile.ZipFile(folder / "sts3215_12v" / "sts3215_12v_raw.zip", "w") as few,
    ):
        taken = set()
        for name in sorted(all_of_them.namelist()):
            with all_of_them.open(name) as member:
                head = dict(re.findall(r'"(\w+)": "?([\w.]+)', member.read(400).decode()))
            kind = head["mass"], head["length"], head["kp"], head["trajectory"]
            if head["trajectory"] in ("brutal", "sin_sin") and head["kp"] in ("8", "16") and kind not in taken:
                few.writestr(name, all_of_them.read(name))
                taken.add(kind)
    return folder


# Inertia about the axis [kg m^2] and torque of gravity [N m] by mass [kg] and arm [m], from the CAD of the bench.
PENDULUMS = {
    **{(0.535, 0.1): (0.006745, 0.5422), (0.535, 0.15): (0.013688, 0.8236), (0.74117693, 0.1): (0.009273, 0.7444)},
    **{(0.74117693, 0.15): (0.018793, 1.1269), (0.969, 0.1): (0.012182, 0.9677), (0.969, 0.15): (0.024550, 1.4619)},
    **{(1.1682, 0.1): (0.014615, 1.1630), (1.1682, 0.15): (0.029472, 1.7549)},
}


@needs_data
def test_the_servos_on_the_large_bench(make: Callable, few_servos: Path) -> None:
    dataset = make("data", "data=sts3215", f"data.folder={few_servos}").load()
    assert {log.metadata["kp"] for log in dataset.train} == {8} and {log.metadata["kp"] for log in dataset.test} == {16}
    assert {log.metadata["trajectory"] for log in dataset.logs} == {"sin_sin"}
    for log in dataset.logs:
        assert log.samples >= 599 and log.timestep == pytest.approx(0.01, rel=1e-9)
        assert (log.extras["gain"] == log.metadata["kp"]).all() and (log.extras["enable"] == 1).all()
        assert ((log.extras["supply"] > 11) & (log.extras["supply"] < 13)).all()
        inertia, gravity = PENDULUMS[log.metadata["mass"], log.metadata["length"]]
        assert log.payload is not None
        depth = -log.payload.position[2]
        # As exact as the numbers in the configuration have digits.
        assert log.payload.inertia[1] + log.payload.mass * depth**2 == pytest.approx(inertia, rel=1e-5)
        assert 9.81 * log.payload.mass * depth == pytest.approx(gravity, rel=1e-5)


@needs_data
def test_the_servo_on_the_small_bench(make: Callable) -> None:
    dataset = make("data", "data=xl330").load()
    assert (len(dataset.train), len(dataset.test)) == (12, 4)
    assert {log.metadata["kp"] for log in dataset.test} == {200}
    assert all(log.samples >= 600 and log.timestep == pytest.approx(0.01, rel=1e-9) for log in dataset.logs)


def test_a_unit_is_worth_what_its_name_says():
    """One of each, in SI units by hand."""
    turn = 6.283185307179586  # rad
    lengths = {"rad": 1, "mrad": 1e-3, "deg": turn / 360, "rev": turn, "m": 1, "mm": 1e-3, "um": 1e-6}
    speeds = {"rad/s": 1, "deg/s": turn / 360, "rev/s": turn, "rpm": turn / 60, "m/s": 1, "mm/s": 1e-3}
    torques = {"N m": 1, "mN m": 1e-3, "N": 1}
    efforts = torques | {"A": 1, "mA": 1e-3, "V": 1, "mV": 1e-3, "%": 0.01, "1": 1}
    worth = {
        **{"time": {"s": 1, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}, "qpos": lengths, "qvel": speeds},
        **{"ctrl": lengths | speeds | efforts, "supply": {"V": 1, "mV": 1e-3}, "enable": {"1": 1}},
        **{"temperature": {"degC": 1}, "ctrl_velocity": speeds, "ctrl_torque": torques, "torque": torques},
        "kp": {"N m/rad": 1, "N m/deg": 360 / turn, "N/m": 1, "N/mm": 1e3},
        "kd": {"N m s/rad": 1, "N m s/deg": 360 / turn, "N s/m": 1, "N s/mm": 1e3},
    }
    ones = np.ones(1)
    found = {signal: {unit: to_si(ones, ratio(signal, unit)).item() for unit in known} for signal, known in SI.items()}
    assert found == {signal: pytest.approx(values, rel=1e-15) for signal, values in worth.items()}
