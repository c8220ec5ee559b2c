"""A friction law over velocity, with the band around it."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from frictionzoo.show import with_matplotlib
from frictionzoo.show.colors import GRID, MODEL
from frictionzoo.show.figure import Axis, Band, Curve, Figure, Mark, Panel, Sheet, Stripe

COLUMNS = 4  # joints beside each other

Torque = Float[np.ndarray, "points"]


def draw_law(velocity: Torque, torque: Torque, low: Torque, high: Torque, look: Mapping[str, Any]) -> Iterator[Mark]:
    """The curve of one joint's law, and the band where it has one.

    Args:
        velocity: Where [rad/s or m/s].
        torque: What opposes the motion there [N m or N].
        low: Lower end of the band; NaN for none.
        high: Upper end.
        look: What its marks have in common.
    """
    if np.isfinite([low, high]).all() and not np.array_equal(low, high):
        yield Band(x=velocity, low=low, high=high, **look)
    yield Curve(x=velocity, y=torque, **look)


def zero() -> Mark:
    """The line at which there is no torque."""
    return Stripe(low=0.0, high=0.0, level=True, color=GRID)


def save_law(
    path: Path,
    title: str,
    joints: Sequence[str],
    velocity: Torque,
    curves: Sequence[Float[np.ndarray, "points nv"]],
    units: tuple[str, str],
) -> None:
    """A picture of a law, a panel a joint.

    Args:
        path: Of the file, PNG or PDF.
        title: Above it.
        joints: Their names.
        velocity: Where [rad/s or m/s].
        curves: Torque, and lower and upper end of its band [N m or N]; NaN where a joint is not drawn.
        units: Of velocity and torque.

    Raises:
        OutputError: It cannot be written.
    """
    figures = []
    for at, name in enumerate(joints):
        known = np.isfinite(curves[0][:, at])
        torque, low, high = (curve[known, at] for curve in curves)
        marks = [zero(), *draw_law(velocity[known], torque, low, high, {"color": MODEL})]
        figures.append(Figure(name, "", (Panel(marks, Axis("velocity", units[0]), Axis("friction", units[1])),)))
    sheet = Sheet(title, figures, 3.6, columns=min(len(figures), COLUMNS), headings=len(figures) > 1)
    with_matplotlib.save_figure(with_matplotlib.draw(sheet), path)
