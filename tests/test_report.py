"""`result.json` against its schema, figures against the data they draw, the summary, and files whole or not at all."""

import contextlib
import operator
import resource
from dataclasses import replace
from functools import reduce
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from conftest import changed
from helpers.results import (
    FIT,
    TIMESTEP,
    TIMING,
    VALUES,
    build,
    curves_of,
    history,
    judge,
    make_log,
    make_rollout,
    of_joints,
)
from matplotlib import colors
from matplotlib.image import imread
from msgspec.structs import replace as replace_fields

from frictionzoo.core.errors import OutputError, RunError
from frictionzoo.core.jobs import parse_record, read_record
from frictionzoo.core.log import Dataset
from frictionzoo.core.manifest import MANIFEST
from frictionzoo.core.output import to_json, write_atomically, write_json
from frictionzoo.fit.uncertainty import Uncertainty
from frictionzoo.models.neural_friction import NeuralFriction
from frictionzoo.report.figure import Sheet
from frictionzoo.report.run_plots import draw_rollout, plot_run, write_figures
from frictionzoo.report.terminal import summarise
from frictionzoo.report.with_matplotlib import draw
from frictionzoo.result.evaluate import Prediction
from frictionzoo.result.record import read_schema
from frictionzoo.result.types import ParameterRecord, Result, Value


def validate(result):
    jsonschema.Draft202012Validator(read_schema()).validate(to_json(result))


def test_schema_is_one_and_describes_every_field():
    schema = read_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    sections = [("result", schema), *schema["$defs"].items(), *schema["properties"].items()]
    sections += [(f"{name}[]", section["items"]) for name, section in sections if "items" in section]
    for name, section in sections:
        fields = section.get("properties", {})
        assert not fields or section["additionalProperties"] is False, name
        assert set(fields) == set(section.get("required", [])), name
        for field, description in fields.items():
            assert name == "versions" or "description" in description, f"{name}.{field}"


def test_result_is_valid(result, tmp_path):
    validate(result)
    write_json(tmp_path / "result.json", result)
    assert read_record(tmp_path / "result.json", Result) == result


def test_result_says_what_was_done(result, bench):
    assert result["model"] == "coulomb_stribeck"
    assert result["data"]["origin"] == "simulated"
    assert result["data"]["samples"] == 800
    assert result["data"]["timestep"] == TIMESTEP
    assert [(log["part"], log["samples"]) for log in result["data"]["logs"]] == [("train", 400), ("test", 400)]
    assert [log["sha256"] for log in result["data"]["logs"]] == [64 * "a", 64 * "b"]
    assert result["data"]["sha256"] not in (64 * "a", 64 * "b")
    parameters = {(parameter.owner, parameter.name): parameter for parameter in result.parameters}
    about = {"value": 0.3, "low": 1e-3, "high": 1.0, "identified": True, "at_bound": False}
    unknown = {"interval": None, "identifiable": None}
    joint = Value(bench.joints[0], list(bench.joints), **about, **unknown)
    expected = ParameterRecord(name="static_torque", owner="friction", unit="N m", **about, by_joint=[joint], **unknown)
    assert parameters["friction", "static_torque"] == expected
    assert parameters["bench", "armature"]["unit"] == "kg m^2"
    assert result["network"] is None
    assert result["fit"] == FIT
    assert result["timing"] == TIMING


def test_result_compares_on_the_same_rollouts(result):
    test, baseline = result["metrics"]["test"], result["metrics"]["baseline"]
    assert (test["horizon"], test["rollouts"]) == (0.1, 4)
    assert (baseline["horizon"], baseline["rollouts"]) == (0.1, 4)
    # The measured position moves on by up to 3 mrad between the command and the sample that it is compared with.
    assert test["position_mae"] == pytest.approx(0.01, abs=0.003)
    assert baseline["position_mae"] == pytest.approx(0.04, abs=0.003)
    assert [entry["horizon"] for entry in result["by_horizon"]] == [0.1, 0.05]
    assert result["by_horizon"][0]["test"] == test
    assert result["paper"]["a"]["model"]["rollouts"] == 1
    assert result["paper"]["b"]["baseline"]["rollouts"] == 3


def test_without_friction_too_the_test_part_counts(bench, model, dataset, evaluation):
    without, worse = judge(evaluation, 0.04), judge(evaluation, 0.5)
    mixed = replace(without, by_horizon=({"train": worse.train, "test": without.test}, *without.by_horizon[1:]))
    result = build(bench, model, dataset, evaluation, VALUES, baseline=mixed)
    assert result["metrics"]["baseline"]["position_mae"] == without.test.position_mae


