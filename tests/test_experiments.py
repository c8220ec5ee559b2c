"""The experiments at full size against their expected.yaml, and what is written about them."""

import importlib.util
import json
import math
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import safetensors.torch
import torch
import yaml
from conftest import needs_data

from frictionzoo.types import DriveState

ROOT = Path(__file__).parent.parent
EXPERIMENTS = ROOT / "experiments"
MEASURED = [*(pytest.param(name, marks=needs_data) for name in ("emps", "emps_stiff")), "twin_clean"]


def expected_of(name):
    return yaml.safe_load((EXPERIMENTS / name / "expected.yaml").read_text())


def lookup(result, path):
    """A value of result.json; parameters by owner and name instead of their place in the list."""
    if path.startswith("parameters."):
        _, owner, name = path.split(".")
        return next(p["value"] for p in result["parameters"] if (p["owner"], p["name"]) == (owner, name))
    for key in path.split("."):
        result = result[key]
    return result


def agrees(value, check):
    if "at_most" in check:
        return value <= check["at_most"]
    return math.isclose(value, check["expected"], rel_tol=check["relative"], abs_tol=0.0)


def friction_at(model, velocities):
    """Torque of a law that has no constraint, at rest but for the velocity."""
    qvel = torch.tensor(velocities, dtype=torch.float64)[:, None]
    still = torch.zeros_like(qvel)
    return model(DriveState(still, qvel, still, still, still)).torque.flatten().tolist()


@pytest.mark.slow
@pytest.mark.parametrize("name", MEASURED)
def test_an_experiment_gives_what_its_page_says(name, tmp_path, make):
    expected = expected_of(name)
    program, *arguments = shlex.split(expected["command"])
    assert program == "python"
    command = [sys.executable, *arguments, f"hydra.run.dir={tmp_path}"]
    subprocess.run(command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, check=True)

    result = json.loads((tmp_path / "result.json").read_text())
    missed = {c["path"]: (lookup(result, c["path"]), c) for c in expected["checks"]}
    missed = {path: pair for path, pair in missed.items() if not agrees(*pair)}
    if torques := expected["friction_torque"]:
        model = make("model", f"experiment={name}", nv=1)
        model.load_state_dict(safetensors.torch.load((tmp_path / "friction.safetensors").read_bytes()))
        for torque, check in zip(friction_at(model, [c["velocity"] for c in torques]), torques, strict=True):
            if not agrees(torque, check):
                missed[f"friction at {check['velocity']}"] = (torque, check)
    assert not missed


def test_twin_clean_is_judged_on_the_drive_that_is_hidden_in_it(compose):
    drive, expected = compose("experiment=twin_clean").data.drive, expected_of("twin_clean")
    truth = {check["path"].rpartition(".")[2]: check["expected"] for check in expected["checks"]}
    assert (truth["armature"], truth["viscous_coefficient"]) == (drive.armature, drive.viscous_coefficient)
    for check in expected["friction_torque"]:
        v = check["velocity"]
        excess = (drive.static_torque - drive.coulomb_torque) * math.exp(-((v / drive.stribeck_velocity) ** 2))
        torque = (drive.coulomb_torque + excess) * math.tanh(v / drive.smoothing_velocity)
        # 1e-4: the file gives five figures
        assert math.isclose(check["expected"], torque + drive.viscous_coefficient * v, rel_tol=1e-4)


@pytest.mark.parametrize(
    "value, check, answer",
    [
        (1.02, {"expected": 1.0, "relative": 0.03}, True),
        (1.02, {"expected": 1.0, "relative": 0.01}, False),
        (0.0021, {"at_most": 0.0021}, True),
        (0.0022, {"at_most": 0.0021}, False),
        (math.nan, {"at_most": 0.0021}, False),
    ],
)
def test_a_check_knows_what_it_allows(value, check, answer):
    assert agrees(value, check) is answer


@pytest.mark.parametrize("path", sorted((ROOT / "conf" / "experiment").glob("*.yaml")), ids=lambda path: path.stem)
def test_an_experiment_starts_with_the_command_that_runs_it(path):
    header, command = path.read_text().splitlines()[:2]
    assert header == "# @package _global_"  # Hydra reads it in the first line only
    assert command.startswith(f"# python -m frictionzoo.run experiment={path.stem}")
    assert command.removeprefix("# ") in (EXPERIMENTS / path.stem / "README.md").read_text()


def test_the_table_puts_runs_beside_the_published_numbers():
    spec = importlib.util.spec_from_file_location("table", EXPERIMENTS / "kovalev2026" / "table.py")
    table = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(table)

    def run(model, mae):
        errors = {"position_mae": mae, "position_mae_std": 0.001}
        pair = {"model": errors, "baseline": {**errors, "position_mae": 0.02}}
        parameters = [{"name": "armature", "value": 0.04}]
        return {"model": model, "parameters": parameters, "paper": {"a": pair, "b": pair}, "timing": {"fit": 12.3}}

    rows = table.tabulate([run("neural_friction", 0.005), run("baseline", 0.02)]).splitlines()[2:]
    assert rows == [
        "| `baseline` | 0.0200 (0.0010) | +0 % | 0.0200 | 0.0400 | 12 | 0.0192 (0.0079) |",
        "| `neural_friction` | 0.0050 (0.0010) | -75 % | 0.0050 | 0.0400 | 12 | 0.0072 (0.0040) |",
    ]
