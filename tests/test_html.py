"""`report.html`: its answers, hostile names, nothing from elsewhere, and how a real browser shows it."""

import copy
import json
import re
from functools import reduce
from html.parser import HTMLParser
from operator import getitem

import numpy as np
import plotly.graph_objects as go
import pytest
from browser import DRAWN, WIDTHS, needs_browser, open_page
from test_report import FIT, bench, curves_of, dataset, evaluation, make_rollout, model, of_joints, result  # noqa: F401

from frictionzoo.result.evaluate import Prediction
from frictionzoo.result.verdict import still_falling
from frictionzoo.show.run_page import check_result, write_report
from frictionzoo.show.with_plotly import POINTS

HOSTILE = "</script><img src=x onerror=alert(1)>\"'&"


@pytest.fixture
def record(result):  # noqa: F811
    return copy.deepcopy(result) | {"fit": FIT | {"stopped": "finished", "moving": []}}


class Page(HTMLParser):
    """The elements of a page with their attributes, and its text without scripts and styles."""

    def __init__(self, source):
        super().__init__()
        self.elements, self.text, self._raw = [], "", False
        self.feed(source)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        self._raw = tag in ("script", "style")

    def handle_endtag(self, tag):
        self._raw = False

    def handle_data(self, data):
        self.text += "" if self._raw else " ".join(data.split()) + " "

    def with_attribute(self, name):
        return [attributes for _, attributes in self.elements if name in attributes]


def report(path, record, joints=("knee",), rollout=None, **more):
    course = np.outer([0.1, 0.05, 0.04], np.ones(len(joints)))
    values = {"bench.armature": course, "friction.static_torque": np.ones((3, len(joints)))} | more
    curves = curves_of(rollout or make_rollout(nv=len(joints)), **values)
    write_report(path, record if len(record["joints"]) > 1 else of_joints(record, *joints), curves)
    return path.read_text(encoding="utf-8")


def figures_of(source):
    return json.loads(re.search(r'<script type="application/json" id="figures">(.*?)</script>', source, re.S)[1])


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
    assert all(version in page.text for version in record["versions"].values())
    assert "6.50 s" in page.text
    links = [attributes["href"] for tag, attributes in page.elements if tag == "a"]
    assert links == ["result.json", "identified.xml"]  # what is there, and what is written next


def test_intervals_stand_beside_the_values(record, tmp_path):
    record["parameters"][0]["by_joint"][0] |= {"identifiable": False}
    record["parameters"][3]["by_joint"][0] |= {"interval": [0.25, 0.35], "identifiable": True}
    page = Page(report(tmp_path / "report.html", record))
    assert page.text.count("0.25 to 0.35") == page.text.count("not identifiable on these data") == 1


def test_every_figure_has_a_heading_and_a_text(record, tmp_path):
    source = report(tmp_path / "report.html", record)
    canvases = Page(source).with_attribute("data-figure")
    figures = figures_of(source)["figures"]
    assert [int(canvas["data-figure"]) for canvas in canvases] == list(range(len(figures)))
    assert len(figures) == 6  # trajectory, error, loss, two parameters, horizons
    for canvas in canvases:
        assert canvas["role"] == "img" and len(canvas["aria-label"]) > 40
    assert source.count("<h3>") == len(figures)
    for figure in figures:
        go.Figure(figure)  # raises for a property that plotly does not know


def test_curves_are_those_of_the_rollout(record, tmp_path):
    segments, fitted, baseline = make_rollout()
    trajectory = figures_of(report(tmp_path / "report.html", record))["figures"][0]
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
    figures = figures_of(source)["figures"]
    lengths = [len(trace["x"]) for figure in figures[:2] for trace in figure["data"] if "fill" not in trace]
    assert POINTS / 2 < max(lengths) <= POINTS
    assert 9.0 in next(trace for trace in figures[0]["data"] if trace["name"] == "measured")["y"]
    assert len(source) < 7_000_000


def test_hostile_names_stay_text(record, tmp_path):
    record["model"] = record["data"]["name"] = record["data"]["logs"][0]["name"] = HOSTILE
    record["parameters"][0]["name"] = HOSTILE
    record["notes"] = [HOSTILE]
    curves = {f"bench.{HOSTILE}": np.ones((3, 2))}
    source = report(tmp_path / "report.html", record, joints=(HOSTILE, "<b>other</b>"), **curves)
    page, plain = (
        Page(source),
        Page(report(tmp_path / "plain.html", record | {"model": "plain"}, joints=("a", "b"), **curves)),
    )
    assert not page.with_attribute("onerror")
    assert [tag for tag, _ in page.elements].count("script") == [tag for tag, _ in plain.elements].count("script") == 3
    assert "img" not in [tag for tag, _ in page.elements]
    assert HOSTILE in page.text
    drawn = json.dumps(figures_of(source)["figures"])
    assert "<img" not in drawn and "<b>" not in drawn


def test_nothing_comes_from_elsewhere(record, tmp_path):
    judge_targets(report(tmp_path / "report.html", record))


