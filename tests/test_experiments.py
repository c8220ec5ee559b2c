"""The experiments, small ones, against their expected.yaml, and what is written about them."""

import functools
import json
import math
import shutil
import sys

import cards
import pytest
import reproduce
import safetensors.torch
import torch
import yaml
from conftest import ROOT, needs_data

import frictionzoo as fz
from frictionzoo.cli.run import NOT_IDENTIFIED
from frictionzoo.core.state import DriveState
from frictionzoo.data import files

EXPERIMENTS = ROOT / "experiments"
RECORDED = ("emps", "emps_stiff", "sts3215", "xl330", "go2", "tx40", "kuka_lwr4")
MEASURED = [*(pytest.param(name, marks=needs_data) for name in RECORDED), "twin_clean", "kovalev2026", "zoo"]
ENTRY = {
    "label": "law",
    "test": {"position_mae": 0.005, "position_mae_std": 0.001},
    "by_horizon": [{"horizon": 1.0}, {"horizon": 0.1}],
    "parameters": [{"owner": "bench", "name": "armature", "value": 0.04}],
}


@pytest.mark.slow
@pytest.mark.usefixtures("unrendered")
@pytest.mark.parametrize("name", MEASURED)
def test_an_experiment_gives_what_its_page_says(name, tmp_path, make, call, monkeypatch):
    """Its small variant, in one process; without one, all of it. `make reproduce` runs all of them at full size."""
    monkeypatch.setattr(files, "read_tables", functools.cache(files.read_tables))  # the same ones for all jobs

    def start(*arguments):
        assert (finished := call(*arguments)).status in (0, NOT_IDENTIFIED), finished.err

    expected = reproduce.read_expected(name, small=True)
    comparison = reproduce.compare(expected, tmp_path, small=True, start=start)
    folders = sorted(path.parent for path in tmp_path.rglob("friction.safetensors"))
    missed = list(reproduce.check(comparison, expected["checks"]))
    for check in expected.get("friction_torque", []):
        model, still = make("model", f"experiment={name}", nv=1), torch.zeros((1, 1), dtype=torch.float64)
        model.load_state_dict(safetensors.torch.load((folders[0] / "friction.safetensors").read_bytes()))
        torque = model(DriveState(still, still + check["velocity"], still, still, still)).torque.item()
        if not reproduce.agrees(torque, check):
            missed.append(f"friction at {check['velocity']} is {torque}, expected {check}")
    assert not missed


def test_twin_clean_is_judged_on_the_drive_that_is_hidden_in_it(compose):
    drive, expected = compose("experiment=twin_clean").data.drive, reproduce.read_expected("twin_clean")
    truth = {check["path"].rpartition(".")[2]: check["expected"] for check in expected["checks"]}
    assert (truth["armature"], truth["viscous_coefficient"]) == (drive.armature, drive.viscous_coefficient)
    for check in expected["friction_torque"]:
        v = check["velocity"]
        excess = (drive.static_torque - drive.coulomb_torque) * math.exp(-((v / drive.stribeck_velocity) ** 2))
        torque = (drive.coulomb_torque + excess) * math.tanh(v / drive.smoothing_velocity)
        # 1e-4: the file gives five figures
        assert math.isclose(check["expected"], torque + drive.viscous_coefficient * v, rel_tol=1e-4)


def test_a_check_knows_what_it_allows():
    relative, most = {"expected": 1.0, "relative": 0.03}, {"at_most": 0.0021}
    assert reproduce.agrees(1.02, relative) and reproduce.agrees(0.0021, most)
    assert not reproduce.agrees(1.02, relative | {"relative": 0.01})
    assert not any(reproduce.agrees(value, most) for value in (0.0022, math.nan, None))


