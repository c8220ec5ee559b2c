"""Run folders, cards and recordings of somebody else: nothing in them runs, and nothing reaches the terminal raw."""

import json
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Finished, finish
from helpers import hostile
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import QuotedString
from hypothesis import given, settings
from hypothesis import strategies as st

import frictionzoo as fz
from frictionzoo.bench import Bench
from frictionzoo.cli import inspect
from frictionzoo.cli.finished import card, compare, export
from frictionzoo.cli.overrides import given_to_hydra, quote_values, read_arguments, refuse_no_choice
from frictionzoo.cli.resume import SETTINGS, SavedRequest, restore_overrides
from frictionzoo.core.build import build
from frictionzoo.core.config import compose_config, merge_saved
from frictionzoo.core.errors import ConfigError, FrictionzooError, LogError
from frictionzoo.core.telling import escape_controls
from frictionzoo.models.registry import REGISTRY

Change = Callable[[dict[str, Any]], None]
CALLBACK = """# @package _global_
hydra: {callbacks: {x: {_target_: stranger.Law}}}
"""
PYTHON = "open('executed', 'w').close()\nclass Law: ...\nX = Law\n"


@pytest.fixture
def foreign(finished_run: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run of somebody else in the present folder, with code beside it that Python would find."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "stranger.py").write_text(PYTHON)
    folder = Path(shutil.copytree(finished_run("coulomb_smooth")[0], "foreign"))
    for name in ("evil.yaml", ".hydra/evil.yaml"):
        (folder / name).write_text(CALLBACK)
    return folder


def change(path: Path, how: Change) -> None:
    content = json.loads(path.read_text())
    how(content)
    path.write_text(json.dumps(content))
    hostile.sign(path.parents[1] if path.parent.name == ".hydra" else path.parent)


def target(*place: str, name: Any = "stranger.Law") -> Change:
    def how(content: dict[str, Any]) -> None:
        for key in place:
            content = content[key]
        content["_target_"] = name

    return how


@pytest.mark.parametrize(
    ("how", "named"),
    [
        (lambda c: c["choices"].update(model="../../../foreign/evil"), "model=../../../foreign/evil"),
        (lambda c: c["choices"].update(model="evil"), "model=evil"),
        (lambda c: c["choices"].update({"hydra/launcher": "joblib"}), "hydra/launcher=joblib"),
        (lambda c: c["choices"].update({"model@hydra.callbacks": "lugre"}), "model@hydra.callbacks=lugre"),
        (lambda c: c["choices"].update(model=["lugre"]), "model=['lugre']"),
        (lambda c: c["options"].append("+hydra.callbacks.x._target_=stranger.Law"), "settings.json"),
        (lambda c: c["options"].append("--config-dir=foreign"), "settings.json"),
        (lambda c: c.pop("settings"), "settings.json"),
        (lambda c: c["choices"].update(logger="mlflow"), "logger=mlflow"),
        *((text, "settings.json") for text in (None, "", "[]", '{"choices": 3}')),
        ("!!python/object/apply:os.mkdir [executed]", "settings.json"),
    ],
)
def test_a_record_that_chooses_something_else_or_is_none_is_refused(foreign, how, named):
    if callable(how):
        change(foreign / SETTINGS, how)
    else:
        (foreign / SETTINGS).unlink() if how is None else (foreign / SETTINGS).write_text(how)
    with pytest.raises(ConfigError, match=re.escape(named)):
        restore_overrides([f"resume={foreign}"])
    assert not Path("executed").exists()


def test_overrides_of_hydra_in_a_folder_are_not_read(foreign: Path) -> None:
    overrides = ["hydra.callbacks.x._target_=stranger.Law", "model=../../../foreign/evil", "hydra/launcher=evil"]
    (foreign / ".hydra" / "overrides.yaml").write_text(json.dumps(overrides))
    restored = restore_overrides([f"resume={foreign}", "seed=4"])
    assert restored[-2:] == [f"resume={foreign}", "seed=4"]
    assert {"model=coulomb_smooth", "fit=adam", "data=files"} <= {*restored[:-2]}
    assert not [each for each in restored if "hydra" in each or "evil" in each]
    for none in (["seed=4"], ["resume=foreign", "resume=null"]):
        assert restore_overrides(none) == none


@pytest.mark.parametrize(
    ("how", "named"),
    [
        (target("settings", "bench", "actuator"), "_target_=stranger.Law"),
        (lambda c: c["settings"].update(hydra={"callbacks": {"x": 3}}), "hydra"),
    ],
)
def test_a_foreign_run_that_is_resumed_is_one_line(call: Callable, foreign: Path, how: Change, named: str) -> None:
    change(foreign / SETTINGS, how)
    finished = call(f"resume={foreign}")
    assert finished.status == 2 and named in finished.err.splitlines()[-1] and "Traceback" not in finished.err
    assert not Path("executed").exists()


STRANGERS = (
    *("frictionzoo.design.__main__.X", "frictionzoo.cli.commands.main", "stranger.Law", "foreign.evil", "os.system"),
    *("frictionzoo.data.files.Files", "frictionzoo.fit.Adam", "frictionzoo.core.build.build", "", None, 3, ["a"]),
)


@pytest.mark.parametrize("name", STRANGERS)
@pytest.mark.parametrize("place", [("bench",), ("bench", "actuator"), ("model",)])
def test_a_run_names_registered_plug_ins_only(foreign: Path, place: tuple[str, ...], name: Any) -> None:
    change(foreign / "result.json", target("settings", *place, name=name))
    before = {*sys.modules}
    with pytest.raises(FrictionzooError) as refused:
        fz.load(foreign)
    assert str(refused.value).startswith("foreign: ") and "\n" not in str(refused.value)
    assert not {"stranger", "frictionzoo.design.__main__"} & ({*sys.modules} - before)
    assert not Path("executed").exists()


def test_a_law_of_this_program_is_built_while_it_is_registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(REGISTRY, "entries", dict(REGISTRY.entries))
    cls = type("Own", (fz.FrictionModel,), {"__module__": "__main__", "dimensions": {}, "terms": lambda *_: None})
    section = {"_target_": "__main__.Own", "params": {}}
    with pytest.raises(ConfigError, match=r"_target_=__main__\.Own"):
        build(section, fz.FrictionModel, nv=1)
    fz.register_model("of_a_stranger_s_test")(cls)
    assert isinstance(build(section, fz.FrictionModel, nv=1), cls)
    with pytest.raises(ConfigError, match="derived from Bench"):
        build(section, Bench, nv=1)


@pytest.mark.parametrize("place", ["figures", "checkpoints", "export"])
def test_a_link_out_of_a_run_is_not_written_through(foreign: Path, tmp_path: Path, place: str) -> None:
    (tmp_path / "mine").mkdir()
    shutil.rmtree(foreign / place, ignore_errors=True)
    (foreign / place).symlink_to(tmp_path / "mine")
    for refuse in (fz.load, lambda folder: restore_overrides([f"resume={folder}"])):
        with pytest.raises(FrictionzooError, match=f"foreign/{place}: a link out of foreign"):
            refuse(foreign)
    finished = finish(lambda: compare([str(foreign)]))
    assert finished.status == 2 and not [*(tmp_path / "mine").iterdir()]


def test_caches_of_a_stranger_are_not_used(foreign: Path) -> None:
    def cache(content: dict[str, Any]) -> None:
        content["settings"] |= {"compilation_cache": "foreign/xla", "device": "${oc.env:HOME}"}
        content["settings"]["data"]["cache_dir"] = "foreign/data"

    change(foreign / SETTINGS, cache)
    plain, today = (compose_config("data=files", "model=coulomb_smooth", *more) for more in ((), ("seed=9",)))
    merged = merge_saved(SavedRequest.read(foreign).settings, plain, today)
    assert merged.compilation_cache == merged.data.cache_dir == "user"
    assert merged.device == "${oc.env:HOME}"  # text that refers to nothing
    assert (merged.seed, merged.fit.iterations) == (9, 3)  # today's, and the run's


def test_a_folder_that_the_user_adds_has_names_too(tmp_path: Path) -> None:
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "own.yaml").write_text("a: 1\n")
    refuse_no_choice(["--config-dir", str(tmp_path), "model=own"])
    refuse_no_choice([f"--config-dir={tmp_path}", "model=own,lugre"])
    with pytest.raises(ConfigError, match="model=own: no such model"):
        refuse_no_choice(["model=own"])


