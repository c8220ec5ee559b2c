"""The example of a law in a package of its own: installed for real, it is a law like any other.

Its page's commands are run as they stand there, with options after them that make them small and keep pip offline.
"""

import json
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest
from conftest import Finished
from helpers.pages import PACKAGE, ROOT, blocks_of

from frictionzoo.core.config import list_choices
from frictionzoo.models import model_names

INSTALL, CHECK, RUN, COMPARE, TORCH = blocks_of(PACKAGE / "README.md")
PARAMETERS = {
    **{"stribeck_torque": "N m", "stribeck_rise": "s/rad", "stribeck_decay": "s/rad", "coulomb_torque": "N m"},
    **{"coulomb_rise": "s/rad", "viscous_coefficient": "N m s/rad"},
}

pytestmark = pytest.mark.usefixtures("in_haste")

Command = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def command(tmp_path_factory: pytest.TempPathFactory, compilation_cache: Path) -> Command:
    """Runs a command with more arguments where the package is installed, and holds that it ends with this status."""
    folder = tmp_path_factory.mktemp("checkout")
    site = folder / "site"
    ignored = shutil.ignore_patterns("build", "*.egg-info", "__pycache__")
    shutil.copytree(PACKAGE, folder / PACKAGE.relative_to(ROOT), ignore=ignored)  # setuptools builds in the folder
    own = {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": os.pathsep.join(map(str, (site, ROOT, ROOT / "tests"))),
        "JAX_COMPILATION_CACHE_DIR": str(compilation_cache),
    }

    def run(text: str, *arguments: str, status: int = 0) -> subprocess.CompletedProcess[str]:
        whole = [*shlex.split(text), *arguments]
        finished = subprocess.run(whole, cwd=folder, env=os.environ | own, capture_output=True, text=True)
        assert finished.returncode == status, finished.stdout + finished.stderr
        return finished

    run(INSTALL, "--no-deps", "--no-index", "--no-build-isolation", "--target", str(site))
    shutil.rmtree(folder / PACKAGE.relative_to(ROOT) / "src")  # what follows is about what was installed
    return run


@pytest.mark.slow
def test_its_own_tests_pass(command: Command) -> None:
    assert " passed" in command(CHECK).stdout


SESSION = """
import json, sys
from frictionzoo.cli.commands import dispatch
from conftest import finish
json.dump([vars(finish(lambda: dispatch(each))) for each in json.loads(sys.argv[1])], sys.stdout)
"""


def run_in_one_process(command: Command, *commands: Sequence[str]) -> Iterator[Finished]:
    """What `python -m frictionzoo.NAME` ends with, for several after each other in a process that has the package."""
    asked = [[*shlex.split(text.removeprefix("python -m frictionzoo.")), *more] for text, *more in commands]
    ended = command(f"python -c {shlex.quote(SESSION)}", json.dumps(asked)).stdout
    return (Finished(**each) for each in json.loads(ended))


@pytest.mark.slow
def test_its_laws_are_laws_like_any_other(command: Command, tiny: tuple[str, ...], tmp_path: Path) -> None:
    refused = "seed=-1"  # each job ends before it begins
    sweep, run, jobs = tmp_path / "sweep", tmp_path / "run", tmp_path / "jobs"
    shown, compared, exported, fitted, scripted, listed, unknown = run_in_one_process(
        command,
        (RUN, "--cfg", "job"),
        (COMPARE, *tiny, "fit=lm", "fit.iterations=12", f"hydra.sweep.dir={sweep}"),
        (f"python -m frictionzoo.export {sweep}/0_makkar target=mujoco",),
        (TORCH, *tiny, "fit.iterations=4", f"hydra.run.dir={run}"),
        (f"python -m frictionzoo.export {run} target=torchscript",),
        ("python -m frictionzoo.run -m 'model=glob(*)'", refused, f"hydra.sweep.dir={jobs}"),
        ("python -m frictionzoo.run model=makka",),
    )
    assert [each.status for each in (shown, compared, exported, fitted, scripted)] == [0] * 5
    assert "Makkar" in shown.out and "Warning" not in compared.err
    comparison = json.loads((sweep / "comparison" / "comparison.json").read_text())
    assert {run["label"] for run in comparison["runs"]} == {"makkar", "coulomb_stribeck"}
    folder = sweep / "0_makkar"
    result = json.loads((folder / "result.json").read_text())
    assert result["model"] == "makkar" and result["metrics"]["test"]["diverged"] == 0
    found = {entry["name"]: entry for entry in result["parameters"]}
    assert {name: found[name]["unit"] for name in PARAMETERS} == PARAMETERS
    # The recording's drive is this law without the Stribeck effect, with coulomb_rise as it is known; no noise.
    truth = {"armature": 0.04, "coulomb_torque": 0.1, "viscous_coefficient": 0.05}
    assert {name: found[name]["value"] for name in truth} == pytest.approx(truth, rel=1e-3)
    module = (folder / "export" / "mujoco" / "drive.py").read_text()
    assert "stribeck_rise" in module and "frictionzoo_makkar" not in module

    assert json.loads((run / "result.json").read_text())["metrics"]["test"]["diverged"] == 0
    assert (run / "export" / "torchscript" / "friction.pt").exists()

    names = {path.parent.name.partition("_")[2] for path in jobs.glob("*/failure.json")}
    assert names == {"makkar", "layer_norm_network", *list_choices("model")}
    (line,) = unknown.err.splitlines()
    assert line.startswith("frictionzoo: model=makka: no such model; did you mean makkar? (")
    assert (listed.status, unknown.status) == (2, 2)


@pytest.mark.slow
def test_other_programs_do_not_see_its_names(command: Command, tmp_path: Path) -> None:
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "own.yaml").write_text("a: 1\n")
    script = f"""
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
with initialize_config_dir({str(tmp_path)!r}, version_base="1.3"):
    print(GlobalHydra.instance().config_loader().get_group_options("model"))
"""
    assert command(f"python -c {shlex.quote(script)}").stdout == "['own']\n"


@pytest.mark.skipif("makkar" in model_names(), reason="the example is installed")
def test_without_the_package_its_name_is_refused(call: Callable[..., Finished]) -> None:
    finished = call(*shlex.split(RUN)[3:])
    assert (finished.status, finished.out) == (2, "")
    (line,) = finished.err.splitlines()
    assert line == f"frictionzoo: model=makkar: no such model; expected one of {', '.join(list_choices('model'))}"