@pytest.mark.parametrize(("name", "folds"), [("sts3215", False), ("kuka_lwr4", True)])
def test_a_measured_drive_gets_a_card(finished_run, tmp_path, monkeypatch, capsys, name, folds):
    """Of its experiment, the run that is recommended; one that was not run has none."""
    sweep, runs = finished_run("sweep")[0], tmp_path / "runs" / name
    shutil.copytree(sweep, runs / "0" / "0" if folds else runs / "0")
    if folds:
        shutil.copytree(finished_run("mujoco_default")[0], runs / "1" / "0")
    words = ["cards.py", "--licence", "cc0-1.0", "--runs", str(tmp_path / "runs"), "--output", str(tmp_path / "cards")]
    monkeypatch.setattr(sys, "argv", words)
    assert cards.main() == 0
    assert capsys.readouterr().out == f"{name}: {tmp_path / 'cards' / name}\n"
    recommended = json.loads((sweep / "comparison" / "comparison.json").read_text())["recommendation"]["run"]
    assert fz.load(tmp_path / "cards" / name).result["model"] == recommended
    assert [path.name for path in (tmp_path / "cards").iterdir()] == [name]


def test_checks_find_what_is_not_as_expected():
    comparison = {"runs": [ENTRY, ENTRY | {"label": "other"}]}
    right = {"run": "law", "path": "test.position_mae", "at_most": 0.005}
    wrong = {"run": "law", "path": "parameters.bench.armature", "expected": 0.05, "relative": 0.1}
    missing = {"run": "other", "path": "parameters.friction.damping", "at_most": 1.0}
    first, second = reproduce.check(comparison, [right, wrong, missing])
    assert first.startswith("law: parameters.bench.armature is 0.04, ")
    assert second.startswith("other: parameters.friction.damping is None, ")
    with pytest.raises(SystemExit, match="2 runs"):
        list(reproduce.check(comparison, [{"path": "test.position_mae", "at_most": 1.0}]))


def test_a_check_may_be_against_another_run_in_each_fold_and_of_each_joint():
    errors = {("a", "1"): (1.0, 2.0), ("b", "1"): (2.0, 2.0), ("a", "2"): (1.0, 3.0), ("b", "2"): (2.0, 2.0)}
    runs = [
        {"label": label, "fold": fold, "by_joint": [{"error": error} for error in joints]}
        for (label, fold), joints in errors.items()
    ]
    check = {"run": "a", "path": "by_joint.*.error", "of": "b", "at_most": 1.0}
    (found,) = reproduce.check({"runs": runs}, [check])
    assert found.startswith("a, 2: by_joint.*.error is [0.5, 1.5], expected ")
    assert not list(reproduce.check({"runs": runs}, [check | {"fold": "1"}]))
    runs[1]["by_joint"][0]["error"] = None
    assert len(list(reproduce.check({"runs": runs}, [check | {"fold": "1"}]))) == 1
    table = [
        {"head": key, "values": [path], "format": f}
        for key, path, f in (("fold", "fold", "{}"), ("error", "by_joint.*.error", "{:.1f}"))
    ]
    assert reproduce.tabulate({"runs": runs[:1]}, {"table": table}).splitlines()[2] == "| 1 | 1.0, 2.0 |"


def test_each_command_runs_in_each_fold_and_in_a_folder_of_its_own(tmp_path, monkeypatch):
    ran = []
    commands = [reproduce.PROGRAM + "-m model=a,b", reproduce.PROGRAM + "'x=[1, 2]'"]
    one, two = reproduce.run(commands, tmp_path, lambda *arguments: ran.append(arguments))
    assert one != two and ran == [("-m", "model=a,b", f"hydra.sweep.dir={one}"), ("x=[1, 2]", f"hydra.run.dir={two}")]
    with pytest.raises(SystemExit, match="make all; expected a command"):
        reproduce.run(["make all"], tmp_path)
    ran.clear()
    monkeypatch.setattr(reproduce, "read_runs", lambda folders: (folders, []))
    monkeypatch.setattr(reproduce, "compare_runs", lambda runs, _: {"runs": [{"label": r.name} for r in runs[::-1]]})
    expected = {"commands": [reproduce.PROGRAM + "a", reproduce.PROGRAM + "b"], "folds": {"x": [], "y": ["c=1"]}}
    found = reproduce.compare(expected, tmp_path, small=True, start=lambda *arguments: ran.append(arguments[:-1]))
    assert ran == [("a",), ("b",), ("a", "c=1"), ("b", "c=1")]
    assert [(run["fold"], run["label"]) for run in found["runs"]] == [("x", "0"), ("x", "1"), ("y", "0"), ("y", "1")]