def judge_targets(source):
    """Nothing that a page shows or leads to lies on another machine."""
    targets = [element[name] for name in ("src", "href", "action") for element in Page(source).with_attribute(name)]
    assert not [target for target in targets if re.match(r"\s*(?:https?:)?//", target)]
    assert "default-src 'none'" in source and "@import" not in source
    # plotly.js offers to upload a chart to its makers' server unless it is told not to.
    assert "showSendToCloud: false" in source


def test_no_doubts_about_a_good_run(record):
    assert {check.state for check in checks_of(record).values()} == {"good", "note"}
    assert "simulator" in checks_of(record)["Simulated data"].text


@pytest.mark.parametrize(
    ("change", "title", "state", "text"),
    [
        ({"data.simulated": False}, "Real data", "good", "recorded on hardware"),
        ({"fit.stopped": "converged"}, "Fit", "good", "converged after 3"),
        ({"fit.stopped": "patience"}, "Fit", "good", "fell no more"),
        ({"fit.stopped": "diverged"}, "Fit", "bad", "diverged after 3"),
        ({"fit.stopped": "finished", "fit.method": "lm"}, "Fit", "caution", "without converging"),
        ({"fit.stopped": "finished", "fit.method": "grid"}, "Fit", "good", "3 combinations"),
        ({"fit.stopped": "finished", "fit.method": "known"}, "Fit", "note", "Nothing was identified"),
        (
            {"fit.moving": ["bench.armature"]},
            "Fit",
            "caution",
            "Still moving when the fit ended: bench.armature; raise",
        ),
        (
            {"reference.0.at_bound": True},
            "Reference",
            "caution",
            "The drive without friction ended with bench.armature",
        ),
        (
            {"not_identified": ["why", "this"]},
            "Not identified",
            "bad",
            "did not identify the drive: why; likely: this.",
        ),
        (
            {"parameters.0.at_bound": True},
            "Bounds",
            "caution",
            "bench.armature ended at a bound of [0.001, 1] kg m^2; widen",
        ),
        (
            {
                **{"no_intervals": None, "parameters.0.identifiable": False},
                "parameters.0.by_joint.0.identifiable": False,
            },
            "Identifiability",
            "caution",
            "Not identifiable on these data: bench.armature; do",
        ),
        ({"indistinct": [["a.b", "c.d"]], "no_intervals": None}, "Identifiability", "caution", "apart a.b and c.d;"),
        ({"metrics.train.position_mae": 1e-3}, "Test against train", "caution", "learnt its own data"),
        ({"metrics.train.position_mae": None}, "Test against train", "caution", "cannot be compared"),
        ({"metrics.baseline.position_mae": 1e-3}, "Gain", "bad", "no better than"),
        ({"metrics.test.position_mae": None}, "Gain", "bad", "every test rollout diverged"),
        ({"by_horizon.0.test.diverged": 2}, "Stability", "bad", "2 of 4 test rollouts of 0.1 s"),
        ({"by_horizon.1.baseline.diverged": 1}, "Stability", "caution", "1 of 4 frictionless test rollouts of 0.05 s"),
        ({"data.logs.1.sha256": 64 * "a"}, "Held-out data", "good", "same recording"),
        ({"model": "baseline"}, "Gain", "note", "compared with itself"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_a_reason_for_trust_or_doubt_is_said(record, change, title, state, text):
    for path, value in change.items():
        *sections, key = [int(name) if name.isdigit() else name for name in path.split(".")]
        reduce(getitem, sections, record)[key] = value
    check = checks_of(record)[title]
    assert check.state == state and text in check.text


@pytest.mark.parametrize(("last", "state"), [(0.9, "caution"), (0.999, "good")])
def test_a_loss_that_still_falls_is_said(record, last, state):
    record["fit"] |= {"iterations": 20, "falling": still_falling(np.array([2.0] + [1.0] * 18 + [last]))}
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
    curves = [trace for trace in figures_of(source)["figures"][0]["data"] if trace["name"] == name]
    assert [len(trace["y"]) for trace in curves] == [first + 1] * 2
    assert "diverged" in Page(source).with_attribute("data-figure")[0]["aria-label"]


def test_a_run_without_any_finite_error_has_a_page(record, tmp_path):
    lost = {"position_mae": None, "position_mae_std": None, "position_rmse": None, "velocity_rmse": None}
    for metrics in (record["metrics"]["test"], record["by_horizon"][0]["test"]):
        metrics |= lost | {"diverged": metrics["rollouts"]}
    assert "diverged: there is no error to report" in Page(report(tmp_path / "report.html", record)).text


@needs_browser
def test_a_browser_draws_every_figure_in_the_colours_that_are_preferred(record, tmp_path):
    path = tmp_path / "report.html"
    page = figures_of(report(path, record, joints=(HOSTILE, "knee")))
    browser = open_page(path, scheme="dark")
    assert browser.run(DRAWN) == len(page["figures"]) - 1  # the trajectory of the other joint is folded
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
    record["data"]["name"] = record["data"]["logs"][0]["name"] = name
    report(tmp_path / "report.html", record, joints=joints)
    inner, page, *drawings = open_page(tmp_path / "report.html", width=390).run(WIDTHS)
    assert inner == 390 and page <= inner
    assert drawings and max(drawings) <= inner
