"""Every command of the documentation is run: as it stands, in a folder like its reader's, at a small size.

A command is taken up by the first rule whose pattern it matches from start to end; one that no rule knows fails. A new
kind of command needs a rule:

    @rule(r"tensorboard --logdir \\S+")
    def serve_tensorboard(command: str, place: Place) -> None: ...
"""

import importlib
import itertools
import json
import math
import os
import re
import shlex
import shutil
import socket
import subprocess
import sys
import time
import tomllib
import urllib.error
import urllib.request
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest
import reproduce
from conftest import BRIEF, Finished, needs_data
from omegaconf import OmegaConf
from pages import PAGES, ROOT, blocks_of, commands_of, expand
from test_bam import M1
from test_benchmarks import QUICKEST
from test_experiments import MEASURED
from test_out_of_tree import COMMANDS as WITH_PACKAGE
from test_sweep import LAUNCHERS
from write_logs import WRITERS, write_degrees, write_log

from frictionzoo.config import CONF_DIR, compose_config
from frictionzoo.logs.formats import get_format

JOB = r"(?:python -m frictionzoo\.run|frictionzoo) "
FILLED = {"MODEL": "baseline"}  # what a page leaves to its reader, and what stands for it here
SMALL = {  # options that make a job quick, where it has them and the page does not set them
    "data.samples": "15000",
    "data.split.gap": "0.05",
    "segments.count": "20",
    "fit.iterations": "20",
    "loop.progress": "false",
    **BRIEF,
}
FEWER = ("'model=glob(*)'", "model=baseline,mujoco_default")  # every law runs in the README's plain sweep over them
STAND = """<mujoco><option timestep="0.001"><flag contact="disable"/></option><worldbody><body name="arm">
<joint name="shaft" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.2254" size="0.01" mass="0.26"/></body></worldbody></mujoco>"""
ROBOT = """<mujoco><worldbody><body><joint name="left_knee" axis="0 1 0"/><geom size="0.1"/>
<body><joint name="right_knee" axis="0 1 0"/><geom size="0.1"/></body></body></worldbody></mujoco>"""
RECORDINGS = ("a", "b", "bare", "loaded", "heavy")
LOGS = ("kp8_one", "kp8_two", "kp16_one", "kp16_two", "kp32_one")
REPRODUCED = sorted({getattr(name, "values", (name,))[0] for name in MEASURED})
CI = (ROOT / ".ci" / "run").read_text()
PATIENCE = 60.0  # s after which a server that does not answer is a failure


@dataclass(frozen=True)
class Place:
    """A reader's folder: a checkout's scripts, a test stand and recordings.

    Attributes:
        folder: The folder, in which the test runs.
        call: Does a job in this process, as the fixture of this name.
        environment: Of processes that are started here.
        cache: Folder of simulated recordings.
    """

    folder: Path
    call: Callable[..., Finished]
    environment: dict[str, str]
    cache: Path

    def run(self, command: str) -> subprocess.CompletedProcess[str]:
        """Run a command in a shell, and hold that it ends well."""
        shell = ["bash", "-euo", "pipefail", "-c", command]
        finished = subprocess.run(shell, cwd=self.folder, env=self.environment, capture_output=True, text=True)
        assert finished.returncode == 0, finished.stdout + finished.stderr
        return finished

    def do(self, *arguments: str) -> None:
        """Do jobs with these arguments, small ones, and hold that each of them ends well and leaves a result."""
        before = set(self.folder.rglob("result.json"))
        finished = self.call(*arguments, *shrink(arguments, self.cache))
        assert finished.status == 0, finished.err
        new = set(self.folder.rglob("result.json")) - before
        assert len(new) == math.prod(len(expand(argument)) for argument in options_of(arguments))
        for path in new:
            result = json.loads(path.read_text())
            assert result["fit"]["stopped"] != "diverged", path
            assert result["metrics"]["test"]["diverged"] == 0, path


