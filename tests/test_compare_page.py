"""`comparison.html`: its answers, hostile names, nothing from elsewhere, and how a real browser shows it."""

import json
import re
from dataclasses import replace

import numpy as np
import plotly.graph_objects as go
import pytest
from conftest import changed, put
from helpers.browser import CLIPPED, WIDTHS, needs_browser, open_page, read_data
from helpers.html_pages import HOSTILE, Page, judge_targets
from helpers.results import of_joints

from frictionzoo.core.output import RESULT
from frictionzoo.core.state import Signals
from frictionzoo.report.colors import BASELINE
from frictionzoo.report.comparison_advice import list_next_steps
from frictionzoo.report.comparison_page import check_comparison, write_page
from frictionzoo.report.comparison_plots import choose_looks
from frictionzoo.result.comparison.record import compare_runs
from frictionzoo.result.comparison.runs import Failure, Run, gather
from frictionzoo.result.curves import Curves
from frictionzoo.result.verdict import DO_NOT_USE

LONG, SHORT, WINDOWS, TIMESTEP = 300, 100, 40, 0.001
RUN = "python -m frictionzoo.run"
LABELS = ("coulomb_stribeck", "coulomb_smooth segments.length=20 seed=1", "baseline")
LOST = {"position_mae": None, "position_mae_std": None, "position_rmse": None, "velocity_rmse": None}


def make_curves(error, joints, rollouts, seed):
    """A drive whose error grows to `error` over the rollout, the smaller in every other rollout."""
    time = np.arange(LONG + 1)[None, :, None] * TIMESTEP
    measured = np.sin(20 * time) * np.ones((2, 1, joints))
    simulated = measured[:, 1:] + error * np.linspace(0, 1, LONG)[None, :, None]
    varied = error * (1 + 0.3 * np.cos(np.arange(rollouts) + seed))
    velocity = np.linspace(-3, 3, 81)
    friction = np.tanh(velocity)[:, None] * np.ones(joints) * (1 + seed)
    history = {
        "iteration": np.array([1.0, 2.0, 3.0]),
        "loss": np.array([30.0, 1.0, 2.0]) * (1 + error),
        "grad_norm": np.ones(3),
        "bench.armature": np.array([0.1, 0.05, 0.04])[:, None] * np.ones(joints),
        "friction.static_torque": np.array([0.1, 0.3, 0.2])[:, None] * np.ones(joints),
    }
    local = np.linspace(0.1, 3, WINDOWS)
    return Curves(
        **{"measured_qpos": measured, "measured_qvel": 2 * measured, "qpos": simulated, "qvel": 2 * simulated},
        **{"baseline_qpos": simulated, "baseline_qvel": 2 * simulated},
        **{"signals": Signals(measured[:, 1:]), "load": np.zeros((len(measured), 0))},
        **{"train_mae": varied, "test_mae": varied, "local_mae": error * local, "local_speed": local},
        **{"local_load": local[::-1].copy(), "velocity": velocity, "friction": friction},
        **{"friction_low": friction - 0.1 * seed, "friction_high": friction + 0.1 * seed, "history": history},
    )


def make_run(folder, result, label, error, joints=("knee",), rollouts=10, seed=0):
    record = changed(of_joints(result, *joints), model=label.partition(" ")[0], fit={"stopped": "finished"})
    curves = make_curves(error, len(joints), rollouts, seed)
    for part in ("train", "test"):
        errors = {"position_mae": float(curves.test_mae.mean()), "position_mae_std": float(curves.test_mae.std())}
        record = changed(record, metrics={part: errors | {"rollouts": rollouts}})
    return Run(label, folder / f"{seed}_{record['model']}", record, curves)


def diverge(run):
    """The same run with every rollout lost, from the first step on."""
    metrics = run.result.metrics
    record = changed(
        run.result, metrics={part: LOST | {"diverged": metrics[part].rollouts} for part in ("train", "test")}
    )
    lost = {name: np.full_like(getattr(run.curves, name), np.nan) for name in ("qpos", "qvel", "test_mae", "local_mae")}
    return replace(run, result=record, curves=replace(run.curves, **lost))


@pytest.fixture
def runs(result, tmp_path):
    errors = zip(LABELS, (0.010, 0.0102, 0.04), strict=True)
    return [make_run(tmp_path, result, label, error, seed=i) for i, (label, error) in enumerate(errors)]