def test_one_source_keeps_its_hash(bench, model, evaluation):
    log = make_log("c", 400)
    result = build(
        bench,
        model,
        Dataset("one", (log.between(0, 200, "train"),), (log.between(200, 400, "test"),)),
        evaluation,
        VALUES,
    )
    assert result["data"]["sha256"] == 64 * "c"


@pytest.mark.parametrize(("value", "expected"), [(1e-3, True), (1.0, True), (1.002e-3, False), (0.99, False)])
def test_at_bound(bench, model, dataset, evaluation, value, expected):
    result = build(bench, model, dataset, evaluation, VALUES | {"viscous_coefficient": np.array([value])})
    at_bound = {parameter["name"] for parameter in result["parameters"] if parameter["at_bound"]}
    # smoothing_velocity lies on its bound as well, but is known and not identified.
    assert at_bound == ({"viscous_coefficient"} if expected else set())


def test_network_counts_its_weights(bench, dataset, evaluation):
    result = build(bench, NeuralFriction(1, hidden=[64, 64], seed=0), dataset, evaluation, {})
    validate(result)
    assert result.network.weights == 4 * 64 + 64 + 64 * 64 + 64 + 64 + 1
    assert "4545" in summarise(result, Path("run"))


def test_divergence_is_null(bench, model, dataset, evaluation):
    result = build(
        bench, model, dataset, evaluation, VALUES, offset=np.nan, fit=replace_fields(FIT, loss=np.float64(np.nan))
    )
    validate(result)
    assert result["metrics"]["test"]["position_mae"] is None
    assert result["metrics"]["test"]["diverged"] == 4
    assert result["fit"]["loss"] is None
    assert "none" in summarise(result, Path("run"))


def breakages():
    """Name and path of one field that is spoilt, and what it is spoilt with; `...` takes it away."""
    return [
        *((("model",), ...), (("extra",), 1), (("schema_version",), 1), (("data", "sha256"), "abc")),
        *((("data", "logs"), []), (("data", "logs", 0, "part"), "validation"), (("parameters", 0, "unit"), ...)),
        *((("parameters", 0, "value"), None), (("parameters", 0, "value"), [0.1])),
        *((("parameters", 0, "interval"), [0.1]), (("parameters", 0, "interval"), [[0.1, 0.2]])),
        *((("indistinct",), [["friction.damping"]]), (("network",), {"weights": 0})),
        *((("metrics", "test", "position_mae"), -1.0), (("metrics", "test", "rollouts"), 2.5)),
        *((("metrics", "test", "more"), 1), (("by_horizon",), []), (("paper", "a", "baseline"), ...)),
        *((("fit", "loss"), "small"), (("timing", "total"), -1), (("seed",), None), (("dtype",), "float16")),
        (("versions", "jax"), ...),
    ]


@pytest.mark.parametrize(("path", "value"), breakages(), ids=[".".join(map(str, path)) for path, _ in breakages()])
def test_schema_rejects(result, path, value):
    broken = to_json(result)
    section = reduce(operator.getitem, path[:-1], broken)
    if value is ...:
        del section[path[-1]]
    else:
        section[path[-1]] = value
    with pytest.raises(jsonschema.ValidationError):
        validate(broken)
    with pytest.raises(RunError) as caught:
        parse_record(Path("result.json"), Result, broken)
    assert "\n" not in str(caught.value)


