"""The verdict: one finding is never nothing, and three commands can be copied."""

import copy
import json
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest
from conftest import Finished, put

from frictionzoo.api.identified import Identified
from frictionzoo.bench.limits import Limits
from frictionzoo.cli.finished import parse, read_options
from frictionzoo.core.config import check_overrides, compose_config
from frictionzoo.design.plan import Request
from frictionzoo.export.base import REGISTRY as TARGETS
from frictionzoo.identification.commands import Origin
from frictionzoo.report.terminal import summarise
from frictionzoo.result.record import read_run
from frictionzoo.result.section_types import SuggestedCommand, Verdict
from frictionzoo.result.types import ParameterRecord, Result, Value
from frictionzoo.result.verdict import judge, say_finding

Run = Callable[[str], tuple[Path, Finished]]
LOST = {"position_mae": None, "position_mae_std": None, "position_rmse": None, "velocity_rmse": None}


@pytest.fixture
def good(finished_run: Run) -> Result:
    """The record of a run, with all that speaks against it taken away."""
    result = read_run(finished_run("mujoco_default")[0])[0]
    result.warnings, result.indistinct = [], []
    result.not_identified = result.no_intervals = result.residual = None
    result.fit.stopped, result.fit.falling, result.fit.moving = "converged", 0.0, []
    for p in (*result.parameters, *result.reference):
        for row in (p, *p.by_joint):
            row.at_bound = False
            if hasattr(row, "identifiable"):
                row.identifiable = True if row.identified else None
    for part, error in (("train", 0.01), ("test", 0.01), ("baseline", 0.1)):
        result.metrics[part].position_mae = error
    return result


def place(**changes: Any) -> dict[str, Any]:
    found = {"place": "load", "periods": None, "value": None, "share": 0.6, "torque": 0.1, "chance": 1e-9}
    return {**found, "known": False, "law": "load_dependent", "whole": True, **changes}


def residual(*places: dict[str, Any], **changes: Any) -> dict[str, Any]:
    row = {"joint": "knee", "rows": 900, "residual": 0.15, "noise": 0.01, "friction": 0.5, "correlation": 0.9}
    row |= {"noise_correlation": -0.5, "kurtosis": 0.0, "places": list(places)}
    return {"unit": "N m", "bandwidth": 20.0, "by_joint": [row | changes]}


def torque(share: float, compared: str = "torque") -> dict[str, Any]:
    row = {part: {"residual": share, "torque": 1.0} for part in ("train", "test")}
    section = {"compared": compared, "unit": "N m", "bandwidth": 20.0, "held": False}
    return {**section, "mean": row, "by_joint": [{"joint": "knee", **row}]}


def spoil(result: Result, path: str, value: Any) -> Result:
    spoilt = copy.deepcopy(result)
    put(spoilt, path, value)
    return spoilt


def test_only_where_nothing_is_found_does_nothing_speak_against_it(good: Result) -> None:
    assert judge(good) == Verdict("no problems found", [], [])


@pytest.mark.parametrize(
    ("path", "value", "grade", "text"),
    [
        ("parameters.0.identifiable", False, "use it with care", "not identifiable from these data: bench.armature"),
        ("parameters.0.at_bound", True, "use it with care", "bench.armature ended at a bound"),
        ("fit.moving", ["bench.armature"], "use it with care", "still moving at the end of the fit: bench.armature"),
        ("fit.falling", 0.2, "use it with care", "fell by 20 % in the last tenth of the iterations; raise"),
        ("fit.stopped", "diverged", "do not use it", "the fit diverged"),
        ("reference.0.at_bound", True, "use it with care", "the change from its error is unreliable"),
        ("indistinct", [["a.b", "c.d"]], "use it with care", "do not distinguish a.b and c.d"),
        ("no_intervals", "nobody asked", "use it with care", "no parameter has an interval: nobody asked"),
        ("metrics.test.position_mae", 0.09, "use it with care", "the model explains almost nothing"),
        ("metrics.test.position_mae", 0.2, "do not use it", "no better than a drive without friction"),
        ("metrics.test.position_mae", None, "do not use it", "every test rollout diverged"),
        ("metrics.train.position_mae", 0.005, "use it with care", "2 times the training error"),
        ("by_horizon.0.test.diverged", 1, "do not use it", "diverged rollouts, excluded from the errors"),
        ("by_horizon.0.baseline.diverged", 1, "use it with care", "frictionless test rollouts"),
        ("warnings", ["qvel is late"], "use it with care", "qvel is late"),
        ("not_identified", ["why", "this"], "do not use it", "the drive was not identified: why; likely reasons: this"),
        ("residual", residual(noise=0.01, residual=0.3), "do not use it", "exceeds noise by 60 % of the friction"),
        ("residual", residual(place(torque=0.3)), "do not use it", "60 % of the friction"),
        ("torque", torque(0.3), "use it with care", "recorded torque contradicts the result"),
        ("torque", torque(0.8), "do not use it", "by 80 %"),
        ("residual", residual(place()), "use it with care", "load on the gear explains 60 % of it (0.1 N m, 20 %"),
        ("residual", residual(), "use it with care", "exceeds noise by 30 % of the friction"),
    ],
)
def test_one_finding_is_never_nothing(good: Result, path: str, value: Any, grade: str, text: str) -> None:
    verdict = judge(spoil(good, path, value))
    assert verdict["grade"] == grade and len(verdict["findings"]) >= 1
    assert any(text in say_finding(finding) for finding in verdict["findings"])


