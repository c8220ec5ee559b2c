"""One description of a figure, drawn by matplotlib and by plotly: both show the same."""

import numpy as np
import plotly.graph_objects as go
import pytest

from frictionzoo.report import with_matplotlib, with_plotly
from frictionzoo.report.figure import Axis, Band, Bars, Curve, Figure, Panel, Sheet, Stripe, scale_errors, scale_values

X, Y = np.array([1.0, 2.0, 3.0]), np.array([0.1, np.nan, 0.4])
FIGURE = Figure(
    "title $1",
    "text",
    (
        Panel(
            (
                Band(x=X, low=X - 1, high=X + 1, color="#0072B2", name="curve", run=0),
                Curve(x=X, y=Y, name="curve", color="#0072B2", dash=(4.0, 2.0), run=0),
                Curve(x=X, y=X, name="points", width=0.0, marker="circle-open"),
                Bars(at=X, length=X, width=0.5, spread=0.1 * X, upright=True, name="bars", color="#009E73"),
                Stripe(low=1.5, high=1.5, dash=(1.0, 1.0)),
                Stripe(low=-0.5, high=0.5, level=True, name="noise"),
            ),
            Axis("abscissa", "s", limits=(0.0, 4.0)),
            Axis("ordinate", "1", log=True, limits=(0.05, 4.5)),
            note="a note",
        ),
        Panel((Curve(x=X, y=X, name="points"),), Axis("abscissa", "s", limits=(0.0, 4.0)), Axis("below")),
    ),
)


@pytest.fixture
def axes():
    return with_matplotlib.draw(Sheet("sheet", [FIGURE], 3.0, headings=True)).get_axes()


@pytest.fixture
def page():
    drawn = with_plotly.draw(FIGURE)
    go.Figure(drawn)  # raises for a property that plotly does not know
    return drawn


def test_both_draw_the_same_data(axes, page):
    band, curve, points, bars, below = page["data"]
    line, ring, *_ = (line for line in axes[0].get_lines() if len(line.get_xdata()) == 3)
    np.testing.assert_array_equal(line.get_ydata(), Y)
    assert (curve["x"], curve["y"]) == ([1.0, 3.0], [0.1, 0.4])  # what is not finite is left out
    np.testing.assert_array_equal(ring.get_ydata(), points["y"])
    np.testing.assert_array_equal([patch.get_height() for patch in axes[0].containers[1].patches], bars["y"])
    area = axes[0].collections[0].get_paths()[0].vertices
    assert {tuple(vertex) for vertex in area} >= {(1.0, 2.0), (3.0, 4.0), (1.0, 0.0)}
    assert band["y"] == [2.0, 3.0, 4.0, 2.0, 1.0, 0.005]  # within reach of a logarithmic axis
    np.testing.assert_array_equal(axes[1].get_lines()[0].get_ydata(), below["y"])
    assert [shape["type"] for shape in page["layout"]["shapes"]] == ["line", "rect"]


def test_both_have_the_same_axes_and_words(axes, page):
    layout = page["layout"]
    assert (axes[0].get_yscale(), layout["yaxis"]["type"]) == ("log", "log")
    np.testing.assert_allclose(axes[0].get_ylim(), 10 ** np.array(layout["yaxis"]["range"]), rtol=1e-5)
    assert axes[0].get_xlim() == axes[1].get_xlim() == tuple(layout["xaxis"]["range"])
    titles = layout["yaxis"]["title"]["text"], layout["yaxis2"]["title"]["text"], layout["xaxis"]["title"]["text"]
    assert (axes[0].get_ylabel(), axes[1].get_ylabel(), axes[1].get_xlabel()) == titles
    assert axes[0].get_title("right") == layout["annotations"][0]["text"] == "a note"
    assert axes[0].get_title("left") == r"title \$1"


def test_a_legend_names_each_once(axes, page):
    (legend,) = axes[0].figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["points", "bars", "noise", "curve"]
    # A page has its own legend of the runs.
    assert [trace["name"] for trace in page["data"] if trace["showlegend"]] == ["points", "bars"]


def test_an_axis_lets_small_errors_be_seen():
    assert scale_errors("e", "rad", [np.ones(3), 2 * np.ones(3)], [3 * np.ones(3)]).limits == pytest.approx((0, 3.15))
    small, large, away = np.full(3, 0.01), np.ones(3), np.full(3, 1e6)
    axis = scale_errors("e", "rad", [small, large, away], (), widest=1e3)
    assert axis.log and axis.limits[0] < 0.01 and 1 < axis.limits[1] < 10
    assert not scale_values("v", "", np.array([-1.0, 100.0]), apart=10.0).log
    assert scale_values("v", "", np.array([1.0, 100.0]), apart=10.0).log
