"""A wheel, installed into an environment of its own, does the same job as the checkout."""

import json
import os
import shutil
import subprocess
import sysconfig
import venv
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import RUNS
from helpers.pages import ROOT


def run(*command: str | Path, **options: Path) -> str:
    """What a command that ends well prints, where nothing leads to the checkout."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    finished = subprocess.run(command, env=environment, capture_output=True, text=True, **options)
    assert finished.returncode == 0, finished.stdout + finished.stderr
    return finished.stdout


def check_content(wheel: Path) -> None:
    """It holds what a job needs, and nothing else."""
    names = set(zipfile.ZipFile(wheel).namelist())
    kinds = (".py", ".xml", ".json", ".jinja", ".css", ".js")
    here = {str(path.relative_to(ROOT)) for path in ROOT.glob("frictionzoo/**/*") if path.suffix in kinds}
    conf = {f"frictionzoo/{path.relative_to(ROOT)}" for path in ROOT.glob("conf/**/*.yaml")}
    assert here | conf <= names
    tops = {name.partition("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"frictionzoo"}


@pytest.mark.slow
@pytest.mark.usefixtures("in_haste")
def test_a_wheel_does_the_same_job(finished_run: Callable, tiny: tuple[str, ...], tmp_path: Path) -> None:
    """The wheel is built as docs/install.md says; the packages that it needs are those of this environment."""
    scripts, elsewhere = tmp_path / "environment" / "bin", tmp_path / "elsewhere"
    elsewhere.mkdir()
    venv.create(scripts.parent, with_pip=True)
    source = shutil.copytree(
        ROOT, tmp_path / "source", ignore=shutil.ignore_patterns(".git", ".venv", "site", "outputs", "multirun")
    )
    run(scripts / "pip", "wheel", "--no-deps", ".", cwd=source)
    (wheel,) = source.glob("frictionzoo-*.whl")
    check_content(wheel)
    run(scripts / "pip", "install", "--quiet", "--no-deps", "--no-index", wheel)
    (packages,) = scripts.parent.glob("lib/python*/site-packages")
    (packages / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    where = run(scripts / "python", "-c", "import frictionzoo; print(frictionzoo.__file__)", cwd=elsewhere)
    assert Path(where.strip()).is_relative_to(scripts.parent)

    run(scripts / "frictionzoo", *RUNS["coulomb_smooth"], *tiny, "hydra.run.dir=run", cwd=elsewhere)
    folders = (elsewhere / "run", finished_run("coulomb_smooth")[0])
    for name in ("friction.safetensors", "identified.xml"):
        first, second = ((folder / name).read_bytes() for folder in folders)
        assert first == second
    first, second = (json.loads((folder / "result.json").read_text()) for folder in folders)
    for section in ("model", "data", "parameters", "fit", "metrics", "paper", "versions"):
        assert first[section] == second[section]