def test_the_table_has_a_row_a_run():
    error = {"values": ["test.position_mae", "test.position_mae_std"], "scale": 1000, "format": "{:.1f} ({:.0f})"}
    columns = [
        {"head": "model", "values": ["label"], "format": "`{}`"},
        {"head": "MAE [mrad]", **error},
        {"head": "horizon", "values": ["by_horizon.1.horizon"], "format": "{}"},
        {"head": "damping", "values": ["parameters.friction.damping"], "format": "{}"},
        {"head": "published", "published": "paper"},
    ]
    assert reproduce.tabulate({"runs": [ENTRY]}, {"table": columns, "paper": {"law": "7"}}).splitlines() == [
        "| model | MAE [mrad] | horizon | damping | published |",
        "| --- | --- | --- | --- | --- |",
        "| `law` | 5.0 (1) | 0.1 |  | 7 |",
    ]


def test_the_table_goes_between_the_marks_and_the_small_variant_leaves_it(tmp_path, monkeypatch, capsys):
    page, check = tmp_path / "one" / "README.md", {"path": "test.position_mae", "at_most": -1.0}
    small = {"commands": ["small"], "checks": [check | {"at_most": 1.0}]}
    table = [{"head": "\\1", "values": ["label"], "format": "{}"}]
    page.parent.mkdir()
    page.write_text(before := "before\n<!-- table: how -->\nold\n<!-- end of table -->\nafter\n")
    expected = {"commands": ["full"], "checks": [check], "table": table, "small": small}
    page.with_name("expected.yaml").write_text(yaml.safe_dump(expected))
    monkeypatch.setattr(reproduce, "EXPERIMENTS", tmp_path)
    monkeypatch.setattr(reproduce, "run", lambda commands, *more: commands)
    monkeypatch.setattr(reproduce, "read_runs", lambda ran: [ran])
    monkeypatch.setattr(reproduce, "compare_runs", lambda ran: {"runs": [ENTRY] * (ran == ["small"])})
    monkeypatch.setattr(reproduce, "write_comparison", lambda ran, output: {"runs": [ENTRY] * (ran == ["full"])})
    monkeypatch.setattr(sys, "argv", ["reproduce.py", "--small", "one"])
    assert (reproduce.main(), page.read_text()) == (0, before)
    monkeypatch.setattr(sys, "argv", ["reproduce.py"])
    assert (reproduce.main(), page.read_text()) == (1, before.replace("old", "| \\1 |\n| --- |\n| law |"))
    assert "one: law: test.position_mae is 0.005, expected" in capsys.readouterr().out
    page.write_text("none")
    with pytest.raises(SystemExit, match="0 places"):
        reproduce.write_table("one", "new")
    assert page.read_text() == "none"


@pytest.mark.parametrize("name", sorted(path.parent.name for path in EXPERIMENTS.glob("*/expected.yaml")))
def test_an_experiment_has_a_page_with_its_commands_and_its_table(name):
    expected, page = reproduce.read_expected(name), (EXPERIMENTS / name / "README.md").read_text()
    assert f"python experiments/reproduce.py {name}" in page
    if "table" in expected:
        table = reproduce.MARKS.search(page)[0]
        assert reproduce.tabulate({"runs": []}, expected) in table
        assert all(f"| `{check['run']}` |" in table for check in expected["checks"])
