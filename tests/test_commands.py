"""Every command of the documentation is known: it runs as it stands, in a folder like its reader's, at a small size.

`LEFT` names files of tests that do the same; of `RULES`, the first one that a command matches says how it is tried.
Jobs of one kind differ in what they read and not in what follows: one of each kind is done in the quick run, the others
are posed there, up to the first iteration.
"""

import functools
import importlib
import itertools
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest
import reproduce
from conftest import BRIEF, LAUNCHERS, Finished, compose_once, needs_data, render_nothing
from filelock import FileLock
from helpers.benchmarks import QUICKEST
from helpers.pages import PACKAGE, PAGES, ROOT, blocks_of, commands_of, expand
from helpers.tutorials import write_robots
from helpers.write_logs import WRITERS, write_degrees, write_log, write_ticks
from omegaconf import OmegaConf

from frictionzoo.cli.commands import COMMANDS
from frictionzoo.cli.inspect import _name_files
from frictionzoo.core.build import build
from frictionzoo.core.config import CONF_DIR, compose_config
from frictionzoo.data import files
from frictionzoo.data.formats import get_format
from frictionzoo.design.excitation import prepare
from frictionzoo.design.plan import Request
from frictionzoo.identification import Problem
from frictionzoo.simulation.context import computing

JOB = r"(?:python -m frictionzoo\.run|frictionzoo) "
SMALL = {  # options that make a job quick, where it has them and the page does not set them
    **{"data.samples": "6000", "data.split.gap": "0.05", "segments.count": "20", "fit.iterations": "3"},
    **{"loop.progress": "false", "recipe": "given", "discretisation": "false"},
    **BRIEF,
}
STAND = """<mujoco><option timestep="0.001"><flag contact="disable"/></option><worldbody><body name="arm">
<joint name="shaft" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.2254" size="0.01" mass="0.26"/></body></worldbody></mujoco>"""
RECORDINGS = ("a", "b", "bare", "loaded", "heavy", "logs/kp8_one", "logs/kp8_two", "logs/kp16_one", "logs/kp32_one")
SCRIPTS = ("benchmarks", "experiments", "frictionzoo", "conf", "Makefile", "pyproject.toml")  # of a checkout
NAMED = r"experiment=(\w+)|reproduce\.py (\w+)"
CI = (ROOT / ".ci" / "run").read_text()


@dataclass(frozen=True)
class Place:
    """A reader's folder with a checkout's scripts, a test stand and recordings, in which the test runs.

    `call` and `finished_run` are the fixtures of these names, `cache` is a folder of simulated recordings.
    """

    folder: Path
    call: Callable[..., Finished]
    finished_run: Callable[[str], tuple[Path, Finished]]
    cache: Path

    def run(self, command: str) -> str:
        """What a command prints in a shell, in which it has to end well."""
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "PATH": path}
        shell = ["bash", "-euo", "pipefail", "-c", command]
        finished = subprocess.run(shell, cwd=self.folder, env=environment, capture_output=True, text=True)
        assert finished.returncode == 0, finished.stdout + finished.stderr
        return finished.stdout


How = Callable[[str, Place], object]  # what it returns must not be false


def arguments_of(command: str) -> list[str]:
    return shlex.split(re.sub(rf"^(?:{JOB}|python -m \S+ )", "", command))


def jobs_of(arguments: Sequence[str], *groups: str) -> Iterator[tuple[str, ...]]:
    """The options of each job that a command does, or only the choices of files among them."""
    options = [argument for argument in arguments if "=" in argument]
    chosen = [option for option in options if not groups or option.partition("=")[0] in groups]
    return itertools.product(*map(expand, chosen))


def shrink(arguments: Sequence[str], cache: Path) -> list[str]:
    """The options of `SMALL`, and a cache, that all of these jobs have and that none of the arguments sets."""
    groups = [folder.name for folder in CONF_DIR.iterdir() if folder.is_dir()]
    configs = [compose_once(*choices) for choices in jobs_of(arguments, *groups)]
    named = {argument.partition("=")[0] for argument in arguments}
    return [
        f"{option}={value}"
        for option, value in (SMALL | {"data.cache_dir": str(cache)}).items()
        if option not in named and all(OmegaConf.select(c, option, default=absent) is not absent for c in configs)
    ]


absent, read_once = object(), functools.cache(files.read_tables)


