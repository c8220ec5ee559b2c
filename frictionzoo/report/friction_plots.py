"""Figures of a run's friction: friction curves with the friction implied by recordings, and the residual torque."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from frictionzoo.core.params import UNITS
from frictionzoo.core.telling import say_percent
from frictionzoo.report import with_matplotlib
from frictionzoo.report.colors import MODEL
from frictionzoo.report.figure import Axis, Band, Curve, Figure, Mark, Panel, Sheet, Stripe
from frictionzoo.report.text import format_number
from frictionzoo.result.curves import Curves
from frictionzoo.result.portrait import Portrait
from frictionzoo.result.types import Result

COLUMNS = 4  # joints in a row of a picture
_OVER = {  # name of each axis, and its unit or its dimension in UNITS
    "velocity": ("velocity", "velocity"),
    "load": ("load on the gear", "torque"),
    "position": ("position", "position"),
    "temperature": ("temperature", "°C"),
}


def plot_portraits(result: Result, curves: Curves) -> Iterator[Figure]:
    """Yield friction curves of each joint over all inputs of the model, with the friction implied by recordings."""
    for joint in range(len(result["joints"])):
        for over in curves.portraits:
            yield _plot_portrait(result, curves, joint, over)


def save_portraits(path: Path, title: str, result: Result, curves: Curves) -> None:
    """Save a picture of friction over velocity, one panel per joint.

    Raises:
        OutputError: The file cannot be written.
    """
    joints = result["joints"]
    figures = [
        replace(_plot_portrait(result, curves, joint, "velocity"), title=name) for joint, name in enumerate(joints)
    ]
    sheet = Sheet(title, figures, 3.6, columns=min(len(figures), COLUMNS), headings=len(figures) > 1)
    with_matplotlib.save_figure(with_matplotlib.draw(sheet), path)


def _plot_portrait(result: Result, curves: Curves, joint: int, over: str) -> Figure:
    units, name, (label, unit) = find_units(result), result["joints"][joint], _OVER[over]
    portrait = Portrait(*(part[:, joint] for part in curves.portraits[over]))
    x = Axis(label, units.get(unit, unit))
    y = Axis("friction" if over == "velocity" else "friction opposing the motion", units["torque"])
    text = f"Friction of {name} over {label}: {_say_portrait(portrait, units['torque'])}"
    panel = Panel(list(_draw_portrait(portrait, over == "velocity")), x, y)
    return Figure(f"Friction of {name} over {label}", text, (panel,))


def _draw_portrait(portrait: Portrait, crosses: bool) -> Iterator[Mark]:
    if crosses:
        yield Stripe(low=0.0, high=0.0, level=True)
        yield Stripe(low=0.0, high=0.0)
    name = "model"
    if (bounded := np.isfinite(portrait.low)).any():
        name = "model, 95 % interval"
        grid, low, high = (part[bounded] for part in (portrait.at, portrait.low, portrait.high))
        yield Band(x=grid, low=low, high=high, name=name, color=MODEL)
    yield Curve(x=portrait.at, y=portrait.law, width=2.2, name=name, color=MODEL)
    if (filled := np.isfinite(portrait.where)).any():
        where, implied, *ends = (part[filled] for part in portrait[4:])
        look: Mapping[str, Any] = {"width": 0.0, "marker": "circle", "reach": np.stack(ends)}
        yield Curve(x=where, y=implied, name="implied by the recorded torque", **look)


def _say_portrait(portrait: Portrait, unit: str) -> str:
    filled = np.isfinite(portrait.where)
    if not filled.any():
        return "the model; the recordings determine no implied friction."
    gap = portrait.implied[filled] - np.interp(portrait.where[filled], portrait.at, portrait.law)
    size = float(np.abs(portrait.implied[filled]).mean()) or 1.0
    return (
        "the model, and the friction implied by the recorded torque in motion: its median and 10 to 90 % range in "
        f"{filled.sum()} bin{'s' * bool(filled.sum() > 1)}. The medians differ from the curve by "
        f"{format_number(float(np.abs(gap).mean()))} {unit} on average, {say_percent(np.abs(gap).mean() / size)} of "
        "the friction."
    )


def plot_left(result: Result, curves: Curves) -> Iterator[Figure]:
    """Yield the residual torque of each joint over the time of the training recordings."""
    unit = find_units(result)["torque"]
    rows = {row["joint"]: row for row in (result["residual"] or {"by_joint": []})["by_joint"]}
    for joint, name in enumerate(result["joints"] if curves.left.size else ()):
        look: Mapping[str, Any] = {"width": 0.0, "marker": "circle", "size": 2.5, "opacity": 0.7}
        residual = Curve(x=curves.left_time, y=curves.left[:, joint], name="residual torque", color=MODEL, **look)
        size = rows[name]["residual"] if name in rows else None
        marks = [Stripe(low=0.0, high=0.0, level=True), residual]
        x = Axis("time in the training data", "s")
        text = f"Residual torque of {name} in motion"
        text += "." if size is None else f": root mean square {format_number(size)} {unit}."
        yield Figure(f"Residual torque of {name}", text, (Panel(marks, x, Axis("torque", unit)),))


def find_units(result: Result) -> Mapping[str, str]:
    """Return the units of the run's joints by dimension."""
    return UNITS["hinge" if result["metrics"]["test"]["unit"] == UNITS["hinge"]["position"] else "slide"]
