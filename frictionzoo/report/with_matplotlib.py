"""Figures as PNG for a screen and as PDF for a paper, drawn by matplotlib."""

import contextlib
import io
import logging
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis as Ruler
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, NullFormatter

from frictionzoo.core.output import write_atomically
from frictionzoo.core.telling import escape_controls
from frictionzoo.report import figure as described
from frictionzoo.report.colors import BAND, TEXT
from frictionzoo.report.figure import Axis, Band, Bars, Curve, Dash, Mark, Panel, Sheet, Stripe, list_named, list_rows
from frictionzoo.report.text import wrap

# For PDF files, fontTools logs every glyph of a font.
logging.getLogger("fontTools").setLevel(logging.WARNING)

DPI = 150
WIDTH = 8.0  # [inch]; 1200 px
COLUMN = 3.5  # width of each of several columns on a screen, and of one column of a paper [inch]
PAGE = 7.2  # width of both columns of a paper [inch]
FONTS = {"sans": "DejaVu Sans", "serif": "STIXGeneral"}  # fonts of a paper; matplotlib contains both
_PAPER: dict[Any, Any] = {
    "font.size": 8.0,
    "axes.linewidth": 0.6,
    "mathtext.fontset": "stix",
    "pdf.fonttype": 42,
}  # no type 3
LINE = 0.17  # height of each line of a legend [inch]
TICK, PANEL, LEGEND = 30, 45, 100  # characters per line: of a tick, above a small panel, in a legend
_POINT = 0.8  # points per pixel of a page
_MARKERS = {"": "None", "circle": "o", "diamond": "D", "x": "x", "cross": "+", "square": "s"}
_MARKERS |= {"triangle-up": "^", "triangle-down": "v"}


class ShownFigure(Figure):
    """A figure that notebooks display, also if pyplot was not imported."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        FigureCanvasAgg(self).print_figure(buffer, format="png", dpi=DPI / 2)
        return buffer.getvalue()


@contextlib.contextmanager
def paper(font: str) -> Iterator[None]:
    """Draw and save figures for a paper: with `font`, a key of `FONTS`, in 8 points."""
    settings: Any = _PAPER | {"font.family": FONTS[font]}
    with matplotlib.rc_context(settings):
        yield


def draw(sheet: Sheet, on_paper: bool = False) -> Figure:
    """Draw a sheet as one matplotlib figure.

    For a paper (within `paper`), the figure has no title, as its caption is below it, and the width of one or of both
    columns.
    """
    columns, parts = min(sheet.columns, len(sheet.figures)), len(sheet.figures[0].panels)
    blocks = -(-len(sheet.figures) // columns)
    wide = columns > 1 or sheet.apart or any(panel.y.ticks for panel in sheet.figures[0].panels)
    width = (PAGE if wide else COLUMN) if on_paper else max(WIDTH, COLUMN * columns)
    figure = ShownFigure(
        figsize=(width, (0.0 if on_paper else 0.6) + sheet.height * blocks * _zoom()), layout="constrained"
    )
    headings = sheet.headings and (len(sheet.figures) > 1 or not on_paper)
    shares = [panel.share for panel in sheet.figures[0].panels] * blocks
    shared = "col" if parts > 1 and blocks == 1 else False
    grid = figure.subplots(len(shares), columns, sharex=shared, squeeze=False, height_ratios=shares)
    for place in range(blocks * columns):
        block = grid[place // columns * parts :, place % columns][:parts]
        if place < len(sheet.figures):
            _draw_figure(block, sheet.figures[place], headings, sheet.apart)
        for axes in block if place >= len(sheet.figures) else ():
            axes.set_axis_off()
    if not on_paper:
        figure.suptitle(_name(sheet.title, LEGEND), fontsize="medium")
    if not sheet.apart:
        _add_legend(figure, [panel for part in sheet.figures for panel in part.panels])
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG or PDF according to the suffix; PDF without a date.

    Raises:
        OutputError: The file cannot be written.
    """
    buffer = io.BytesIO()
    metadata = {"CreationDate": None} if path.suffix == ".pdf" else None
    FigureCanvasAgg(figure).print_figure(buffer, format=path.suffix[1:], dpi=DPI, metadata=metadata)
    write_atomically(path, buffer.getvalue())


