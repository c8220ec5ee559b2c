"""Description of figures, independent of the library: `with_matplotlib` draws files, `with_plotly` draws pages."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from frictionzoo.report.colors import MEASURED

FLATTENED = 20.0  # ratio of two curves' maxima above which a linear axis hides the smaller one
FEW = 100.0  # ratio of the ends of a logarithmic axis below which it has ticks at 1, 2 and 5
_BAND = 1.5  # limit of the axis for a band around an error's moving mean, relative to the largest mean

Dash = tuple[float, ...]
"""Lengths of strokes and gaps in line widths; empty for a solid line."""


@dataclass(frozen=True, kw_only=True)
class Mark:
    """Mark in a panel; base class of all marks.

    Attributes:
        name: Name in the legend and under the pointer; a mark without a name has no hover text.
        color: Colour on paper and on a light page.
        run: Index of its run, which a page may bring to the front.
        legend: Whether the legend names it.
        notes: Text for each value.
    """

    name: str = ""
    color: str = MEASURED
    dash: Dash = ()
    opacity: float = 1.0
    run: int | None = None
    legend: bool = True
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Curve(Mark):
    """Line or points, with or without intervals.

    Attributes:
        y: Values on the vertical axis; NaN for a missing value.
        width: Line width [px of a page]; 0 for points only.
        marker: Marker of the points, with plotly's name; empty for none.
        size: Size of the points [px of a page].
        ends: Lower and upper ends of horizontal intervals.
        reach: Lower and upper ends of vertical whiskers.
    """

    x: Float[np.ndarray, "points"]
    y: Float[np.ndarray, "points"]
    width: float = 1.7
    marker: str = ""
    size: float = 6.0
    ends: Float[np.ndarray, "2 points"] | None = None
    reach: Float[np.ndarray, "2 points"] | None = None


@dataclass(frozen=True, kw_only=True)
class Band(Mark):
    """Pale area between two curves, not in the legend; if `selected`, a page shows it only for the selected run."""

    x: Float[np.ndarray, "points"]
    low: Float[np.ndarray, "points"]
    high: Float[np.ndarray, "points"]
    selected: bool = False


@dataclass(frozen=True, kw_only=True)
class Stripe(Mark):
    """Area between two values of an axis, vertical axis if `level`; a line if the values are equal."""

    low: float
    high: float
    level: bool = False


@dataclass(frozen=True, kw_only=True)
class Bars(Mark):
    """Bars from 0, horizontal unless `upright`.

    Attributes:
        at: Position of each bar on the other axis.
        length: Length of each bar; NaN for a missing value.
        width: Width on the other axis.
        spread: Half the length of the whisker at the end of each bar.
        pale: Whether the bars are pale, and hatched on paper.
    """

    at: Float[np.ndarray, "bars"]
    length: Float[np.ndarray, "bars"]
    width: float
    spread: Float[np.ndarray, "bars"] | None = None
    upright: bool = False
    pale: bool = False


@dataclass(frozen=True)
class Axis:
    """Axis of a panel, for a quantity and its unit.

    Attributes:
        log: Whether it is logarithmic.
        limits: First and last value; None, or values that are not finite, to fit the marks.
        ticks: Names of the values 0, 1, 2 and so on, instead of numbers.
    """

    label: str = ""
    unit: str = ""
    log: bool = False
    limits: tuple[float, float] | None = None
    ticks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.limits is not None and not np.isfinite(self.limits).all():
            object.__setattr__(self, "limits", None)

    @property
    def title(self) -> str:
        """Axis title: label and unit."""
        return f"{self.label} [{self.unit}]" if self.label and self.unit else self.label or self.unit

    @property
    def few(self) -> bool:
        """Whether a logarithmic axis has ticks between the powers of ten."""
        return self.limits is not None and bool(self.limits[1] < FEW * self.limits[0])


@dataclass(frozen=True)
class Panel:
    """Marks on a pair of axes.

    Attributes:
        marks: Marks from back to front; of several runs, the first is in front on paper.
        note: Short text above the panel.
        share: Height relative to the other panels of the figure.
        magnified: Limits of both axes of a stretch that is magnified on paper, where nobody can zoom.
    """

    marks: Sequence[Mark]
    x: Axis
    y: Axis
    note: str = ""
    share: float = 1.0
    magnified: tuple[tuple[float, float], tuple[float, float]] | None = None


@dataclass(frozen=True)
class Figure:
    """Figure of one or more panels, stacked on one horizontal axis.

    Attributes:
        text: Content in a few sentences, also for readers who cannot see the figure.
        panels: Panels from top to bottom.
        time: Whether the horizontal axis is the time of a rollout; all such figures of a page zoom together.
        rollout: Index of the single long test rollout that it shows.
        height: Height on a page [px]; None for the default.
        small: Whether it is one of many small figures on a page.
    """

    title: str
    text: str
    panels: tuple[Panel, ...]
    time: bool = False
    rollout: int | None = None
    height: int | None = None
    small: bool = False


@dataclass(frozen=True)
class Sheet:
    """Figures on one printed sheet.

    Attributes:
        figures: Figures with the same number of panels.
        height: Height of a row of figures [inch].
        columns: Number of figures in a row.
        headings: Whether the figures' titles are printed.
        apart: Whether each figure has a legend above it, instead of one legend below all figures.
    """

    title: str
    figures: Sequence[Figure]
    height: float
    columns: int = 1
    headings: bool = False
    apart: bool = False


def list_named(panel: Panel) -> Iterator[Mark]:
    """Yield marks for the legend: no bands, and no runs that a row names already."""
    for mark in panel.marks:
        if mark.legend and mark.name and not isinstance(mark, Band) and (mark.run is None or not panel.y.ticks):
            yield mark


def list_rows(panel: Panel) -> Iterator[tuple[float, float, str]]:
    """Yield position, value and note of each value in a panel with rows."""
    for mark in panel.marks if panel.y.ticks else ():
        if isinstance(mark, Curve | Bars):
            rows, values = (mark.y, mark.x) if isinstance(mark, Curve) else (mark.at, mark.length)
            yield from zip(rows.tolist(), values.tolist(), mark.notes, strict=True)


def frame(
    shown: Sequence[Float[np.ndarray, "points"]], others: Sequence[Float[np.ndarray, "points"]] = ()
) -> tuple[float, float]:
    """Return limits of a vertical axis; a drive without friction may run away and leave the frame.

    The curves `shown`, NaN after they have ended, are shown completely. The `others` may extend the axis by at most
    half the range of `shown` above and below.
    """
    lowest, highest = float(np.nanmin(shown)), float(np.nanmax(shown))
    room = highest - lowest or 1.0
    low = max(min([lowest, *(float(np.nanmin(curve)) for curve in others)]), lowest - room / 2)
    high = min(max([highest, *(float(np.nanmax(curve)) for curve in others)]), highest + room / 2)
    return low - 0.04 * room, high + 0.04 * room


def scale_errors(
    label: str,
    unit: str,
    curves: Sequence[Float[np.ndarray, "..."]],
    tops: Sequence[Float[np.ndarray, "..."]] = (),
    widest: float = np.inf,
) -> Axis:
    """Return an axis for errors: from 0 upwards, or logarithmic if one curve would flatten another.

    Curves leave the frame if the ratio of their maximum to the smallest maximum exceeds `widest`. The upper ends of
    bands, `tops`, may leave it too.
    """
    positive = [curve[curve > 0] for curve in curves if (curve > 0).any()]
    lowest = min((curve.max() for curve in positive), default=1.0)
    positive = [curve for curve in positive if curve.max() <= widest * lowest] or [np.ones(1)]
    highest = max(curve.max() for curve in positive)
    if highest > FLATTENED * lowest:
        bottom = float(min(np.percentile(np.concatenate(positive), 1), lowest / 2))
        return Axis(label, unit, True, (bottom, highest * (highest / bottom) ** 0.05))
    reach = max((float(np.nanmax(top)) for top in tops if np.isfinite(top).any()), default=0.0)
    return Axis(label, unit, limits=(0.0, 1.05 * max(highest, min(reach, _BAND * highest))))


def scale_values(label: str, unit: str, values: Float[np.ndarray, "values"], apart: float) -> Axis:
    """Return an axis for finite values: logarithmic if all are positive and span at least a factor of `apart`."""
    finite = values[np.isfinite(values)]
    low, high = finite.min(initial=np.inf), finite.max(initial=0.0)
    if low <= 0 or high < apart * low:
        return Axis(label, unit)
    room = max((high / low) ** 0.05, 1.05)
    return Axis(label, unit, True, (float(low / room), float(high * room)))