Run = Callable[[str, Place], None]
RULES: list[tuple[str, Run]] = []
MARKS = [  # of the tests of commands that match
    (r"(pip|wandb|mlflow) .*|.* make install .*", pytest.mark.slow),
    (rf"{JOB}.*experiment=emps.*", needs_data),
    (rf"{JOB}.*(experiment|data)=(sts3215|xl330).*", needs_data),
    (rf"{JOB}.*experiment=.*", pytest.mark.slow),
    (rf"{JOB}.*data=(sts3215|xl330).*", pytest.mark.slow),
    (rf"{JOB}-m .*", pytest.mark.slow),
    (r"python -m frictionzoo\.(export|distill|compare) .*", pytest.mark.slow),
]


def rule(pattern: str) -> Callable[[Run], Run]:
    """Run commands that match from start to end in this way, unless a rule above does."""

    def register(run: Run) -> Run:
        RULES.append((pattern, run))
        return run

    return register


def find_rule(command: str) -> Run:
    """How a command is run."""
    return next((run for pattern, run in RULES if re.fullmatch(pattern, command)), refuse)


def refuse(command: str, place: Place) -> None:
    pytest.fail(f"no rule runs `{command}`; add one to tests/test_commands.py")


def options_of(arguments: Sequence[str]) -> list[str]:
    """Arguments that are options of a job and not flags of Hydra's."""
    return [argument for argument in arguments if "=" in argument]


def shrink(arguments: Sequence[str], cache: Path) -> list[str]:
    """The options of `SMALL`, and a cache, that all of these jobs have and that none of the arguments sets."""
    groups = [expand(option) for option in options_of(arguments) if (CONF_DIR / option.partition("=")[0]).is_dir()]
    configs = [compose_config(*choices) for choices in itertools.product(*groups)]
    named = {option.partition("=")[0] for option in arguments}
    return [
        f"{option}={value}"
        for option, value in (SMALL | {"data.cache_dir": str(cache)}).items()
        if option not in named and all(OmegaConf.select(c, option, default=absent) is not absent for c in configs)
    ]


absent = object()


@rule(r"python3\.11 -m venv .* pip install -c constraints\.txt -e .*")
def leave_to_ci(command: str, place: Place) -> None:
    number = blocks_of(ROOT / "README.md").index(command) + 1
    assert f"run_readme_command {number}" in map(str.strip, CI.splitlines())


@rule(r"python3\.11 -m venv .* make install .*")
def install_for_development(command: str, place: Place) -> None:
    """In a copy of the project whose new environment sees the packages of this one, so that few are installed."""
    copy_project(place)
    # Made before it sees other packages: with a pip among these it would get none, and theirs would install into them.
    place.run("python3.11 -m venv .venv")
    (packages,) = place.folder.glob(".venv/lib/python*/site-packages")
    (packages / "borrowed.pth").write_text("\n".join(path for path in sys.path if path.endswith("site-packages")))
    pip = place.run("python3.11 -m venv .venv && . .venv/bin/activate && command -v pip").stdout
    assert Path(pip.strip()) == place.folder / ".venv" / "bin" / "pip"
    place.run("git init --quiet")
    place.run(command)
    assert list(packages.glob("frictionzoo-*.dist-info"))
    assert (place.folder / ".git" / "hooks" / "pre-commit").exists()
    place.run(". .venv/bin/activate && frictionzoo --cfg job && ruff --version")


@rule(r"pip wheel .*")
def build_wheel(command: str, place: Place) -> None:
    copy_project(place)
    place.run(command)
    assert len(list(place.folder.glob("frictionzoo-*.whl"))) == 1


@rule(r"pip install .*-e \"\.\[[\w,]+\]\"")
def resolve_extra(command: str, place: Place) -> None:
    """The project itself only: what an extra brings is as large as CUDA."""
    copy_project(place)
    place.run(f"{command} --dry-run --no-deps")
    extras = set(command.rpartition("[")[2].partition("]")[0].split(","))
    assert extras <= tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"].keys()