@pytest.mark.parametrize(("ended", "is_heavy"), [("low", True), ("high", False), ("one", False)])
def test_an_armature_at_its_lower_bound_in_every_joint_means_heavy_links(good, ended, is_heavy):
    spoilt = copy.deepcopy(good)
    armature = next(p for p in spoilt.parameters if p.name == "armature")
    rows = [copy.deepcopy(armature.by_joint[0]) for _ in range(3)]
    for row, name in zip(rows, ("hip", "knee", "ankle"), strict=True):
        row.name, row.joints, row.at_bound = name, [name], ended != "one" or name == "hip"
        row.value = row.high if ended == "high" else row.low
    armature.by_joint, armature.at_bound = rows, True
    verdict = judge(spoilt)
    said = say_finding(verdict.findings[0])
    assert ("the links of the model file are too heavy" in said and "fit.links" in said) == is_heavy
    assert (verdict.grade == "do not use it") == (is_heavy or ended == "high")


def test_what_is_left_is_no_finding_where_it_is_noise_or_little(good: Result) -> None:
    for changes in ({"noise": 0.1495}, {"correlation": 0.1}, {"residual": 0.02}):
        assert judge(spoil(good, "residual", residual(**changes)))["findings"] == []


@pytest.mark.parametrize(
    ("found", "text"),
    [
        (place(), "; the model load_dependent has this term"),
        (place(known=True), "; the model load_dependent has another form of this term"),
        (place(whole=False), "; the model load_dependent has this term, but lacks other terms"),
        (place(law=None), "; no model has this term"),
        (place(law=None, known=True), "; the fitted model has this term; check its form and bounds"),
        (place(place="constant", value=0.33, law=None), "; identify bench.params.torque_offset (about 0.33)"),
        (place(place="limit", value=2.5, law=None), "torque_limit={init: 2.5,"),
        (place(place="scale", value=0.83, law=None), "; 0.83 times the actuator's torque would fit"),
        (place(place="late", value=0.01, law=None), "; identify bench.params.delay (about 0.01 s)"),
        (place(place="gap", law="backlash"), "; the model backlash has this term"),
        (place(place="pull", law=None), "; this is not friction: check gravity"),
        (place(place="position", periods=12.0), "position (12 periods per turn) explains 60 % of it ("),
    ],
)
def test_where_the_error_is_and_what_has_that_is_said(good: Result, found: dict, text: str) -> None:
    (finding,) = judge(spoil(good, "residual", residual(found)))["findings"]
    assert finding["kind"] == "residual" and finding["law"] == found["law"] and text in say_finding(finding)


def bound(full: str, unit: str, high: bool) -> ParameterRecord:
    (owner, name), value = full.split("."), 2.0 if high else 1.0
    about: Any = {"value": value, "low": 1.0, "high": 2.0, "identified": True, "at_bound": True}
    unknown: Any = {"interval": None, "identifiable": True}
    row = Value(name="knee", joints=["knee"], **about, **unknown)
    return ParameterRecord(name=name, owner=cast(Any, owner), unit=unit, by_joint=[row], **about, **unknown)


@pytest.mark.parametrize(
    ("parameter", "severe"),
    [
        (bound("bench.armature", "kg m^2", True), True),
        (bound("bench.armature", "kg m^2", False), False),
        (bound("bench.position_offset", "rad", False), True),
        (bound("friction.frictionloss", "N m", True), True),
        (bound("friction.frictionloss", "N m", False), False),
        (bound("friction.stribeck_velocity", "rad/s", True), False),
    ],
)
def test_a_bound_that_cuts_a_size_off_forbids_use(good: Result, parameter: ParameterRecord, severe: bool) -> None:
    good.parameters = [parameter]
    findings = judge(good).findings
    assert [finding["severe"] for finding in findings if finding["kind"] == "bounds"] == [severe]