def _draw_figure(block: Iterable[Axes], figure: described.Figure, headings: bool, apart: bool) -> None:
    for axes, panel in zip(block, figure.panels, strict=True):
        _draw_panel(axes, panel)
        first, last = panel is figure.panels[0], panel is figure.panels[-1]
        axes.set_xlabel(_name(panel.x.title, PANEL) if last else "")
        axes.set_ylabel(_name(panel.y.title, PANEL))
        axes.set_title(_name(panel.note, PANEL), loc="right", fontsize="small", color=TEXT)
        if headings and first and not apart:
            axes.set_title(_name(figure.title, PANEL), loc="left", fontsize="medium")
        if apart and first:
            keys = _list_keys([panel], LEGEND)
            place = {"loc": "lower left", "bbox_to_anchor": (-0.02, 1.0), "alignment": "left", "frameon": False}
            title = _name(figure.title, PANEL)
            axes.legend([*keys.values()], [*keys], title=title, fontsize="x-small", handlelength=3.5, **place)


def _draw_panel(axes: Axes, panel: Panel) -> None:
    _draw_marks(axes, panel)
    side = axes.get_yaxis_transform()
    for row, value, note in list_rows(panel):
        # Right of the frame: legible even if a bar leaves the frame.
        axes.text(1.02, row, note, transform=side, va="center", fontsize="x-small")
        if panel.x.limits and value > panel.x.limits[1]:
            axes.text(0.99, row, "→", transform=side, ha="right", va="center")
    if panel.magnified:
        _magnify(axes, panel, *panel.magnified)


def _draw_marks(axes: Axes, panel: Panel) -> None:
    for mark in panel.marks:
        # The first run is the best and is drawn in front.
        _draw_mark(axes, mark, 2.0 if mark.run is None else 2.1 + 0.5 / (1 + mark.run))
    axes.margins(x=0.01)
    _scale(axes.xaxis, panel.x)
    _scale(axes.yaxis, panel.y)
    axes.set_xlim(panel.x.limits)
    axes.set_ylim(panel.y.limits)
    axes.grid(axis="x" if panel.y.ticks else "y" if panel.x.ticks else "both", alpha=0.3)
    axes.set_axisbelow(True)


def _draw_mark(axes: Axes, mark: Mark, order: float) -> None:
    match mark:
        case Curve() if mark.ends is not None:
            ends = np.abs(mark.ends - mark.x)
            axes.errorbar(mark.x, mark.y, xerr=ends, capsize=4, elinewidth=1.8, zorder=order, **_look(mark))
        case Curve() if mark.reach is not None:
            ends = np.abs(mark.reach - mark.y)
            axes.errorbar(mark.x, mark.y, yerr=ends, capsize=2.5, elinewidth=1.0, zorder=3, **_look(mark))
        case Curve():
            # Points are in front, and not clipped at the edge.
            axes.plot(mark.x, mark.y, zorder=order if mark.width else 3, clip_on=mark.width > 0, **_look(mark))
        case Band():
            axes.fill_between(mark.x, mark.low, mark.high, color=mark.color, alpha=BAND, linewidth=0)
        case Stripe() if mark.low == mark.high:
            line = axes.axhline if mark.level else axes.axvline
            line(mark.low, color=mark.color, linestyle=_line(mark.dash), linewidth=1.0, zorder=1)
        case Stripe():
            stripe = axes.axhspan if mark.level else axes.axvspan
            stripe(mark.low, mark.high, facecolor=mark.color, alpha=mark.opacity, linewidth=0)
        case Bars():
            whiskers = {"ecolor": "black", "elinewidth": 1, "capsize": 2.5}
            draw, spread = (axes.bar, "yerr") if mark.upright else (axes.barh, "xerr")
            draw(mark.at, mark.length, mark.width, **{spread: mark.spread}, error_kw=whiskers, **_fill(mark))