def do_jobs(command: str, place: Place) -> None:
    """Small ones; each ends well and leaves a result."""
    arguments = arguments_of(command)
    with pytest.MonkeyPatch.context() as patch:
        render_nothing(patch)
        finished = place.call(*arguments, *shrink(arguments, place.cache))
    assert finished.status == 0, finished.err
    results = list(place.folder.glob("**/result.json"))
    assert len(results) == len(list(jobs_of(arguments)))
    for path in results:
        result = json.loads(path.read_text())
        assert result["fit"]["stopped"] != "diverged", path
        assert result["metrics"]["test"]["diverged"] == 0, path


def pose_jobs(command: str, place: Place) -> None:
    """All that comes before the first iteration: files, columns, fields, how they suit the bench, and the law."""
    arguments = arguments_of(command)
    for options in jobs_of(arguments):
        config = compose_config(*options, *shrink(arguments, place.cache))
        with computing(config.dtype, config.device, config.compilation_cache):
            problem = Problem.from_settings(OmegaConf.to_container(config, resolve=True))
        assert problem.dataset.train and problem.dataset.test


def is_run_by_ci(command: str, _: Place) -> bool:
    """CI runs the README's first blocks."""
    blocks = enumerate(blocks_of(ROOT / "README.md"), 1)
    (number,) = (i for i, block in blocks if f" && {block}".endswith(f" && {command}"))
    return f"run_readme_command {number}" in map(str.strip, CI.splitlines())


def install_for_development(command: str, place: Place) -> None:
    """CI installs the same into an environment of its own, and runs its tools; the hooks are installed here."""
    create, activate, make, hooks = command.split(" && ")
    assert f"{create} && {activate}" in blocks_of(ROOT / "README.md")[0]
    assert place.run(f"{make} --dry-run --no-print-directory").strip() in CI.replace(" --quiet", "")
    place.run(f"git init --quiet && {hooks}")
    assert (place.folder / ".git" / "hooks" / "pre-commit").exists()


def extras_exist(command: str, _: Place) -> bool:
    """What an extra brings is as large as CUDA; `make install` installs most of them."""
    extras = set(command.rpartition("[")[2].partition("]")[0].split(","))
    return extras <= tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"].keys()


def shows_configuration(command: str, place: Place) -> bool:
    return OmegaConf.create(place.call(*arguments_of(command)).out).keys() >= {"bench", "data", "fit", "segments"}


def export_all(command: str, place: Place) -> None:
    shutil.copytree(place.finished_run("mujoco_default")[0], place.folder / "RUN")
    place.run(command)
    written = list(place.folder.glob("RUN/export/*/export.json"))
    assert len(written) > 5 and all(json.loads(path.read_text())["files"] for path in written)


def composes_for_a_cluster(command: str, place: Place) -> bool:
    """There is no cluster here; its options are known to the launcher."""
    options = [argument for argument in arguments_of(command) if argument.startswith("hydra")]
    return "slurm" in place.call(*options, "--cfg", "hydra").out


def search(command: str, place: Place) -> None:
    """Two trials, in a process of its own: the sweeper's package warns. The lesser training error is the better one."""
    place.run(f"{command} {shlex.join(shrink(arguments_of(command), place.cache))} hydra.sweeper.n_trials=2")
    results = [json.loads(path.read_text()) for path in place.folder.glob("multirun/**/result.json")]
    errors = [result["metrics"]["train"]["position_mae"] for result in results]
    assert len({*errors}) == 2
    (found,) = (OmegaConf.load(path) for path in place.folder.glob("multirun/**/optimization_results.yaml"))
    assert found.best_value == min(errors)
    assert {*found.best_params} == {"segments.length", "fit.learning_rate"}


def is_reproduced(command: str, _: Place) -> object:
    """The experiment, or one of whose commands it is, is run; all of its jobs compose."""
    return {*re.findall(NAMED, command)[0]} & list_reproduced() - {""}


@functools.cache
def list_reproduced() -> set[str]:
    names = {path.parent.name for path in (ROOT / "experiments").glob("*/expected.yaml")}
    published = [each for name in names for each in reproduce.read_expected(name)["commands"]]
    return names | {re.findall(NAMED, each)[0][0] for each in published}


def loads(command: str, _: Place) -> object:
    arguments = _name_files(arguments_of(command))
    settings = OmegaConf.to_container(compose_config(*arguments, "data.split.gap=0.05"), resolve=True)
    return build(settings["data"]).load().test


def asks_for_excitation(command: str, _: Place) -> object:
    """The drive that it chooses is one of which a recording tells; designing is tests/test_design.py's."""
    with computing("float64"):
        options = dict(argument.split("=", 1) for argument in arguments_of(command))
        return prepare(Request.read(options, None), None).space.names


