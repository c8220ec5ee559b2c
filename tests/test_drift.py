"""Whether a drive is still the same: the test's false alarms and power, what is refused, and the command."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from conftest import Finished, changed, finish, write_recording

import frictionzoo as fz
from frictionzoo.api import drift as api
from frictionzoo.cli.drift import compose_data
from frictionzoo.cli.finished import drift as main
from frictionzoo.cli.mistakes import CHANGED
from frictionzoo.core.errors import ConfigError, FaultError, RunError
from frictionzoo.core.output import to_json
from frictionzoo.result.comparison.drift import Estimates, find_differences, judge_drift, read_schema

pytestmark = pytest.mark.usefixtures("settings_kept")

ALARM, FREEDOM = 0.05, 30
NAMES = ("bench.armature", "friction.frictionloss", "friction.damping")


@pytest.fixture
def drive(finished_run: Callable[[str], tuple[Path, Finished]]) -> fz.Identified:
    return fz.load(finished_run("mujoco_default")[0])


def count_alarms(runs: int, between: float, shift: float = 0.0, parameters: int = 4, trials: int = 20_000) -> float:
    """The share of trials in which any parameter changed; estimates have a variance of 1, which is estimated too."""
    rng = np.random.default_rng(runs)
    centre = rng.normal(size=(runs + 1, parameters, trials)) * np.hypot(1.0, between)
    variance = rng.chisquare(FREEDOM, size=centre.shape) / FREEDOM
    centre[-1, 0] += shift
    earlier, now = (Estimates(centre[rows], variance[rows], FREEDOM) for rows in (slice(-1), -1))
    found = find_differences(earlier, now, ALARM / parameters)
    return float((np.abs(found.change) > found.half).any(axis=0).mean())


def test_false_alarms_have_the_stated_rate() -> None:
    # 20 000 trials know a rate of 5 % to 0.15 %.
    assert count_alarms(1, 0.0) == pytest.approx(ALARM, abs=0.005)
    # Where runs spread far more than their intervals, the prediction interval is exact; in between both are safe.
    assert count_alarms(4, 10.0) == pytest.approx(ALARM, abs=0.005)
    for runs, between in ((2, 0.0), (2, 1.0), (2, 10.0), (5, 0.0), (5, 1.0)):
        assert count_alarms(runs, between) < ALARM + 0.005, (runs, between)
    # One run does not know of the spread between repetitions, as the command says.
    assert count_alarms(1, 2.0) > 0.3


def test_changes_have_the_expected_power() -> None:
    # Half of the changes of the size of the limit are seen, nearly all of the double.
    one = np.ones(1)
    earlier, now = Estimates(0 * one[None], one[None], FREEDOM), Estimates(0 * one, one, FREEDOM)
    limit = float(find_differences(earlier, now, ALARM / 4).half[0])
    assert limit == pytest.approx(2.575 * np.sqrt(2), rel=0.01)  # Student's quantile at 1 - 0.05 / 8, 60 degrees
    assert count_alarms(1, 0.0, limit) == pytest.approx(0.5, abs=0.03)
    assert count_alarms(1, 0.0, 2 * limit) > 0.98
    assert count_alarms(8, 0.0, 2 * limit) > 0.95


def moved(drive: fz.Identified, by: float, number: int = 0, width: float = 0.01) -> fz.Identified:
    """The drive with intervals of this width in its coordinates, and one of the values moved."""
    row = drive.result.covariance
    assert row is not None
    centre = [at + by * (index == number) for index, at in enumerate(row.centre)]
    parameters = to_json(drive.result.parameters)
    for index, name in enumerate(row.labels):
        (parameter,) = (each for each in parameters if f"{each['owner']}.{each['name']}" == name)
        value = float(np.exp(centre[index]))
        parameter |= {"value": value, "identifiable": True, "interval": [0.99 * value, 1.01 * value]}
        parameter["by_joint"][0] |= {"value": value, "identifiable": True, "interval": [0.99 * value, 1.01 * value]}
    covariance = {"centre": centre, "matrix": np.diag(np.full(len(centre), width**2)).tolist()}
    return dataclasses.replace(drive, result=changed(drive.result, covariance=covariance, parameters=parameters))


def test_the_verdict_names_what_has_changed(drive: fz.Identified) -> None:
    labels = drive.result.covariance.labels
    number = labels.index("friction.frictionloss")
    same = judge_drift([moved(drive, 0.0)], moved(drive, 0.005, number), 0.01, 0.01)
    assert same.verdict == "unchanged" and same.summary.startswith("unchanged: 3 parameters; the least certain: ")
    assert [row.verdict for row in same.parameters] == ["unchanged"] * 3
    found = judge_drift([moved(drive, 0.0)], moved(drive, np.log(1.1), number), 0.01, 0.01)
    row = found.parameters[number]
    assert found.verdict == row.verdict == "changed"
    assert found.summary.startswith("changed: frictionloss of knee +10.0 % [") and row.interval is not None
    assert row.difference == pytest.approx(0.1 * row.then) and row.interval[0] < row.difference < row.interval[1]
    assert row.now == pytest.approx(1.1 * row.then)
    jsonschema.Draft202012Validator(read_schema()).validate(to_json(found))
    # A change below `smallest` does not count, however narrow the intervals are: they do not contain a bias.
    narrow = [moved(drive, by, number, width=1e-6) for by in (0.0, 0.005)]
    assert judge_drift(narrow[:1], narrow[1], 0.01, 0.01).verdict == "unchanged"
    assert judge_drift(narrow[:1], narrow[1], 0.01, 0.001).verdict == "changed"
    # Runs that differ by as much explain it; three that differ much more know nothing.
    for spread, verdict in ((0.015, "unchanged"), (0.2, "cannot tell")):
        runs = [moved(drive, by, number) for by in (-spread, 0.0, spread)]
        several = judge_drift(runs, moved(drive, 0.08, number), 0.01, 0.01)
        assert several.verdict == verdict, several.summary
        assert several.parameters[number].spread == pytest.approx(spread * several.parameters[number].then)
    assert judge_drift(runs[1:2], moved(drive, 0.08, number), 0.01, 0.01).verdict == "changed"


def test_what_is_not_determined_is_not_told(drive: fz.Identified) -> None:
    same = moved(drive, 0.0)
    parameters = to_json(same.result.parameters)
    (damping,) = (each for each in parameters if each["name"] == "damping")
    damping["by_joint"][0]["identifiable"] = False
    doubtful = dataclasses.replace(same, result=changed(same.result, parameters=parameters))
    found = judge_drift([same], doubtful, 0.01, 0.01)
    assert found.verdict == "cannot tell" and "do not determine damping of knee" in found.summary
    untested = judge_drift([doubtful], same, 0.01, 0.01)
    assert untested.verdict == "cannot tell" and untested.untested == ["friction.damping"]
    wide = judge_drift([moved(drive, 0.0, width=0.15)], moved(drive, 0.0, width=0.15), 0.01, 0.01)
    assert wide.verdict == "cannot tell" and "too uncertain armature of knee" in wide.summary
    lost = dataclasses.replace(same, result=changed(same.result, not_identified=["two parameters ended at bounds"]))
    assert "two parameters ended at bounds" in judge_drift([same], lost, 0.01, 0.01).summary
    refused = judge_drift([same], None, 0.01, 0.01, "a.csv: the clock runs backwards")
    assert refused.verdict == "cannot tell" and refused.data is None and "clock" in refused.summary
    jsonschema.Draft202012Validator(read_schema()).validate(to_json(refused))


def test_runs_that_do_not_fit_are_refused(drive, leg, tmp_path, monkeypatch):
    logs: list[fz.Log] = []  # refused before they are read
    nothing = dataclasses.replace(drive, result=changed(drive.result, covariance=None, no_intervals="of a network"))
    with pytest.raises(RunError, match="of a network, expected intervals"):
        fz.drift(nothing, logs)
    joints = dataclasses.replace(drive, result=changed(drive.result, joints=["elbow"]))
    with pytest.raises(RunError, match=r"joints \['elbow'\], expected \['knee'\]"):
        fz.drift([drive, joints], logs)
    law = dataclasses.replace(drive, result=changed(drive.result, model="stribeck"))
    with pytest.raises(RunError, match="model stribeck, expected mujoco_default"):
        fz.drift([drive, law], logs)
    with pytest.raises(RunError, match="runs: none"):
        fz.drift([], logs)
    heavy = (Path(fz.__file__).parent / "bench" / "assets" / "knee_rod.xml").read_text().replace("0.26", "0.3")
    (tmp_path / "heavy.xml").write_text(heavy)
    other = dataclasses.replace(drive, bench=fz.Bench(str(tmp_path / "heavy.xml"), actuator=fz.PositionPD(kp=20, kd=1)))
    with pytest.raises(RunError, match=r"heavy\.xml: body .* differs from .*identified\.xml"):
        fz.drift(other, logs)
    with pytest.raises(RunError, match="another model file, body"):
        fz.drift([drive, dataclasses.replace(other, folder=None)], logs)
    for option in ("alarm", "smallest"):
        with pytest.raises(ConfigError, match=f"{option}=-1"):
            fz.drift(drive, logs, **{option: -1.0})


def test_a_faulty_recording_does_not_end_in_an_error(drive: fz.Identified, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise FaultError("a.csv: the command is constant")

    monkeypatch.setattr(api, "repeat_fit", refuse)
    log = fz.Log("a", np.arange(3.0), *np.zeros((3, 3, 1)), sha256=64 * "0", simulated=True)
    found = fz.drift(drive, log)
    assert found.verdict == "cannot tell" and found.drive is None and "the command is constant" in repr(found)


def test_recordings_are_read_as_the_run_read_its_own(drive: fz.Identified) -> None:
    settings = drive.result.settings
    settings = settings | {
        "data": settings["data"] | {"sign": settings["data"]["sign"] | {"ctrl": -1}, "where": {"kp": [4]}}
    }
    section = compose_data(settings, ["b.csv"], {"data.units.qpos": "deg"})
    assert section["train"] == ["b.csv"] and section["test"] == [] and section["where"] is None
    assert section["sign"]["ctrl"] == -1 and section["units"]["qpos"] == "deg"
    assert section["split"]["gap"] == settings["data"]["split"]["gap"]
    simulated = compose_data(settings | {"data": {"_target_": "frictionzoo.data.twin.Twin"}}, ["b.csv"], {})
    assert simulated["sign"]["ctrl"] == 1
    for option in ("bench.timestep", "data.unheard"):
        with pytest.raises(ConfigError, match=option):
            compose_data(settings, ["b.csv"], {option: "1"})


def see(folder: Path) -> dict[str, int]:
    return {str(path): path.stat().st_mtime_ns for path in folder.rglob("*")}


@pytest.mark.slow
@pytest.mark.usefixtures("unrendered")
def test_the_command_tells_a_changed_drive(call: Callable, tiny: tuple[str, ...], tmp_path: Path) -> None:
    run, options = tmp_path / "run", ("model=mujoco_default", "fit=lm", "segments.length=50", "bench.timestep=0.001")
    assert call(*tiny, *options, "segments.count=null", f"hydra.run.dir={run}").status == 0
    before = see(run)
    for coulomb, status in ((0.1, 0), (0.13, CHANGED)):
        place = tmp_path / f"{coulomb}"
        log = write_recording(tmp_path / f"{coulomb}.csv", coulomb, (1.3, 0.9))
        finished = finish(lambda: main([str(run), str(log), f"output={place}"]))  # noqa: B023
        assert finished.status == status, finished.out + finished.err
        record = json.loads((place / "drift.json").read_text())
        jsonschema.Draft202012Validator(read_schema()).validate(record)
        assert finished.out.rstrip().endswith(f"verdict: {record['summary']}")
        assert fz.load(place).result.settings["recipe"] == "given"
    assert "frictionloss of knee" in record["summary"]
    assert see(run) == before


def test_mistakes_get_one_line(finished_run: Callable, tmp_path: Path, recording: Path) -> None:
    run = str(finished_run("mujoco_default")[0])
    short = tmp_path / "short.csv"
    short.write_text("".join(recording.read_text().splitlines(keepends=True)[:30]))
    two = tmp_path / "two.csv"
    two.write_text("time,q1,q2,dq1,dq2,u1,u2\n" + "".join(f"{0.01 * i}" + f",{i}" * 6 + "\n" for i in range(300)))
    cases = {
        (str(tmp_path), str(recording)): "no result.json in it",
        (run,): "no recording",
        (run, "nothing.csv"): "nothing.csv",
        (run, str(short)): "short.csv",
        (run, str(two)): "two.csv",
        (run, str(recording), "alarm=often"): "alarm=often: expected a number",
        (run, str(recording), "loss.velocity=1"): "loss.velocity: expected data.",
        (run, str(recording), f"output={run}"): "it exists already",
    }
    for arguments, text in cases.items():
        output = [] if "output=" in arguments[-1] else [f"output={tmp_path / 'drift'}"]
        finished = finish(lambda: main([*arguments, *output]))  # noqa: B023
        assert finished.status == 2 and finished.err.count("\n") == 1 and text in finished.err, finished
        assert not (tmp_path / "drift").exists()