def _look(mark: Curve) -> dict[str, Any]:
    hollow = mark.marker.endswith("-open")
    points: Mapping[str, Any] = {
        "marker": _MARKERS[mark.marker.removesuffix("-open")],
        "markersize": _POINT * mark.size * (0.75 if "diamond" in mark.marker else 1),  # size of its edge, not its width
        "markerfacecolor": "white" if hollow else mark.color,
    }
    line = {"linestyle": _line(mark.dash) if mark.width else "none", "linewidth": _POINT * mark.width}
    return {"color": mark.color, "alpha": mark.opacity, **line, **points}


def _line(dash: Dash) -> Any:
    return (0, dash) if dash else "-"


def _fill(mark: Bars) -> dict[str, Any]:
    pale = {"alpha": 0.45, "hatch": "////"} if mark.pale else {}
    return {"facecolor": mark.color, "edgecolor": "black", "linewidth": 0.5, **pale}


def _scale(ruler: Ruler, axis: Axis) -> None:
    if axis.ticks:
        ruler.set_ticks(range(len(axis.ticks)), [_name(tick, TICK) for tick in axis.ticks])
    if axis.log:
        ruler.axes.set(**{f"{ruler.axis_name}scale": "log"})
        ruler.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if axis.few else (1.0,)))
        ruler.set_minor_formatter(NullFormatter())
        ruler.set_major_formatter("{x:g}")


def _magnify(axes: Axes, panel: Panel, x: tuple[float, float], y: tuple[float, float]) -> None:
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.9 * (high - low))
    inset = axes.inset_axes((0.2, 0.56, 0.78, 0.41))
    _draw_marks(inset, panel)
    inset.set(xlim=x, ylim=y)
    inset.tick_params(labelsize="x-small")
    axes.indicate_inset_zoom(inset, edgecolor="black")


def _list_keys(panels: Iterable[Panel], width: int) -> dict[str, Artist]:
    """Return legend entries by name in lines of this width; runs come last, in their order."""
    marks = [mark for panel in panels for mark in list_named(panel)]
    marks.sort(key=lambda mark: -1 if mark.run is None else mark.run)
    return {_name(mark.name, width): _make_key(mark) for mark in marks}


def _make_key(mark: Mark) -> Artist:
    if isinstance(mark, Curve):
        return Line2D([], [], **_look(mark))
    return Patch(**_fill(mark)) if isinstance(mark, Bars) else Patch(facecolor=mark.color, alpha=mark.opacity)


def _zoom() -> float:
    """Return the size of text relative to a screen's."""
    return matplotlib.rcParams["font.size"] / matplotlib.rcParamsDefault["font.size"]


def _add_legend(figure: Figure, panels: Iterable[Panel]) -> None:
    width = int(LEGEND * figure.get_figwidth() / WIDTH / _zoom())
    if not (keys := _list_keys(panels, min(width, LEGEND))):
        return
    longest = max(len(line) for name in keys for line in name.splitlines())
    columns = int(np.clip(width // (longest + 8), 1, len(keys)))
    lines = max(1, -(-sum(1 + name.count("\n") for name in keys) // columns))
    figure.set_figheight(figure.get_figheight() + 0.1 + 0.2 * _zoom() * lines)
    place = {"loc": "outside lower center", "ncols": columns}
    figure.legend([*keys.values()], [*keys], fontsize="small", handlelength=3.5, **place)


def _name(text: str, width: int) -> str:
    """Wrap a text to lines of this width, and escape `$`, which matplotlib reads as mathematics."""
    wrapped = [part for line in text.split("\n") if line for part in wrap(escape_controls(line), width)]
    return "\n".join(wrapped).replace("$", r"\$")