def measure(command: str, place: Place) -> None:
    """The options are the script's; that it measures something, tests/test_benchmarks.py looks at."""
    path, *options = shlex.split(command)[1:]
    assert Path(path).stem in QUICKEST
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "benchmarks")
        patch.setattr(sys, "argv", [path, *options])
        importlib.import_module(Path(path).stem).parse()


def is_a_target_of_ci(command: str, place: Place) -> bool:
    """CI runs the target, or each line of it."""
    run = CI + blocks_of(ROOT / "README.md")[1]
    lines = place.run(command.replace("make", "make --dry-run")).splitlines()
    return bool(lines) and (command in run or all(line in run for line in lines))


SLOW = pytest.mark.slow
WITH_PACKAGE = blocks_of(PACKAGE / "README.md")  # tests/test_out_of_tree.py runs them
FROM = r"python -m frictionzoo\."
LEFT = {
    "test_actuator_net": rf"{FROM}export RUN target=actuator_net",
    "test_bam": rf"{FROM}bench\.read_bam FILE\.json",
    "test_card": rf"{FROM}card RUN licence=cc-by-4\.0.*",
    "test_card_origin": rf"{FROM}card RUN licence=.* bam=.*|{FROM}run data=xl330 \$\({FROM}bench\.read_bam .*\)",
    "test_compare": rf"{FROM}compare multirun/\S+( outputs/\S+ --output comparison)?",
    "test_design": rf"{FROM}design RUN position=1\.5 velocity=4 torque=2",
    "test_distill": rf"{FROM}distill RUN model=(stribeck|actuator_network|mujoco_default output=STUDENT)",
    "test_drift": rf"{FROM}drift RUN (OTHER_RUN THIRD_RUN )?b\.csv.*",
    "test_docs": r"make docs|mkdocs serve|python docs/draw_landing\.py",
    "test_experiments": r"make cards LICENCE=cc-by-4\.0",
    "test_export_targets": rf"{FROM}export RUN target=mjcf into=robot\.xml joint=left_knee,right_knee",
    "test_help": rf"eval .*|{JOB}--help|{JOB}-sc install=fish \| source",
    "test_loggers": r"tensorboard --logdir (outputs|multirun)|wandb sync FOLDER/wandb/offline-run-\*|mlflow ui.*",
    "test_names": rf"{FROM}export (RUN|drive) target=(mjcf|mujoco|onnx|isaaclab|mjlab|urdf|sdf)",
    "test_randomisation": rf"{FROM}export (RUN|drive) target=randomisation",
    "test_resume": rf"{JOB}resume=outputs/\S+",
    "test_sweep": rf"{JOB}-m .* resume=true",
    "test_targets": r"make targets RUNS=.*|python benchmarks/targets\.py .*",
    "test_usd": rf"{FROM}export RUN target=usd into=robot\.usd",
    "test_wheel": r"pip wheel --no-deps \.",
}
RULES: list[tuple[str, How, *tuple[pytest.MarkDecorator, ...]]] = [
    (r"python3\.11 -m venv .* pip install -c constraints\.txt -e .*|pytest -n 2", is_run_by_ci),
    (r"python3\.11 -m venv .* make install .*", install_for_development, SLOW),  # pre-commit comes with `dev`
    (r"pip install (-c constraints\.txt )?-e \"\.\[[\w,]+\]\"", extras_exist),
    (r"export FRICTIONZOO_DATA=\S+", lambda *_: "oc.env:FRICTIONZOO_DATA" in (CONF_DIR / "data/emps.yaml").read_text()),
    (r"pip install \./experiments/\w+|python -m pytest experiments/\w+", lambda command, _: command in WITH_PACKAGE),
    (rf"{JOB}.*\b(makkar|layer_norm_network)\b.*", lambda command, _: command in WITH_PACKAGE),
    (r"make help", lambda command, place: {"install", "test", "lint", "docs"} <= {*place.run(command).split()}),
    (r"make \w+", is_a_target_of_ci),
    (r"python benchmarks/\w+\.py.*", measure),
    (r"python experiments/reproduce\.py.*", is_reproduced),
    (rf"{FROM}list( \w+)*", lambda command, place: place.run(command)),
    (rf"{FROM}export RUN target=all", export_all, SLOW),
    (rf"{FROM}design position=.* bench=knee .*", asks_for_excitation),
    (rf"{FROM}inspect (data=files .*|\S+\.csv)", loads),
    (rf"{FROM}inspect data=xl330", loads, needs_data),
    (rf"{JOB}--cfg job", shows_configuration),
    # Sweeps
    (rf"{JOB}-m hydra/launcher=submitit_slurm .*", composes_for_a_cluster),
    (rf"{JOB}-m hydra/launcher=.*", lambda command, _: re.search(r"launcher=(\w+)", command)[1] in LAUNCHERS),
    (rf"{JOB}-m hydra/sweeper=.*", search, SLOW),
    (rf"{JOB}-m experiment=\w+ \"bench\..*", pose_jobs, SLOW, needs_data),
    (rf"{JOB}(-m )?experiment=.*", is_reproduced),
    (rf"{JOB}-m data=xl330 .*", pose_jobs, SLOW, needs_data),
    (rf"{JOB}-m .*", pose_jobs, SLOW),  # `finished_run` and the experiments do such sweeps
    # One job of each kind of drive, and those like it, which differ in what they read
    (rf"{JOB}model=coulomb_stribeck", do_jobs),
    (rf"{JOB}.* recipe=auto.*", do_jobs, SLOW),
    (rf"{JOB}bench=emps data=files .*", do_jobs),
    (rf"{JOB}.*bench\.payload=arm .*", do_jobs),
    (rf"{JOB}.*'bench\.joint=\[.*", pose_jobs, SLOW),
    (rf"{JOB}.*data=files .*", pose_jobs),
    (rf"{JOB}data=(sts3215|xl330) .*", loads, SLOW, needs_data),  # the experiments fit such laws to them
    (rf"{JOB}model=(mujoco_default|coulomb_smooth) .*", pose_jobs, SLOW),  # the laws of `finished_run`
    (rf"{JOB}.*", do_jobs, SLOW),
]


