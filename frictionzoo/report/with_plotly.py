"""Figures for HTML pages, as `data` and `layout` of plotly.js."""

import html
import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from frictionzoo.report.colors import GRID, MODEL, PAPER, SOFT, TEXT, fade
from frictionzoo.report.figure import Axis, Band, Bars, Curve, Figure, Mark, Panel, Stripe, list_named, list_rows
from frictionzoo.report.text import wrap

POINTS = 4000  # largest number of points per curve; a screen has fewer pixel columns
DIGITS = 6  # significant digits of a point, about the precision of float32
TICK = 28  # characters per line of a tick label
GAP = 0.06  # gap between two panels, as a share of the height


def draw(figure: Figure, points: int = POINTS) -> dict[str, Any]:
    """Convert a figure to plotly.js, with at most `points` points per curve.

    The page's script replaces the colours on a dark page.
    """
    data: list[dict[str, Any]] = []
    extra: dict[str, list[dict[str, Any]]] = {"shapes": [], "annotations": []}
    axes: dict[str, Any] = {}
    named: set[str] = set()
    rows = bool(figure.panels[0].y.ticks)
    top, ticks = 1.0, 5 if figure.small or rows else 8
    heights = (1 - GAP * (len(figure.panels) - 1)) / sum(panel.share for panel in figure.panels)
    for i, panel in enumerate(figure.panels):
        axis = f"y{i + 1}" if i else "y"
        bottom = max(0.0, top - heights * panel.share)
        axes[f"yaxis{axis[1:]}"] = _make_axis(panel.y, ticks) | {"domain": [bottom, top]}
        top = bottom - GAP
        legend = list(map(id, list_named(panel)))
        for mark in panel.marks:
            if isinstance(mark, Stripe):
                extra["shapes"].append(_draw_stripe(mark, axis))
                continue
            trace = _draw_mark(mark, points, panel)
            shown = id(mark) in legend and mark.run is None and mark.name not in named and not rows
            data.append(trace | {"yaxis": axis, "showlegend": shown})
            named |= {mark.name} if shown else set()
        extra["annotations"] += _annotate(panel, axis)
    axes["xaxis"] = _make_axis(figure.panels[-1].x, ticks) | {"anchor": axis}
    top = 40 if named else 12 if figure.small and not extra["annotations"] else 30
    margin = {"l": 20 if rows else 62, "r": 12, "t": top, "b": 44}
    if rows:
        axes["yaxis"] |= {"showgrid": False, "fixedrange": True}
        axes["xaxis"] |= {"tickangle": 0}
    hover = "closest" if rows or figure.panels[0].x.ticks else "x unified"
    layout = {"margin": margin, "showlegend": bool(named), "hovermode": hover, "barmode": "overlay"}
    return {"data": data, "layout": _SHARED | axes | layout | {name: value for name, value in extra.items() if value}}


_SHARED: dict[str, Any] = {
    "autosize": True,
    "paper_bgcolor": "rgba(0,0,0,0)",
    "plot_bgcolor": "rgba(0,0,0,0)",
    "font": {"color": TEXT, "size": 12, "family": "system-ui, sans-serif"},
    "legend": {"orientation": "h", "x": 0, "y": 1, "yanchor": "bottom"},
    "hoverlabel": {"namelength": -1, "bgcolor": PAPER, "bordercolor": GRID, "font": {"color": TEXT}},
    "uirevision": "keep",
    "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": SOFT, "activecolor": MODEL},
}


def _make_axis(axis: Axis, ticks: int) -> dict[str, Any]:
    shown: dict[str, Any] = {"title": {"text": escape(axis.title), "standoff": 8}, "nticks": ticks}
    shown |= {"gridcolor": GRID, "linecolor": GRID, "zeroline": False, "automargin": True}
    if axis.limits:
        shown["range"] = [_round(math.log10(end) if axis.log else end) for end in axis.limits]
    if axis.log:
        shown |= {"type": "log", "dtick": "D2" if axis.few else 1, "tickformat": ".1~g"}
    if axis.ticks:
        names = ["<br>".join(map(escape, wrap(name, TICK, 3))) for name in axis.ticks]
        shown |= {"tickvals": list(range(len(names))), "ticktext": names}
    return shown


def _draw_mark(mark: Mark, points: int, panel: Panel) -> dict[str, Any]:
    name = escape(mark.name)
    shared: dict[str, Any] = {"type": "scatter", "name": name, "legendgroup": name, "opacity": mark.opacity}
    shared |= {} if mark.run is None else {"meta": {"run": mark.run}}
    match mark:
        case Band():
            kept = decimate(mark.low, points)
            x = round_points(mark.x[kept])
            # A logarithmic axis cannot show values of 0 or less.
            low = np.maximum(mark.low, panel.y.limits[0] / 10) if panel.y.log and panel.y.limits else mark.low
            outline = round_points(np.concatenate([mark.high[kept], low[kept][::-1]]))
            shape = {"mode": "lines", "x": x + x[::-1], "y": outline, "fill": "toself", "fillcolor": fade(mark.color)}
            only = {"meta": {"run": mark.run, "only": True}} if mark.selected else {}
            return shared | shape | only | {"line": {"width": 0, "color": mark.color}, "hoverinfo": "skip"}
        case Bars():
            return shared | _draw_bars(mark, panel)
        case Curve():
            return shared | _draw_curve(mark, points, panel)
    raise TypeError(type(mark).__name__)


