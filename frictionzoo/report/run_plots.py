"""Figures of one run: friction curves, rollouts, errors, residual torque, optimisation, errors by horizon."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure as Drawing

from frictionzoo.core.telling import say_percent
from frictionzoo.core.units import UNITS
from frictionzoo.report import with_matplotlib
from frictionzoo.report.colors import BASELINE, BEST, JOINTS, MODEL, TRAIN
from frictionzoo.report.figure import Axis, Band, Bars, Curve, Figure, Mark, Panel, Sheet, Stripe, frame, scale_values
from frictionzoo.report.rollouts import SimulatedDrive, draw_errors, draw_motion, say_where
from frictionzoo.report.text import format_number, format_unit, say_origin
from frictionzoo.result.curves import Curves
from frictionzoo.result.portrait import Portrait
from frictionzoo.result.types import Result

PHASE = 5.0  # duration in a phase plot [s]; beyond it, curves hide each other
_FIRST = {"": 0}  # first long test rollout, from the paper's evaluation (a)
REPORTED: Mapping[str, Any] = {"width": 0.0, "marker": "diamond", "size": 8.0, "color": BEST}  # reported iteration
COLUMNS = 4  # joints in a row of a picture or sheet
_OVER = {  # name of each axis, and its unit or its dimension in UNITS
    "velocity": ("velocity", "velocity"),
    "load": ("load on the gear", "torque"),
    "position": ("position", "position"),
    "temperature": ("temperature", "°C"),
}


def plot_run(result: Result, curves: Curves) -> dict[str, list[Figure]]:
    """Return all figures of one run by name; an empty list if there is nothing to show.

    In `portraits`, `phase`, `left` and `trajectories`, each joint has the same number of figures, in joint order.
    """
    shown = choose_rollouts(curves)
    return {
        "portraits": [
            _plot_portrait(result, curves, joint, over)
            for joint in range(len(result.joints))
            for over in curves.portraits
        ],
        "trajectories": list(_plot_trajectories(result, curves, shown)),
        "error": list(_plot_errors(result, curves, shown)),
        "phase": list(_plot_phases(result, curves, shown)),
        "left": list(plot_left(result, curves)),
        "history": list(plot_history(result, curves)),
        "horizons": [_plot_horizons(result)] if len(result.by_horizon) > 1 else [],
    }


def choose_rollouts(curves: Curves) -> dict[str, int]:
    """Return the indices of best, median and worst long test rollout by rank; a diverged rollout counts as worst."""
    error = np.abs(curves.qpos - curves.measured_qpos[:, 1:]).mean(axis=(1, 2))
    order = np.argsort(np.where(np.isfinite(error), error, np.inf), kind="stable").tolist()
    if len(order) == 1:
        return {"only": order[0]}
    middle = {"median": order[(len(order) - 1) // 2]} if len(order) > 2 else {}
    return {"best": order[0]} | middle | {"worst": order[-1]}


def write_figures(folder: Path, result: Result, curves: Curves) -> None:
    """Write figures 3, 4 and 5 of a run as PNG files into this folder.

    Raises:
        OutputError: A file cannot be written.
    """
    fitted = f"{_describe(result, 'fit to the training part')}\nmarked: iteration {result.fit.best_iteration}, "
    window = f"moving mean and standard deviation over {result.evaluation.window:g} s"
    tested = _describe(result, "one rollout of the test part")
    history, error = list(plot_history(result, curves)), list(_plot_errors(result, curves, _FIRST))
    sheets = {
        "figure3_parameters": Sheet(f"{fitted}as reported", history, 1.9, columns=2, headings=True),
        "figure4_trajectory": _arrange(result, curves),
        "figure5_error": Sheet(f"{tested}\n{window}", error, 3.6),
    }
    if len(curves.history["iteration"]) == 1:  # nothing was optimised
        del sheets["figure3_parameters"]
    for name, sheet in sheets.items():
        with_matplotlib.save_figure(with_matplotlib.draw(sheet), folder / f"{name}.png")


def draw_rollout(result: Result, curves: Curves) -> Drawing:
    """Return figure 4 as a matplotlib figure."""
    return with_matplotlib.draw(_arrange(result, curves))


def _arrange(result: Result, curves: Curves) -> Sheet:
    trajectories = list(_plot_trajectories(result, curves, _FIRST))
    title = _describe(result, "one rollout of the test part")
    return Sheet(title, trajectories, 6.0, columns=min(len(trajectories), COLUMNS), headings=True)


def _describe(result: Result, what: str) -> str:
    return f"{result.model}, {what} of {result.data.name} ({say_origin(result.data.origin)})"


def plot_history(result: Result, curves: Curves, color: str = MODEL) -> Iterator[Figure]:
    """Yield figure 3: loss and each identified parameter over the iterations, with the reported iteration marked.

    A model without friction parameters (a network) shows the gradient norm instead. Several joints have separate
    colours instead of `color`.
    """
    history = curves.history
    units = {f"{p.owner}.{p.name}": format_unit(p.unit) for p in result.parameters if p.identified}
    names = ["loss", *(name for name in units if name in history)]
    if "grad_norm" in history and not any(name.startswith("friction.") for name in names):
        names.append("grad_norm")
    iteration, best = history["iteration"].astype(np.float64), result.fit.best_iteration
    reported = int(np.flatnonzero(iteration == best)[0])
    for name in names:
        lines = _name_lines(result, name)
        columns = np.reshape(history[name], (len(iteration), -1)).T.astype(np.float64)[list(lines.values())]
        label, unit = name.partition(".")[2] or name, units.get(name, "")
        reached = _say_reached(columns[:, reported])
        y = Axis(unit=unit) if name in units else scale_values("", "", columns.ravel(), apart=10.0)
        marks = list(_draw_courses(iteration, dict(zip(lines, columns, strict=True)), reported, result, color))
        panel = Panel(marks, Axis("iteration"), y, note=reached if len(columns) == 1 else "")
        remark = ", one line per joint" if len(columns) > len(JOINTS) else ""
        text = f"{label} over {len(iteration)} iterations{remark}. Reported: {reached} {unit}".rstrip()
        yield Figure(label, f"{text} at iteration {best} (marked).", (panel,), small=True)


def _name_lines(result: Result, name: str) -> dict[str, int]:
    """Return the history columns by joint name; joints that share a value have one column."""
    rows = [row for p in result.parameters if f"{p.owner}.{p.name}" == name for row in p.by_joint]
    joints = {row.name: result.joints.index(row.joints[0]) for row in rows if row.identified}
    return joints if len(joints) > 1 else {"value": next(iter(joints.values()), 0)}


def _say_reached(values: np.ndarray) -> str:
    if len(values) <= len(JOINTS):
        return ", ".join(format_number(value) for value in values)
    return f"{format_number(values.min())} to {format_number(values.max())}"


def _draw_courses(
    iteration: np.ndarray, columns: Mapping[str, np.ndarray], at: int, result: Result, color: str
) -> Iterator[Mark]:
    best, several = float(iteration[at]), 1 < len(columns) <= len(JOINTS)
    points: dict[str, Any] = {"width": 0.0, "marker": "circle", "size": 4.0}
    look = points if result.fit.method == "grid" else {}
    colors = JOINTS if len(columns) > 1 else (color,)
    yield Stripe(low=best, high=best, color=BEST, dash=(4.0, 3.0))
    for i, (name, column) in enumerate(columns.items()):
        yield Curve(x=iteration, y=column, name=name, legend=several, color=colors[i % len(colors)], **look)
    reached = np.array([column[at] for column in columns.values()])
    yield Curve(x=np.full(len(columns), best), y=reached, name="reported", legend=several, **REPORTED)


def _plot_trajectories(result: Result, curves: Curves, shown: Mapping[str, int]) -> Iterator[Figure]:
    """Yield figure 4 for each joint and rollout: measured and simulated position and velocity."""
    test, timestep = result.metrics.test, result.data.timestep
    duration, count = timestep * (curves.measured_qpos.shape[1] - 1), len(curves.qpos)
    for joint, name in enumerate(result.joints):
        for rank, rollout in shown.items():
            drives = _list_drives(curves, rollout)
            panels = draw_motion(drives, joint, timestep, (test.unit, test.velocity_unit))
            errors = [drive.follow("qpos")[:, joint] - drive.measured("qpos")[:, joint] for drive in drives]
            errors_text = _say_each([_say_error(error, test.unit) for error in errors])
            place = say_where(result.data, curves, rollout)
            text = f"Measured and simulated position and velocity of joint {name} over {duration:g} s"
            text += f", {place}; " if place else "; "
            text += f"the mean position error is {errors_text}."
            which = f"The {rank} of {count} long test rollouts" if count > 1 else "The only long test rollout"
            title = f"{which}: {name}" if rank else f"Trajectory of {name}"
            yield Figure(title, text, panels, time=True, rollout=rollout)


def _plot_phases(result: Result, curves: Curves, shown: Mapping[str, int]) -> Iterator[Figure]:
    rank, rollout = list(shown.items())[(len(shown) - 1) // 2]
    model, *_ = _list_drives(curves, rollout)
    units, kept = find_units(result), slice(1 + round(PHASE / result.data.timestep))
    for joint, name in enumerate(result.joints):
        (x, y), (position, speed) = (
            [read(signal)[kept, joint] for signal in ("qpos", "qvel")] for read in (model.measured, model.follow)
        )
        marks = Curve(x=x, y=y, name="measured", width=4.5, opacity=0.3), Curve(x=position, y=speed, **model.look)
        across, up = frame([x, position]), frame([y, speed])
        axes = Axis("position", units["position"], limits=across), Axis("velocity", units["velocity"], limits=up)
        panel = Panel(marks, *axes)
        text = f"Velocity over position of {name} in the {rank} rollout, at most {PHASE:g} s. If the curves "
        text += "separate at zero velocity, the simulated drive starts or stops at another position than measured."
        yield Figure(f"Phase plot of {name}", text, (panel,))


def _list_drives(curves: Curves, rollout: int) -> list[SimulatedDrive]:
    model, baseline = {"name": "this model", "color": MODEL}, {"name": "no friction", "color": BASELINE}
    return [
        SimulatedDrive(curves, model, rollout=rollout),
        SimulatedDrive(curves, baseline, "baseline_", reference=True, rollout=rollout),
    ]


def _say_each(values: Sequence[str]) -> str:
    """Name a value of each drive in `_list_drives`."""
    model, baseline = values
    return f"{model} with the model and {baseline} without friction"


def _say_error(error: Float[np.ndarray, "samples"], unit: str) -> str:
    steps = np.abs(error[1:])
    return f"{steps.mean():.4g} {unit}" if np.isfinite(steps).all() else "undefined (diverged)"


def _plot_errors(result: Result, curves: Curves, shown: Mapping[str, int]) -> Iterator[Figure]:
    """Yield figure 5 for each rollout: moving mean +- standard deviation of the position error, mean over joints."""
    window, unit = result.evaluation.window, result.metrics.test.unit
    drawn = [_list_drives(curves, rollout) for rollout in shown.values()]
    panels = draw_errors(drawn, result.data.timestep, window, unit)
    for (rank, rollout), drives, panel in zip(shown.items(), drawn, panels, strict=True):
        largest = [f"{format_number(float(np.nanmax(drive.errors())))} {unit}" for drive in drives]
        text = (
            f"Moving mean and standard deviation over {window:g} s of the absolute position error"
            f"{f', {place}' if (place := say_where(result.data, curves, rollout)) else ''}; the largest error "
        )
        text += f"is {_say_each(largest)}."
        title = f"Error of the {rank} rollout" if rank else "Position error"
        yield Figure(title, text, (panel,), time=True, rollout=rollout)


def _plot_horizons(result: Result) -> Figure:
    entries = sorted(result.by_horizon, key=lambda entry: entry.horizon)
    unit, places = entries[0].test.unit, np.arange(len(entries), dtype=np.float64)
    parts = ("test", "test", MODEL), ("train", "train", TRAIN), ("baseline", "test, no friction", BASELINE)
    marks, width, middle = [], 0.81 / len(parts), (len(parts) - 1) / 2
    for i, (part, name, color) in enumerate(parts):
        errors = [(entry[part].position_mae, entry[part].position_mae_std) for entry in entries]
        length, spread = np.array(errors, np.float64).T
        bars = {"at": places + width * (i - middle), "length": length, "spread": spread, "width": width}
        marks.append(Bars(name=name, color=color, upright=True, **bars))
    lengths = tuple(f"{entry.horizon:g} s" for entry in entries)
    phrases = []
    for length, entry in zip(lengths, entries, strict=True):
        test, baseline = (format_number(entry[part].position_mae) for part in ("test", "baseline"))
        phrases.append(f"at {length}: {test} {unit} on test data, {baseline} {unit} without friction")
    panel = Panel(marks, Axis("rollout length", ticks=lengths), Axis("position MAE", unit))
    return Figure("Position error by horizon", f"Mean position error {'; '.join(phrases)}.", (panel,))


def save_portraits(path: Path, title: str, result: Result, curves: Curves) -> None:
    """Save a picture of friction over velocity, one panel per joint.

    Raises:
        OutputError: The file cannot be written.
    """
    joints = result.joints
    figures = [
        replace(_plot_portrait(result, curves, joint, "velocity"), title=name) for joint, name in enumerate(joints)
    ]
    sheet = Sheet(title, figures, 3.6, columns=min(len(figures), COLUMNS), headings=len(figures) > 1)
    with_matplotlib.save_figure(with_matplotlib.draw(sheet), path)


def _plot_portrait(result: Result, curves: Curves, joint: int, over: str) -> Figure:
    """Return the friction curve of a joint over an input of the model, with the friction implied by recordings."""
    units, name, (label, unit) = find_units(result), result.joints[joint], _OVER[over]
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
        return "curve of the model. The recordings imply no friction values."
    gap = portrait.implied[filled] - np.interp(portrait.where[filled], portrait.at, portrait.law)
    size = float(np.abs(portrait.implied[filled]).mean()) or 1.0
    return (
        "curve of the model, and points of the friction implied by the recorded torque in motion, as median and 10 to "
        f"90 % range in {filled.sum()} bin{'s' * bool(filled.sum() > 1)}. The medians differ from the curve by "
        f"{format_number(float(np.abs(gap).mean()))} {unit} on average, {say_percent(np.abs(gap).mean() / size)} of "
        "the friction."
    )


def plot_left(result: Result, curves: Curves) -> Iterator[Figure]:
    """Yield the residual torque of each joint over the time of the training recordings."""
    unit = find_units(result)["torque"]
    rows = {row.joint: row for row in (result.residual.by_joint if result.residual else [])}
    for joint, name in enumerate(result.joints if curves.left.size else ()):
        look: Mapping[str, Any] = {"width": 0.0, "marker": "circle", "size": 2.5, "opacity": 0.7}
        residual = Curve(x=curves.left_time, y=curves.left[:, joint], name="residual torque", color=MODEL, **look)
        size = rows[name].residual if name in rows else None
        marks = [Stripe(low=0.0, high=0.0, level=True), residual]
        x = Axis("time in the training data", "s")
        text = f"Residual torque of {name} in motion"
        text += "." if size is None else f": root mean square {format_number(size)} {unit}."
        yield Figure(f"Residual torque of {name}", text, (Panel(marks, x, Axis("torque", unit)),))


def find_units(result: Result) -> Mapping[str, str]:
    """Return the units of the run's joints by dimension."""
    return UNITS["hinge" if result.metrics.test.unit == UNITS["hinge"]["position"] else "slide"]