def find_rule(command: str) -> tuple[How | None, list[pytest.MarkDecorator]]:
    """How a command is tried, or None where other tests do that, and the marks of its test."""
    if any(re.fullmatch(pattern, command) for pattern in LEFT.values()):
        return None, []
    rules = ((how, marks) for pattern, how, *marks in RULES if re.fullmatch(pattern, command))
    if not (rule := next(rules, None)):
        raise LookupError(f"no rule knows `{command}`; add one to tests/test_commands.py")
    return rule


@pytest.fixture(scope="session")
def desk(shared_folder: Path, recording: Path) -> Path:
    """A folder of what a reader has: recordings in every format and a test stand; made once for all workers."""
    folder = shared_folder / "desk"
    with FileLock(shared_folder / "desk.lock"):
        if not folder.exists():
            (folder / "logs").mkdir(parents=True)
            for name in RECORDINGS:
                (folder / f"{name}.csv").symlink_to(recording)
            columns = get_format("csv").read(recording)[0].columns
            for name in WRITERS:
                write_log(folder, name, columns)
            write_degrees(folder / "degrees.csv", columns)
            write_ticks(folder / "ticks.csv", columns)
            (folder / "stand.xml").write_text(STAND)
            write_robots(folder)
    return folder


@pytest.fixture
def place(call: Callable, finished_run: Callable, desk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Place:
    monkeypatch.setattr(files, "read_tables", read_once)  # the same recordings for many commands
    for path in (*desk.iterdir(), *(ROOT / name for name in SCRIPTS)):
        (tmp_path / path.name).symlink_to(path)
    return Place(tmp_path, call, finished_run, desk.with_name("simulated"))


def fill(command: str) -> str:
    """The command without its reader's choices; the console script is the same program."""
    filled = command.replace("MODEL", "coulomb_stribeck")
    filled = re.sub(rf"^frictionzoo (?=(?:{'|'.join(COMMANDS)})\b)", "python -m frictionzoo.", filled)
    return re.sub("^frictionzoo ", "python -m frictionzoo.run ", filled)


FOUND = {fill(command): None for page in PAGES for command in commands_of(page)}
pytestmark = pytest.mark.usefixtures("in_haste")


RUN = {each: find_rule(each) for each in FOUND if find_rule(each)[0]}


@pytest.mark.parametrize("command", [pytest.param(each, marks=marks, id=each) for each, (_, marks) in RUN.items()])
def test_a_command_of_the_documentation_runs(command: str, place: Place) -> None:
    answer = RUN[command][0](command, place)
    assert answer is None or answer


def test_each_command_of_the_pages_needs_a_rule() -> None:
    """The patterns still find them, in blocks and in text."""
    assert len(FOUND) > 30 and {"make help", "tensorboard --logdir outputs"} <= FOUND.keys()
    assert all((ROOT / "tests" / f"{name}.py").exists() for name in LEFT)
    assert all(any(re.fullmatch(pattern, command) for command in FOUND) for pattern in LEFT.values())
    with pytest.raises(LookupError, match=r"no rule knows `python -m frictionzoo\.unheard_of FOLDER`"):
        find_rule("python -m frictionzoo.unheard_of FOLDER")
