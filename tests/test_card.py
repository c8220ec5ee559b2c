"""Cards: a run's drive for those who have neither the run nor its recordings."""

import hashlib
import json
import pickle
import re
import shutil
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from conftest import ROOT, finish
from helpers.fitted import fit as fit_robot
from helpers.robot_texts import LEG

import frictionzoo as fz
from frictionzoo.cli.finished import card as main
from frictionzoo.cli.finished import compare
from frictionzoo.core.anonymous import find_paths, list_paths, without_paths
from frictionzoo.core.described import describe
from frictionzoo.core.errors import ConfigError, FrictionzooError, OutputError, RunError
from frictionzoo.core.jobs import find_runs
from frictionzoo.core.manifest import MANIFEST
from frictionzoo.core.output import RESULT, TEMPLATE
from frictionzoo.report.card import FILES, PAGE, PICTURE, describe_bench, write_card, write_template
from frictionzoo.result.card import hash_record
from frictionzoo.result.read_back import LAW, build_drive

EXACT = 1e-9  # rad, rad/s
LICENCE = {"licence": "cc-by-4.0"}
STATED = {"name": "A <knee> | with a_rod", "supply": "7.4 V", "temperature": "21 °C"}


@pytest.fixture(scope="module")
def run(finished_run: Callable) -> Path:
    return finished_run("coulomb_stribeck")[0]


