"""What is drawn, described once: `with_matplotlib` makes a file of it, `with_plotly` what a page shows."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from frictionzoo.show.colors import MEASURED

FLATTENED = 20.0  # ratio of two curves' largest values from which a linear axis hides the smaller one
FEW = 100.0  # ratio of the ends of a logarithmic axis below which it has ticks at 1, 2 and 5
_BAND = 1.5  # times the largest of an error's moving mean is as high as a band around it is shown

Dash = tuple[float, ...]
"""Lengths of strokes and gaps in widths of the line; empty for a solid one."""


@dataclass(frozen=True, kw_only=True)
class Mark:
    """What all marks have.

    Attributes:
        name: What it is called in a legend and under the pointer, which passes over a mark without one.
        color: On paper and on a light page.
        dash: Of its line.
        opacity: From 0 to 1.
        run: Place of the run that it belongs to, which a page may bring to the front; None for none.
        legend: Whether a legend names it.
        notes: What is said of each of its values.
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
    """A line, or points, with or without intervals.

    Attributes:
        x: Where on the horizontal axis.
        y: Values, NaN where there is none.
        width: Of the line [px of a page]; 0 for points alone.
        marker: Of the points, as plotly names it; empty for none.
        size: Of the points [px of a page].
        ends: Lower and upper ends of intervals along the horizontal axis.
        reach: Lower and upper ends of whiskers along the vertical axis.
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
    """The pale area between two curves, which no legend names; `selected` where a page's front run alone has it."""

    x: Float[np.ndarray, "points"]
    low: Float[np.ndarray, "points"]
    high: Float[np.ndarray, "points"]
    selected: bool = False


@dataclass(frozen=True, kw_only=True)
class Stripe(Mark):
    """All between two values of an axis, the vertical one where `level`; a line across where they are the same."""

    low: float
    high: float
    level: bool = False


@dataclass(frozen=True, kw_only=True)
class Bars(Mark):
    """Bars from 0, along the horizontal axis unless they stand upright.

    Attributes:
        at: Their places on the other axis.
        length: Their lengths, NaN where there is none.
        width: On the other axis.
        spread: Half the length of the whisker at the end of each.
        upright: Whether they stand.
        pale: Whether they are pale, and hatched on paper.
    """

    at: Float[np.ndarray, "bars"]
    length: Float[np.ndarray, "bars"]
    width: float
    spread: Float[np.ndarray, "bars"] | None = None
    upright: bool = False
    pale: bool = False


@dataclass(frozen=True)
class Axis:
    """An axis of a panel.

    Attributes:
        label: What it shows.
        unit: In which unit.
        log: Whether it is logarithmic.
        limits: Its first and its last value; None for those of the marks.
        ticks: Names of the values 0, 1, 2 and so on, in place of numbers.
    """

    label: str = ""
    unit: str = ""
    log: bool = False
    limits: tuple[float, float] | None = None
    ticks: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """Label and unit."""
        return f"{self.label} [{self.unit}]" if self.label and self.unit else self.label or self.unit

    @property
    def few(self) -> bool:
        """Whether a logarithmic axis has ticks between the powers of ten."""
        return self.limits is not None and bool(self.limits[1] < FEW * self.limits[0])


@dataclass(frozen=True)
class Panel:
    """Marks on a pair of axes.

    Attributes:
        marks: From the one at the back to the one in front; of several runs, the first is in front on paper.
        x: The horizontal axis.
        y: The vertical axis.
        note: A few words above it.
        share: Of the height of its figure, relative to the other panels.
        magnified: Limits of both axes of a stretch that is magnified on paper, where one cannot zoom.
    """

    marks: Sequence[Mark]
    x: Axis
    y: Axis
    note: str = ""
    share: float = 1.0
    magnified: tuple[tuple[float, float], tuple[float, float]] | None = None


@dataclass(frozen=True)
class Figure:
    """One figure: a panel, or several above each other with the same horizontal axis.

    Attributes:
        title: Its heading.
        text: Its content in a few sentences, also for those who do not see it.
        panels: From the top down.
        time: Whether the horizontal axis is the time of a rollout, which all such figures of a page share.
        rollout: Which of the run's long test rollouts it is over; None for none of them alone.
        height: On a page [px], where it is not that of the others.
        small: Whether it is one of many small ones on a page.
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
    """Figures that are printed together.

    Attributes:
        title: Above all of them.
        figures: With as many panels each.
        height: Of a row of figures [inch].
        columns: Figures beside each other.
        headings: Whether the figures' titles are printed.
        apart: Whether each figure has its own legend above it instead of one below for all.
    """

    title: str
    figures: Sequence[Figure]
    height: float
    columns: int = 1
    headings: bool = False
    apart: bool = False


def list_named(panel: Panel) -> Iterator[Mark]:
    """Marks that a legend may name: not bands, nor runs that a row names already."""
    for mark in panel.marks:
        if mark.legend and mark.name and not isinstance(mark, Band) and (mark.run is None or not panel.y.ticks):
            yield mark


def list_rows(panel: Panel) -> Iterator[tuple[float, float, str]]:
    """Of a panel with rows: place of each value, the value, and what is said of it."""
    for mark in panel.marks if panel.y.ticks else ():
        if isinstance(mark, Curve | Bars):
            rows, values = (mark.y, mark.x) if isinstance(mark, Curve) else (mark.at, mark.length)
            yield from zip(rows.tolist(), values.tolist(), mark.notes, strict=True)


def frame(
    shown: Sequence[Float[np.ndarray, "points"]], others: Sequence[Float[np.ndarray, "points"]] = ()
) -> tuple[float, float]:
    """Limits of a vertical axis: a drive without friction may run away, and leave the frame.

    Args:
        shown: Curves that are seen whole, NaN where they have ended.
        others: Curves that may take half as much room again above and below.
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
    """An axis for errors: from 0 upwards, logarithmic where one curve would flatten another.

    Args:
        label: What they are.
        unit: Their unit.
        curves: The errors.
        tops: Upper ends of bands around them, which may leave the frame.
        widest: How many times larger a curve may grow than the smallest one does; one beyond that leaves the frame.
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
    """An axis for values: logarithmic where they are positive and the largest is `apart` times the smallest.

    NaN and infinities do not count.
    """
    finite = values[np.isfinite(values)]
    low, high = finite.min(initial=np.inf), finite.max(initial=0.0)
    if low <= 0 or high < apart * low:
        return Axis(label, unit)
    room = max((high / low) ** 0.05, 1.05)
    return Axis(label, unit, True, (float(low / room), float(high * room)))
