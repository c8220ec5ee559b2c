"""What the pages for a browser share: templates, how they draw curves with plotly.js, and how they print numbers."""

import html
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from jinja2 import Environment, PackageLoader, StrictUndefined
from plotly.offline import get_plotlyjs

from frictionzoo.show.colors import BASELINE, BEST, MODEL

POINTS = 4000  # largest number of points of a curve; a screen has fewer columns of pixels
DIGITS = 6  # significant digits of a point, about what float32 holds
MEASURED, TEXT, SOFT, GRID = "#000000", "#3d4450", "#7d8794", "#dfe3e8"
BANDS = {MODEL: "rgba(0,114,178,0.2)", BASELINE: "rgba(230,159,0,0.25)"}
DARK = {  # what each colour becomes on a dark page; all others are legible on both
    MEASURED: "#f4f4f4",
    MODEL: "#56B4E9",
    "#56B4E9": "#0072B2",
    BEST: "#ff6b6b",
    TEXT: "#c3c9d2",
    GRID: "#323945",
    BANDS[MODEL]: "rgba(86,180,233,0.25)",
}


@dataclass(frozen=True)
class Check:
    """One reason to trust the result, or to doubt it.

    Attributes:
        state: `good`, `note`, `caution` or `bad`.
        title: What was looked at.
        text: What was seen, in plain sentences.
    """

    state: str
    title: str
    text: str


@dataclass(frozen=True)
class Plot:
    """One figure of the page.

    Attributes:
        title: Its heading.
        text: Its content in one sentence, the alternative for those who do not see it.
        figure: `data` and `layout` of plotly.js.
        time: Whether its horizontal axis is the time of the rollout, which all such figures share.
        height: In pixels, where it is not that of the others.
    """

    title: str
    text: str
    figure: dict[str, Any]
    time: bool = False
    height: int | None = None


def render_page(template: str, figures: Sequence[Mapping[str, Any]], **content: Any) -> bytes:
    """One self-contained page.

    Args:
        template: Its file, relative to the package; it extends `show/page.html.jinja`.
        figures: `data` and `layout` of each figure, in the order in which the template numbers them.
        content: What else the template names: the program's `version`; `state` is handed to the page's script.
    """
    plotly = get_plotlyjs().replace("</script", "<\\/script")
    shared = {"dark": DARK, "state": {}, "plotly": plotly}
    page = _environment().get_template(template).render(figures=figures, **shared | content)
    return page.encode()


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("frictionzoo", ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"number": format_number, "unit": format_unit, "place": _place, "change": format_change}
    return environment


def with_start(
    measured: Float[np.ndarray, "samples ..."], predicted: Float[np.ndarray, "steps ..."]
) -> Float[np.ndarray, "samples ..."]:
    """A rollout with the measured state that it starts from, NaN from the first sample that is not finite."""
    curve = np.concatenate([measured[:1], predicted])
    finite = np.isfinite(curve.reshape(len(curve), -1)).all(axis=1)
    kept = np.logical_and.accumulate(finite)
    return np.where(kept.reshape(-1, *[1] * (curve.ndim - 1)), curve, np.nan)


def find_frame(shown: Sequence[Float[np.ndarray, "time"]], others: Sequence[Float[np.ndarray, "time"]]) -> list[float]:
    """Limits of a vertical axis: a drive without friction may run away, and leave the frame.

    Args:
        shown: Curves that are seen whole, NaN where they have ended.
        others: Curves that may take half as much room again above and below.
    """
    lowest, highest = float(np.nanmin(shown)), float(np.nanmax(shown))
    room = highest - lowest or 1.0
    low = max(min([lowest, *(float(np.nanmin(curve)) for curve in others)]), lowest - room / 2)
    high = min(max([highest, *(float(np.nanmax(curve)) for curve in others)]), highest + room / 2)
    return [low - 0.04 * room, high + 0.04 * room]