@pytest.fixture(scope="module")
def card(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A card; it is there to be read."""
    folder = tmp_path_factory.mktemp("cards") / "knee"
    assert write_card(run, LICENCE | STATED | {"output": str(folder)}) == (folder, [])
    return folder


@pytest.fixture
def own(card: Path, tmp_path: Path) -> Path:
    """A copy, to be changed."""
    return shutil.copytree(card, tmp_path / "elsewhere" / "card")


def read(folder: Path) -> dict[str, Any]:
    return json.loads((folder / RESULT).read_text())


def test_it_is_the_run_without_its_recordings(card: Path, run: Path) -> None:
    files = {path.name for path in card.iterdir()}
    assert files == {PAGE, MANIFEST, *FILES} - {"identified.urdf", "bench.xml"}
    record, result, drive = read(card), read(run), fz.load(run)
    for key in ("parameters", "metrics", "covariance", "versions", "evaluation"):
        assert record[key] == result[key], key
    assert [log["sha256"] for log in record["data"]["logs"]] == [log["sha256"] for log in result["data"]["logs"]]
    assert record["card"]["origin"] is None and {*record["card"]["files"]} == files - {PAGE, MANIFEST}
    (visited,) = record["card"]["conditions"]["visited"]
    assert visited["position"] == [drive.segments.qpos.min(), drive.segments.qpos.max()]
    assert visited["speed"] == np.abs(drive.segments.qvel).max()
    assert visited["torque"] == np.abs(drive.samples.motor_torque).max()
    for name in ("identified.xml", LAW):
        assert (card / name).read_bytes() == (run / name).read_bytes()
    assert (card / PICTURE).read_bytes().startswith(b"\x89PNG")
    curves = fz.load(card).curves
    np.testing.assert_array_equal(curves.friction, drive.curves.friction)
    assert not any(len(array) for array in (curves.measured_qpos, curves.signals.ctrl, curves.left, curves.train_mae))


def test_its_page_has_what_hubs_read_and_every_value(card: Path, run: Path) -> None:
    _, head, page = (card / PAGE).read_text().split("---\n", 2)
    assert yaml.safe_load(head) == {
        "license": "cc-by-4.0",
        "library_name": "frictionzoo",
        "tags": ["robotics", "friction", "system-identification", "mujoco", "coulomb_stribeck"],
    }
    result = read(run)
    for row in result["parameters"]:
        (line,) = re.findall(rf"^\| {row['owner']}\.{row['name']} .*$", page, re.M)
        assert f"| {row['value']:.4g} |" in line and f"| {row['unit']} |" in line
        assert not row["interval"] or f"{row['interval'][0]:.4g} to {row['interval'][1]:.4g}" in line
    for part in ("test", "baseline"):
        assert f"| {result['metrics'][part]['position_mae']:.4g} |" in page
    assert all(f"`{log['sha256']}`" in page for log in result["data"]["logs"])
    assert "torque = (f_k + (f_s - f_k) exp(-(v / v_s)^2)) tanh(v / v_0) + d v" in page
    assert page.startswith("\n# A \\<knee\\> \\| with a\\_rod\n")
    assert "- supply: 7.4 V\n" in page and "- payload: not stated\n" in page
    assert "identified by frictionzoo" in page and f"![Friction torque over velocity]({PICTURE})" in page
    assert re.search(r"^frictionzoo model=coulomb_stribeck fit=lm .*'?data\.train=\[knee\.csv\]'? ", page, re.M)


def test_it_names_no_path_of_the_machine(card, run, recording, tmp_path, monkeypatch):
    monkeypatch.chdir(run.parent)
    relative, _ = write_card(Path(run.name), LICENCE | STATED | {"output": str(tmp_path / "card")})
    assert (relative / PAGE).read_text() == (card / PAGE).read_text()
    for path in [*card.iterdir(), *relative.iterdir()]:
        if path.suffix in (".json", ".md", ".xml", ".safetensors"):
            text = path.read_bytes().decode(errors="replace")
            assert not [part for part in recording.parts[1:-1] if f"{part}/" in text or f"/{part}" in text], path
            assert str(run) not in text and str(Path.home()) + "/" not in text, path


PATHS = {
    "bench": {"mjcf": "/home/me/a b/c.xml", "joint": ["/leg/knee", r"C:\x", "~/a", "/home/me/knee"]},
    "data": {"train": ["/home/me/*.csv", r"C:\Users\me\a.csv", "~/logs/a.csv"], "columns": {"qpos": "/joint_states"}},
    "other": {"place": str(Path(__file__)), "topic": "/not/there"},
}


def test_paths_are_found_by_the_option_that_they_are() -> None:
    expected = {PATHS["bench"]["mjcf"], *PATHS["data"]["train"], PATHS["other"]["place"]}
    assert set(list_paths(PATHS)) == expected


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("/home/me/a b/c.xml", "c.xml"),
        ("data.train=[/home/me/a.csv,/home/me/b.csv]", "data.train=[a.csv,b.csv]"),
        ("look at '/home/me/a b/c.xml': gaps", "look at 'c.xml': gaps"),
        ("look at '/home/me/a b/mesh.stl': gaps", "look at 'mesh.stl': gaps"),
        (r"C:\Users\me\a.csv is late", "a.csv is late"),
        ("~/logs/a.csv", "a.csv"),
        (f"{Path.home()}/x/y.csv", "y.csv"),
        *[(kept, kept) for kept in ("N m s/rad", "0.5 N m / 3", "https://a.org/b", "logs/a.csv", "a: 1/2 or 3/(4 s)")],
        *[(kept, kept) for kept in PATHS["bench"]["joint"]],
        ("bench.armature//home/me/knee: no", "bench.armature//home/me/knee: no"),
        ("joint /leg/knee of /home/me/a b/c.xml", "joint /leg/knee of c.xml"),
        ("/home/men/a.csv", "/home/men/a.csv"),
    ],
)
def test_paths_become_names(text: str, expected: str) -> None:
    shortened = without_paths({text: [text, 1.0, None]}, set(list_paths(PATHS)), PATHS["bench"]["joint"])
    assert shortened == {expected: [expected, 1.0, None]}


def test_paths_in_a_robot_s_file_are_told() -> None:
    text = (
        '<!-- of /home/me --><a><compiler meshdir="/opt/a b"/><!-- of /leg/knee --><joint name="/leg/knee"/>\n'
        '<motor joint="/leg/knee"/><mesh file="b.stl"/></a><!-- N m/rad -->'
    )
    assert find_paths(text.encode()) == ["/home/me", "/opt/a"]


@pytest.mark.parametrize(
    "name",
    ["mujoco_default", "coulomb_stribeck", "neural_friction", pytest.param("actuator_lstm", marks=pytest.mark.slow)],
)
def test_it_moves_as_the_run_did_wherever_it_lies(finished_run: Callable, tmp_path: Path, name: str) -> None:
    run = fz.load(finished_run(name)[0])
    assert run.folder
    write_card(run.folder, LICENCE | {"output": str(tmp_path / "here")})
    shutil.move(tmp_path / "here", tmp_path / "empty" / "there")
    moved = fz.load(tmp_path / "empty" / "there")
    for own, expected in zip(moved.rollout(run.segments), run.rollout(), strict=True):
        np.testing.assert_allclose(own, expected, rtol=0, atol=EXACT)
    assert moved.timestep == run.timestep
    for full, parameter in run.parameters.items():
        np.testing.assert_array_equal(moved.parameters[full].value, parameter.value)


def test_the_page_s_code_does_what_it_says(run, card, tmp_path, monkeypatch, capsys):
    (tmp_path / "RUN").symlink_to(run)
    (tmp_path / "CARD").symlink_to(card)
    monkeypatch.chdir(tmp_path)
    (block,) = re.findall(r"^```python\n(.*?)^```$", (ROOT / "docs" / "cards.md").read_text(), re.M | re.S)
    exec(block, names := {})
    np.testing.assert_allclose(names["qpos"], names["run"].rollout()[0], rtol=0, atol=EXACT)
    assert capsys.readouterr().out == f"{fz.load(run).parameters['friction.static_torque'].value}\n"


def test_what_needs_recordings_says_that_a_card_has_none(card: Path, tmp_path: Path) -> None:
    drive = fz.load(card)
    assert drive.at(drive.timestep / 2).timestep == drive.timestep / 2
    export, save = partial(drive.export, "mjcf", tmp_path / "export"), partial(drive.save, tmp_path / "run")
    again = partial(write_card, card, LICENCE | {"output": str(tmp_path / "card")})
    for use in (drive.rollout, drive.plot, drive.band, export, save, again, partial(fz.Compared.of, [drive])):
        with pytest.raises(RunError, match="a card without recordings"):
            use()
    assert not [*tmp_path.iterdir()]


def test_a_comparison_leaves_cards_in_a_sweep_out_and_refuses_one_by_name(card: Path, tmp_path: Path) -> None:
    (tmp_path / "sweep" / "0").mkdir(parents=True)
    (tmp_path / "sweep" / "0" / RESULT).touch()
    shutil.copytree(card, tmp_path / "sweep" / "0" / "card")
    assert find_runs(tmp_path / "sweep") == [tmp_path / "sweep" / "0"]
    done = finish(lambda: compare([str(card), "--output", str(tmp_path / "comparison")]))
    assert done.status == 2 and f"{card}: a card without recordings" in done.err


def test_a_robot_needs_its_own_file_no_more(tmp_path: Path) -> None:
    source, folder, tie = tmp_path / "robot.xml", tmp_path / "card", {"all": ".*"}
    source.write_text(LEG)
    fitted = fit_robot(source, tie=tie, timestep=0.002)
    folder.mkdir()
    (folder / TEMPLATE).write_text(write_template(fitted.bench))
    section = {name: part for name, part in describe(fitted.model).items() if name != "nv"}
    bench = describe_bench(fitted.bench, {"solreffriction": [0.02, 1.0], "tie": tie, "base": "fixed"})
    bench = json.loads(json.dumps(bench)) | {"mjcf": str(folder / TEMPLATE)}
    expected = fitted.rollout()
    source.unlink()
    remade, model = build_drive(folder, {"bench": bench, "model": section})
    assert remade.joints == fitted.bench.joints and remade.nv > 1
    assert remade.groups(remade.params["armature"]) == remade.nv * ["all"]
    model.double().load_state_dict(fitted.model.state_dict())
    for own, other in zip(replace(fitted, bench=remade, model=model).rollout(), expected, strict=True):
        np.testing.assert_allclose(own, other, rtol=0, atol=EXACT)


Change = Callable[[dict[str, Any]], Any]


def edit(folder: Path, change: Change) -> None:
    record = read(folder)
    change(record)
    (folder / RESULT).write_text(json.dumps(record))


def settle(folder: Path, change: Change = lambda record: None) -> None:
    """Change a card's record, and make all hashes agree."""

    def hash_again(record: dict[str, Any]) -> None:
        change(record)
        files = {name: (folder / name).read_bytes() for name in record["card"]["files"] if name != RESULT}
        record["card"]["files"] = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
        record["card"]["files"][RESULT] = hash_record(record)

    edit(folder, hash_again)


def write(name: str, content: bytes) -> Callable[[Path], None]:
    def replace_file(folder: Path) -> None:
        (folder / name).write_bytes(content)
        settle(folder)

    return replace_file


def refer(to: str) -> Callable[[Path], None]:
    def replace_text(folder: Path) -> None:
        text = (folder / TEMPLATE).read_text()
        write(TEMPLATE, text.replace("<worldbody>", f"{to}<worldbody>", 1).encode())(folder)

    return replace_text


def put(section: str, value: Any) -> Callable[[Path], None]:
    return lambda folder: settle(folder, lambda record: record["settings"].update({section: value}))


def name_file(record: dict[str, Any]) -> None:
    record["card"]["files"]["../x"] = 64 * "0"


def multiply(record: dict[str, Any]) -> None:
    next(row for row in record["parameters"] if row["name"] == "armature")["value"] *= 1.001


class Executed:
    """What a pickle would do."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (exec, ("import sys; sys.executed = True",))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda folder: (folder / RESULT).write_text("[" * 100_000), "not JSON"),
        (lambda folder: edit(folder, lambda record: record.update(schema_version=5)), "schema_version 5, expected"),
        (lambda folder: (folder / LAW).write_bytes((folder / LAW).read_bytes()[:-8]), "SHA-256 .* get the card again"),
        (lambda folder: edit(folder, multiply), r"result\.json: SHA-256"),
        (lambda folder: (folder / TEMPLATE).unlink(), "No such file or directory"),
        (lambda folder: edit(folder, lambda record: record["card"].pop("licence")), "missing required field `licence`"),
        (lambda folder: edit(folder, name_file), r"names the file \.\./x"),
        (write(LAW, pickle.dumps(Executed())), "expected the values of coulomb_stribeck"),
        (write(LAW, b""), "expected the values of coulomb_stribeck"),
        (write(TEMPLATE, b"\xff"), TEMPLATE),
        (refer('<include file="/etc/passwd"/>'), "refers to <include>, expected one file"),
        (refer('<asset><mesh name="m" file="/etc/passwd"/></asset>'), "refers to /etc/passwd, expected one file"),
        (refer('<extension><plugin plugin="a.so"/></extension>'), "refers to <extension>, expected one file"),
        (refer("<"), "MJCF|XML|not well-formed"),
        (put("bench", []), r"settings\.bench"),
        (put("bench", {"_target_": "frictionzoo.bench.Bench"}), "actuator"),
        (put("model", None), "None: expected a section"),
        (put("model", {"_target_": "frictionzoo.models.Lugre", "params": 3}), "Lugre"),
    ],
)
def test_a_damaged_or_foreign_card_is_one_line_and_nothing_of_it_runs(own, change, expected):
    (own.parent / "x").write_text("mine")
    change(own)
    with pytest.raises(FrictionzooError, match=expected) as told:
        fz.load(own)
    assert "\n" not in str(told.value) and str(own) in str(told.value) and not hasattr(sys, "executed")


STRANGERS = ("os.system", "frictionzoo.export.__main__.main", "frictionzoo.data.files.Files", "antigravity.Law", "x")


@pytest.mark.parametrize("target", STRANGERS)
@pytest.mark.parametrize("place", ["bench", "actuator", "params", "model"])
def test_nothing_but_laws_is_built(own: Path, target: str, place: str) -> None:
    def name(record: dict[str, Any]) -> None:
        bench, model = record["settings"]["bench"], record["settings"]["model"]
        parts = {"bench": bench, "actuator": bench["actuator"], "params": bench["params"], "model": model}
        parts[place]["_target_"] = target

    settle(own, name)
    before = {*sys.modules}
    with pytest.raises(RunError, match=rf"^{re.escape(str(own))}.*_target_|{re.escape(target)}: "):
        fz.load(own)
    assert not {"antigravity", "frictionzoo.export.__main__"} & ({*sys.modules} - before)


@pytest.mark.parametrize(
    ("options", "error", "expected"),
    [
        ({}, ConfigError, "^licence is missing"),
        ({"licence": "CC BY 4.0\n- evil: 1"}, ConfigError, "^licence=.* one line"),
        ({"licence": "CC BY 4.0"}, ConfigError, "^licence=.* lower-case"),
        ({"license": "mit"}, ConfigError, r"^license: unknown option; did you mean licence\?"),
        (LICENCE | {"output": "taken"}, OutputError, r"^taken/README\.md: not written by this program"),
        (LICENCE | {"output": "taken/README.md/card"}, OutputError, "set output to a folder that can be written$"),
        (LICENCE | {"output": "run"}, OutputError, r"^run/result\.json: written by another command"),
    ],
)
def test_what_cannot_be_written_leaves_nothing(run, tmp_path, monkeypatch, options, error, expected):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "README.md").write_text("mine")
    (tmp_path / "run").symlink_to(run)
    before = {*tmp_path.rglob("*"), *run.iterdir()}
    with pytest.raises(error, match=expected):
        write_card(run, options)
    assert {*tmp_path.rglob("*"), *run.iterdir()} == before


def test_a_failure_on_the_way_leaves_the_older_card(run: Path, own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise OutputError("the disk is full")

    before = {path.name: path.read_bytes() for path in own.iterdir()}
    monkeypatch.setattr("frictionzoo.report.card.save_portraits", fail)
    with pytest.raises(OutputError, match="disk is full"):
        write_card(run, LICENCE | {"output": str(own)})
    assert {path.name: path.read_bytes() for path in own.iterdir()} == before and len([*own.parent.iterdir()]) == 1


def test_the_command_writes_it_and_refuses_what_is_no_run(run: Path, tmp_path: Path) -> None:
    done = finish(lambda: main([str(run), "licence=mit", f"output={tmp_path / 'card'}"]))
    assert done.status == 0 and done.out == f"files: {tmp_path / 'card'}\n" and (tmp_path / "card" / PAGE).exists()
    refused = finish(lambda: main([str(tmp_path), "licence=mit"]))
    assert refused.status == 2 and refused.err.count("\n") == 1
    assert refused.err.startswith(f"frictionzoo: {tmp_path}: no result.json in it")
    assert {path.name for path in tmp_path.iterdir()} == {"card"}


class Hub(BaseHTTPRequestHandler):
    """The part of a hub's interface that downloads a repository's files."""

    files: Path
    commit = 40 * "c"

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        asked = re.fullmatch(r"/maker/knee/resolve/(main|v1|c{40})/([^/?]+)(\?.*)?", self.path)
        path = self.files / asked[2] if asked else None
        if path is None or not path.is_file():
            self.send_response(404)
            self.send_header("X-Error-Code", "EntryNotFound" if asked else "RepoNotFound")
            content = b""
        else:
            content = path.read_bytes()
            self.send_response(200)
            self.send_header("ETag", f'"{hashlib.sha256(content).hexdigest()}"')
        self.send_header("X-Repo-Commit", self.commit)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(content)

    def log_message(self, *_: Any) -> None:
        pass


@pytest.fixture
def hub(card: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[type[Hub]]:
    """A stand-in on this machine's own address, and an empty cache; nothing else is reached."""
    pytest.importorskip("huggingface_hub", reason="the extra hub is not installed")
    handler = type("Own", (Hub,), {"files": card})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    address = f"http://127.0.0.1:{server.server_port}"
    constants = "huggingface_hub.constants"
    monkeypatch.setattr(f"{constants}.ENDPOINT", address)
    monkeypatch.setattr(
        f"{constants}.HUGGINGFACE_CO_URL_TEMPLATE", address + "/{repo_id}/resolve/{revision}/{filename}"
    )
    monkeypatch.setattr(f"{constants}.HF_HUB_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(f"{constants}.HF_HUB_DISABLE_XET", True)
    yield handler
    server.shutdown()
    server.server_close()


def test_a_card_comes_by_name(hub: type[Hub], card: Path, tmp_path: Path) -> None:
    drive, same = fz.load("hub:maker/knee"), fz.load(card)
    assert drive.folder and drive.folder.is_relative_to(tmp_path / "cache") and drive.folder.name == hub.commit
    assert {path.name for path in drive.folder.iterdir()} == {path.name for path in card.iterdir()} - {PAGE, MANIFEST}
    assert repr(drive).replace(str(drive.folder), "") == repr(same).replace(str(card), "")
    assert fz.load("hub:maker/knee@v1").folder == drive.folder


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("hub:maker/arm", "^hub:maker/arm: no such public repository"),
        ("hub:../knee", r"^hub:\.\./knee: expected hub:OWNER/NAME"),
    ],
)
def test_a_name_that_is_none_is_one_line(hub: type[Hub], name: str, expected: str) -> None:
    with pytest.raises(FrictionzooError, match=expected):
        fz.load(name)


def test_a_repository_without_a_card_is_one_line(hub: type[Hub], tmp_path: Path) -> None:
    hub.files = tmp_path
    with pytest.raises(RunError, match=r"^hub:maker/knee: no result\.json, expected a card"):
        fz.load("hub:maker/knee")


def test_a_hub_that_does_not_answer_has_what_is_kept(hub: type[Hub], monkeypatch: pytest.MonkeyPatch) -> None:
    kept = fz.load("hub:maker/knee").folder
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    assert fz.load("hub:maker/knee").folder == kept
    with pytest.raises(RunError, match=r"^hub:maker/arm: the hub does not answer"):
        fz.load("hub:maker/arm")


def test_without_the_extra_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r'^hub:a/b: huggingface-hub .* pip install "frictionzoo\[hub\]"$'):
        fz.load("hub:a/b")