def _draw_curve(mark: Curve, points: int, panel: Panel) -> dict[str, Any]:
    mode = "+".join(name for name, is_drawn in (("lines", mark.width), ("markers", mark.marker)) if is_drawn)
    dash = ",".join(f"{mark.width * length:g}px" for length in mark.dash) or "solid"
    trace: dict[str, Any] = {"mode": mode, "line": {"color": mark.color, "width": mark.width, "dash": dash}}
    if mark.marker:
        edge = {"color": mark.color, "width": 1.5}
        trace["marker"] = {"color": mark.color, "symbol": mark.marker, "size": mark.size, "line": edge}
    finite = np.isfinite(mark.y)
    if mark.ends is not None:
        trace["error_x"] = _draw_whiskers(mark.ends[:, finite], mark.x[finite], mark.color, 2.0)
    if mark.reach is not None:
        trace["error_y"] = _draw_whiskers(mark.reach[:, finite], mark.y[finite], mark.color, 1.2)
    x, y = mark.x[finite], mark.y[finite]
    # If x turns back, as in a phase plot, extremes of y do not describe the curve: keep evenly spaced points.
    kept = decimate(y, points) if (np.diff(x) >= 0).all() else np.arange(0, len(x), -(-len(x) // points))
    return trace | _point(mark, "%{y:.5g}", panel.y.unit) | {"x": round_points(x[kept]), "y": round_points(y[kept])}


def _draw_whiskers(ends: np.ndarray, about: np.ndarray, color: str, width: float) -> dict[str, Any]:
    below, above = map(round_points, np.abs(ends - about))
    shared = {"type": "data", "symmetric": False, "color": color, "thickness": width, "width": 2.5 * width}
    return shared | {"array": above, "arrayminus": below}


def _draw_bars(mark: Bars, panel: Panel) -> dict[str, Any]:
    along, across = ("y", "x") if mark.upright else ("x", "y")
    unit = panel.y.unit if mark.upright else panel.x.unit
    trace: dict[str, Any] = {"type": "bar", "orientation": "v" if mark.upright else "h", "width": mark.width}
    trace |= {across: round_points(mark.at), along: round_points(mark.length)}
    trace |= {"marker": {"color": fade(mark.color) if mark.pale else mark.color}}
    if mark.pale:
        trace["marker"] |= {"line": {"color": mark.color, "width": 1.5}}
    if mark.spread is not None:
        trace[f"error_{along}"] = {"array": round_points(mark.spread), "color": TEXT, "thickness": 1.2, "width": 4}
    return trace | _point(mark, f"%{{{along}:.5g}}", unit)


def _point(mark: Curve | Bars, value: str, unit: str) -> dict[str, Any]:
    if not mark.name:
        return {"hoverinfo": "skip"}
    if mark.notes:
        return {"hovertext": [escape(note) for note in mark.notes], "hovertemplate": "%{hovertext}"}
    return {"hovertemplate": f"{value} {escape(unit)}".rstrip()}


def _draw_stripe(mark: Stripe, axis: str) -> dict[str, Any]:
    kind = {"type": "line" if mark.low == mark.high else "rect", "layer": "below", "opacity": mark.opacity}
    along, across = ("y", "x") if mark.level else ("x", "y")
    place = {f"{along}0": mark.low, f"{along}1": mark.high, f"{across}0": 0, f"{across}1": 1}
    refs = {"xref": "paper" if mark.level else "x", "yref": axis if mark.level else f"{axis} domain"}
    dash = ",".join(f"{length:g}px" for length in mark.dash) or "solid"
    if mark.low == mark.high:
        return kind | place | refs | {"line": {"color": mark.color, "width": 1, "dash": dash}}
    return kind | place | refs | {"fillcolor": mark.color, "line": {"width": 0}}


def _annotate(panel: Panel, axis: str) -> list[dict[str, Any]]:
    shared = {"showarrow": False, "xref": "paper", "x": 1, "xanchor": "right", "font": {"color": TEXT, "size": 12}}
    end = panel.x.limits[1] if panel.x.limits else math.inf
    beyond = [(row, f"{value:.3g} →") for row, value, _ in list_rows(panel) if value > end]
    texts = [shared | {"text": text, "yref": axis, "y": row} for row, text in beyond]
    if panel.note:
        texts.append(shared | {"text": escape(panel.note), "yref": f"{axis} domain", "y": 1, "yanchor": "bottom"})
    return texts


def decimate(curve: Float[np.ndarray, "points"], points: int) -> Int[np.ndarray, "kept"]:
    """Return indices of at most `points` points that look like the whole curve: the extremes of each stretch."""
    if len(curve) <= points:
        return np.arange(len(curve))
    edges = np.linspace(0, len(curve), points // 2).astype(int)
    stretches = [(int(start), curve[start:stop]) for start, stop in pairwise(edges)]
    extremes = [start + int(offset) for start, part in stretches for offset in (part.argmin(), part.argmax())]
    return np.unique([0, *extremes, len(curve) - 1])


def round_points(values: Sequence[float] | Float[np.ndarray, "points"]) -> list[float | None]:
    """Round values to `DIGITS` digits; None for a value that is not finite."""
    return [_round(value) if math.isfinite(value) else None for value in values]


def _round(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


def escape(text: str) -> str:
    """Escape a name, because plotly.js interprets some HTML tags and entities."""
    return html.escape(text, quote=False)
