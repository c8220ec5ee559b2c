"""The commands of the console script, and what `--help` tells of them: at once, and true."""

import contextlib
import os
import pty
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from conftest import ROOT, check_each, slow_but
from helpers.composing import assert_composes

from frictionzoo.cli import list as list_command
from frictionzoo.cli import run
from frictionzoo.cli.commands import _INSPECT, _MODULES, COMMANDS, HELP, dispatch, main
from frictionzoo.cli.finished import parse, read_options
from frictionzoo.cli.inspect import _name_files
from frictionzoo.core.config import is_choice
from frictionzoo.export.base import target_names

HEAVY = {"hydra", "omegaconf", "numpy", "torch", "jax", "mujoco", "scipy"}


def examples_of(page: str) -> list[list[str]]:
    """The command and its arguments of each line that shows one."""
    shown = re.findall(r"^    frictionzoo (.*)$", page.replace("\\\n", " "), re.M)
    return [words if words[0] in COMMANDS else ["run", *words] for words in map(shlex.split, shown)]


@pytest.mark.parametrize("name", COMMANDS)
def test_help_does_not_wait_for_imports(name: str) -> None:
    command = [sys.executable, "-X", "importtime", "-m", f"frictionzoo.{name}", "--help"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "80"}
    finished = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert finished.returncode == 0, finished.stderr
    assert re.search(rf"^usage: .*frictionzoo[. ]\[?{name}\b", finished.stdout, re.M)
    assert max(map(len, finished.stdout.splitlines())) < 80
    imported = {line.rpartition("|")[2].strip().partition(".")[0] for line in finished.stderr.splitlines()}
    assert "frictionzoo" in imported and not HEAVY & imported


MISTAKES = {
    "data.train=[nothing.csv] bench.mjcf=knee_rod.xml": "nothing.csv: no such file (looked from ",
    "data.train=[knee.csv] data.columns.qpos=angle": "knee.csv: no column angle; expected one of ",
    "data.train=[text.csv]": "text.csv, line 3: qpos is 'abc', expected a number",
    "data.train=[knee.csv] bench.joint=elbow": "knee_rod.xml: no joint elbow; ",
    "data.train=[knee.csv] model.params.static_torque.high=-3": "static_torque: bounds low=0.0001, high=-3; expected ",
}
TELL = """
import sys
from frictionzoo.cli.commands import main
for options in sys.argv[1:]:
    sys.argv = ["frictionzoo", "data=files", "bench=knee", *options.split()]
    try:
        main()
    except SystemExit as ended:
        print(ended.code)
print(*{"torch", "jax"} & {*sys.modules})
"""


def test_a_mistake_is_told_at_a_terminal_before_slow_imports(tmp_path: Path, recording: Path) -> None:
    (tmp_path / "knee.csv").symlink_to(recording)
    (tmp_path / "text.csv").write_text("time,qpos,qvel,ctrl\n0,0,0,0\n0.001,abc,0,0\n")
    terminal, end = pty.openpty()
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    out = subprocess.check_output([sys.executable, "-c", TELL, *MISTAKES], cwd=tmp_path, env=environment, stderr=end)
    assert out.decode().split() == ["2"] * len(MISTAKES)
    told = read_terminal(terminal, end).split("frictionzoo run: reading the options ...")[1:]
    for lines, line in zip(told, MISTAKES.values(), strict=True):
        *doing, refused = lines.split("\n")[1:-1]
        assert refused.startswith(f"frictionzoo: {line}")
        assert all(each.startswith("reading bench and recordings ") for each in doing)


def read_terminal(terminal: int, end: int) -> str:
    """What was written to a terminal, no more than it keeps for a reader that comes late."""
    os.close(end)
    with contextlib.suppress(OSError):  # how a terminal ends whose programs have
        return os.read(terminal, 1 << 16).decode().replace("\r\n", "\n")
    raise AssertionError("nothing was written")


@pytest.mark.parametrize("arguments", [["--cfg", "job"], ["list"], ["--help"]], ids=" ".join)
def test_a_reader_that_goes_away_ends_a_command_in_silence(capfd, monkeypatch, arguments):
    reading, writing = os.pipe()
    os.close(reading)
    monkeypatch.setattr(sys, "argv", ["frictionzoo", *arguments])
    with open(writing, "w", buffering=1) as gone:
        monkeypatch.setattr(sys, "stdout", gone)
        main()
    assert capfd.readouterr() == ("", "")


