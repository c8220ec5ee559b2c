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
from conftest import ROOT

EXACT = 1e-9  # rad; rounding of 3000 steps stays far below


pytestmark = pytest.mark.slow
Roll = Callable[..., list[dict[str, Any]]]


@pytest.fixture
def roll(finished_run: Callable, tmp_path: Path) -> Roll:
    """Gives the rows of the benchmark for runs in these programs; skips the test where one has no environment."""

    def roll(runs: list[str], *programs: str) -> list[dict[str, Any]]:
        script, out = ROOT / "benchmarks" / "targets.py", tmp_path / "rows.json"
        command = [sys.executable, script, *[finished_run(name)[0] for name in runs], "--out", out]
        command += ["--programs", *programs, "--environments", tmp_path / "environments"]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        finished = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True)
        assert finished.returncode == 0, finished.stderr
        rows = json.loads(out.read_text())["rows"]
        if missing := [row["note"] for row in rows if (row["note"] or "").startswith("no environment")]:
            pytest.skip(missing[0])
        return rows

    return roll


def test_exports_move_in_mujoco_4_as_in_this_one(roll: Roll) -> None:
    """MuJoCo's own friction in the MJCF, the law in the module, and what the MJCF has in place of another law."""
    rows = roll(["mujoco_default", "coulomb_stribeck"], "mujoco", "mjcf", "mujoco4", "mjcf4")
    assert [row["program"].split(".")[0] for row in rows] == 2 * (2 * ["mujoco 3"] + 2 * ["mujoco 4"])
    law, mjcf, law4, mjcf4, law_s, mjcf_s, law4_s, mjcf4_s = [row["largest"] for row in rows]
    assert max(law, mjcf, law4, mjcf4, law_s, law4_s) < EXACT
    assert mjcf4_s == pytest.approx(mjcf_s, abs=EXACT)
    assert {row["note"] for row in rows[5::2]} == {rows[5]["note"]}


@pytest.mark.skipif(shutil.which("g++") is None, reason="no g++, which makes a program with libtorch")
def test_a_law_moves_in_libtorch_as_in_this_one(roll: Roll) -> None:
    """From C++, which asks the TorchScript file for friction in each step."""
    (row,) = roll(["coulomb_stribeck"], "libtorch")
    assert row["program"].startswith("libtorch ") and row["largest"] < EXACT


def test_drake_takes_urdf_and_sdf_alike_and_dry_friction_from_outside(roll: Roll) -> None:
    """It reads links, damping and armature."""
    urdf, sdf, dry = [row["mean"] for row in roll(["mujoco_default"], "drake", "drakesdf", "drakedry")]
    assert sdf == pytest.approx(urdf, rel=1e-6)
    assert dry < 0.2 * sdf


def test_dart_takes_dry_friction_from_the_urdf_armature_from_outside_and_gazebo_the_sdf_as_dart(roll: Roll) -> None:
    """They read links and damping, too. Gazebo's physics has DART in it."""
    bare, rotors, gazebo = roll(["mujoco_default"], "dart", "dartrotors", "gazebo")
    assert rotors["mean"] < 1e-3 * bare["mean"]  # its friction has no regard to the damping: 1e-4
    if (gazebo["note"] or "").startswith("no Gazebo physics"):
        pytest.skip(gazebo["note"])
    assert gazebo["program"].startswith("gazebo physics ")
    assert gazebo["mean"] == pytest.approx(bare["mean"], rel=1e-6)
