"""Exported drives in programs of environments of their own, which pip makes."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from conftest import Finished

ROOT = Path(__file__).parent.parent
EXACT = 1e-9  # rad; rounding of 3000 steps stays far below


def roll(folder: Path, runs: list[Path], *programs: str) -> list[dict[str, Any]]:
    """The rows of the benchmark for these runs in these programs."""
    command = [sys.executable, ROOT / "benchmarks" / "targets.py", *runs, "--out", folder / "rows.json"]
    command += ["--programs", *programs, "--environments", folder / "environments"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    finished = subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True)
    assert finished.returncode == 0, finished.stderr
    return json.loads((folder / "rows.json").read_text())["rows"]


@pytest.mark.slow
def test_exports_move_in_mujoco_4_as_in_this_one(
    finished_run: Callable[[str], tuple[Path, Finished]], tmp_path: Path
) -> None:
    """MuJoCo's own friction in the MJCF, the law in the module, and what the MJCF has in place of another law."""
    runs = [finished_run(name)[0] for name in ("mujoco_default", "coulomb_stribeck")]
    rows = roll(tmp_path, runs, "mujoco", "mjcf", "mujoco4", "mjcf4")
    if missing := [row["note"] for row in rows if (row["note"] or "").startswith("no environment")]:
        pytest.skip(missing[0])
    assert [row["program"].split(".")[0] for row in rows] == 2 * (2 * ["mujoco 3"] + 2 * ["mujoco 4"])
    law, mjcf, law4, mjcf4, law_s, mjcf_s, law4_s, mjcf4_s = [row["largest"] for row in rows]
    assert max(law, mjcf, law4, mjcf4, law_s, law4_s) < EXACT
    assert mjcf4_s == pytest.approx(mjcf_s, abs=EXACT)
    assert {row["note"] for row in rows[5::2]} == {rows[5]["note"]}


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="no g++, which makes a program with libtorch")
def test_a_law_moves_in_libtorch_as_in_this_one(
    finished_run: Callable[[str], tuple[Path, Finished]], tmp_path: Path
) -> None:
    """From C++, which asks the TorchScript file for friction in each step."""
    (row,) = roll(tmp_path, [finished_run("coulomb_stribeck")[0]], "libtorch")
    assert row["program"].startswith("libtorch ") and row["largest"] < EXACT


@pytest.mark.slow
def test_drake_takes_urdf_and_sdf_alike_and_dry_friction_from_outside(
    finished_run: Callable[[str], tuple[Path, Finished]], tmp_path: Path
) -> None:
    """It reads links, damping and armature."""
    rows = roll(tmp_path, [finished_run("mujoco_default")[0]], "drake", "drakesdf", "drakedry")
    if missing := [row["note"] for row in rows if (row["note"] or "").startswith("no environment")]:
        pytest.skip(missing[0])
    urdf, sdf, dry = [row["mean"] for row in rows]
    assert sdf == pytest.approx(urdf, rel=1e-6)
    assert dry < 0.2 * sdf


@pytest.mark.slow
def test_dart_takes_dry_friction_from_the_urdf_armature_from_outside_and_gazebo_the_sdf_as_dart(
    finished_run: Callable[[str], tuple[Path, Finished]], tmp_path: Path
) -> None:
    """They read links and damping, too. Gazebo's physics has DART in it."""
    rows = roll(tmp_path, [finished_run("mujoco_default")[0]], "dart", "dartrotors", "gazebo")
    if missing := [row["note"] for row in rows if (row["note"] or "").startswith("no environment")]:
        pytest.skip(missing[0])
    bare, rotors, gazebo = rows
    assert rotors["mean"] < 1e-3 * bare["mean"]  # its friction has no regard to the damping: 1e-4
    if (gazebo["note"] or "").startswith("no Gazebo physics"):
        pytest.skip(gazebo["note"])
    assert gazebo["program"].startswith("gazebo physics ")
    assert gazebo["mean"] == pytest.approx(bare["mean"], rel=1e-6)
