"""A wheel, installed into an environment of its own, does the same job as the checkout."""

import json
import os
import subprocess
import sys
import sysconfig
import venv
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The project's wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "build", "--wheel", "--outdir", str(folder), str(ROOT)]
    finished = subprocess.run(command, capture_output=True, text=True)
    assert finished.returncode == 0, finished.stdout + finished.stderr
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The `bin` folder of a new environment with the wheel; the packages that it needs are those of this one."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=True)
    scripts = folder / "bin"
    subprocess.run([scripts / "pip", "install", "--quiet", "--no-deps", "--no-index", wheel], check=True)
    (packages,) = folder.glob("lib/python*/site-packages")
    (packages / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return scripts


def test_the_wheel_holds_what_a_job_needs(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    kinds = (".py", ".xml", ".json", ".jinja")
    here = {str(path.relative_to(ROOT)) for path in ROOT.glob("frictionzoo/**/*") if path.suffix in kinds}
    conf = {f"frictionzoo/{path.relative_to(ROOT)}" for path in ROOT.glob("conf/**/*.yaml")}
    assert here | conf <= names
    tops = {name.partition("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"frictionzoo"}


def test_the_installed_command_does_the_same_job(
    installed: Path, start: Callable, compilation_cache: Path, tiny: tuple[str, ...], tmp_path: Path
) -> None:
    job = (*tiny, "model=baseline", "fit.iterations=3")
    checkout = start(*job, "hydra.run.dir=checkout")
    assert checkout.wait() == 0
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}

    where = [installed / "python", "-c", "import frictionzoo; print(frictionzoo.__file__)"]
    module = subprocess.run(where, cwd=elsewhere, env=environment, check=True, capture_output=True, text=True).stdout
    assert Path(module.strip()).is_relative_to(installed.parent)
    command = [installed / "frictionzoo", *job, "hydra.run.dir=run"]
    finished = subprocess.run(command, cwd=elsewhere, env=environment, capture_output=True, text=True)
    assert finished.returncode == 0, finished.stderr

    for name in ("friction.safetensors", "identified.xml"):
        assert (elsewhere / "run" / name).read_bytes() == (tmp_path / "checkout" / name).read_bytes()
    first, second = (
        json.loads((folder / "result.json").read_text()) for folder in (elsewhere / "run", tmp_path / "checkout")
    )
    for section in ("model", "data", "parameters", "fit", "metrics", "paper", "versions"):
        assert first[section] == second[section]
