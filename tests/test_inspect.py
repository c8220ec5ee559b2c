"""`python -m frictionzoo.inspect`: findings in words, JSON against its schema, the page, and the command itself."""

import inspect
import json
import os
import re
import shlex
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import jsonschema
import numpy as np
import plotly.graph_objects as go
import pytest
from conftest import DATA, ROOT, needs_data
from helpers.browser import CLIPPED, DRAWN, WIDTHS, needs_browser, open_page, read_data
from helpers.html_pages import HOSTILE, Page
from helpers.recordings import make_recording, read_sts3215, simulate_servo
from helpers.write_logs import write_csv

import frictionzoo as fz
from frictionzoo.cli.inspect import inspect_data, main
from frictionzoo.core.config import compose_config
from frictionzoo.core.errors import ConfigError, LogError
from frictionzoo.core.log import Dataset, Log
from frictionzoo.data.files import Files
from frictionzoo.data.recording import Recording
from frictionzoo.diagnostics.survey import list_recordings, put_in_order, rank_by_faults, read_schema, survey_recordings
from frictionzoo.diagnostics.survey_findings import merge_findings
from frictionzoo.report.inspection_page import write_page
from frictionzoo.report.inspection_tables import judge, list_quantities
from frictionzoo.report.inspection_terminal import summarise

TIME = 0.01 * np.arange(1000)
BACK = np.where(TIME % 1 < 0.9, 0.1, -9.0)  # forward too slowly to count


def swing(name="a.csv", time=TIME, lag=0.0, scale=1.0, **signals):
    """A motion of two frequencies at rest nowhere."""
    late = time - lag
    position = np.sin(3 * time) + 0.5 * np.sin(11 * time)
    velocity = scale * (3 * np.cos(3 * late) + 5.5 * np.cos(11 * late))
    return make_recording(time, name, **{"qpos": position, "qvel": velocity, "ctrl": 0 * time} | signals)


def spiked(recording, *at):
    position = recording.signals["qpos"].copy()
    position[list(at)] -= 2.0
    return replace(recording, signals={**recording.signals, "qpos": position})


def validate(survey):
    jsonschema.Draft202012Validator(read_schema()).validate(json.loads(json.dumps(survey, allow_nan=False)))
    return survey


def findings(*recordings):
    return {finding["title"]: finding for finding in validate(survey_recordings("swings", recordings))["findings"]}


@pytest.fixture(scope="module")
def faulty():
    """Three recordings with all kinds of faults, of which the second has most."""
    rng = np.random.default_rng(0)
    jittered = TIME + rng.uniform(0, 0.003, len(TIME))
    jittered[500:] += 1.0
    servo = simulate_servo(0.03, True)
    volts = {"supply": np.full(len(TIME), 12.0), "enable": TIME < 9}
    recordings = [
        swing("fine.csv", lag=0.02, **volts),
        spiked(swing(HOSTILE, jittered, 0.02, **volts), 100, 400),
        replace(servo, name="servo.csv"),
    ]
    return [replace(recording, fields={"vin": 15.0}) for recording in recordings]


def test_what_is_in_order_is_good():
    found = findings(swing(), swing("b.csv"))
    states = {title: finding["state"] for title, finding in found.items()}
    titles = ("Hardware data", "Clock", "Completeness", "Spikes", "Velocity", "Excitation", "Resolution")
    assert states == dict.fromkeys(titles, "good") | {"Command": "note"}
    assert all(finding["option"] is None for finding in found.values())
    assert "Simulated data" in findings(replace(swing(), simulated=True))


def test_faults_are_found_with_the_option_that_solves_them(faulty):
    found = findings(*faulty)
    assert found["Spikes"]["option"] == "data.clean.spikes=repair" and "1 of 3 rec" in found["Spikes"]["text"]
    assert found["Clock"]["option"] == "data.clean.step=0.01"
    assert "1 gap." in found["Completeness"]["text"]
    assert found["Velocity"]["option"] == "data.clean.velocity=estimated" and "by 20" in found["Velocity"]["text"]
    assert "12 V" in found["Supply"]["text"] and "vin is 15 V" in found["Supply"]["text"]
    assert "10 %" in found["Drive off"]["text"]
    late = findings(simulate_servo(0.03, True))["Command"]
    assert late["option"] == "bench.params.delay.identify=true" and late["state"] == "caution"
    # The simple drive's step is 2.5 ms.
    assert float(re.search(r"about (\d+) ms", late["text"])[1]) == pytest.approx(30, abs=4)