@settings(max_examples=100, deadline=None)
@given(st.text(st.characters(codec="ascii", exclude_categories=["Cc"]), min_size=1, max_size=12))
def test_a_value_keeps_its_meaning_or_is_quoted_as_it_stands(value: str) -> None:
    """What Hydra reads stays; what it cannot read becomes just that text, a list of texts, or is refused as before."""
    argument, parse = f"bench.joint={value}", OverridesParser.create().parse_override
    (quoted,) = quote_values([argument])
    if quoted == argument:
        return
    with pytest.raises(Exception, match=r".*"):
        parse(argument)
    read = parse(quoted)._value
    if isinstance(read, list):
        texts = [each.text if isinstance(each, QuotedString) else each for each in read]
        assert value.startswith("[") and all(str(text).strip() in value for text in texts)
    else:
        assert isinstance(read, QuotedString) and read.text == value.strip()
        assert "," not in value or set(value) & set("([{")


COPIED = {  # options of the documentation, and their values
    "bench.joint=.*_(hip|knee)": ".*_(hip|knee)",
    "data.columns.time=data[0]": "data[0]",
    "data.columns.qpos=[data[0],data[1]]": ["data[0]", "data[1]"],
    "bench.joint=[.*_(hip|knee),wheel]": [".*_(hip|knee)", "wheel"],
    r"data.fields_from_name=^a(?P<kp>\d+)$": r"^a(?P<kp>\d+)$",
    'data.train=a"(1)\\': 'a"(1)\\',
    "data.where={kp:[4,8]}": {"kp": [4, 8]},
}
SWEEPS = ["seed=1,2", "model=glob(*)", "seed=range(3)", "bench.joint=choice(a,b)", "fit.learning_rate=0.1,0.2"]