def show(path, runs, failures=()):
    comparison = compare_runs(runs, failures)
    write_page(path, comparison, runs)
    return path.read_text(encoding="utf-8"), comparison


def plain(source):
    return " ".join(Page(source).text.split())


def checks_of(runs, failures=()):
    return {check.title: check for check in check_comparison(compare_runs(runs, failures), runs)}


def test_the_page_answers_the_three_questions(runs, tmp_path):
    failures = [Failure("7_neural_friction", "neural_friction", "the loss is not finite; lower fit.learning_rate")]
    source, comparison = show(tmp_path / "comparison.html", runs, failures)
    text = plain(source)
    assert comparison["recommendation"]["reason"] in text
    assert failures[0].reason in text and "1 job failed" in text and "1 of 4 jobs failed" in text
    for entry in comparison["runs"]:
        assert entry["label"] in text and f"{entry['test']['position_mae']:.3g}" in text
        assert f"{entry['test']['position_mae_std']:.2g}" in text
        for parameter in entry["parameters"]:
            assert parameter["name"] in text and f"{parameter['value']:.4g}" in text
    changes = {entry["label"]: round(-100 * entry["change"]["test"]) for entry in comparison["runs"]}
    assert changes["baseline"] == 0 and changes[LABELS[0]] > 50
    assert f"−{changes[LABELS[0]]} %" in text and "within noise" in text and "simulated data" in text


def suggest(run: Run, law: str, recording: str, grade: str = "use it with care") -> None:
    """Let a run's verdict have these commands."""
    commands = {"law": law, "recording": recording, "export": "export"}
    rows = [{"kind": kind, "command": command} for kind, command in commands.items()]
    put(run.result, "verdict", {"grade": grade, "findings": [], "commands": rows})


