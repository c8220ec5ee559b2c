"""Other people's files in an output folder: each stays as it is, byte for byte, or the command refuses."""

import ast
import builtins
import contextlib
import functools
import itertools
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from conftest import RUNS, finish
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import frictionzoo as fz
from frictionzoo.api.comparison_files import FILES as COMPARISON
from frictionzoo.api.comparison_files import write_comparison as write_real_comparison
from frictionzoo.cli.finished import design
from frictionzoo.cli.inspect import inspect_data
from frictionzoo.cli.resume import recorded
from frictionzoo.cli.student import distill
from frictionzoo.core import output
from frictionzoo.core.config import compose_config
from frictionzoo.core.errors import OutputError
from frictionzoo.core.manifest import MANIFEST, Manifest
from frictionzoo.core.output import LOGGERS, RUN_FILES, RUNNING
from frictionzoo.export.write import write_exports
from frictionzoo.fit.loggers import Csv, TensorBoard
from frictionzoo.report.card import write_card

PACKAGE = Path(__file__).parent.parent / "frictionzoo"
LICENCE = {"licence": "cc-by-4.0"}
PART = ".result.json.0123456789abcdef.part"


@dataclass(frozen=True)
class Foreign:
    """Something of the user's under a name in an output folder: `file`, `empty`, `folder`, `link` or `away`."""

    name: str
    what: str


def put(folder: Path, outside: Path, foreign: list[Foreign]) -> None:
    """Lay the user's files into a folder, as far as they do not exclude each other; links lead out of it."""
    for each in foreign:
        path = folder / each.name
        with contextlib.suppress(FileExistsError, NotADirectoryError):
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.is_dir() and not path.is_symlink():
                continue
            path.unlink(missing_ok=True)
            if each.what == "folder":
                path.mkdir()
            elif each.what in ("link", "away"):
                path.symlink_to(outside if each.what == "away" else outside / "notes.txt")
            else:
                path.write_text("" if each.what == "empty" else f"mine: {each.name}")


def see(folder: Path) -> dict[str, Any]:
    """All that is in a folder: content of files, text of links, None for folders."""
    found: dict[str, Any] = {}
    for place, folders, files in os.walk(folder):
        for name in [*folders, *files]:
            path = Path(place, name)
            kept = os.readlink(path) if path.is_symlink() else None if path.is_dir() else path.read_bytes()
            found[path.relative_to(folder).as_posix()] = kept
    return found


@contextlib.contextmanager
def kept(folder: Path, outside: Path, foreign: list[Foreign]) -> Iterator[None]:
    """What the user put there is the same afterwards, whether the command refused or not."""
    (outside / "notes.txt").write_text("outside")
    put(folder, outside, foreign)
    before, mine = see(folder), {each.name for each in foreign}
    try:
        yield
    except OutputError as error:
        assert "\n" not in str(error)
    after = see(folder)
    for name, content in before.items():
        if name in mine or any(each.startswith(f"{name}/") for each in mine):
            assert name in after and after[name] == content, name
    assert see(outside) == {"notes.txt": b"outside"}