@contextlib.contextmanager
def smallest_files(limit):
    """No file of this process may grow beyond `limit` bytes: writing fails in the middle, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_write_atomically(tmp_path):
    path = tmp_path / "deep" / "result.bin"
    for content in (b"first", b"second"):
        write_atomically(path, content)
        assert path.read_bytes() == content
    assert {*path.parent.iterdir()} == {path, path.with_name(MANIFEST)}


@pytest.mark.parametrize("before", [None, b"older"])
def test_full_disk_leaves_nothing_half_written(tmp_path, before):
    path = tmp_path / "result.json"
    if before:
        write_atomically(path, before)
    with smallest_files(1000), pytest.raises(OutputError) as caught:
        write_atomically(path, 5000 * b"x")
    assert str(caught.value).startswith(f"{path}: ")
    assert "5000 bytes" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert (path.read_bytes() if path.exists() else None) == before
    assert {*tmp_path.iterdir()} == ({path, path.with_name(MANIFEST)} if before else set())


def test_unwritable_folder_is_one_line(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(OutputError, match=r"file/result\.json: File exists"):
        write_atomically(tmp_path / "file" / "result.json", b"{}")


def test_summary_holds_the_numbers(result):
    text = summarise(result, Path("outputs/run"))
    assert "coulomb_stribeck on waves. The data are simulated." in text
    assert "outputs/run" in text
    lines = {line.split("  ")[0]: line for line in text.splitlines()}
    assert "0.3" in lines["friction.static_torque"] and "N m" in lines["friction.static_torque"]
    assert lines["friction.smoothing_velocity"].endswith("known")
    test, baseline = (result["metrics"][part]["position_mae"] for part in ("test", "baseline"))
    assert f"{test:.4g}" in lines["position MAE"] and f"{baseline:.4g}" in lines["position MAE"]
    assert lines["position MAE"].endswith(f"{round(100 * (test / baseline - 1)):+d} %")
    assert "warning" not in text
    assert max(map(len, text.splitlines())) <= 80


def test_summary_says_real(bench, model, evaluation):
    dataset = Dataset("encoder", (make_log("a", 400, simulated=False),), (make_log("b", 400, simulated=False),))
    text = summarise(build(bench, model, dataset, evaluation, VALUES), Path("run"))
    assert "encoder. Recorded on hardware" in text and "simulated" not in text


def test_summary_warns_at_a_bound(bench, model, dataset, evaluation):
    result = build(bench, model, dataset, evaluation, VALUES | {"kinetic_torque": np.array([1.0])})
    text = summarise(result, Path("run"))
    assert "warning: friction.kinetic_torque ended at a bound of [0.001, 1] N m" in text


def test_a_result_says_what_the_data_determine(bench, model, dataset, evaluation):
    name, group = "friction.static_torque", ("friction.kinetic_torque", "friction.stribeck_velocity")
    intervals = {name: np.array([[0.25, 0.35]])} | dict.fromkeys(group, np.full((1, 2), np.nan))
    determined = {name: np.ones(1, bool)} | dict.fromkeys(group, np.zeros(1, bool))
    found = Uncertainty(intervals, determined, (group,))
    result = build(bench, model, dataset, evaluation, VALUES, uncertainty=found)
    validate(result)
    told = {p["name"]: (p["interval"], p["identifiable"]) for p in result["parameters"]}
    assert told["static_torque"] == ([0.25, 0.35], True)
    assert told["kinetic_torque"] == told["stribeck_velocity"] == (None, False)
    assert told["kp"] == (None, None)
    assert result["indistinct"] == [list(group)] and result["no_intervals"] is None
    text = summarise(result, Path("run"))
    lines = {line.split("  ")[0]: line for line in text.splitlines()}
    assert "0.25 to 0.35" in lines[name] and lines[name].endswith(" identified")
    assert lines["friction.kinetic_torque"].endswith("not identifiable")
    assert f"warning: not identifiable from these data: {', '.join(group)}; " in text
    assert f"the data do not distinguish {' and '.join(group)}" in text


def drawn(axes, color):
    """Data of the one line of this colour."""
    lines = [line for line in axes.get_lines() if colors.same_color(line.get_color(), color)]
    (line,) = [line for line in lines if line.get_marker() == "None"]
    return np.asarray(line.get_xdata()), np.asarray(line.get_ydata())


def draw_history(result, **values):
    """Panels of figure 3."""
    figures = plot_run(result, curves_of(make_rollout(nv=len(result["joints"])), **values))["history"]
    figure = draw(Sheet("title", figures, 2.0, columns=2, headings=True))
    return figure, {axes.get_title("left"): axes for axes in figure.get_axes() if axes.axison}


def test_figure3_draws_loss_and_every_parameter(result):
    values = {"bench.armature": np.array([[1.0], [2.0], [4.0]]), "friction.static_torque": np.array([5.0, 6.0, 7.0])}
    _, panels = draw_history(result, **values)
    assert list(panels) == ["loss", "armature", "static_torque"]
    assert [axes.get_ylabel() for axes in panels.values()] == ["", "kg m²", "N m"]
    curves = [history()["loss"], values["bench.armature"].ravel(), values["friction.static_torque"]]
    for axes, expected in zip(panels.values(), curves, strict=True):
        iterations, curve = drawn(axes, "#0072B2")
        np.testing.assert_array_equal(iterations, [1, 2, 3])
        np.testing.assert_array_equal(curve, expected)
        best, marker = axes.get_lines()[0], axes.get_lines()[-1]
        assert set(best.get_xdata()) == {2} and best.get_linestyle() == "--"
        assert (marker.get_xdata()[0], marker.get_ydata()[0]) == (2, expected[1])
        assert axes.get_title("right") == f"{expected[1]:.4g}"


def test_figure3_of_a_network_draws_loss_and_gradient(result):
    _, panels = draw_history(result, **{"bench.armature": np.ones(3)})
    assert list(panels) == ["loss", "armature", "grad_norm"]


def test_figure3_draws_every_joint(result):
    values = {"friction.static_torque": np.arange(6.0).reshape(3, 2)}
    figure, panels = draw_history(of_joints(result, "hip", "knee"), **values)
    lines = [line.get_ydata() for line in panels["static_torque"].get_lines()[1:3]]
    np.testing.assert_array_equal(lines, values["friction.static_torque"].T)
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["hip", "knee", "reported"]


def test_figure4_draws_the_rollouts(result):
    segments, model, baseline = make_rollout()
    figure = draw_rollout(of_joints(result, "knee"), curves_of((segments, model, baseline)))
    assert figure.get_suptitle() == "coulomb_stribeck, one rollout of the test part of waves (simulated data)"
    position, velocity = figure.get_axes()
    assert (position.get_ylabel(), velocity.get_ylabel()) == ("position [rad]", "velocity [rad/s]")
    assert velocity.get_xlabel() == "time [s]"
    for axes, signal in ((position, "qpos"), (velocity, "qvel")):
        measured = getattr(segments, signal)[0, :, 0]
        np.testing.assert_array_equal(drawn(axes, "black")[1], measured)
        np.testing.assert_allclose(drawn(axes, "black")[0], np.arange(201) * TIMESTEP, rtol=1e-12)
        for color, prediction in (("#0072B2", model), ("#E69F00", baseline)):
            expected = np.concatenate([measured[:1], getattr(prediction, signal)[0, :, 0]])
            np.testing.assert_array_equal(drawn(axes, color)[1], expected)
    (inset,) = position.child_axes
    assert inset.get_xlim()[1] == pytest.approx(0.2)  # the error grows to the end


def test_figure4_has_a_column_a_joint(result):
    slide = changed(of_joints(result, "x", "y"), metrics={"test": {"unit": "m", "velocity_unit": "m/s"}})
    figure = draw_rollout(slide, curves_of(make_rollout(nv=2)))
    assert [axes.get_title("left") for axes in figure.get_axes()] == ["Trajectory of x", "Trajectory of y", "", ""]
    assert figure.get_axes()[3].get_ylabel() == "velocity [m/s]"


def draw_error(result, rollout, window):
    record = changed(result, evaluation={"window": window})
    return draw(Sheet("title", plot_run(record, curves_of(rollout))["error"], 3.0))


def test_figure5_draws_the_moving_error(result):
    segments, model, baseline = make_rollout()
    (axes,) = draw_error(result, (segments, model, baseline), 0.01).get_axes()
    assert axes.get_ylabel() == "absolute position error [rad]"
    time, mean = drawn(axes, "#0072B2")
    error = np.concatenate([[0.0], np.abs(model.qpos - segments.qpos[:, 1:])[0, :, 0]])
    np.testing.assert_allclose(mean, [error[i : i + 10].mean() for i in range(192)], rtol=1e-12)
    np.testing.assert_allclose(time[[0, -1]], [0.0045, 0.1955], rtol=1e-12)
    assert len(axes.collections) == 2  # a band each
    assert axes.get_yscale() == "linear"


def test_figure5_keeps_the_smaller_error_visible(result):
    segments, model, baseline = make_rollout()
    away = Prediction(baseline.qpos * 1e3, baseline.qvel)
    (axes,) = draw_error(result, (segments, model, away), 0.01).get_axes()
    assert axes.get_yscale() == "log"


@pytest.mark.parametrize("spoilt", ["model", "baseline"])
@pytest.mark.parametrize("first", [0, 100])
def test_diverged_rollouts_are_drawn_as_far_as_they_go(result, spoilt, first):
    segments, model, baseline = make_rollout()
    prediction = {"model": model, "baseline": baseline}[spoilt]
    prediction.qpos[:, first:] = np.inf
    figure = draw_rollout(of_joints(result, "knee"), curves_of((segments, model, baseline)))
    curve = drawn(figure.get_axes()[0], {"model": "#0072B2", "baseline": "#E69F00"}[spoilt])[1]
    assert np.isfinite(curve).sum() == first + 1
    for drawing in (figure, draw_error(result, (segments, model, baseline), 0.01)):
        drawing.set_layout_engine("none")
        drawing.draw_without_rendering()


def test_figures_are_written(result, tmp_path):
    values = {"bench.armature": np.ones(3), "friction.static_torque": np.arange(3.0)}
    write_figures(tmp_path, result, curves_of(make_rollout(), **values))
    names = ["figure3_parameters.png", "figure4_trajectory.png", "figure5_error.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == [MANIFEST, *names]
    for name in names:
        image = imread(tmp_path / name, format="png")
        assert image.shape[1] == 1200
        assert image.std() > 0.05  # more than an empty canvas


def test_known_values_have_no_course_to_draw(result, tmp_path):
    record = changed(result, fit={"best_iteration": 1})
    curves = curves_of(make_rollout())
    write_figures(tmp_path, record, replace(curves, history={k: v[:1] for k, v in curves.history.items()}))
    assert sorted(path.name for path in tmp_path.iterdir()) == [MANIFEST, "figure4_trajectory.png", "figure5_error.png"]
