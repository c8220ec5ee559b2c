"""Motion and errors of simulated drives in one long test rollout."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from frictionzoo.report.figure import Axis, Band, Curve, Mark, Panel, frame, scale_errors
from frictionzoo.result.curves import Curves
from frictionzoo.result.evaluate import moving_mean_and_std
from frictionzoo.result.types import Data

LARGEST = 1e100  # limit of drawn positions [rad or m] and velocities
RUNAWAY = 1000.0  # ratio of two drives' largest errors above which a logarithmic axis hides how the others differ
INSET = 0.08  # initial share of the rollout in the inset
MAGNIFIED = 6.0  # range of the measured curve in the inset, at most, relative to the largest difference of the curves
NARROWEST = 0.01  # smallest share of the rollout in the inset
_SIGNALS = (("qpos", "position", 3.0), ("qvel", "velocity", 2.0))


@dataclass(frozen=True)
class SimulatedDrive:
    """Simulated drive in one long test rollout.

    Attributes:
        look: Attributes shared by its marks.
        part: `baseline_` for the run's drive without friction.
        reference: Whether it has no friction and may run away.
    """

    curves: Curves
    look: Mapping[str, Any]
    part: str = ""
    reference: bool = False
    rollout: int = 0

    def measured(self, signal: str) -> Float[np.ndarray, "states nv"]:
        """Return recorded `qpos` or `qvel`."""
        return getattr(self.curves, f"measured_{signal}")[self.rollout].astype(np.float64)

    def follow(self, signal: str) -> Float[np.ndarray, "states nv"]:
        """Return simulated `qpos` or `qvel`, from the measured initial state on; NaN once it is too large to draw."""
        simulated = getattr(self.curves, f"{self.part}{signal}")[self.rollout].astype(np.float64)
        curve = np.concatenate([self.measured(signal)[:1], simulated])
        kept = np.logical_and.accumulate((np.abs(curve) < LARGEST).all(axis=1))
        return np.where(kept[:, None], curve, np.nan)

    def errors(self) -> Float[np.ndarray, "states"]:
        """Return the absolute position error, mean over joints; NaN after divergence."""
        return np.abs(self.follow("qpos") - self.measured("qpos")).mean(axis=1)


def say_where(data: Data, curves: Curves, rollout: int) -> str:
    """Return recording and start time of a long test rollout; empty if the run did not store them."""
    if not len(curves.begins):
        return ""
    names = [log.name for log in data.logs if log.part == "test"]
    return f"{names[int(curves.recording[rollout])]} from {curves.begins[rollout]:.4g} s on"


def draw_motion(
    drives: Sequence[SimulatedDrive], joint: int, timestep: float, units: Sequence[str]
) -> tuple[Panel, Panel]:
    """Return panels of measured and simulated position and velocity of one joint, in these units.

    On paper, an inset magnifies the stretch where the drives with friction differ most. All drives follow the same
    command, sampled every `timestep` [s]; the axes show the first drive completely.
    """
    panels: list[Panel] = []
    for (signal, quantity, share), unit in zip(_SIGNALS, units, strict=True):
        measured = drives[0].measured(signal)[:, joint]
        curves = [drive.follow(signal)[:, joint] for drive in drives]
        time = timestep * np.arange(len(measured))
        recorded = Curve(x=time, y=measured, name="measured", width=4.5, opacity=0.3)
        drawn = [Curve(x=time, y=curve, **drive.look) for drive, curve in zip(drives, curves, strict=True)]
        y = Axis(quantity, unit, limits=frame([measured, curves[0]], curves[1:]))
        friction = [curve for drive, curve in zip(drives, curves, strict=True) if not drive.reference]
        magnified = None if panels else _magnify(time, measured, friction)
        panels.append(Panel([recorded, *reversed(drawn)], _over(time[-1]), y, share=share, magnified=magnified))
    return panels[0], panels[1]


def draw_errors(
    shown: Sequence[Sequence[SimulatedDrive]], timestep: float, window: float, unit: str
) -> Iterator[Panel]:
    """Yield panels with moving mean +- one standard deviation of the absolute position error, on one scale.

    `shown` has the drives of each panel, under the same command; `timestep` and the moving `window` are in s.
    """
    drawn = [_draw_errors(drives, timestep, window) for drives in shown]
    means = [mean for _, series, _ in drawn for mean in series]
    tops = [top for *_, series in drawn for top in series]
    y = scale_errors("absolute position error", unit, means, tops, RUNAWAY if len(shown[0]) > 2 else np.inf)
    for drives, (marks, *_) in zip(shown, drawn, strict=True):
        duration = timestep * (drives[0].curves.measured_qpos.shape[1] - 1)
        yield Panel(marks, _over(duration), y, say_above(marks, y))


def _draw_errors(
    drives: Sequence[SimulatedDrive], timestep: float, window: float
) -> tuple[list[Mark], list[np.ndarray], list[np.ndarray]]:
    """Return marks of a rollout's errors, the moving means, and the upper ends of their bands."""
    marks: list[Mark] = []
    means, tops = [], []
    for drive in drives:
        error = drive.errors()
        finite = error[np.isfinite(error)]
        width = min(max(1, round(window / timestep)), len(finite))
        mean, std = moving_mean_and_std(finite, width)
        time = timestep * (np.arange(len(mean)) + (width - 1) / 2)
        selected = "run" in drive.look
        marks.append(Band(x=time, low=mean - std, high=mean + std, selected=selected, **drive.look))
        marks.append(Curve(x=time, y=mean, **drive.look))
        means.append(mean)
        tops.append(mean + std)
    return marks, means, tops


def say_above(marks: Sequence[Mark], y: Axis) -> str:
    """Return a note that names curves above the frame; empty for none."""
    top = y.limits[1] if y.limits else np.inf
    curves = {mark.name: mark.y[np.isfinite(mark.y)] for mark in marks if isinstance(mark, Curve)}
    above = [name for name, curve in curves.items() if len(curve) and curve.min() > top]
    return f"above the frame: {', '.join(above)}" if above else ""


def _over(duration: float) -> Axis:
    return Axis("time", "s", limits=(0.0, float(duration)))


def _magnify(
    time: np.ndarray, measured: np.ndarray, curves: Sequence[np.ndarray]
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return limits of both axes of the stretch where curves that stay near the measured one differ most."""
    extent = np.ptp(measured) or 1.0
    finite = [curve for curve in curves if np.isfinite(curve).all()]
    close = [curve for curve in finite if np.abs(curve - measured).max() <= extent] or finite
    spread = np.ptp(close if len(close) > 1 else [measured, *close], axis=0)
    centre, share = int(np.argmax(spread)), INSET
    while True:
        half = max(2, round(share * len(time) / 2))
        start = min(max(0, centre - half), max(0, len(time) - 2 * half - 1))
        part = slice(start, start + 2 * half + 1)
        # Narrow enough to show the difference of the curves.
        if share <= NARROWEST or np.ptp(measured[part]) <= MAGNIFIED * spread[centre]:
            break
        share /= 2
    return (float(time[part][0]), float(time[part][-1])), frame([curve[part] for curve in (measured, *close)])