STILL, FORWARD = np.where(TIME < 1, np.sin(3 * TIME), np.sin(3)), TIME + 0.1 * np.sin(TIME)


@pytest.mark.parametrize(
    ("signals", "title", "text"),
    [
        ({"qpos": STILL}, "Excitation", "Stribeck and viscous friction"),
        ({"qpos": STILL}, "Rest", "at rest for"),
        ({"qpos": FORWARD, "qvel": 1 + 0.1 * np.cos(TIME)}, "Direction", "0 % backward"),
        ({"qpos": np.cumsum(0.01 * BACK), "qvel": BACK}, "Direction", "0 % of the samples move forward"),
        ({"qpos": 80 * np.sin(3 * TIME), "qvel": 240 * np.cos(3 * TIME)}, "Units", "look like degrees"),
        ({"scale": 57.3}, "Units", "57."),
        ({"qvel": np.random.default_rng(0).normal(size=1000)}, "Velocity", "does not match"),
        ({"ctrl": np.sign(np.sin(TIME))}, "Saturation", "at an end of its range"),
        ({"supply": np.where(TIME == 5, 0, 12.0)}, "Supply readings", "1 of 1 recordings"),
    ],
)
def test_each_kind_of_finding(signals, title, text):
    assert text in findings(swing(**signals))[title]["text"]


def test_joints_are_distinguished():
    signals = {name: np.hstack([values, values]) for name, values in swing().signals.items()}
    signals["qpos"][300, 0] -= 2.0
    survey = validate(survey_recordings("arm", [Recording("arm.csv", TIME, signals)], "slide"))
    units = {row[0]: row[-1] for row in list_quantities(survey, "1")}
    assert (units["position"], units["velocity"]) == ("m", "m/s")
    assert not any("rad" in finding["text"] for finding in survey["findings"])
    assert [joint["spikes"] for joint in survey["joints"]] == [1, 0]
    assert {"Spikes, joint 1", "Spikes, joint 2"} <= {finding["title"] for finding in survey["findings"]}


@pytest.mark.parametrize(("joints", "names"), [((), ["knee", "hip"]), (("hip", "knee"), ["hip", "knee"])])
def test_every_recording_is_labelled_with_the_joints(tmp_path, joints, names):
    fast, slow = np.sin(3 * TIME), 0.5 * np.sin(2 * TIME)
    columns = {"time": TIME, "q_knee": fast, "q_hip": slow, "cmd_hip": slow, "cmd_knee": fast}
    for name, headers in (("a", [*columns]), ("b", ["time", "q_hip", "q_knee", "cmd_knee", "cmd_hip"])):
        write_csv(tmp_path / f"{name}.csv", {header: columns[header] for header in headers})
    source = Files(train=[str(tmp_path)]).for_joints(joints)
    recordings, found = put_in_order(list_recordings(source), joints)
    survey = validate(survey_recordings("leg", recordings, None, found))
    assert found == names == [joint["name"] for joint in survey["joints"]]
    for part, entries in (("position", survey["joints"]), ("range", survey["commands"])):
        assert {entry["name"]: round(entry[part][1], 2) for entry in entries} == {"hip": 0.5, "knee": 1.0}
    (columns,) = survey["columns"]
    assert [row["columns"]["ctrl"] for row in columns["joints"]] == [f"cmd_{name}" for name in names]
    assert f"Spikes, joint {names[0]}" in {finding["title"] for finding in survey["findings"]}
    ranges = {name: dict(row[:4:3] for row in list_quantities(survey, name)) for name in names}
    assert {name: row["position"] for name, row in ranges.items()} == {"hip": "0.5", "knee": "1"}
    assert "joint <-" not in summarise(survey, tmp_path)
    columns["by"]["qpos"] = "place"  # to be checked by the user
    assert "joint <-  position  command" in summarise(survey, tmp_path)