def draw_band(
    mean: Float[np.ndarray, "windows"],
    std: Float[np.ndarray, "windows"],
    time: Float[np.ndarray, "windows"],
    name: str,
    color: str,
    fill: str,
    unit: str,
    points: int = POINTS,
) -> list[dict[str, Any]]:
    """The area within one standard deviation of a curve, and the curve.

    Args:
        mean: The curve.
        std: Its standard deviation.
        time: Where on the horizontal axis.
        name: What it is called.
        color: Of the curve.
        fill: Colour of the area.
        unit: Of the curve.
        points: At most so many of the curve.
    """
    kept = decimate(mean, points)
    x = round_points(time[kept])
    outline = np.concatenate([mean[kept] + std[kept], (mean[kept] - std[kept])[::-1]])
    shared = {"type": "scatter", "mode": "lines", "name": name, "legendgroup": name}
    area = {"x": x + x[::-1], "y": round_points(outline), "fill": "toself", "fillcolor": fill}
    hidden = {"showlegend": False, "hoverinfo": "skip", "line": {"width": 0, "color": color}}
    curve = {"x": x, "y": round_points(mean[kept]), "line": {"color": color}, "hovertemplate": f"%{{y:.4g}} {unit}"}
    return [{**shared, **area, **hidden}, {**shared, **curve}]


def spans_decades(values: Float[np.ndarray, "..."]) -> bool:
    """Whether positive values differ so much that a linear axis would hide the smaller ones."""
    finite = values[np.isfinite(values)]
    return bool(finite.min(initial=np.inf) > 0 and finite.max(initial=0) > 10 * finite.min(initial=np.inf))


def make_layout(**axes: dict[str, Any]) -> dict[str, Any]:
    """What all figures share; the page's script swaps the colours on a dark page."""
    return {
        "autosize": True,
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {"color": TEXT, "size": 12, "family": "system-ui, sans-serif"},
        "margin": {"l": 62, "r": 12, "t": 40, "b": 44},
        "legend": {"orientation": "h", "x": 0, "y": 1, "yanchor": "bottom"},
        "hovermode": "x unified",
        "hoverlabel": {"namelength": -1},
        "uirevision": "keep",
        "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": SOFT, "activecolor": MODEL},
        **axes,
    }


def make_axis(title: str, **options: Any) -> dict[str, Any]:
    """An axis with its title; `options` are plotly's."""
    shown = {"title": {"text": title, "standoff": 8}, "gridcolor": GRID, "linecolor": GRID, "zeroline": False}
    return shown | {"automargin": True, "nticks": 8} | options


def draw_points(
    x: Float[np.ndarray, "points"], y: Float[np.ndarray, "points"], points: int = POINTS
) -> dict[str, list[float]]:
    """A curve as plotly.js takes it, of at most `points` points, without the samples that are not finite."""
    finite = np.isfinite(y)
    x, y = x[finite], y[finite]
    kept = decimate(y, points)
    return {"x": round_points(x[kept]), "y": round_points(y[kept])}


def decimate(curve: Float[np.ndarray, "points"], points: int = POINTS) -> Int[np.ndarray, "kept"]:
    """Indices of at most `points` points that look like the whole curve: lowest and highest of each stretch."""
    if len(curve) <= points:
        return np.arange(len(curve))
    edges = np.linspace(0, len(curve), points // 2).astype(int)
    stretches = [(int(start), curve[start:stop]) for start, stop in pairwise(edges)]
    extremes = [start + int(at) for start, part in stretches for at in (part.argmin(), part.argmax())]
    return np.unique([0, *extremes, len(curve) - 1])


def round_points(values: Float[np.ndarray, "points"]) -> list[float]:
    """Values as short as their precision allows."""
    return [float(f"{value:.{DIGITS}g}") for value in values]


def escape(text: str) -> str:
    """A name as text: plotly.js reads a few HTML tags and entities."""
    return html.escape(text, quote=False)


def format_number(value: float | Sequence[float] | None) -> str:
    """A value, or one for each joint, as it is printed."""
    if value is None:
        return "none"
    return f"{value:.4g}" if isinstance(value, int | float) else ", ".join(f"{joint:.4g}" for joint in value)


def format_unit(unit: str) -> str:
    """A unit as it is printed; nothing for a pure number."""
    return "" if unit == "1" else unit.replace("^2", "²")


def format_change(value: float | None, reference: float | None) -> str:
    """Relative change, where there is something to compare."""
    if value is None or not reference:
        return ""
    percent = round(100 * (value / reference - 1))
    return f"{'−' if percent < 0 else '+' if percent > 0 else '±'}{abs(percent)} %"


def _place(value: float, parameter: Mapping[str, Any]) -> float:
    """Where a value lies between its bounds, from 0 to 100; in decades where the bounds are positive."""
    low, high = parameter["low"], parameter["high"]
    if low > 0:
        low, high, value = math.log(low), math.log(high), math.log(max(value, low))
    return round(100 * min(1.0, max(0.0, (value - low) / (high - low))), 1)
