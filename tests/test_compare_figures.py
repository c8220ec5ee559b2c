"""Figures of a comparison against the numbers they draw, for awkward runs too, and their files."""

import re
import zlib

import jsonschema
import matplotlib
import numpy as np
import pytest
from conftest import put
from matplotlib import colors
from matplotlib.container import BarContainer
from matplotlib.image import imread
from matplotlib.text import Text

from frictionzoo.api.comparison_files import save_comparison
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.manifest import MANIFEST
from frictionzoo.core.output import to_json, write_atomically
from frictionzoo.report.comparison_plots import arrange, choose_looks, write_figures
from frictionzoo.report.with_matplotlib import COLUMN, FONTS, PAGE, draw, paper, save_figure
from frictionzoo.result.comparison.record import compare_runs, read_schema
from frictionzoo.result.evaluate import moving_mean_and_std

MAE = "position MAE [rad]"
LABELS = ("stribeck", "smooth", "baseline")
AWKWARD = (
    r"cost $1 \alpha_2 50%",
    "_hidden",
    "coulomb_smooth segments.length=20 seed=1 fit.schedule.learning_rate=0.001 loss.robust=huber loss.velocity=0.25",
    *(f"model_{i} $x_{i}$" for i in range(3)),
    "baseline",
)
NAMES = [
    *("autocorrelation", "differences", "error_by_horizon", "error_by_load", "error_by_speed", "figure3_parameters"),
    *("figure4_trajectories", "figure5_error", "figure6_mae", "friction"),
]


def compare(runs):
    comparison = compare_runs(runs, [])
    jsonschema.Draft202012Validator(read_schema()).validate(to_json(comparison))
    return comparison


@pytest.fixture
def runs(make_runs):
    return make_runs(LABELS)


@pytest.fixture
def comparison(runs):
    return compare(runs)


def flat(figure):
    """The figure as it is: to find room for all that is in it takes most of the time."""
    figure.set_layout_engine("none")
    return figure


def figure_of(name, comparison, runs):
    """One of the comparison's figures, None where it has nothing to show."""
    sheet = arrange(comparison, runs)[name]
    return draw(sheet) if sheet.figures else None


def panels_of(name, comparison, runs):
    return [axes for axes in figure_of(name, comparison, runs).get_axes() if axes.axison]


def drawn(axes, label, comparison):
    """Data of the one line of this run."""
    look = choose_looks((run["label"] for run in comparison["runs"]), comparison["reference"])[label]
    (line,) = [line for line in axes.get_lines() if line.get_color() == look["color"]]
    return np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float)


def numbers(values):
    return np.array(values, dtype=float)


def test_looks_are_distinct_for_many_runs():
    looks = choose_looks(map(str, range(42))).values()
    assert len({(look["color"], look["dash"]) for look in looks}) == 42
    assert len({look["dash"] for look in list(looks)[:7]}) == 7  # for grey print


def test_figure3_draws_the_parameters(runs, comparison):
    panels = panels_of("figure3_parameters", comparison, runs)
    assert [axes.get_legend().get_title().get_text() for axes in panels] == list(LABELS)
    for axes, run in zip(panels, runs, strict=True):
        iteration, values = drawn(axes, run.label, comparison)
        np.testing.assert_array_equal(iteration, run.curves.history["iteration"])
        # From 0.1 to 100 N m s/rad, three decades.
        np.testing.assert_allclose(values, np.log10(run.curves.history["friction.damping"][:, 0] / 0.1) / 0.03)
        best, _, marker = axes.get_lines()
        assert (marker.get_xdata()[0], marker.get_ydata()[0]) == (3, pytest.approx(values[-1]))
        assert axes.get_ylabel() == "between the bounds [%]"
        assert (set(best.get_xdata()), best.get_linestyle()) == ({3}, "--")
        assert colors.same_color(best.get_color(), "#D00000")
        text = axes.get_legend().get_texts()[0].get_text()
        assert text == f"damping = {run.result['parameters'][0]['value']:.4g} N m s/rad"