@pytest.fixture(scope="module")
def robot():
    """Ten recordings of 12 joints: late velocities except in two joints, one spike, a command at its limits."""
    one = {name: np.repeat(values, 12, axis=1) for name, values in swing(lag=0.02).signals.items()}
    one["qvel"][:, :2], one["ctrl"][:, 5] = swing().signals["qvel"], np.sign(np.sin(TIME))
    recordings = [Recording(f"{number}.csv", TIME, one) for number in range(10)]
    position = one["qpos"].copy()
    position[300, 3] -= 2.0
    recordings[4] = replace(recordings[4], signals=one | {"qpos": position})
    return recordings, survey_recordings("robot", recordings, "hinge", [f"joint_{number}" for number in range(12)])


def test_findings_that_joints_share_are_one_line(robot, tmp_path):
    _, survey = robot
    merged = {finding.title: finding for finding in merge_findings(validate(survey))}
    assert "by 20 ms" in merged["Velocity, all joints except joint_0, joint_1"].text
    assert merged["Velocity, joints joint_0, joint_1"].state == merged["Clock"].state == "good"
    assert merged["Spikes, joint joint_3"].option == "data.clean.spikes=repair"
    lines = summarise(survey, tmp_path, "python -m frictionzoo.run").splitlines()
    assert len(lines) <= 40 and lines[-1] == "  python -m frictionzoo.run"
    rows = {line.split()[0]: line for line in lines if line.startswith("joint_")}
    assert len(rows) == 12 and [name for name, row in rows.items() if "!" not in row] == ["joint_0", "joint_1"]
    assert re.search(r"1 ! +20 !", rows["joint_3"]) and "slow" not in summarise(survey, tmp_path)
    assert sum("Excitation" in line for line in lines) == 1


@pytest.mark.parametrize(
    ("texts", "merged"),
    [(("5 ms, -2 to 0.5", "10 ms, -2 to 0.25"), "5 to 10 ms, -2 to 0.25 to 0.5"), (("1e-3 rad",), "1e-3 rad")],
)
def test_numbers_that_differ_become_a_range(robot, texts, merged):
    entries = [
        {"state": "note", "title": f"X, joint joint_{i}", "text": t, "option": None} for i, t in enumerate(texts)
    ]
    (finding,) = merge_findings(robot[1] | {"findings": entries})
    assert finding.text == merged


def test_the_verdict_names_problems_and_those_that_no_option_solves(robot):
    survey = robot[1]
    text, _, unsolved = judge(survey).partition("Not solved by an option: ")
    assert "Velocity, Spikes" in text and not unsolved
    still = survey_recordings("still", [swing(qpos=STILL)])
    assert "Excitation" in judge(still).partition("Not solved by an option: ")[2]
    assert "No problems" in judge(survey_recordings("swings", [swing()]))


def test_python_inspects_what_the_command_does(tmp_path, call, monkeypatch):
    write_csv(tmp_path / "a.csv", {"time": TIME, "qpos": np.sin(3 * TIME), "ctrl": np.sin(3 * TIME)})
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("conftest.main", main)
    finished = call("data=files", "data.train=[a.csv]", "hydra.run.dir=command")
    checked = fz.inspect(fz.read("a.csv"))
    checked.save("python")
    assert finished.out.startswith(repr(checked)) and "\nfiles: " not in repr(checked)
    assert [finding.title for finding in checked.findings] == [row["title"] for row in checked.survey["findings"]]
    command, python = (json.loads((tmp_path / name / "inspect.json").read_text()) for name in ("command", "python"))
    assert python == command and (tmp_path / "python" / "inspect.html").exists()