def test_the_page_opens_with_what_to_take_and_what_to_do(runs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for run in runs:
        run.folder.mkdir()
        (run.folder / RESULT).touch()
        suggest(run, f"{RUN} data=twin model=lugre", "python -m frictionzoo.design")
    source, comparison = show(tmp_path / "comparison.html", runs)
    text, chosen = plain(source), comparison["recommendation"]["run"]
    place = next(run.folder.name for run in runs if run.label == chosen)
    asked = [f"Recommended: {chosen}", "Confidence", "no relevant difference", "How to use"]
    asked += [
        f"frictionzoo.export {place}",
        f"fz.load('{place}')",
        "Next steps",
        "model=lugre",
        "frictionzoo.design",
        "± sigma",
    ]
    places = [text.find(each) for each in asked]
    assert -1 not in places and places == sorted(places)
    page = Page(source)
    links = [link["href"][1:] for link in page.with_attribute("href") if link["href"][0] == "#"]
    identifiers = [element["id"] for element in page.with_attribute("id")]
    assert len(links) == 11 and links == sorted(links, key=identifiers.index)


def test_what_is_next_fits_what_was_found(runs, result):
    """More rollouts where they may tell laws apart, and no law that was tried."""
    close = replace(runs[1], label="coulomb_smooth")
    for run in (runs[0], close):
        suggest(run, f"{RUN} 'data.train=[a b.csv]' evaluation.rollouts=3 model=coulomb_smooth", "record")
    swept = f"{RUN} -m 'data.train=[a b.csv]' model=coulomb_smooth,coulomb_stribeck evaluation.rollouts=40"
    steps = list_next_steps(compare_runs([runs[0], close], []), runs[0])
    assert [step.command for step in steps] == [swept, "record"]
    steps = list_next_steps(compare_runs([runs[0], runs[2]], []), runs[0])
    assert steps[0].command.endswith("model=coulomb_smooth") and len(steps) == 2
    suggest(runs[0], "fz.identify(bench, 'baseline', logs)", "fz.design_recording({}, drive)")
    steps = list_next_steps(compare_runs([runs[0], runs[2]], []), runs[0])
    assert [step.command for step in steps] == ["fz.design_recording({}, drive)"]


def test_a_drive_that_is_not_to_be_used_goes_nowhere(runs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for run in runs:
        run.folder.mkdir()
        (run.folder / RESULT).touch()
        suggest(run, f"{RUN} data=twin model=lugre", "python -m frictionzoo.design", DO_NOT_USE)
        put(run.result, "verdict.commands", [{"kind": "repair", "command": f"{RUN} data.clean.spikes=repair"}])
    source, _ = show(tmp_path / "comparison.html", runs)
    text = plain(source)
    assert "data.clean.spikes=repair" in text and "fz.load(" in text
    assert not any(word in text for word in ("frictionzoo.export", "frictionzoo.design", "identified.xml"))


def test_no_absolute_path_is_on_the_page(result, tmp_path):
    home = "/home/some body/logs"
    runs = [make_run(tmp_path, result, "baseline", 0.01 * (1 + i), seed=i) for i in range(2)]
    for i, run in enumerate(runs):
        run.result.data.logs[0].name = f"{home}/a.csv"
        run.result.warnings = [f"{home}/a.csv: 3 samples are missing"]
        run.result.settings |= {"seed": 0, "bench": {"mjcf": f"{home}/stand{i}.xml"}, "data": [f"{home}/a.csv"]}
        (run.folder / ".hydra").mkdir(parents=True)
        (run.folder / ".hydra" / "overrides.yaml").write_text(json.dumps([f"bench.mjcf={home}/stand{i}.xml"]))
    labelled = gather(runs)
    assert [run.label for run in labelled] == [f"baseline, bench.mjcf stand{i}.xml" for i in range(2)]
    failure = Failure("7_neural_friction", "neural_friction", f"{home}/a.csv: not finite")
    source, _ = show(tmp_path / "comparison.html", labelled, [failure])
    shown = Page(source).text + json.dumps(Page(source).elements) + json.dumps(read_data(source))
    assert "some body" not in shown and str(tmp_path) not in shown
    assert "a.csv: 3 samples are missing" in shown and "a.csv: not finite" in shown
    assert "python -m frictionzoo.run bench.mjcf=stand0.xml" in shown.replace("'", "")


def test_same_names_in_other_folders_are_told_apart(result, tmp_path):
    runs = [make_run(tmp_path, result, "baseline", 0.01, seed=i) for i in range(2)]
    for run, folder in zip(runs, "ab", strict=True):
        run.result.settings |= {"seed": 0, "bench": {"mjcf": f"/{folder}/stand.xml"}}
    assert [run.label for run in gather(runs)] == ["baseline (0_baseline)", "baseline (1_baseline)"]


def test_rows_are_ranked_and_open_their_panels(runs, tmp_path):
    source, comparison = show(tmp_path / "comparison.html", runs[::-1])
    page = Page(source)
    labels = [entry["label"] for entry in comparison["runs"]]
    buttons = page.with_attribute("aria-controls")
    panels = {element["id"] for element in page.with_attribute("id")}
    assert [button["aria-controls"] for button in buttons] == [f"panel-{i}" for i in range(len(labels))]
    assert {button["aria-controls"] for button in buttons} <= panels
    assert [row["data-run"] for tag, row in page.elements if tag == "tr" and "data-run" in row] == ["0", "1", "2"]
    assert state_of(source)["labels"] == labels


def state_of(source):
    return read_data(source)["state"]


@pytest.mark.parametrize("joints", [("knee",), ("hip", "knee")], ids=len)
def test_every_figure_is_valid_and_says_what_it_shows(result, tmp_path, joints):
    runs = [make_run(tmp_path, result, label, 0.01 * 3**i, joints, seed=i) for i, label in enumerate(LABELS)]
    source, _ = show(tmp_path / "comparison.html", runs)
    figures, canvases = read_data(source)["figures"], Page(source).with_attribute("data-figure")
    assert [int(canvas["data-figure"]) for canvas in canvases] == list(range(len(figures)))
    # For each run the loss and its two drawn parameters; for each joint a trajectory and a friction curve.
    assert len(figures) == 3 * len(runs) + 2 * len(joints) + 8
    for canvas in canvases:
        assert canvas["role"] == "img" and len(canvas["aria-label"]) > 40
    for figure in figures:
        go.Figure(figure)  # raises for a property that plotly does not know


def figure_named(source, title):
    headings = re.findall(r"<h3>(.*?)</h3>\s*<div class=\"canvas[^>]*data-figure=\"(\d+)\"", source)
    return read_data(source)["figures"][next(int(number) for name, number in headings if name == title)]


def test_figures_hold_the_numbers_of_the_comparison(runs, tmp_path):
    source, comparison = show(tmp_path / "comparison.html", runs)
    bars = [trace for trace in figure_named(source, "Error of each run")["data"] if trace["x"] != [None]]
    errors = [entry[part]["position_mae"] for part in ("test", "train") for entry in comparison["runs"]]
    np.testing.assert_allclose([bar["x"][0] for bar in bars], errors, rtol=1e-5)
    best = comparison["runs"][0]["label"]
    pairs = {pair["run"]: pair for pair in comparison["pairs"] if pair["other"] == best}
    points = figure_named(source, "Differences to the best run")["data"]
    means = {point["name"]: point["x"][0] for point in points}
    assert means == pytest.approx({best: 0} | {name: pair["mean"] for name, pair in pairs.items()}, rel=1e-5)
    for point in points[1:]:
        pair = pairs[point["name"]]
        assert point["x"][0] + point["error_x"]["array"][0] == pytest.approx(pair["high"], rel=1e-5)
        assert point["x"][0] - point["error_x"]["arrayminus"][0] == pytest.approx(pair["low"], rel=1e-5)
    curves = {trace["name"]: trace["y"] for trace in figure_named(source, "Error by horizon")["data"]}
    for label, curve in comparison["by_horizon"]["position_mae"].items():
        np.testing.assert_allclose(curves[label], curve, rtol=1e-5)
    torque = [trace for trace in figure_named(source, "Friction of knee")["data"] if "fill" not in trace]
    for trace in torque:
        np.testing.assert_allclose(trace["y"], comparison["friction"][trace["name"]]["torque"][0], rtol=1e-5)
    bands = {trace["name"] for trace in figure_named(source, "Friction of knee")["data"] if "fill" in trace}
    assert bands == set(LABELS[1:])  # the first run's law depends on the velocity alone


def test_a_run_has_the_same_look_in_every_figure(runs, tmp_path):
    source, comparison = show(tmp_path / "comparison.html", runs)
    looks = choose_looks((entry["label"] for entry in comparison["runs"]), "baseline")
    for title in ("Trajectory of knee", "Error over time", "Error by speed", "Autocorrelation of the error"):
        lines = [t for t in figure_named(source, title)["data"] if "meta" in t and "fill" not in t]
        assert {trace["name"] for trace in lines} == set(looks)
        for trace in lines:
            line, look = trace["line"], looks[trace["name"]]
            assert (line["color"], trace["meta"]["run"]) == (look["color"], look["run"])
            dash = [] if line["dash"] == "solid" else [float(part[:-2]) for part in line["dash"].split(",")]
            np.testing.assert_allclose(dash, line["width"] * np.array(look["dash"]))


def test_many_runs_are_told_apart():
    looks = choose_looks(map(str, range(42)))
    assert len({(look["color"], look["dash"]) for look in looks.values()}) == 42


def test_no_friction_has_a_colour_of_its_own():
    looks = choose_looks([*map(str, range(9)), "baseline"], "baseline")
    assert [label for label, look in looks.items() if look["color"] == BASELINE] == ["baseline"]
    assert len({(look["color"], look["dash"]) for look in looks.values()}) == 10


def test_a_far_difference_leaves_the_frame_and_is_named(runs, result, tmp_path):
    close = [make_run(tmp_path, result, f"other{i}", 0.0105, seed=3 + i) for i in range(3)]
    far = make_run(tmp_path, result, "far", 5.0, seed=9)
    source, comparison = show(tmp_path / "comparison.html", [*runs[:2], *close, far])
    layout = figure_named(source, "Differences to the best run")["layout"]
    (mean,) = [
        p["mean"] for p in comparison["pairs"] if p["run"] == "far" and p["other"] == comparison["runs"][0]["label"]
    ]
    assert layout["xaxis"]["range"][1] < mean
    assert [note["text"] for note in layout["annotations"]] == [f"{mean:.3g} →"]
    assert figure_named(source, "Error over time")["layout"]["yaxis"]["type"] == "log"


def test_a_run_that_diverged_entirely_has_its_place(runs, tmp_path):
    source, comparison = show(tmp_path / "comparison.html", [*runs[:2], diverge(runs[2])])
    assert comparison["runs"][-1]["label"] == "baseline"
    assert "10 of 10" in plain(source)
    for figure in read_data(source)["figures"]:
        go.Figure(figure)


def test_runs_that_all_diverged_have_a_page(runs, tmp_path):
    source, _ = show(tmp_path / "comparison.html", [diverge(run) for run in runs])
    text = plain(source)
    assert "Every test rollout of every run diverged" in text and "★" not in text
    assert ">within noise<" not in source and "10 of 10 test rollouts diverged" in text
    assert state_of(source)["selected"] == 0


def test_one_run_alone_has_a_page(runs, tmp_path):
    source, _ = show(tmp_path / "comparison.html", runs[:1])
    assert "nothing to compare" in plain(source)


def test_hostile_names_stay_text(runs, result, tmp_path):
    hostile = make_run(tmp_path, result, HOSTILE, 0.02, joints=(HOSTILE,), seed=3)
    hostile = replace(hostile, folder=tmp_path / "javascript:alert(1)" / "a#b?c")
    hostile.folder.mkdir(parents=True)
    (hostile.folder / "report.html").touch()
    for run in (hostile, *runs):
        run.result.data.name = run.result.data.logs[0].name = HOSTILE
    runs = [replace(run, result=of_joints(run.result, HOSTILE)) for run in runs]
    hostile.result.parameters[0].name = HOSTILE
    hostile.result.settings["loss"] = {HOSTILE: HOSTILE}
    source, _ = show(tmp_path / "comparison.html", [hostile, *runs], [Failure(HOSTILE, HOSTILE, HOSTILE)])
    page = Page(source)
    tags = [tag for tag, _ in page.elements]
    assert not page.with_attribute("onerror") and "img" not in tags and tags.count("script") == 3
    assert HOSTILE in page.text
    assert "<img" not in json.dumps(read_data(source)["figures"])
    links = [attributes["href"] for tag, attributes in page.elements if tag == "a"]
    assert "javascript%3Aalert%281%29/a%23b%3Fc/report.html" in links


def test_links_lead_to_what_is_there(runs, tmp_path):
    for run in runs[:2]:
        run.folder.mkdir()
        (run.folder / "report.html").touch()
    (tmp_path / "out" / "figures").mkdir(parents=True)
    for name in ("table.tex", "figures/figure6_mae.pdf"):
        (tmp_path / "out" / name).touch()
    source, _ = show(tmp_path / "out" / "comparison.html", runs)
    links = {attributes["href"] for tag, attributes in Page(source).elements if tag == "a"}
    links -= {link for link in links if link.startswith("#")}
    reports = {f"../{run.folder.name}/report.html" for run in runs[:2]}
    assert links == {"comparison.json", "table.tex", "figures/figure6_mae.pdf"} | reports


def test_nothing_comes_from_elsewhere(runs, tmp_path):
    judge_targets(show(tmp_path / "comparison.html", runs)[0])


def test_long_curves_of_many_runs_stay_small(result, tmp_path):
    runs = [make_run(tmp_path, result, f"law{i}", 0.01, seed=i) for i in range(20)]
    simulated = "qpos", "qvel", "baseline_qpos", "baseline_qvel"
    runs = [
        replace(run, curves=replace(run.curves, **{n: np.repeat(getattr(run.curves, n), 40, 1) for n in simulated}))
        for run in runs
    ]
    first = {f"measured_{n}": np.zeros((2, 40 * LONG + 1, 1)) for n in ("qpos", "qvel")}
    runs = [replace(run, curves=replace(run.curves, **first)) for run in runs]
    source, _ = show(tmp_path / "comparison.html", runs)
    longest = max(len(trace["x"]) for trace in figure_named(source, "Trajectory of knee")["data"])
    assert 1000 < longest <= 2000
    assert len(source) < 9_000_000


def test_no_doubts_about_good_runs(runs):
    assert {check.state for check in checks_of(runs).values()} == {"good", "note"}


@pytest.mark.parametrize(
    ("spoilt", "value", "title", "state", "text"),
    [
        ("parameters.0.at_bound", True, "Bounds", "caution", "baseline (armature)"),
        ("fit.stopped", "diverged", "Fits", "caution", "baseline"),
        ("settings.segments", {"count": 7, "length": 5}, "Different fit options", "caution", "segments"),
        ("settings.seed", 5, "Same fit options", "note", "seed"),
        ("metrics.test.diverged", 2, "Stability", "caution", "baseline (2 of 10 on test"),
    ],
)
def test_a_reason_for_doubt_is_said(runs, spoilt, value, title, state, text):
    put(runs[2].result, spoilt, value)
    check = checks_of(runs)[title]
    assert check.state == state and text in check.text


def test_a_recommended_run_that_diverged_is_a_problem(runs):
    for run in runs:
        run.result.metrics.test.diverged = 2
    assert checks_of(runs)["Stability"].state == "bad"


def test_few_rollouts_ask_for_caution(result, tmp_path):
    runs = [make_run(tmp_path, result, label, 0.01, rollouts=3, seed=i) for i, label in enumerate(LABELS)]
    assert checks_of(runs)["Few rollouts"].state == "caution"


CLICKS = """
  const panel = () => document.querySelector(".panel:not([hidden])").textContent;
  const trajectory = document.querySelector("[data-time]");
  const emphasised = () => trajectory.data.filter(trace => trace.line.width === 2.8).map(trace => trace.meta.run);
  const visible = () => trajectory.data.filter(trace => trace.visible !== false);
  const said = { figures: await allDrawn() ? shown().length : 0, start: panel() };
  document.querySelectorAll(".ranking tbody tr")[1].querySelector("td.value").click();
  await until(() => emphasised().length && emphasised().every(run => run === 1));
  said.chosen = panel();
  said.hash = decodeURIComponent(location.hash);
  said.expanded = [...document.querySelectorAll("[aria-expanded]")].map(item => item.getAttribute("aria-expanded"));
  said.panels = document.querySelectorAll(".panel:not([hidden])").length;
  said.redrawn = await allDrawn();
  said.emphasised = emphasised();
  const before = visible().length;
  document.getElementById("only").click();
  await until(() => visible().length < before);
  said.shown = visible().map(trace => trace.meta?.run ?? "measured");
  const chosen = panel();
  history.back();
  await until(() => panel() !== chosen);
  said.back = panel();
  return said;
"""


@pytest.mark.slow
@needs_browser
def test_a_browser_draws_every_figure_and_shows_the_run_that_is_clicked_or_linked(runs, tmp_path):
    path = tmp_path / "comparison.html"
    _, comparison = show(path, runs)
    browser = open_page(path, scheme="dark")
    said = browser.run(CLICKS)
    labels = [entry["label"] for entry in comparison["runs"]]
    assert said["figures"] == 13 and said["redrawn"]
    selected, other = labels.index(comparison["recommendation"]["run"]), 1
    assert selected != other
    assert labels[selected] in said["start"] and labels[other] in said["chosen"]
    assert said["hash"] == f"#{labels[other]}"
    assert said["expanded"] == [str(i == other).lower() for i in range(len(labels))] and said["panels"] == 1
    assert set(said["emphasised"]) == {other} and set(said["shown"]) == {other, "measured"}
    assert labels[selected] in said["back"]
    assert browser.run("return isDark()")
    browser.prefer("light")
    assert browser.run("return until(() => !isDark())")
    linked = "document.querySelector('.panel:not([hidden]) h2').textContent.trim()"  # once the figures are unpacked
    assert open_page(path, fragment=f"#{LABELS[2]}").run(f"return until(() => {linked} === {LABELS[2]!r})")


@needs_browser
def test_the_page_does_not_scroll_sideways(runs, result, tmp_path):
    name = "law-with-a-very-long-name-that-cannot-be-broken-anywhere-at-all-in-any-table"
    runs = [*runs, make_run(tmp_path, result, name, 0.02, seed=3)]
    for run in runs:
        run.result.data.name = run.result.data.logs[0].name = name
        for row in (row for parameter in run.result.parameters for row in parameter.by_joint):
            row.identifiable, row.interval = False, [0.0123456, 0.0234567]
    show(tmp_path / "comparison.html", runs, [Failure(name, name, name)])
    for width in (390, 1440):
        browser = open_page(tmp_path / "comparison.html", width=width)
        inner, page, *drawings = browser.run(WIDTHS)
        assert inner == width and page <= inner
        assert drawings and max(drawings) <= inner
        assert browser.run(CLIPPED) == []