def test_figure3_of_a_grid_search_has_points_where_it_improved(make_runs):
    runs = make_runs(["grid"], grid="grid")
    comparison = compare(runs)
    (axes,) = panels_of("figure3_parameters", comparison, runs)
    points = axes.get_lines()[1]
    assert (points.get_linestyle(), points.get_marker()) == ("None", "o")
    np.testing.assert_array_equal(points.get_xdata(), [0, 2, 3])
    assert axes.get_xlabel() == "combination"


def test_figure3_names_joints_and_networks(make_runs):
    runs = make_runs(["neural"], joints=2)
    put(runs[0].result, "network", {"weights": 4545})
    panels = panels_of("figure3_parameters", compare(runs), runs)
    titles = [axes.get_legend().get_title().get_text() for axes in panels]
    assert titles == [f"neural, joint {i} (4545 weights not shown)" for i in range(2)]


def test_figure3_without_parameters_is_not_drawn(runs, comparison, tmp_path):
    for run in runs:
        run.result.parameters[0].identified = False
    assert figure_of("figure3_parameters", comparison, runs) is None


@pytest.mark.parametrize("joints", [1, 2])
def test_figure4_draws_the_rollouts(make_runs, joints):
    runs = make_runs(LABELS, joints)
    comparison = compare(runs)
    panels = panels_of("figure4_trajectories", comparison, runs)
    assert [axes.get_ylabel() for axes in panels] == joints * ["position [rad]"] + joints * ["velocity [rad/s]"]
    titles = [axes.get_title("left") for axes in panels[:joints]]
    assert titles == [f"Trajectory of {joint}" for joint in comparison["joints"]]
    for place, axes in enumerate(panels):
        signal, joint = ("qpos", "qvel")[place // joints], place % joints
        for run in runs:
            measured = getattr(run.curves, f"measured_{signal}")[0, :, joint]
            time, curve = drawn(axes, run.label, comparison)
            np.testing.assert_allclose(time, np.arange(101) * 0.01, rtol=1e-12)
            np.testing.assert_array_equal(curve, [measured[0], *getattr(run.curves, signal)[0, :, joint]])
            np.testing.assert_array_equal(axes.get_lines()[0].get_ydata(), measured)


def test_figure4_magnifies_where_the_runs_differ(runs, comparison):
    runs[1].curves.qpos[0, 70] = runs[0].curves.qpos[0, 70] + 0.3
    position = panels_of("figure4_trajectories", comparison, runs)[0]
    (inset,) = position.child_axes
    assert inset.get_xlim()[0] <= 0.71 <= inset.get_xlim()[1]
    assert np.diff(inset.get_xlim()) < 0.1


def test_figure5_draws_the_moving_error(runs, comparison):
    (axes,) = panels_of("figure5_error", comparison, runs)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("time [s]", "absolute position error [rad]")
    for run in runs:
        time, mean = drawn(axes, run.label, comparison)
        error = error_of(run)
        np.testing.assert_allclose(mean, [error[i : i + 10].mean() for i in range(92)], rtol=1e-12)
        np.testing.assert_allclose(time[[0, -1]], [0.045, 0.955], rtol=1e-12)
    bands = [collection.get_paths()[0].vertices[:, 1] for collection in axes.collections]
    mean, std = moving_mean_and_std(error_of(runs[0]), 10)
    assert len(bands) == 3
    assert bands[0].max() == pytest.approx((mean + std).max())
    assert bands[0].min() == pytest.approx((mean - std).min())


def error_of(run):
    """In the first long rollout, with the measured state that it starts from."""
    return np.append(0.0, np.abs(run.curves.qpos - run.curves.measured_qpos[:, 1:])[0, :, 0])


def test_figure6_draws_the_errors(runs, comparison):
    (axes,) = panels_of("figure6_mae", comparison, runs)
    assert axes.get_xlabel() == "position MAE [rad]"
    assert [label.get_text() for label in axes.get_yticklabels()] == list(LABELS)
    bars = [container for container in axes.containers if isinstance(container, BarContainer)]
    for part, shown in (("test", bars[1:4]), ("train", bars[5:])):  # each after what stands in the legend
        mean, std = (
            numbers([run[part][key] for run in comparison["runs"]]) for key in ("position_mae", "position_mae_std")
        )
        np.testing.assert_array_equal([bar.patches[0].get_width() for bar in shown], mean)
        ends = np.array([bar.errorbar.lines[2][0].get_segments()[0][:, 0] for bar in shown])
        np.testing.assert_allclose(ends, np.stack([mean - std, mean + std], axis=1), rtol=1e-12)
        notes = [text.get_text() for text in axes.texts if text.get_text().startswith(part)]
        assert [float(note.split()[1]) for note in notes] == pytest.approx(mean, rel=1e-2)


@pytest.mark.parametrize(
    ("name", "section", "abscissa", "curves", "labels"),
    [
        ("error_by_horizon", "by_horizon", "horizon", "position_mae", ("horizon [s]", MAE)),
        ("error_by_speed", "by_speed", "centre", "position_mae", ("mean absolute speed [rad/s]", MAE)),
        ("error_by_load", "by_load", "centre", "position_mae", ("mean absolute motor torque [N m]", MAE)),
        ("autocorrelation", "autocorrelation", "lag", "coefficient", ("lag [s]", "autocorrelation of the error [1]")),
    ],
    ids=["horizon", "speed", "load", "autocorrelation"],
)
def test_curves_are_the_comparison(runs, comparison, name, section, abscissa, curves, labels):
    (axes,) = panels_of(name, comparison, runs)
    assert (axes.get_xlabel(), axes.get_ylabel()) == labels
    for run in LABELS:
        x, y = drawn(axes, run, comparison)
        np.testing.assert_array_equal(x, comparison[section][abscissa])
        np.testing.assert_array_equal(y, numbers(comparison[section][curves][run]))


def test_autocorrelation_shows_white_noise(runs, comparison):
    (axes,) = panels_of("autocorrelation", comparison, runs)
    (band,) = axes.patches
    assert band.get_y() == pytest.approx(-comparison["autocorrelation"]["band"])
    assert band.get_height() == pytest.approx(2 * comparison["autocorrelation"]["band"])


def test_friction_has_a_panel_a_joint_and_a_band_where_it_spreads(make_runs):
    runs = make_runs(LABELS, joints=2)
    comparison = compare(runs)
    panels = panels_of("friction", comparison, runs)
    assert [axes.get_title("left") for axes in panels] == ["Friction of joint 0", "Friction of joint 1"]
    for joint, axes in enumerate(panels):
        for run, law in comparison["friction"].items():
            velocity, torque = drawn(axes, run, comparison)
            np.testing.assert_array_equal(velocity, law["velocity"])
            np.testing.assert_array_equal(torque, law["torque"][joint])
        assert len(axes.collections) == 2  # the first run's low and high quantiles are its median
        assert (axes.get_xlabel(), axes.get_ylabel()) == ("velocity [rad/s]", "friction [N m]")


def test_differences_are_those_to_the_best(runs, comparison):
    (axes,) = panels_of("differences", comparison, runs)
    pairs = [pair for pair in comparison["pairs"] if pair["other"] == "stribeck"]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["stribeck", "smooth", "baseline"]
    assert axes.containers[0].lines[0].get_xdata()[0] == 0 and axes.texts[0].get_text() == "best"
    for container, pair in zip(axes.containers[1:], pairs, strict=True):
        point, _, (bar,) = container.lines
        assert point.get_xdata()[0] == pair["mean"]
        np.testing.assert_allclose(bar.get_segments()[0][:, 0], [pair["low"], pair["high"]], rtol=1e-9)
    assert axes.get_xlabel() == "MAE above the best [rad]"


def test_errors_of_different_sizes_are_logarithmic(runs, comparison):
    (axes,) = panels_of("error_by_horizon", comparison, runs)
    low, high = axes.get_ylim()
    assert axes.get_yscale() == "log" and low < 0.01 and high > max(numbers(drawn(axes, "baseline", comparison)[1]))


def test_a_run_without_friction_does_not_hide_the_others(make_runs):
    runs = make_runs(["a", "b", "c", "baseline"])
    runs[-1].curves.qpos[:] += 1e6 * np.arange(100)[:, None]
    for part in ("train", "test", "baseline"):
        runs[-1].result.metrics[part].position_mae = runs[-1].result.metrics[part].position_mae_std = 1e6
    comparison = compare(runs)
    position, velocity = panels_of("figure4_trajectories", comparison, runs)
    assert np.abs(position.get_ylim()).max() < 10 and np.abs(velocity.get_ylim()).max() < 50
    for name in ("figure5_error", "error_by_horizon"):
        (axes,) = panels_of(name, comparison, runs)
        assert axes.get_ylim()[1] < 0.1 and axes.get_title("right") == "above the frame: baseline"
    (bars,) = panels_of("figure6_mae", comparison, runs)
    assert bars.get_xlim()[1] < 0.1
    assert {"test 1.00e+06 ± 1.0e+06", "→"} <= {text.get_text() for text in bars.texts}


@pytest.mark.parametrize(
    ("labels", "lost", "joints"),
    [(("only",), "only", 2), (("good", "baseline"), "baseline", 1), (AWKWARD, AWKWARD[4], 2)],
    ids=["one", "baseline", "many"],
)
def test_awkward_runs_are_drawn(make_runs, monkeypatch, tmp_path, labels, lost, joints):
    def save(figure, path):
        flat(figure).draw_without_rendering()
        path.touch()

    monkeypatch.setattr("frictionzoo.report.with_matplotlib.save_figure", save)
    monkeypatch.setattr("frictionzoo.report.comparison_plots.FORMATS", ("png",))
    runs = make_runs(labels, joints, diverged=lost)
    write_atomically(tmp_path / "differences.png", b"of an older comparison")
    comparison = compare(runs)
    assert (figure_of("differences", comparison, runs) is None) == (len(labels) == 1)
    write_figures(tmp_path, comparison, runs)
    found = {path.stem for path in tmp_path.iterdir() if path.name != MANIFEST}
    assert found == set(NAMES) - ({"differences"} if len(labels) == 1 else set())


@pytest.mark.slow
def test_many_runs_find_room(make_runs, tmp_path):
    runs = make_runs(AWKWARD, 2)
    write_figures(tmp_path, compare(runs), runs)  # where the layout collapses it warns


def test_a_diverged_rollout_is_drawn_as_far_as_it_goes(make_runs):
    runs = make_runs(["good", "lost"], diverged="lost")
    runs[1].curves.qpos[:, 40:50] = 1e300  # on its way out
    comparison = compare(runs)
    figure = figure_of("figure4_trajectories", comparison, runs)
    assert np.isfinite(drawn(figure.get_axes()[0], "lost", comparison)[1]).sum() == 41
    figure.draw_without_rendering()
    (axes,) = panels_of("figure5_error", comparison, runs)
    assert np.isfinite(drawn(axes, "lost", comparison)[1]).sum() == 32  # windows of 10 of 41 samples
    (bars,) = panels_of("figure6_mae", comparison, runs)
    assert bars.texts[2].get_text() == "test all diverged"


def test_labels_stand_as_they_are(make_runs, tmp_path):
    runs = make_runs(AWKWARD)
    comparison = compare(runs)
    figure = figure_of("figure5_error", comparison, runs)
    figure.draw_without_rendering()
    (legend,) = figure.legends
    shown = [text.get_text().replace(r"\$", "$").replace("\n", " ") for text in legend.get_texts()]
    assert shown == [run["label"] for run in comparison["runs"]]
    assert not any(matplotlib.cbook.is_math_text(text.get_text()) for text in legend.get_texts())
    width = figure.get_figwidth() * figure.dpi
    box = legend.get_window_extent()
    assert box.x0 >= 0 and box.x1 <= width and box.y0 >= 0
    assert box.y1 <= figure.get_axes()[0].get_tightbbox().y0


@pytest.mark.parametrize("font", FONTS)
def test_figures_of_a_paper_have_its_width_and_font_and_no_title(make_runs, font):
    runs = make_runs(AWKWARD if font == "serif" else LABELS)
    widths = {}
    with paper(font):
        for name, sheet in arrange(compare(runs), runs).items():
            figure = draw(sheet, on_paper=True)
            figure.draw_without_rendering()  # a layout that collapses warns
            texts = [text for text in figure.findobj(Text) if text.get_text()]
            assert {text.get_fontname() for text in texts} == {FONTS[font]}, name
            assert max(text.get_fontsize() for text in texts) <= 8, name
            assert not figure.get_suptitle() and not any(axes.get_title("left") for axes in figure.axes)
            widths[name] = figure.get_figwidth()
    wide = {"differences", "figure3_parameters", "figure6_mae"}
    assert widths == {name: PAGE if name in wide else COLUMN for name in NAMES}


def test_an_unknown_font_is_refused(comparison, runs, tmp_path):
    with pytest.raises(ConfigError, match="font=serfi: did you mean serif"):
        save_comparison(comparison, runs, tmp_path, font="serfi")
    assert not list(tmp_path.iterdir())


def test_files_are_whole_and_the_same_each_time(runs, comparison, monkeypatch, tmp_path):
    before = dict(matplotlib.rcParams)
    printed = ("figure4_trajectories", "figure6_mae", "friction")  # an inset, hatches and a band

    def save(figure, path):
        save_figure(flat(figure), path) if path.suffix == ".png" or path.stem in printed else path.touch()

    monkeypatch.setattr("frictionzoo.report.with_matplotlib.save_figure", save)
    write_figures(tmp_path / "first", comparison, runs)
    assert dict(matplotlib.rcParams) == before
    paths = sorted(path for path in (tmp_path / "first").iterdir() if path.name != MANIFEST)
    assert [path.name for path in paths] == [f"{name}.{suffix}" for name in NAMES for suffix in ("pdf", "png")]
    for path in paths:
        if path.suffix == ".png":
            assert imread(path, format="png").std() > 0.05  # more than an empty canvas
        elif path.stem in printed:
            _judge_pdf(path.read_bytes())
    save_figure(flat(figure_of("figure6_mae", comparison, runs)), tmp_path / "second.png")
    with paper("sans"):
        save_figure(flat(draw(arrange(comparison, runs)["figure6_mae"], True)), tmp_path / "second.pdf")
    for suffix in ("pdf", "png"):
        assert (tmp_path / f"second.{suffix}").read_bytes() == (tmp_path / f"first/figure6_mae.{suffix}").read_bytes()


def _judge_pdf(content):
    assert content.startswith(b"%PDF") and content.rstrip().endswith(b"%%EOF")
    assert b"CreationDate" not in content
    assert b"/FontFile2" in content and b"/Type3" not in content
    streams = re.findall(rb"stream\r?\n(.*?)\r?\nendstream", content, re.DOTALL)
    assert not re.search(rb"/Subtype\s*/Image", content)  # drawn as lines
    assert any(zlib.decompress(stream).count(b" l\n") > 10 for stream in streams if stream.startswith(b"x"))