def test_a_bench_names_the_joints_of_logs_in_memory(leg):
    slow, fast = 0.5 * np.sin(2 * TIME), np.sin(3 * TIME)
    both = np.stack([slow, fast], 1)
    swapped = fz.read({"time": TIME, "q_knee": fast, "q_hip": slow, "cmd_knee": fast, "cmd_hip": slow})
    for logs in (swapped, Log("log", TIME, both, 0 * both, both, "", True)):
        survey = validate(fz.inspect(logs, leg()).survey)
        assert {joint["name"]: round(joint["position"][1], 1) for joint in survey["joints"]} == {"hip": 0.5, "knee": 1}
        assert survey["units"] == {"position": "rad", "velocity": "rad/s"}
    one = fz.read({"time": TIME, "qpos": fast, "ctrl": fast})
    with pytest.raises(LogError, match="qpos has 1 columns, expected 2"):
        fz.inspect(one, leg())
    with pytest.raises(ConfigError, match=r"^bench: str, expected a Bench"):
        inspect.unwrap(fz.inspect)(one, "stand.xml")
    with pytest.raises(LogError, match="logs: none"):
        fz.inspect([])


def test_every_field_of_the_schema_is_described():
    schema = read_schema()
    jsonschema.Draft202012Validator.check_schema(schema)

    def undescribed(field, path):
        for name, inner in field.get("properties", {}).items():
            yield from [f"{path}.{name}"] * ("description" not in inner)
            yield from undescribed(inner, f"{path}.{name}")
            yield from undescribed(inner.get("items", {}), f"{path}.{name}[]")

    sections = [("", schema), *schema["$defs"].items()]
    assert [field for name, section in sections for field in undescribed(section, name)] == []


def test_logs_serve_where_there_are_no_recordings():
    position = np.sin(3 * TIME)[:, None]
    log = Log("log", TIME, position, position, position, "", True, extras={"supply": 0 * position + 12})
    recordings = list_recordings(SimpleNamespace(load=lambda: Dataset("logs", (log,), (log,))))
    assert len(recordings) == 2 and set(recordings[0].signals) == {"qpos", "qvel", "ctrl", "supply"}


@pytest.fixture(scope="module")
def page(faulty, tmp_path_factory):
    path = tmp_path_factory.mktemp("inspect") / "inspect.html"
    survey = survey_recordings("swings", faulty)
    write_page(path, survey, faulty)
    return path, survey


def test_page_and_summary_have_the_findings_and_the_worst_recording(page, faulty, tmp_path):
    path, survey = page
    source, summary = path.read_text(encoding="utf-8"), summarise(survey, tmp_path)
    shown = Page(source)
    assert summary.startswith("swings: 3 recordings, 2800 samples") and str(tmp_path) in summary
    assert max(map(len, summary.splitlines()[:-1])) <= 160 and "data.clean.spikes=repair" in summary
    for finding in survey["findings"]:
        assert finding["title"] in summary and " ".join(finding["text"].split()) in shown.text
    assert rank_by_faults(survey)[0]["name"] == HOSTILE
    figures = read_data(source)["figures"]
    assert len(figures) == 2 + 6  # velocities, the worst recording, spreads
    spikes = [trace for trace in figures[1]["data"] if trace["name"] == "spike"]
    time = faulty[1].time - faulty[1].time[0]
    np.testing.assert_allclose(spikes[0]["x"], time[[100, 400]], rtol=1e-5)
    for figure in figures:
        go.Figure(figure)  # raises for a property that plotly does not know
    assert "<img src=x" not in source
    assert [link["href"] for link in shown.with_attribute("href")] == ["data:,", "inspect.json"]
    assert not shown.with_attribute("src")


@needs_browser
def test_a_browser_draws_every_figure(page):
    path, _ = page
    browser = open_page(path)
    assert browser.run(DRAWN) == len(read_data(path.read_text(encoding="utf-8"))["figures"])
    inner, width, *_ = browser.run(WIDTHS)
    assert width <= inner


