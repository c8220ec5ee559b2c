"""`report.html`: its answers, hostile names, nothing from elsewhere, and how a real browser shows it."""

import base64
import gzip
import json
import re
from dataclasses import replace

import numpy as np
import plotly.graph_objects as go
import pytest
from conftest import changed, put
from helpers.browser import CLIPPED, DRAWN, WIDTHS, needs_browser, open_page, read_data
from helpers.html_pages import HOSTILE, Page, judge_targets
from helpers.results import curves_of, make_rollout, of_joints
from plotly.offline import get_plotlyjs_version

from frictionzoo.core.anonymous import without_paths
from frictionzoo.core.output import to_json
from frictionzoo.core.telling import say_percent
from frictionzoo.identification.solve import still_falling
from frictionzoo.report import with_plotly
from frictionzoo.report.rollouts import say_where
from frictionzoo.report.run_page import MOST, check_result, correlate, write_report
from frictionzoo.report.run_plots import choose_rollouts, plot_run
from frictionzoo.report.text import format_change
from frictionzoo.result.evaluate import Prediction
from frictionzoo.result.portrait import Portrait


@pytest.fixture
def record(result):
    return changed(result, fit={"stopped": "finished", "moving": []})


def report(path, record, joints=("knee",), rollout=None, **more):
    course = np.outer([0.1, 0.05, 0.04], np.ones(len(joints)))
    values = {"bench.armature": course, "friction.static_torque": np.ones((3, len(joints)))} | more
    curves = curves_of(rollout or make_rollout(nv=len(joints)), **values)
    write_report(path, record if len(record["joints"]) > 1 else of_joints(record, *joints), curves)
    return path.read_text(encoding="utf-8")


def checks_of(record):
    return {check.title: check for check in check_result(record)}


def test_the_page_answers_the_three_questions(record, tmp_path):
    (tmp_path / "identified.xml").write_text("<mujoco/>")
    page = Page(report(tmp_path / "report.html", record))
    assert "coulomb_stribeck on waves" in page.text and "simulated data" in page.text
    for parameter in record["parameters"]:
        assert parameter["name"] in page.text and f"{parameter['value']:.4g}" in page.text
    for part in ("test", "baseline", "train"):
        assert f"{record['metrics'][part]['position_mae']:.4g}" in page.text
    test, baseline = (record["metrics"][part]["position_mae"] for part in ("test", "baseline"))
    assert f"−{round(100 * (1 - test / baseline))} %" in page.text
    assert all(version in page.text for version in to_json(record.versions).values())
    assert "6.50 s" in page.text
    links = [attributes["href"] for tag, attributes in page.elements if tag == "a"]
    files = [link for link in links if not link.startswith("#")]
    assert files == ["result.json", "identified.xml"]  # what is there, and what is written next


@pytest.mark.parametrize("joints", [("knee",), ("hip", "knee")], ids=len)
def test_links_at_the_top_lead_to_sections(record, tmp_path, joints):
    page = Page(report(tmp_path / "report.html", record, joints))
    places = [attributes["id"] for attributes in page.with_attribute("id")]
    links = [attributes["href"][1:] for attributes in page.with_attribute("href") if attributes["href"][0] == "#"]
    assert len(links) > 6 and {*links} <= {*places} and len(places) == len({*places})
    assert sorted(links, key=places.index)[:2] == ["verdict", "parameters"]


def test_the_page_opens_with_what_to_do(record, tmp_path):
    put(record, "verdict.commands", [{"kind": "law", "command": "frictionzoo model=stribeck"}])
    text = Page(report(tmp_path / "report.html", record)).text
    change = format_change(*(record["metrics"][part]["position_mae"] for part in ("test", "baseline")))
    asked = (change, "Verdict: ", "Next: the model to try", "model=stribeck", "fz.load(", "armature", "test rollout ")
    places = [text.find(each) for each in asked]
    assert -1 not in places and places == sorted(places)