def test_the_page_names_every_command_wherever_a_run_is_asked_for_help(capsys: pytest.CaptureFixture) -> None:
    pages = set()
    for arguments in (["-h"], ["--help"], ["run", "--help"], ["model=coulomb_smooth", "-m", "-h"]):
        assert dispatch(arguments) is None
        pages.add(capsys.readouterr().out)
    (page,) = pages
    for name, does in COMMANDS.items():
        assert f"  {name:<8} {does}\n" in page


def check_example(name: str, *rest: str) -> None:
    """Jobs compose and data sets do; other commands parse, and what they name exists."""
    if name == "run":
        return assert_composes([*rest])
    if name == "inspect":
        return assert_composes(_name_files([*rest]))
    parsed = list_command._parse([*rest]) if name == "list" else parse(name, rest)
    options = read_options([text for text in getattr(parsed, "options", []) if "=" in text], "KEY=VALUE")
    assert options.get("target", "mjcf") in target_names()
    assert is_choice("model", options.get("model", "lugre"))


def test_an_example_is_true_and_there_is_one_of_each_command() -> None:
    check_each(check_example, map(tuple, examples_of(HELP + _INSPECT)))
    examples = examples_of(HELP)
    assert {words[0] for words in examples} == {*COMMANDS} and len(examples) >= 10


@pytest.mark.parametrize(
    ("arguments", "name", "rest"),
    [
        *[([name, "a", "b=c"], name, ["a", "b=c"]) for name in COMMANDS],
        (["model=lugre", "-m"], "run", ["model=lugre", "-m"]),
        (["--cfg", "job"], "run", ["--cfg", "job"]),
        (["~data"], "run", ["~data"]),
        (["hydra/launcher=joblib", "-m"], "run", ["hydra/launcher=joblib", "-m"]),
        ([], "run", []),
    ],
)
def test_a_command_gets_its_arguments(monkeypatch, arguments, name, rest):
    given: list[Any] = []
    function = f"{name}.main" if name in _MODULES else f"finished.{name}"
    monkeypatch.setattr(f"frictionzoo.cli.{function}", given.extend)
    assert dispatch(arguments) is None
    assert given == rest


COMPLETIONS = {
    "frictionzoo in": {"inspect"},
    "frictionzoo model=coul": {"model=coulomb_smooth", "model=coulomb_stribeck"},
    "frictionzoo run model=lug": {"model=lugre", "model=lugre_load_dependent"},
    "frictionzoo inspect data=em": {"data=emps"},
    "frictionzoo fit=lm fit.it": {"fit.iterations="},
    "frictionzoo export RU": set(),
}


@pytest.mark.parametrize(
    "line", slow_but(["frictionzoo in", "frictionzoo run model=lug", "frictionzoo export RU"], COMPLETIONS)
)
def test_a_line_is_completed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, line: str) -> None:
    monkeypatch.setenv("COMP_LINE", line)
    dispatch(["-sc", "query=bash"])
    captured = capsys.readouterr()
    assert {*captured.out.split()} == COMPLETIONS[line] and captured.err == ""


@pytest.mark.parametrize("name", ["comapre", "a.csv", "logs/a"])
def test_a_command_that_does_not_exist_is_one_line(capsys: pytest.CaptureFixture, name: str) -> None:
    with pytest.raises(SystemExit) as ended:
        dispatch([name, "seed=3"])
    err = capsys.readouterr().err
    assert ended.value.code == 2 and err.startswith(f"frictionzoo: {name}: no such command; ") and err.count("\n") == 1
    assert all(command in err for command in COMMANDS)


def test_files_to_inspect_are_named_as_they_are() -> None:
    assert _name_files(["a b.csv", "logs/*.csv", "data.split.gap=1", "--cfg", "job"]) == [
        *("data=files", 'data.train=["a b.csv","logs/*.csv"]', "data.split.gap=1", "--cfg", "job")
    ]
    for none in (["data=emps"], ["--cfg", "job", "data=emps"], []):
        assert _name_files(none) == none


def test_a_command_leaves_the_process_as_it_was(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["program", "of its own"])
    before = dict(os.environ), signal.getsignal(signal.SIGINT), sys.unraisablehook
    with pytest.raises(SystemExit):
        run.main(["seed=1", "-m", "model=coulomb_smoth"])  # a flag between overrides
    assert "did you mean coulomb_smooth?" in capsys.readouterr().err
    assert (dict(os.environ), signal.getsignal(signal.SIGINT), sys.unraisablehook) == before
    assert sys.argv == ["program", "of its own"]