@needs_browser
def test_the_page_of_a_robot_folds_its_joints(robot, tmp_path):
    recordings, survey = robot
    write_page(tmp_path / "inspect.html", survey, recordings, "python -m frictionzoo.run data.clean.spikes=repair")
    browser = open_page(tmp_path / "inspect.html", width=1440)
    bottom = """return [document.querySelector(".matrix"), document.querySelector(".command")]
      .map(part => part.getBoundingClientRect().bottom <= innerHeight);"""
    assert browser.run(bottom) == [True, True]
    doubtful = "return [...document.querySelectorAll('.matrix .caution')].map(cell => cell.dataset.label);"
    assert browser.run(doubtful) == ["lag [ms]", "spikes", *["lag [ms]"] * 9]
    browser = open_page(tmp_path / "inspect.html", fragment="#joint-4", width=390)
    assert browser.run("return await allDrawn() && document.querySelectorAll('details[open]').length;") == 1
    inner, width, *drawings = browser.run(WIDTHS)
    assert width <= inner == 390 and drawings and max(drawings) <= inner
    assert browser.run(CLIPPED) == []


@pytest.mark.parametrize(
    ("given", "suggested"),
    [
        ((), ["data.clean.step=0.01", "data.clean.spikes=repair"]),
        (["data.clean.step=0.02"], ["data.clean.spikes=repair"]),
        (["data.clean.spikes=drop"], ["data.clean.step=0.01"]),
        (["data.clean.spikes=repair", "data.clean.step=0.01"], []),
    ],
)
def test_an_option_that_is_set_is_a_note_and_the_next_command_has_the_others(tmp_path, given, suggested):
    uneven = TIME + np.random.default_rng(0).uniform(0, 0.003, len(TIME))
    position = spiked(swing(time=uneven), 300).signals["qpos"][:, 0]
    write_csv(tmp_path / "a.csv", {"time": uneven, "qpos": position, "ctrl": np.sin(uneven)})
    options = ["data=files", f"data.train=[{tmp_path / 'a.csv'}]", *given]
    summary = inspect_data(compose_config(*options), tmp_path / "out", options=options)
    assert shlex.split(summary.splitlines()[-1]) == ["python", "-m", "frictionzoo.run", *options, *suggested]
    findings = validate(json.loads((tmp_path / "out" / "inspect.json").read_text()))["findings"]
    states = {finding["title"]: (finding["state"], finding["option"]) for finding in findings}
    for title, option in (("Clock", "data.clean.step=0.01"), ("Spikes", "data.clean.spikes=repair")):
        assert states[title] == (("caution", option) if option in suggested else ("note", None))


def test_the_command_writes_what_it_says_without_torch_or_jax(recording, tmp_path):
    light = "assert not {'torch', 'jax', 'mujoco'} & set(sys.modules)"
    code = f"import sys; from frictionzoo.cli.inspect import main; main(); {light}"
    words = [sys.executable, "-c", code, "data=files", f"data.train=[{recording}]", "data.split.gap=0.05"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    finished = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert finished.returncode == 0, finished.stderr
    (folder,) = (tmp_path / "outputs").glob("*/*")
    assert folder.name.endswith("_inspect_files") and str(folder.relative_to(tmp_path)) in finished.stdout
    survey = validate(json.loads((folder / "inspect.json").read_text()))
    assert survey["data"]["recordings"] == 1 and survey["timing"]["interval"]["median"] == pytest.approx(0.001)
    assert (folder / "inspect.html").exists()


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("data=fils",), "data=fils: no such data; did you mean files"),
        (("data=files", "data.train=[nothing.csv]"), "nothing.csv: "),
        (("data=files", "data.trian=[a.csv]"), "data.trian: unknown option; did you mean train"),
        (("~data",), "~data: "),
        (("data=files,twin", "--multirun"), "--multirun: "),
    ],
)
def test_a_mistake_is_one_line_and_status_2(call, monkeypatch, overrides, message):
    monkeypatch.setattr("conftest.main", main)  # in place of that of a job
    finished = call(*overrides)
    assert finished.status == 2
    assert finished.err.startswith(f"frictionzoo: {message}") and finished.err.count("\n") == 1


@needs_data
def test_sts3215_shows_what_others_found():
    # 24 of the 960 logs: enough for all but the delay, for which tests of the diagnosis take more.
    found = findings(*read_sts3215(DATA, every=40))
    assert re.search(r"derivative by (19\.|20\.|20 ms)", found["Velocity"]["text"])
    assert "vin is 15 V" in found["Supply"]["text"] and "isolated spike" in found["Spikes"]["text"]
    assert found["Clock"]["option"] == "data.clean.step=0.01"