@pytest.fixture(scope="module")
def outputs(finished_run: Callable, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A finished folder of each command that is quick."""
    run, home = finished_run("coulomb_stribeck")[0], tmp_path_factory.mktemp("outputs")
    write_card(run, LICENCE | {"output": str(home / "card")})
    write_exports(run, {"target": "mjcf", "output": str(home / "export")})
    comparison = finished_run("sweep")[0] / "comparison"
    return {"run": run, "comparison": comparison, "card": home / "card", "export": home / "export"}


def contents(folder: Path) -> dict[str, bytes]:
    """What a command wrote, by name, as its folder says; what loggers wrote themselves is not among it."""
    return {
        name: (folder / name).read_bytes()
        for name in sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
        if not name.startswith(("tensorboard/", MANIFEST)) and "/export/" not in name
    }


def write(folder: Path, files: dict[str, bytes]) -> None:
    for name, content in files.items():
        output.write_atomically(folder / name, content)


def write_run(folder: Path, files: dict[str, bytes]) -> None:
    """What a job does with its folder, in its order, with the files of a finished one."""
    record = {folder / name: content for name, content in files.items() if name.startswith(".hydra/")}
    inside = LOGGERS - {"wandb"}
    with output.occupy(folder, wait=False, names=RUN_FILES, inside=inside) as manifest, recorded(record):
        for logger in (TensorBoard(), Csv()):
            log = logger.start(folder, {"model": "lugre"})
            log.log_metrics({"loss": 1.0}, 0)
            log.save()
            log.log_metrics({"loss": 0.5}, 1)
            logger.finish(2, {"fit/loss": 0.5}, [], "all of it")
        manifest.remove("result.json")
        write(folder, files)


def write_comparison(folder: Path, files: dict[str, bytes]) -> None:
    with output.claim(folder, "comparison", COMPARISON):
        write(folder, files)
        output.remove_written(folder / "figures" / "differences.png")


def write_staged(kind: str, last: str, folder: Path, files: dict[str, bytes]) -> None:
    with output.take_place(folder, kind, [last]) as fresh:
        write(fresh, files)


WRITERS: dict[str, Callable[[Path, dict[str, bytes]], None]] = {
    "run": write_run,
    "comparison": write_comparison,
    "card": functools.partial(write_staged, "card", "result.json"),
    "export": functools.partial(write_staged, "export", "export.json"),
}


def names_of(outputs: dict[str, Path]) -> list[str]:
    """Every name that the program uses, files and folders, and a few that look like them."""
    used = {name for folder in outputs.values() for name in see(folder)}
    return sorted({*used, *RUN_FILES, *COMPARISON, RUNNING, MANIFEST, PART, "csv", "csv/metrics.csv", "csv/a.csv"})


CHARACTERS = st.characters(codec="utf-8", exclude_characters="/\0", exclude_categories=["Cs"])
TEXT = st.text(CHARACTERS, min_size=1, max_size=8).filter(lambda text: text not in (".", ".."))
INSIDE = st.builds("{}/{}".format, st.sampled_from(["figures", "tensorboard", "csv", ".git", "checkpoints"]), TEXT)
KINDS = st.sampled_from(["file", "file", "empty", "folder", "link", "away"])


def hold(tmp_path: Path, names: list[str], write: Callable[[Path], Any], examples: int, again: bool = False) -> None:
    """Files of these names, and of others, stay whatever is written into their folder; also when written again."""

    @settings(deadline=None, derandomize=True, suppress_health_check=list(HealthCheck), max_examples=examples)
    @given(
        st.lists(st.builds(Foreign, st.sampled_from(names) | TEXT | INSIDE, KINDS), min_size=1, max_size=4),
        st.booleans(),
    )
    def check(foreign: list[Foreign], twice: bool) -> None:
        with tempfile.TemporaryDirectory(dir=tmp_path) as place:
            folder, outside = Path(place, "out"), Path(place, "outside")
            folder.mkdir()
            outside.mkdir()
            if again and twice:
                write(folder)
            with kept(folder, outside, foreign):
                write(folder)

    check()


@pytest.mark.parametrize("examples", [12, pytest.param(100, marks=pytest.mark.slow)])
@pytest.mark.parametrize("command", WRITERS)
def test_foreign_files_stay_or_the_command_refuses(outputs, tmp_path, command, examples):
    files = contents(outputs[command])
    files.pop("figures/differences.png", None)  # as of a comparison in which there is none to show

    def write(folder: Path) -> None:
        WRITERS[command](folder, files)
        assert contents(folder).items() >= files.items()

    hold(tmp_path, names_of(outputs), write, examples, again=True)


@pytest.mark.parametrize("command", WRITERS)
def test_each_name_of_a_command_is_refused_and_named(outputs: dict[str, Path], tmp_path: Path, command: str) -> None:
    files = contents(outputs[command])
    for number, name in enumerate(files):
        folder = tmp_path / str(number)
        put(folder, tmp_path, [Foreign(name, "file")])
        before = see(folder)
        with pytest.raises(OutputError, match=f"^{folder / name}: not written by this program"):
            WRITERS[command](folder, files)
        assert see(folder) == before  # before the work
        if number < 3:
            (folder / name).unlink()
            WRITERS[command](folder, files)
            with open(folder / name, "ab") as file:
                file.write(b"my notes")
            with pytest.raises(OutputError, match=f"^{folder / name}: changed since it was written"):
                WRITERS[command](folder, files)


def test_a_finished_folder_holds_what_is_refused_beforehand(outputs: dict[str, Path]) -> None:
    assert {*contents(outputs["run"])} <= {*RUN_FILES} and {*contents(outputs["comparison"])} <= {*COMPARISON}
    for command, folder in outputs.items():
        manifest = Manifest(folder, command)
        assert [name for name in contents(folder) if not manifest.owns(name)] == []


def test_a_card_in_a_clone_is_updated_and_all_else_stays(outputs: dict[str, Path], tmp_path: Path) -> None:
    run, repo = outputs["run"], tmp_path / "repo"
    shutil.copytree(outputs["card"], repo)
    names = (".git/HEAD", ".git/objects/ab/cd", "notes.md", "photo.jpg", ".gitignore")
    put(repo, tmp_path, [Foreign(name, "file") for name in names])
    before = {name: (repo / name).read_bytes() for name in names}
    write_card(run, LICENCE | {"output": str(repo), "name": "Another title"})
    assert before == {name: (repo / name).read_bytes() for name in names}
    assert "Another title" in (repo / "README.md").read_text()
    fz.load(repo)
    (repo / "README.md").write_text("mine")
    with pytest.raises(OutputError, match=r"repo/README\.md: changed since it was written"):
        write_card(run, LICENCE | {"output": str(repo)})
    assert (repo / "README.md").read_text() == "mine"


def test_one_export_replaces_another_and_nothing_else(outputs: dict[str, Path], tmp_path: Path) -> None:
    folder = shutil.copytree(outputs["comparison"], tmp_path / "folder")
    (folder / "bench.py").write_text("mine")
    before = see(folder)
    for name in ("a.py", "deep/b.py"):
        WRITERS["export"](folder, {name: b"a", "export.json": b"{}"})
    after = see(folder)
    assert {name: after[name] for name in before} == before | {MANIFEST: after[MANIFEST]}
    assert after.keys() - before.keys() == {"deep", "deep/b.py", "export.json"}


def test_what_a_killed_process_or_a_full_disk_left_is_known(tmp_path: Path) -> None:
    """At each write of a file and of a manifest, the process ends there; the next one goes on."""

    class Killed(BaseException):
        pass

    def work(folder: Path) -> None:
        manifest = Manifest(folder, "run")
        manifest.remove_parts()
        manifest.write("figures/a.png", b"a" * 9)
        manifest.write("csv/metrics.csv", b"loss\n")
        manifest.append("csv/metrics.csv", b"1\n")
        manifest.write("figures/a.png", b"b" * 7)

    ways = itertools.product((Killed(), OSError(28, "no space")), ((os, "replace"), (os, "fsync"), (Path, "mkdir")))
    for end, (owner, name) in (*ways, (Killed(), (builtins, "open"))):
        for moment in itertools.count():
            folder, left, real = tmp_path / type(end).__name__ / name / str(moment), [moment], getattr(owner, name)

            def stop(*arguments: Any, real: Any = real, left: list[int] = left, end: Any = end, **more: Any) -> Any:
                left[0] -= 1
                if left[0] < 0:
                    raise end
                return real(*arguments, **more)

            with pytest.MonkeyPatch.context() as patch, contextlib.suppress(Killed, OutputError):
                patch.setattr(owner, name, stop)
                if isinstance(end, Killed):
                    patch.setattr(Path, "unlink", lambda *_, **__: None)  # a killed process cleans nothing up
                work(folder)
            assert isinstance(end, Killed) or not list(folder.glob("*.part"))
            work(folder)
            assert (folder / "figures" / "a.png").read_bytes() == b"b" * 7
            assert not list(folder.glob("*.part"))
            if left[0] >= 0:  # it came to its end
                break


def test_a_file_is_known_by_any_content_that_was_written(tmp_path: Path) -> None:
    manifest, path = Manifest(tmp_path, "run"), tmp_path / "metrics.csv"
    manifest.write("metrics.csv", b"loss\n")
    manifest.append("metrics.csv", b"1\n2\n")
    for content in (b"loss\n", b"loss\n1\n2\n", b"loss\n1\n", b"loss\n1\n2\n3\n", b"mine\n"):
        path.write_bytes(content)
        assert Manifest(tmp_path, "run").owns("metrics.csv") == (content in (b"loss\n", b"loss\n1\n2\n")), content
    with (tmp_path / MANIFEST).open("ab") as file:
        file.write(b'{"kind": "run", "fi')  # a killed process's
    path.write_bytes(b"loss\n")
    Manifest(tmp_path, "run").write("metrics.csv", b"anew")
    assert Manifest(tmp_path, "run").owns("metrics.csv")


ALLOWED = {  # who may write or remove: the layer itself, and what export targets put into a scratch folder
    "core/manifest.py",
    "core/output.py",
    *(path.relative_to(PACKAGE).as_posix() for path in (PACKAGE / "export").glob("*.py")),
}
MORE = [("tensorboard", name) for name in (*RUN_FILES, MANIFEST, "tensorboard/notes.txt", "figures", "checkpoints")]
WRITING = {"write_text", "write_bytes", "unlink", "rmdir", "rmtree", "rename", "savefig", "savetxt", "touch"}


def test_files_are_written_and_removed_in_one_place() -> None:
    for path in PACKAGE.rglob("*.py"):
        calls = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
        for node in calls if path.relative_to(PACKAGE).as_posix() not in ALLOWED else ():
            called, given_to = ast.unparse(node.func), {*map(ast.unparse, node.args)}
            name, where = called.rpartition(".")[2], f"{path}: {ast.unparse(node)}"
            assert name not in WRITING or "buffer" in given_to, where
            assert called not in ("os.replace", "shutil.copy", "shutil.move"), where
            reads = "os.devnull" in given_to or not {"'w'", "'wb'", "'a'", "'ab'", "'xb'"} & given_to
            assert name != "open" or reads, where


@pytest.mark.parametrize(
    ("logger", "name"),
    [("csv", "csv/a.csv"), ("csv", "csv/metrics.csv"), ("tensorboard", "report.html"), ("tensorboard", ".running")]
    + [pytest.param(*each, marks=pytest.mark.slow) for each in MORE],
)
def test_a_run_refuses_a_folder_with_such_a_file_before_it_begins(call, recording, tmp_path, logger, name):
    put(tmp_path, tmp_path, [Foreign(name, "file")])
    shutil.copy(recording, tmp_path / "csv" / "a.csv" if name.startswith("csv/") else tmp_path / "a.csv")
    before = see(tmp_path)
    (log,) = tmp_path.rglob("a.csv")
    refused = call("data=files", f"data.train=[{log.relative_to(tmp_path)}]", f"logger={logger}", "hydra.run.dir=.")
    assert refused.status == 2 and refused.err.count("\n") == 1
    named = "csv/a.csv" if logger == "csv" else name
    assert refused.err.startswith(f"frictionzoo: {tmp_path / named}: not "), refused.err
    assert see(tmp_path) == before


@pytest.mark.slow
@pytest.mark.usefixtures("in_haste")
@pytest.mark.parametrize("logger", ["csv", "tensorboard"])
def test_a_run_beside_other_files_leaves_them_and_goes_on(call, tiny, tmp_path, logger):
    other = "csv" if logger == "tensorboard" else "tensorboard"
    names = (f"{other}/a.csv", "figures/mine.png", "checkpoints/best.ckpt", ".a.csv.1.part", ".git/HEAD", "notes.md")
    mine = [Foreign(name, "file") for name in names]
    put(tmp_path, tmp_path, mine)
    before = {name: (tmp_path / name).read_bytes() for name in names}
    options = (*RUNS["coulomb_smooth"], *tiny, f"logger={logger}", "hydra.run.dir=.")
    for arguments in (options, ("resume=.",)):
        done = call(*arguments)
        assert done.status == 0, done.err
        assert {name: (tmp_path / name).read_bytes() for name in names} == before
    with open(tmp_path / "report.html", "a") as file:
        file.write("my notes")
    refused = call("resume=.")
    assert refused.status == 2 and f"{tmp_path}/report.html: changed since it was written" in refused.err


@pytest.mark.slow
@pytest.mark.parametrize("name", ["multirun.yaml", "0_baseline/result.json"])
def test_a_sweep_refuses_foreign_files(call: Callable, tmp_path: Path, name: str) -> None:
    put(tmp_path, tmp_path, [Foreign(f"sweep/{name}", "file")])
    before = see(tmp_path)
    refused = call("-m", "model=baseline", "data=files", "data.train=[a.csv]", "hydra.sweep.dir=sweep")
    assert refused.status == 2 and f"sweep/{name}: not written by this program" in refused.err
    assert see(tmp_path).items() >= before.items()


@pytest.mark.slow
@pytest.mark.usefixtures("unrendered")
@pytest.mark.parametrize("command", ["save", "card", "export", "compare", "inspect", "design", "distill"])
def test_foreign_files_stay_whatever_a_command_does(finished_run, outputs, recording, tmp_path, command):
    run, names = outputs["run"], [*names_of(outputs), "inspect.html", "inspect.json", "excitation.json", "command.csv"]
    drive, limits = fz.load(run), ("position=1.5", "velocity=4", "torque=2")
    inspected = compose_config("data=files", f"data.train=[{recording}]")
    commands: dict[str, Callable[[Path], Any]] = {
        "save": drive.save,
        "card": lambda folder: write_card(run, LICENCE | {"output": str(folder)}),
        "export": lambda folder: write_exports(run, {"target": "torchscript", "output": str(folder)}),
        "compare": lambda folder: write_real_comparison([finished_run("sweep")[0]], folder),
        "inspect": lambda folder: inspect_data(inspected, folder),
        "design": lambda folder: finish(lambda: design([str(run), *limits, f"output={folder}"])),
        "distill": lambda folder: distill(run, {"model": "mujoco_default", "output": str(folder)}),
    }

    hold(tmp_path, names, commands[command], examples=8)