@rule(r"export FRICTIONZOO_DATA=\S+")
def name_the_data(command: str, place: Place) -> None:
    folder = place.run(f"{command}; {sys.executable} -c 'import os; print(os.environ[\"FRICTIONZOO_DATA\"])'").stdout
    assert folder.strip() == command.partition("=")[2]
    assert "oc.env:FRICTIONZOO_DATA" in (CONF_DIR / "data" / "emps.yaml").read_text()


@rule(r"pip install \./experiments/\w+|python -m pytest experiments/\w+|.*\b(makkar|layer_norm_network)\b.*")
def leave_to_the_packages_test(command: str, place: Place) -> None:
    """tests/test_out_of_tree.py runs it where the package is installed."""
    assert command in WITH_PACKAGE


@rule(rf"{JOB}.*--cfg job.*")
def show_configuration(command: str, place: Place) -> None:
    finished = place.call(*arguments_of(command))
    assert finished.status == 0, finished.err
    assert OmegaConf.create(finished.out).keys() >= {"bench", "data", "fit", "segments"}


@rule(rf"{JOB}resume=\S+")
def resume(command: str, place: Place) -> None:
    (argument,) = arguments_of(command)
    folder = argument.partition("=")[2]
    place.do("model=coulomb_stribeck", f"hydra.run.dir={folder}")
    before = json.loads((place.folder / folder / "result.json").read_text())
    (place.folder / folder / "result.json").unlink()
    finished = place.call(argument)
    assert finished.status == 0, finished.err
    after = json.loads((place.folder / folder / "result.json").read_text())
    assert after["parameters"] == before["parameters"]


@rule(r"python -m frictionzoo\.export RUN .*")
def export(command: str, place: Place) -> None:
    place.do("model=mujoco_default", "hydra.run.dir=RUN")
    (place.folder / "robot.xml").write_text(ROBOT)
    place.run(command)
    written = list(place.folder.glob("RUN/export/*/export.json"))
    assert written and all(json.loads(path.read_text())["files"] for path in written)


@rule(r"python -m frictionzoo\.distill RUN .*")
def distill(command: str, place: Place) -> None:
    place.do("model=coulomb_stribeck", "hydra.run.dir=RUN")
    place.run(command)
    (path,) = place.folder.rglob("distillation.json")
    assert len(json.loads(path.read_text())["differences"]) == 2


@rule(r"python -m frictionzoo\.export\.read_bam FILE\.json")
def read_bam(command: str, place: Place) -> None:
    (place.folder / "FILE.json").write_text(json.dumps(M1))
    assert "fit=known" in place.run(command).stdout


@rule(rf"{JOB}-m hydra/launcher=submitit_slurm .*")
def compose_for_a_cluster(command: str, place: Place) -> None:
    """There is no cluster here; its options are known to the launcher."""
    options = [argument for argument in arguments_of(command) if argument.startswith("hydra")]
    assert "slurm" in place.run(f"python -m frictionzoo.run {shlex.join(options)} --cfg hydra").stdout


@rule(rf"{JOB}-m hydra/launcher=\w+ 'model=glob\(\*\)'")
def leave_launchers_to_their_test(command: str, place: Place) -> None:
    """tests/test_sweep.py sweeps with each of them and compares what they find."""
    launcher = options_of(arguments_of(command))[0].partition("=")[2]
    assert launcher in LAUNCHERS


@rule(rf"{JOB}-m hydra/(launcher|sweeper)=.*")
def sweep_in_processes(command: str, place: Place) -> None:
    """Launchers and sweepers hand jobs to other processes, to which nothing of this one goes."""
    trials = ["hydra.sweeper.n_trials=2"] if "sweeper=" in command else []
    command = command.replace(*FEWER)
    place.run(f"{command} {shlex.join([*shrink(arguments_of(command), place.cache), *trials])}")
    assert len(list(place.folder.glob("multirun/**/result.json"))) > 1