def test_further_findings_are_folded(record, tmp_path):
    record.warnings = [f"fault {number}" for number in range(5)]
    text = Page(report(tmp_path / "report.html", record)).text.lower()
    folded = text.index("more findings, perhaps with the same cause")
    assert text.index("fault 1") < folded < text.index("fault 2") < text.index("between the bounds")


def test_no_absolute_path_is_on_the_page(record, tmp_path):
    home = "/home/somebody/logs"
    command = f"frictionzoo data.train=[{home}/a.csv,{home}/b.csv]"
    put(record, "verdict.commands", [{"kind": "law", "command": command}])
    record.warnings = [f"{home}/a.csv: 3 samples are missing"]
    record.notes = [f"read from {home}/robot.xml; N m/rad, 1/2, and/or"]
    record.data.logs[0].name = f"{home}/a.csv"
    page = Page(report(tmp_path / "report.html", record))
    shown = page.text + json.dumps(page.elements)
    assert "somebody" not in shown and str(tmp_path) not in shown
    assert "data.train=[a.csv,b.csv]" in page.text and "robot.xml; N m/rad, 1/2, and/or" in page.text
    assert f"fz.load('{tmp_path.name}')" in page.text


def test_the_command_of_a_run_is_on_its_page_without_its_folders(record, tmp_path):
    assert "frictionzoo.run" not in Page(report(tmp_path / "report.html", record)).text  # as of one made in Python
    (tmp_path / ".hydra").mkdir()
    kept = ["model=dahl", "data.train=[/home/somebody/a b.csv]", "hydra.run.dir=/home/somebody/out", "resume=null"]
    (tmp_path / ".hydra" / "overrides.yaml").write_text(json.dumps(kept))
    page = Page(report(tmp_path / "report.html", record))
    assert "python -m frictionzoo.run model=dahl 'data.train=[" in page.text
    assert "somebody" not in page.text and "resume" not in page.text and "hydra.run" not in page.text


@pytest.mark.parametrize(
    ("share", "said"),
    [(0.0712, "7.1 %"), (0.996, "100 %"), (23.71, "2371 %"), (1.55, "155 %"), (0.0, "0 %"), (4e-5, "0.004 %")],
)
def test_a_share_is_no_power_of_ten(share, said):
    assert say_percent(share) == said


def test_many_recordings_are_folded(record, tmp_path):
    (log,) = record["data"]["logs"][:1]
    for count, folded in ((12, False), (13, True)):
        record.data.logs = [changed(log, name=f"{i}.csv") for i in range(count)]
        text = Page(report(tmp_path / "report.html", record)).text
        assert ("13 recordings: 13 in " in text) is folded and "11.csv" in text


def test_errors_of_all_rollouts_are_on_one_scale(record):
    drawn = plot_run(record, curves_of(spread_out([1.0, 2.0, 30.0])))["error"]
    assert len(drawn) == 3 and len({figure.panels[0].y for figure in drawn}) == 1