def test_causes_come_first_and_few_parameters_are_not_overfitted(good: Result) -> None:
    found = spoil(spoil(good, "residual", residual(place())), "metrics.train.position_mae", 0.005)
    found = spoil(found, "fit.stopped", "diverged")
    findings = judge(found)["findings"]
    assert [finding["kind"] for finding in findings[:2]] == ["residual", "fit"]
    (train,) = (say_finding(finding) for finding in findings if finding["kind"] == "train")
    assert "overfitted" not in train
    put(found, "network", {"weights": 10_000})
    assert any("overfitted" in say_finding(finding) for finding in judge(found)["findings"])


def test_a_reference_at_a_bound_is_no_doubt_where_noise_is_all_that_is_left(good: Result) -> None:
    found = spoil(good, "reference.0.at_bound", True)
    assert judge(spoil(found, "residual", residual(residual=0.01)))["findings"] == []
    assert judge(spoil(found, "residual", residual(residual=0.03)))["findings"] != []


def test_the_export_of_a_result_without_findings_comes_first(good: Result) -> None:
    commands = [SuggestedCommand(kind, f"frictionzoo {kind}") for kind in ("law", "recording", "export")]
    assert [row.kind for row in judge(good, commands).commands] == ["export", "law", "recording"]
    good.warnings = ["3 samples are missing"]
    assert [row.kind for row in judge(good, commands).commands] == ["law", "recording", "export"]


def test_three_commands_can_be_copied(finished_run: Run, tiny: tuple[str, ...]) -> None:
    """They are read by what reads the command line."""
    folder, finished = finished_run("mujoco_default")
    result = json.loads((folder / "result.json").read_text())
    rows = result["verdict"]["commands"]
    assert [row["kind"] for row in rows] == ["law", "recording", "export"]
    run, design, export = (shlex.split(row["command"]) for row in rows)
    assert run[:3] == ["python", "-m", "frictionzoo.run"] and {*tiny} <= {*run[3:]}
    config = compose_config(*run[3:])
    assert "fit=lm" in run and config.model._target_ != compose_config("model=mujoco_default").model._target_
    chosen = [each for each in run[3:] if each.partition("=")[0] in ("model", "data", "fit")]
    check_overrides(config, compose_config(*chosen))

    assert design[:3] == ["python", "-m", "frictionzoo.design"]
    place, *options = parse("design", design[3:]).options
    request = Request.read(read_options(options, ""), Identified.load(Path(folder.parent, place)))
    limits = Limits.read(1, **request.limits)
    assert (limits.low < limits.home).all() and limits.velocity > 0 and limits.torque > 0

    parsed = parse("export", export[3:])
    assert export[:3] == ["python", "-m", "frictionzoo.export"] and Path(folder.parent, parsed.folder) == folder
    assert parsed.options == ["target=mjcf"] and "mjcf" in TARGETS.names()
    assert finished.out.rstrip().splitlines()[-3:] == [f"  {row['command']}" for row in rows]


def test_options_of_the_law_and_of_the_folder_are_not_those_of_the_next() -> None:
    given = ["model=ripple", "model.params.periods.init=12", "data=files", "data.train=[a b.csv]", "resume=x", "seed=1"]
    origin = Origin.of_run(given, Path("run 1"))
    assert origin.options == ("data=files", "data.train=[a b.csv]", "seed=1")
    assert origin.place == "'run 1'"
    assert Origin.of_run(given, Path("b"), "a").command == "python -m frictionzoo.distill a"


def test_the_terminal_ends_with_the_verdict(finished_run: Run) -> None:
    folder, finished = finished_run("coulomb_smooth")
    result = read_run(folder)[0]
    lines = summarise(result, folder).splitlines()
    at = next(number for number, line in enumerate(lines) if line.startswith("verdict: "))
    count = len(result["verdict"]["findings"])
    assert count and lines[at] == f"verdict: {result['verdict']['grade']}, {count} finding{'s' * (count > 1)}"
    assert [line for line in lines[at + 1 :] if line.startswith("warning: ")] and lines[-4].startswith("next: ")
    assert any(line.startswith("files: ") for line in lines[:at])
    assert finished.out.rstrip() == "\n".join(lines)