def test_arguments_keep_their_meaning() -> None:
    for argument, value in COPIED.items():
        (override,) = read_arguments(quote_values([argument]))
        assert override.value() == value and not override.is_sweep_override()
    for argument in ("data.train=[a.csv", "seed=choice(1,2", "bench.joint=a(b),c", "data.train='a", "a=${b"):
        assert quote_values([argument]) == [argument]
        with pytest.raises(ConfigError, match="close brackets"):
            [*read_arguments([argument])]
    assert quote_values(["-m", *SWEEPS]) == ["-m", *SWEEPS]
    with given_to_hydra(SWEEPS):
        assert sys.argv[1:] == SWEEPS


@given(st.text(max_size=30))
@settings(max_examples=200, deadline=None)
def test_what_is_printed_obeys_nobody(text: str) -> None:
    escaped = escape_controls(text)
    assert not any(ord(char) < 32 or 127 <= ord(char) < 160 or 0xD800 <= ord(char) < 0xE000 for char in escaped)
    assert not set(escaped) & set("\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069\u2028\u2029")
    assert escape_controls(escaped) == escaped and len(escaped) >= len(text)
    assert str(LogError(text)) == escaped
    assert escaped == text or any(not char.isprintable() for char in text)


TITLE = "\x1b]0;owned\x07\x9b31m\u202e"


def finish_plainly(command: Callable, *arguments: str) -> Finished:
    """What a command leaves, which controls no terminal."""
    finished = finish(lambda: command([*arguments]))
    codes = {*map(ord, finished.out + finished.err)} - {ord("\n")}
    assert not codes & {*range(32), *range(127, 160), 0x202E}
    return finished


@pytest.mark.usefixtures("call")
def test_a_header_of_a_recording_does_not_reach_the_terminal() -> None:
    time = np.arange(0, 2, 0.01)
    table = np.stack([time, np.sin(time), np.cos(time), np.sin(time)], axis=1)
    for name, header in (("a.csv", f"time,qpos,qvel,ctrl{TITLE}"), (f"b{TITLE}.csv", f"time,{TITLE},b,c")):
        np.savetxt(name, table, delimiter=",", header=header, comments="", encoding="utf-8")
        finished = finish_plainly(inspect.main, name, "hydra.run.dir=out")
        assert "\\x1b]0;owned\\x07" in finished.out + finished.err


@pytest.mark.usefixtures("unrendered")
def test_names_of_a_run_do_not_reach_the_terminal(foreign: Path) -> None:
    path, forged = foreign / "result.json", f"files{TITLE}\nverdict: all is well"
    path.write_text(path.read_text().replace('"files"', json.dumps(forged)))
    finished = finish_plainly(compare, str(foreign), "--output", "out")
    assert finished.status == 0 and "\\x1b]0;owned" in finished.out
    assert "\nverdict: all is well" not in finished.out + repr(fz.load(foreign))
    assert finish_plainly(export, f"foreign{TITLE}", "target=mjcf").status == 2


@pytest.mark.slow
def test_a_thousand_mutated_runs_and_cards_do_no_harm(finished_run: Callable, start: Callable, tmp_path: Path) -> None:
    """See hostile.py. Audit hooks cannot be removed, so that it is a process of its own."""
    source, output, scratch = finished_run("coulomb_smooth")[0], tmp_path / "card", tmp_path / "scratch"
    finish(lambda: card([str(source), "licence=cc-by-4.0", f"output={output}"]))
    scratch.mkdir()
    program = (hostile.__file__, *map(str, (source, output, scratch)), "1000", "0")
    process = start(program=program, XDG_CACHE_HOME=str(tmp_path / "cache"))
    out, err = process.communicate()
    assert process.returncode == 0, err[-3000:]
    said = json.loads(out.splitlines()[-1])
    assert said["wrong"] == [] and sum(said["counts"].values()) > 1000
    assert min(said["counts"].get(f"{command} refused", 0) for command in ("load", "resume")) > 20