@rule("|".join(re.escape(command) for name in REPRODUCED for command in reproduce.read_expected(name)["commands"]))
def leave_reproduced_commands_to_ci(command: str, place: Place) -> None:
    """`python experiments/reproduce.py NAME` runs them at full size."""
    assert "pytest -m slow " in CI


@rule(rf"{JOB}-m .*experiment=.*")
def sweep_over_an_experiment(command: str, place: Place) -> None:
    place.do(*arguments_of(command.replace(*FEWER)))


@rule(rf"{JOB}.*")
def do_jobs(command: str, place: Place) -> None:
    place.do(*arguments_of(command))


@rule(r"python -m frictionzoo\.inspect .*")
def inspect(command: str, place: Place) -> None:
    place.run(command)
    (path,) = place.folder.rglob("inspect.json")
    assert json.loads(path.read_text())["findings"]


@rule(r"python -m frictionzoo\.compare .*")
def compare(command: str, place: Place) -> None:
    """Each folder that is named is that of a sweep."""
    folders = shlex.split(command.partition(" --output ")[0])[3:]
    for folder in folders:
        place.do("-m", "model=baseline,coulomb_smooth", f"hydra.sweep.dir={folder}")
        shutil.rmtree(place.folder / folder / "comparison")  # the sweep's own
    place.run(command)
    (path,) = place.folder.rglob("comparison.json")
    assert len(json.loads(path.read_text())["runs"]) == 2 * len(folders)


@rule(r"python experiments/reproduce\.py \w+")
def leave_experiment_to_ci(command: str, place: Place) -> None:
    """CI runs it at full size, in tests/test_experiments.py."""
    assert command.split()[-1] in REPRODUCED and "pytest -m slow " in CI


@rule(r"python benchmarks/\w+\.py.*")
def measure(command: str, place: Place) -> None:
    """The options are the script's; that it measures something, tests/test_benchmarks.py looks at."""
    path, *options = shlex.split(command)[1:]
    assert Path(path).stem in QUICKEST
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "benchmarks")
        patch.setattr(sys, "argv", [path, *options])
        importlib.import_module(Path(path).stem).parse()


@rule(r"pytest -m slow .*")
def leave_slow_tests_to_ci(command: str, place: Place) -> None:
    assert "pytest -m slow " in CI
    assert all((ROOT / path).exists() for path in command.split()[3:])


@rule(r"make help")
def list_targets(command: str, place: Place) -> None:
    listed = place.run(command).stdout.split()
    assert {"install", "test", "slow", "lint", "docs"} <= set(listed)


@rule(r"make \w+")
def leave_target_to_ci(command: str, place: Place) -> None:
    """CI runs the target, or each line of it with tools from folders of its own."""
    run = re.sub(r'"?\S*/bin/(\w+)"?', r"\1", CI) + blocks_of(ROOT / "README.md")[1]
    lines = place.run(command.replace("make", "make --dry-run")).stdout.splitlines()
    assert lines and (command in run or all(line in run for line in lines)), lines


@rule(r"tensorboard --logdir \S+")
def serve_tensorboard(command: str, place: Place) -> None:
    folder = command.split()[-1]
    place.do("model=baseline", f"hydra.run.dir={folder}/run")
    wait_for(place, f"{command} --host 127.0.0.1", "data/runs", json.dumps(["run/tensorboard"]))


@rule(r"(wandb|mlflow) .*")
def look_outside(command: str, place: Place) -> None:
    """These programs need a network, or packages that are no part of the extras; what they are to read is there."""
    if "FOLDER" not in command:  # named again, in short
        assert any(other.startswith(f"{command} ") for other in FOUND)
        return
    place.do("model=baseline", f"logger={command.split()[0]}", "hydra.run.dir=FOLDER")
    assert list(place.folder.glob(command[command.index("FOLDER") :]))