def test_paths_below_this_folder_are_relative(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    given = {"a": [f"export {tmp_path}/runs/1 'x=[/other/place/b.csv]'", 3], "b": r"C:\home\me\c.csv, m/s"}
    shortened = without_paths(given, ("/other/place/a.csv", r"C:\home\me\c.csv"), below=tmp_path)
    assert shortened == {"a": ["export runs/1 'x=[b.csv]'", 3], "b": "c.csv, m/s"}


def spread_out(sizes):
    """Rollouts whose errors are of these sizes; of NaN, the rollout diverges."""
    segments, fitted, _ = make_rollout()
    times = np.array(sizes)[:, None, None]
    several = replace(
        segments, qpos=np.repeat(segments.qpos, len(sizes), 0), qvel=np.repeat(segments.qvel, len(sizes), 0)
    )
    error = fitted.qpos - segments.qpos[:, 1:]
    qpos = several.qpos[:, 1:] + times * error
    return several, Prediction(qpos, several.qvel[:, 1:]), Prediction(qpos + 0.1, several.qvel[:, 1:])


@pytest.mark.parametrize(
    ("sizes", "ranks"),
    [
        ([2.0], {"only": 0}),
        ([2.0, 1.0], {"best": 1, "worst": 0}),
        ([2.0, 5.0, 1.0, 3.0, 4.0], {"best": 2, "median": 3, "worst": 1}),
        ([2.0, np.nan, 1.0], {"best": 2, "median": 0, "worst": 1}),
    ],
    ids=len,
)
def test_best_median_and_worst_rollout_are_shown_and_said(record, tmp_path, sizes, ranks):
    rollout = spread_out(sizes)
    assert choose_rollouts(curves_of(rollout)) == ranks
    source = report(tmp_path / "report.html", record, rollout=rollout)
    page, figures = Page(source), read_data(source)["figures"]
    for number, (rank, at) in enumerate(ranks.items()):
        assert f"The {rank} " in source
        drawn = next(t["y"] for t in figures[number]["data"] if t["name"] == "this model" and t["yaxis"] == "y")
        expected = rollout[1].qpos[at, :, 0]
        np.testing.assert_allclose(drawn[1:], expected[np.isfinite(expected)], rtol=1e-5)
        mean = np.abs(rollout[1].qpos[at] - rollout[0].qpos[at, 1:]).mean()
        assert f"{rank} {mean:.4g} rad" in page.text if np.isfinite(mean) else f"{rank} none" in page.text


def test_recordings_of_the_rollouts_are_named(record, tmp_path):
    curves = curves_of(spread_out([2.0, 5.0, 1.0]))
    assert say_where(record["data"], curves, 2) == ""
    curves = replace(curves, recording=np.zeros(3), begins=np.array([1.5, 0.25, 12.0]))
    write_report(tmp_path / "report.html", of_joints(record, "knee"), curves)
    name = next(log["name"] for log in record["data"]["logs"] if log["part"] == "test")
    text = Page((tmp_path / "report.html").read_text()).text
    for rank, begins in (("best", "12"), ("median", "1.5"), ("worst", "0.25")):
        assert re.search(rf"{rank} \S+ rad \([^)]*{name} from {begins} s on\)", text), rank


def test_friction_and_what_is_left_are_drawn(record, tmp_path):
    """Joint by joint, over all that the law sees; a portrait without intervals or points has none."""
    at = np.linspace(-2, 2, 9)[:, None] * np.ones(2)
    none, points = np.full((9, 2), np.nan), np.where(abs(at) < 1, np.nan, at)
    velocity = Portrait(at, at, at - 0.1, at + 0.2, points, points + 1, points, points + 3)
    load = Portrait(abs(at), at, none, none, *[none] * 4)
    curves = curves_of(make_rollout(nv=2), **{"bench.armature": np.ones((3, 2))})
    left = np.where(np.arange(20)[:, None] % 5, 0.25, np.nan) * np.ones(2)
    more = {"portraits": {"load": load, "velocity": velocity}, "left": left, "left_time": np.arange(20.0)}
    drawn = plot_run(of_joints(record, "hip", "knee"), replace(curves, **more))
    titles = [figure.title for figure in drawn["portraits"]]
    assert titles == [
        f"Friction of {joint} over {what}" for joint in ("hip", "knee") for what in ("load on the gear", "velocity")
    ]
    bare, full = (with_plotly.draw(figure)["data"] for figure in drawn["portraits"][:2])
    assert [trace["name"] for trace in bare] == ["model"]
    band, law, implied = full
    assert law["y"] == at[:, 0].tolist() and band["y"][:9] == (at[:, 0] + 0.2).tolist()
    seen = points[~np.isnan(points[:, 0]), 0]
    assert implied["x"] == seen.tolist() and implied["y"] == (seen + 1).tolist()
    assert set(implied["error_y"]["array"]) == {2.0} and set(implied["error_y"]["arrayminus"]) == {1.0}
    assert [sum(trace["y"]) for trace in with_plotly.draw(drawn["left"][1])["data"]] == [16 * 0.25]
    assert "1 N m on average" in drawn["portraits"][1].text


def test_where_a_value_began_and_how_values_go_together(record, tmp_path):
    covariance = {
        "labels": ["bench.armature", "friction.static_torque"],
        **{"scale": ["log", "log"], "centre": [0.0, 0.0], "matrix": [[4.0, -3.0], [-3.0, 9.0]], "freedom": 10.0},
    }
    put(record, "covariance", covariance)
    page = Page(report(tmp_path / "report.html", record))
    assert "initial value 0.1 " in page.text and "1.00 -0.50" in page.text
    assert correlate(changed(record, covariance=None), "knee") is None
    several = of_joints(record, "hip", "knee")
    several.covariance.labels = ["bench.armature/knee", "friction.static_torque/knee"]
    found = correlate(several, "knee")
    assert found and found["names"] == ["armature", "static_torque"] and found["rows"][0][1] == -0.5
    assert found["strongest"] == ""
    several.covariance.matrix = [[4.0, -5.4], [-5.4, 9.0]]
    assert (close := correlate(several, "knee")) and close["strongest"] == "armature and static_torque (-0.90)"
    assert correlate(several, "hip") is None


def test_intervals_stand_beside_the_values(record, tmp_path):
    put(record, "parameters.0.by_joint.0.identifiable", False)
    put(record, "parameters.3.by_joint.0.identifiable", True)
    put(record, "parameters.3.by_joint.0.interval", [0.25, 0.35])
    page = Page(report(tmp_path / "report.html", record))
    assert page.text.count("0.25 to 0.35") == page.text.count("not identifiable from these data") == 1
    assert "Least certain of the identifiable values: friction.static_torque, ± 17 %." in page.text


def test_every_figure_has_a_heading_and_a_text(record, tmp_path):
    source = report(tmp_path / "report.html", record)
    canvases = Page(source).with_attribute("data-figure")
    figures = read_data(source)["figures"]
    assert [int(canvas["data-figure"]) for canvas in canvases] == list(range(len(figures)))
    assert len(figures) == 7  # trajectory, error, phase, loss, two parameters, horizons
    for canvas in canvases:
        assert canvas["role"] == "img" and len(canvas["aria-label"]) > 40
    assert len(re.findall(r"<h3>[^<]+</h3>\s*<div class=\"canvas", source)) == len(figures)
    for figure in figures:
        go.Figure(figure)  # raises for a property that plotly does not know


def test_plotly_is_the_one_whose_schema_holds_and_no_more_than_figures_need(record, tmp_path):
    packed = re.search(r'id="plotly">(.*?)</script>', report(tmp_path / "report.html", record))[1]
    library = gzip.decompress(base64.b64decode(packed)).decode()
    assert library.startswith("/**\n* plotly.js (basic - minified) v" + get_plotlyjs_version())
    assert "Licensed under the MIT license" in library and len(packed) < 6e5


def test_curves_are_those_of_the_rollout(record, tmp_path):
    segments, fitted, baseline = make_rollout()
    trajectory = read_data(report(tmp_path / "report.html", record))["figures"][0]
    for signal, axis in (("qpos", "y"), ("qvel", "y2")):
        curves = {trace["name"]: trace["y"] for trace in trajectory["data"] if trace["yaxis"] == axis}
        start = getattr(segments, signal)[0, :, 0]
        np.testing.assert_allclose(curves["measured"], start, rtol=1e-5)
        for name, prediction in (("this model", fitted), ("no friction", baseline)):
            np.testing.assert_allclose(curves[name][1:], getattr(prediction, signal)[0, :, 0], rtol=1e-5)


def test_long_curves_keep_their_extremes_and_lose_the_rest(record, tmp_path):
    segments, fitted, baseline = make_rollout(length=30_000)
    segments.qpos[0, 12_345, 0] = 9.0
    source = report(tmp_path / "report.html", record, rollout=(segments, fitted, baseline))
    figures = read_data(source)["figures"]
    lengths = [len(trace["x"]) for figure in figures[:2] for trace in figure["data"] if "fill" not in trace]
    assert MOST / 2 < max(lengths) <= MOST
    assert 9.0 in next(trace for trace in figures[0]["data"] if trace["name"] == "measured")["y"]
    assert len(source) < 2_500_000


def test_hostile_names_stay_text(record, tmp_path):
    record.model = record.data.name = record.data.logs[0].name = record.parameters[0].name = HOSTILE
    record.notes = [HOSTILE]
    curves = {f"bench.{HOSTILE}": np.ones((3, 2))}
    source = report(tmp_path / "report.html", record, joints=(HOSTILE, "<b>other</b>"), **curves)
    page, plain = (
        Page(source),
        Page(report(tmp_path / "plain.html", changed(record, model="plain"), joints=("a", "b"), **curves)),
    )
    assert not page.with_attribute("onerror")
    assert [tag for tag, _ in page.elements].count("script") == [tag for tag, _ in plain.elements].count("script") == 3
    assert "img" not in [tag for tag, _ in page.elements]
    assert HOSTILE in page.text
    drawn = json.dumps(read_data(source)["figures"])
    assert "<img" not in drawn and "<b>" not in drawn


def test_nothing_comes_from_elsewhere(record, tmp_path):
    judge_targets(report(tmp_path / "report.html", record))


def test_no_doubts_about_a_good_run(record):
    assert {check.state for check in checks_of(record).values()} == {"good", "note"}
    assert "simulator" in checks_of(record)["Simulated data"].text


@pytest.mark.parametrize(
    ("change", "title", "state", "text"),
    [
        ({"data.origin": "hardware"}, "Hardware data", "good", "hardware"),
        ({"data.origin": None}, "Origin", "note", "Your recordings"),
        ({"fit.stopped": "converged"}, "Fit", "good", "converged after 3"),
        ({"fit.stopped": "patience"}, "Fit", "good", "stopped falling"),
        ({"fit.stopped": "diverged"}, "Fit", "bad", "diverged after 3"),
        ({"fit.stopped": "finished", "fit.method": "lm"}, "Fit", "caution", "did not converge"),
        ({"fit.stopped": "finished", "fit.method": "grid"}, "Fit", "good", "3 combinations"),
        ({"fit.stopped": "finished", "fit.method": "known"}, "Fit", "note", "Nothing was identified"),
        ({"fit.moving": ["bench.armature"]}, "Fit", "caution", "Parameters still moving at the end of the fit: bench"),
        ({"reference.0.at_bound": True}, "Reference", "caution", "fit without friction, bench.armature ended"),
        ({"not_identified": ["why", "this"]}, "Not identified", "bad", "not identified: why; likely reasons: this."),
        ({"parameters.0.at_bound": True}, "Bounds", "caution", "armature ended at a bound of [0.001, 1] kg m^2; widen"),
        (
            {
                **{"no_intervals": None, "parameters.0.identifiable": False},
                "parameters.0.by_joint.0.identifiable": False,
            },
            "Identifiability",
            "caution",
            "Not identifiable from these data: bench.armature; do",
        ),
        ({"indistinct": [["a.b", "c.d"]], "no_intervals": None}, "Identifiability", "caution", "a.b and c.d;"),
        ({"metrics.train.position_mae": 1e-3}, "Training and test error", "caution", "overfitted"),
        ({"metrics.train.position_mae": None}, "Training and test error", "caution", "cannot be compared"),
        ({"metrics.baseline.position_mae": 1e-3}, "Improvement", "bad", "no better than"),
        ({"metrics.test.position_mae": None}, "Improvement", "bad", "every test rollout diverged"),
        ({"by_horizon.0.test.diverged": 2}, "Stability", "bad", "2 of 4 test rollouts of 0.1 s"),
        ({"by_horizon.1.baseline.diverged": 1}, "Stability", "caution", "1 of 4 frictionless test rollouts of 0.05 s"),
        ({"data.logs.1.sha256": 64 * "a"}, "Held-out data", "good", "same recording"),
        ({"model": "baseline"}, "Improvement", "note", "compared with itself"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_a_reason_for_trust_or_doubt_is_said(record, change, title, state, text):
    for path, value in change.items():
        put(record, path, value)
    check = checks_of(record)[title]
    assert check.state == state and text in check.text


@pytest.mark.parametrize(("last", "state"), [(0.9, "caution"), (0.999, "good")])
def test_a_loss_that_still_falls_is_said(record, last, state):
    record.fit.iterations, record.fit.falling = 20, still_falling(np.array([2.0] + [1.0] * 18 + [last]))
    assert checks_of(record)["Fit"].state == state


@pytest.mark.parametrize("spoilt", ["model", "baseline"])
@pytest.mark.parametrize("first", [0, 100])
def test_a_diverged_rollout_is_drawn_as_far_as_it_goes(record, tmp_path, spoilt, first):
    segments, *predictions = make_rollout()
    qpos = predictions[spoilt == "baseline"].qpos.copy()
    qpos[:, first:] = np.inf
    predictions[spoilt == "baseline"] = Prediction(qpos, qpos)
    source = report(tmp_path / "report.html", record, rollout=(segments, *predictions))
    name = {"model": "this model", "baseline": "no friction"}[spoilt]
    curves = [trace for trace in read_data(source)["figures"][0]["data"] if trace["name"] == name]
    assert [len(trace["y"]) for trace in curves] == [first + 1] * 2
    assert "diverged" in Page(source).with_attribute("data-figure")[0]["aria-label"]


def test_a_run_without_any_finite_error_has_a_page(record, tmp_path):
    for metrics in (record.metrics.test, record.by_horizon[0].test):
        metrics.position_mae = metrics.position_mae_std = metrics.position_rmse = metrics.velocity_rmse = None
        metrics.diverged = metrics.rollouts
    assert "diverged: there is no error to report" in Page(report(tmp_path / "report.html", record)).text


@needs_browser
def test_a_browser_draws_every_figure_in_the_colours_that_are_preferred(record, tmp_path):
    path = tmp_path / "report.html"
    page = read_data(report(path, record, joints=(HOSTILE, "knee")))
    browser = open_page(path, scheme="dark")
    assert browser.run(DRAWN) == len(page["figures"]) - 2  # the other joint's trajectory and phase plot are folded
    opened = "document.querySelectorAll('details').forEach(fold => (fold.open = true)); await pause(100);"
    assert browser.run(opened + DRAWN) == len(page["figures"])
    assert browser.run("return isDark()")
    browser.prefer("light")
    assert browser.run("return until(() => !isDark())")
    assert not browser.run("return document.querySelector('main').innerHTML.includes('Share chart')")


@needs_browser
@pytest.mark.parametrize("joints", [("knee",), ("FL_hip_joint", "FL_thigh_joint", "FL_calf_joint")], ids=len)
def test_a_phone_shows_the_page_without_scrolling_sideways(record, tmp_path, joints):
    name = "report-of-a-recording-with-a-very-long-name-that-cannot-be-broken-anywhere"
    record.data.name = record.data.logs[0].name = name
    for parameter in record.parameters:  # what a table of a law with long names must not hide at its right edge
        parameter.name = f"{parameter.name}_of_the_external_load"
        parameter.by_joint[0].identifiable, parameter.by_joint[0].interval = False, [0.0123456, 0.0234567]
    report(tmp_path / "report.html", record, joints=joints)
    browser = open_page(tmp_path / "report.html", width=390)
    inner, page, *drawings = browser.run(WIDTHS)
    assert browser.run(CLIPPED) == []
    ends = browser.run("""document.querySelectorAll("details").forEach(fold => (fold.open = true));
      return [...document.querySelectorAll(".mark, pre, .parameters td, .parameters th")]
        .map(mark => Math.ceil(mark.getBoundingClientRect().right));""")
    assert ends and max(ends) <= inner
    assert inner == 390 and page <= inner
    assert drawings and max(drawings) <= inner
