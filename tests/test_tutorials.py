"""The Python of the tutorials and of the page on Python runs as it stands, and finds the drives that it speaks of."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from filelock import FileLock
from helpers.robots import TRUTH, record
from helpers.tutorials import DOCS, ENCODER, LEG, SUBSTEPS, code_of, write_robots

import frictionzoo as fz
from frictionzoo.models.registry import REGISTRY

pytestmark = pytest.mark.usefixtures("in_haste", "unrendered")
STAND = """<mujoco><option timestep="0.002"><flag contact="disable"/></option><worldbody><body>
<joint name="shaft" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.01" mass="0.3"/>
</body></worldbody></mujoco>"""
SHAFT = {"armature": [0.03], "frictionloss": [0.15], "damping": [0.05]}
SERVO = SHAFT | {"damping": [0.55], "kp": [15.0]}  # kd among its damping


@pytest.fixture(scope="module")
def recordings(shared_folder: Path) -> Path:
    """The folder with the robots, the test stand and two recordings of it, written once for all workers."""
    folder, headers = shared_folder / "tutorials", {signal: [signal] for signal in ("qpos", "qvel", "ctrl")}
    with FileLock(folder.with_suffix(".lock")):
        if not folder.exists():
            (half := shared_folder / "half").mkdir()
            write_robots(half)
            (half / "stand.xml").write_text(STAND)
            options: dict[str, Any] = {"seconds": 16.0, "noise": ENCODER, "substeps": SUBSTEPS}
            for seed, name in enumerate(("a.csv", "b.csv")):
                record(half / name, STAND, SHAFT, {"kp": 15, "kd": 0.5}, headers, seed=seed, **options)
            half.rename(folder)
    return folder


@pytest.fixture
def follow(recordings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., dict[str, Any]]:
    """Runs the Python of a page from some block on, where its files are; the names that it leaves."""
    monkeypatch.chdir(shutil.copytree(recordings, tmp_path, dirs_exist_ok=True))
    monkeypatch.setattr(REGISTRY, "entries", dict(REGISTRY.entries))

    def run(page: str, first: int = 0) -> dict[str, Any]:
        names: dict[str, Any] = {"__name__": page}
        for block in code_of(page, "python")[first:]:
            exec(compile(block, page, "exec"), names)
        return names

    return run


def assert_found(drive: fz.Identified, truth: dict[str, Any], tolerance: float) -> None:
    """All that was identified is near these."""
    assert drive.result["engine"] == "specialised"
    found = {name.partition(".")[2]: each.value for name, each in drive.parameters.items() if each.identified}
    assert found.keys() == truth.keys()
    for name, values in truth.items():
        np.testing.assert_allclose(found[name], values, rtol=tolerance, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("page", "drive", "truth", "tolerance"),
    [("leg", "leg", LEG, 0.05), ("arm", "arm", TRUTH, 0.05), ("servo", "servo", SERVO, 0.15)],
)
def test_a_tutorial_finds_its_drive(follow, tmp_path, page, drive, truth, tolerance):
    """And leaves all that a run leaves, also with several joints."""
    found = follow(f"tutorials/{page}.md")[drive]
    assert_found(found, truth, tolerance)
    found.save(tmp_path / "saved")
    assert {"report.html", "identified.xml", "result.json"} <= {path.name for path in (tmp_path / "saved").iterdir()}


@pytest.mark.slow
def test_the_tutorial_of_a_law_ranks_it(follow: Callable, tmp_path: Path) -> None:
    ranking = follow("tutorials/law.md")["found"].ranking
    assert {*ranking} == {"baseline", "coulomb_smooth", "mujoco_default", "pushed_coulomb"}
    assert ranking[0] == "mujoco_default"  # whose friction the recording has
    assert (tmp_path / "comparison" / "comparison.html").exists()


@pytest.mark.slow
def test_the_tutorial_of_ranges_holds_the_drive(follow: Callable, finished_run: Callable, tmp_path: Path) -> None:
    (tmp_path / "drive").symlink_to(finished_run("mujoco_default")[0])
    names = follow("tutorials/randomisation.md")
    for fit in names["units"]:
        assert_found(fit, SHAFT, 0.15)
    for low, high in names["ranges"].values():
        assert 0.5 < low < 1 < high < 1.5
    low, high = np.array(names["ranges"]["bench.armature"]) * names["units"][0].parameters["bench.armature"].value
    assert low < SHAFT["armature"][0] < high
    with np.load(tmp_path / "drives" / "samples.npz") as samples:
        drawn = samples["joint.armature"]
    assert low < drawn.min() < low + 0.01 * (high - low) and high - 0.01 * (high - low) < drawn.max() < high
    assert len(list((tmp_path / "drives" / "samples").iterdir())) == 4


@pytest.mark.slow
def test_the_page_on_python_identifies_and_compares(follow: Callable, tmp_path: Path) -> None:
    before = torch.get_default_dtype()
    names = follow("python.md", first=1)
    assert torch.get_default_dtype() == before
    assert_found(names["fit"], SHAFT, 0.1)
    assert names["several"].cleaned[0][0].qpos.shape[1] == 2 and names["held_out"].held_out == 1
    assert names["found"].ranking == ["mujoco_default", "baseline"]
    assert (tmp_path / "comparison" / "comparison.json").exists()
    assert follow("posterior.md")["posterior"]["bench.armature"].shape == (1000, 1)


def test_every_tutorial_has_code_that_is_run() -> None:
    pages = {path.stem for path in (DOCS / "tutorials").glob("*.md")}
    assert pages == {"servo", "leg", "arm", "law", "randomisation"}
    assert all(code_of(f"tutorials/{page}.md", "python") for page in pages)