@rule(r"mkdocs serve")
def serve_documentation(command: str, place: Place) -> None:
    pytest.importorskip("mkdocs", reason="the extra docs is not installed")  # CI installs it and runs this test
    copy_project(place)
    wait_for(place, f"{command} --dev-addr 127.0.0.1:", "index.html", "<title>frictionzoo</title>")


def wait_for(place: Place, command: str, page: str, content: str) -> None:
    """Start a server, and hold that a page of it comes to hold this."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    arguments = shlex.split(f"{command}{port}" if command.endswith(":") else f"{command} --port {port}")
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    server = subprocess.Popen(arguments, cwd=place.folder, env=place.environment, **quiet)
    try:
        end = time.monotonic() + PATIENCE
        while content not in fetch(f"http://127.0.0.1:{port}/{page}"):
            assert server.poll() is None and time.monotonic() < end
            time.sleep(0.2)
    finally:
        server.terminate()
        server.wait()


def fetch(address: str) -> str:
    """A page; "" while nobody answers."""
    try:
        with urllib.request.urlopen(address, timeout=PATIENCE) as answer:
            return answer.read().decode()
    except urllib.error.URLError:
        return ""


def copy_project(place: Place) -> None:
    """Replace the links to the project by a copy that a command may write into."""
    for path in place.folder.iterdir():
        if path.is_symlink():
            path.unlink()
    ignored = (".git", ".venv", "site", "outputs", "multirun", "results", "__pycache__", "*.egg-info", ".*_cache")
    shutil.copytree(ROOT, place.folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns(*ignored))


def arguments_of(command: str) -> list[str]:
    """What follows the program that does jobs."""
    return shlex.split(re.sub(f"^{JOB}", "", command))


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the jobs share simulated recordings."""
    return tmp_path_factory.mktemp("simulated")


@pytest.fixture
def place(call: Callable[..., Finished], recording: Path, tmp_path: Path, simulated: Path) -> Place:
    for name in ("benchmarks", "experiments", "frictionzoo", "conf", "Makefile", "pyproject.toml"):
        (tmp_path / name).symlink_to(ROOT / name)
    (tmp_path / "stand.xml").write_text(STAND)
    for name in RECORDINGS:
        shutil.copy(recording, tmp_path / f"{name}.csv")
    (tmp_path / "logs").mkdir()
    for name in LOGS:
        (tmp_path / "logs" / f"{name}.csv").symlink_to(recording)
    columns = get_format("csv").read(recording)[0].columns
    for name in WRITERS:
        write_log(tmp_path, name, columns)
    write_degrees(tmp_path / "degrees.csv", columns)
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PATH": path}
    return Place(tmp_path, call, environment, simulated)


def fill(command: str) -> str:
    return re.sub("|".join(FILLED), lambda match: FILLED[match[0]], command)


FOUND = {fill(command): None for page in PAGES for command in commands_of(page)}
pytestmark = pytest.mark.usefixtures("in_haste")
CASES = [
    pytest.param(command, marks=[mark for pattern, mark in MARKS if re.fullmatch(pattern, command)], id=command)
    for command in FOUND
]


@pytest.mark.parametrize("command", CASES)
def test_a_command_of_the_documentation_runs(command: str, place: Place) -> None:
    find_rule(command)(command, place)


def test_the_pages_have_commands() -> None:
    """The patterns still find them, in blocks and in text."""
    assert len(FOUND) > 30
    assert {"make help", "tensorboard --logdir outputs"} <= FOUND.keys()


def test_a_command_that_no_rule_knows_fails(place: Place) -> None:
    command = "python -m frictionzoo.unheard_of FOLDER"
    with pytest.raises(
        pytest.fail.Exception, match=r"no rule runs `python -m frictionzoo\.unheard_of FOLDER`; add one"
    ):
        find_rule(command)(command, place)
