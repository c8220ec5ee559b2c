"""Figures of several runs, each in one colour and dash pattern: the paper's figures 3 to 6, and further comparisons."""

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from frictionzoo.core.output import remove_written
from frictionzoo.report import with_matplotlib
from frictionzoo.report.colors import BASELINE, BEST, GRID, RUNS, SOFT
from frictionzoo.report.figure import (
    FLATTENED,
    Axis,
    Band,
    Bars,
    Curve,
    Dash,
    Figure,
    Mark,
    Panel,
    Sheet,
    Stripe,
    scale_errors,
    scale_values,
)
from frictionzoo.report.rollouts import RUNAWAY, SimulatedDrive, draw_errors, draw_motion, say_above, say_where
from frictionzoo.report.run_plots import COLUMNS, REPORTED
from frictionzoo.report.text import format_digits, format_number, format_unit, say_origin, say_seeds, wrap
from frictionzoo.result.comparison.runs import Run
from frictionzoo.result.comparison.statistics import MATTERS
from frictionzoo.result.comparison.types import Comparison, Pair
from frictionzoo.result.names import pick_value, place_between_bounds
from frictionzoo.result.types import Metrics, ParameterRecord

# Seven dash patterns and six colours: each combination occurs once in 42 runs, and neighbours differ in both.
_BROKEN: tuple[Dash, ...] = ((6.0, 2.0, 1.2, 2.0), (3.5, 1.3, 1.2, 1.3, 1.2, 1.3), (9.0, 3.0), (2.4, 3.5))
DASHES: tuple[Dash, ...] = ((), (5.0, 2.0), (1.2, 1.6), *_BROKEN)
# Markers of parameters in a grid search.
MARKERS = ("circle", "x", "triangle-up", "cross", "square", "triangle-down", "diamond")
FRAME = 4.0  # largest difference on the axis, relative to the median one; larger ones are labelled at the edge
ROW, LINE = 28, 17  # px for each run in figures with one row per run, and for each line of its label
FORMATS = ("png", "pdf")
PIXELS = 75.0  # page pixels per inch of paper, for figures whose height depends on the number of rows

Look = Mapping[str, Any]
"""Attributes shared by the marks of one run: name, index, colour and dash."""


def choose_looks(labels: Iterable[str], reference: str | None = None) -> dict[str, Look]:
    """Return the look of each run by label, best first; only the reference has the colour of "no friction"."""
    labels = list(labels)
    colors = [color for color in RUNS if color != BASELINE] if reference in labels else RUNS
    places = {label: i for i, label in enumerate(other for other in labels if other != reference)}
    styles = {label: (colors[i % len(colors)], DASHES[i % len(DASHES)]) for label, i in places.items()}
    styles[reference or ""] = BASELINE, DASHES[-1]
    return {
        label: {"name": label, "run": i, "color": styles[label][0], "dash": styles[label][1]}
        for i, label in enumerate(labels)
    }


def plot_comparison(comparison: Comparison, runs: Sequence[Run]) -> dict[str, list[Figure]]:
    """Return all figures of several runs by name; an empty list if there is nothing to show."""
    by_label = {run.label: run for run in runs}
    ranked = [by_label[entry.label] for entry in comparison.runs]
    speed = Axis("mean absolute speed", comparison.velocity_unit)
    load = Axis("mean absolute motor torque", comparison.torque_unit)
    return {
        "parameters": list(_plot_parameters(comparison, ranked)),
        "mae": [_plot_errors(comparison)],
        "differences": [_plot_differences(comparison)] if len(runs) > 1 else [],
        "trajectories": list(_plot_trajectories(comparison, ranked)),
        "error": [_plot_error(comparison, ranked)],
        "by_horizon": [_plot_errors_over(comparison, "by_horizon", Axis("horizon", "s"))],
        "by_speed": [_plot_errors_over(comparison, "by_speed", speed)],
        "by_load": [_plot_errors_over(comparison, "by_load", load)],
        "autocorrelation": [_plot_autocorrelation(comparison)],
        "friction": list(_plot_friction(comparison)),
        "loss": [_plot_loss(comparison, ranked)],
    }


def write_figures(folder: Path, comparison: Comparison, runs: Sequence[Run], font: str = "sans") -> None:
    """Write all figures of a comparison; an older file of a figure that is now empty is removed.

    Args:
        folder: Folder of the figures.
        comparison: Comparison of the runs.
        runs: Compared runs.
        font: Font of the PDF files, which are for a paper: `sans` or `serif`. The PNG files are for a screen.

    Raises:
        OutputError: A file cannot be written.
    """
    for name, sheet in arrange(comparison, runs).items():
        for suffix in FORMATS:
            path, printed = folder / f"{name}.{suffix}", suffix == "pdf"
            if not sheet.figures:
                remove_written(path)
                continue
            with with_matplotlib.paper(font) if printed else contextlib.nullcontext():
                with_matplotlib.save_figure(with_matplotlib.draw(sheet, printed), path)


def arrange(comparison: Comparison, runs: Sequence[Run]) -> dict[str, Sheet]:
    """Return the sheet of each file; an empty figure has a sheet without figures."""
    plots, evaluation, joints = plot_comparison(comparison, runs), comparison.evaluation, len(comparison.joints)
    data = f"{comparison.data.name} ({say_origin(comparison.data.origin)})"
    fits = f"Fits to the training part of {data}\nred: the reported iteration and its values; axis from the lower "
    fits += "to the upper bound of each parameter, logarithmic if both are positive"
    single = f"One rollout of the test part of {data}"
    window = f"moving mean and standard deviation over {runs[0].result.evaluation.window:g} s"
    short = f"{evaluation.rollouts} rollouts of {evaluation.horizon:g} s, {data}"
    long = f"Mean over {evaluation.long_rollouts} rollouts of the test part of {data}"
    windows = sum(comparison.by_speed.windows)
    local = f"{windows} short rollouts over the test part of {data}, in bins of equal count"
    friction = f"Friction identified from {data}\nband: 10 % to 90 % of recorded states, if friction depends on more"
    names = max((len(figure.panels[0].marks) // 2 for figure in plots["parameters"]), default=0)
    rows = (plots["mae"][0].height or 0) / PIXELS
    columns = min(joints, COLUMNS)
    return {
        "figure3_parameters": Sheet(
            fits, plots["parameters"], 2.1 + with_matplotlib.LINE * names, 2 if joints == 1 else columns, apart=True
        ),
        "figure4_trajectories": Sheet(single, plots["trajectories"], 5.4, columns, headings=True),
        "figure5_error": Sheet(f"{single}\n{window}", plots["error"], 3.4),
        "figure6_mae": Sheet(f"{short}\nmean and standard deviation over rollouts", plots["mae"], rows),
        "error_by_horizon": Sheet(long, plots["by_horizon"], 3.0),
        "error_by_speed": Sheet(local, plots["by_speed"], 3.0),
        "error_by_load": Sheet(local, plots["by_load"], 3.0),
        "friction": Sheet(f"{friction} than the velocity", plots["friction"], 3.2, columns, headings=True),
        "autocorrelation": Sheet(long, plots["autocorrelation"], 3.0),
        "differences": Sheet(f"{short}\nmean of paired differences and its 95 % interval", plots["differences"], rows),
    }


def _looks(comparison: Comparison) -> dict[str, Look]:
    return choose_looks((run.label for run in comparison.runs), comparison.reference)


def _numbers(values: Iterable[float | None]) -> Float[np.ndarray, "values"]:
    """Return values from JSON as an array, NaN for null."""
    return np.array(list(values), dtype=np.float64)


def _plot_parameters(comparison: Comparison, runs: Sequence[Run]) -> Iterator[Figure]:
    """Yield figure 3 for each run and joint: parameters over the iterations, between their bounds as units differ."""
    joints, looks = comparison.joints, _looks(comparison)
    for run in (run for run in runs if _identified(run)):
        for joint, name in enumerate(joints):
            where = f", {name}" if len(joints) > 1 else ""
            network = f" ({run.result.network.weights} weights not shown)" if run.result.network else ""
            grid = run.result.fit.method == "grid"
            marks = _draw_parameters(run, name, joint, looks[run.label]["color"])
            first, last = (float(end) for end in run.curves.history["iteration"][[0, -1]])
            room = 0.02 * (last - first) + 0.5
            x = Axis("combination" if grid else "iteration", limits=(first - room, last + room))
            yield Figure(f"{run.label}{where}{network}", "", (Panel(marks, x, Axis("between the bounds", "%")),))


def _draw_parameters(run: Run, name: str, joint: int, color: str) -> list[Mark]:
    history, fit = run.curves.history, run.result.fit
    grid, best = fit.method == "grid", float(fit.best_iteration)
    loss = np.where(np.isnan(history["loss"]), np.inf, history["loss"])
    better = np.flatnonzero(loss < np.concatenate([[np.inf], np.minimum.accumulate(loss)[:-1]]))
    shown = better if grid else slice(None)
    iteration = history["iteration"][shown].astype(np.float64)
    marks: list[Mark] = [Stripe(low=best, high=best, color=BEST, dash=(4.0, 3.0))]
    for i, (key, parameter) in enumerate(_identified(run).items()):
        if (row := pick_value(parameter, name)) is None:
            continue
        curve = np.reshape(history[key], (len(history["iteration"]), -1))[shown, joint].astype(np.float64)
        curve, reached = (100 * place_between_bounds(row, values) for values in (curve, np.array([row.value])))
        points = {"width": 0.0, "marker": MARKERS[i % len(MARKERS)], "size": 5.0}
        look: dict[str, Any] = points if grid else {"dash": DASHES[i % len(DASHES)]}
        label = f"{parameter.name} = {row.value:.4g} {format_unit(parameter.unit)}".rstrip()
        marks.append(Curve(x=iteration, y=curve, name=label, color=color, **look))
        marks.append(Curve(x=np.array([best]), y=reached, **REPORTED))
    return marks


def _identified(run: Run) -> dict[str, ParameterRecord]:
    """Return the identified parameters that have a history, by their names in it."""
    parameters = {f"{parameter.owner}.{parameter.name}": parameter for parameter in run.result.parameters}
    return {key: value for key, value in parameters.items() if value.identified and key in run.curves.history}


def _plot_trajectories(comparison: Comparison, runs: Sequence[Run]) -> Iterator[Figure]:
    """Yield figure 4 for each joint: measured and simulated position and velocity in the first long test rollout."""
    drives, timestep = _list_drives(comparison, runs), comparison.data.timestep
    duration = timestep * (runs[0].curves.measured_qpos.shape[1] - 1)
    for joint, name in enumerate(comparison.joints):
        panels = draw_motion(drives, joint, timestep, (comparison.unit, comparison.velocity_unit))
        place = say_where(comparison.data, runs[0].curves, 0) or "test data"
        text = f"Measured and simulated position and velocity of joint {name} over {duration:g} s of {place}. "
        text += "The command is the same for all runs."
        yield Figure(f"Trajectory of {name}", text, panels, time=True)


def _list_drives(comparison: Comparison, runs: Sequence[Run]) -> list[SimulatedDrive]:
    looks, reference = _looks(comparison), comparison.reference
    return [SimulatedDrive(run.curves, looks[run.label], reference=run.label == reference) for run in runs]


def _plot_error(comparison: Comparison, runs: Sequence[Run]) -> Figure:
    """Return figure 5: moving mean +- one standard deviation of the position error in the first long test rollout."""
    window = runs[0].result.evaluation.window
    text = f"Moving mean over {window:g} s of the absolute position error in the same rollout. "
    text += "Band: one standard deviation, for the selected run."
    drives, timestep = _list_drives(comparison, runs), comparison.data.timestep
    (panel,) = draw_errors([drives], timestep, window, comparison.unit)
    return Figure("Error over time", text, (panel,), time=True)


def _plot_errors(comparison: Comparison) -> Figure:
    """Return figure 6: MAE and sigma on test and training data, two bars per run."""
    entries, unit, looks = comparison.runs, comparison.unit, _looks(comparison)
    key, ends = {"at": np.zeros(1), "length": np.full(1, np.nan), "notes": ("",)}, [0.0]
    marks: list[Mark] = []
    for part, offset in (("test", -0.2), ("train", 0.2)):
        shared: dict[str, Any] = {"width": 0.38, "pale": part == "train"}
        marks.append(Bars(name=part, color=SOFT, **key, **shared))  # for the legend
        for i, entry in enumerate(entries):
            mean, spread = (_numbers([entry[part][key]]) for key in ("position_mae", "position_mae_std"))
            seeds = say_seeds(entry.seeds) if part == "test" else ""
            notes = (f"{part} {_say_error(entry[part])}" + (f", {seeds}" if seeds else ""),)
            bar = {"at": np.array([i + offset]), "length": mean, "spread": spread, "notes": notes}
            marks.append(Bars(**bar, **shared, **looks[entry.label]))
            ends.append(float((mean + spread)[0]))
    labels, x = [*looks], Axis("position MAE", unit, limits=(0.0, 1.05 * _limit(np.array(ends), FLATTENED)))
    text = (
        f"Bars: position MAE on test data [{unit}]; whiskers: its sigma; pale: training data. "
        f"From {format_number(entries[0].test.position_mae)} ({labels[0]}) to "
        f"{format_number(entries[-1].test.position_mae)} ({labels[-1]})."
    )
    return _arrange_rows("Error of each run", text, marks, x, labels)


def _say_error(metrics: Metrics) -> str:
    mean, spread = metrics.position_mae, metrics.position_mae_std
    if mean is None or spread is None:
        return "all diverged"
    diverged = f", {metrics.diverged} of {metrics.rollouts} diverged" if metrics.diverged else ""
    return f"{format_digits(mean, 3)} ± {format_digits(spread, 2)}{diverged}"


def _limit(sizes: Float[np.ndarray, "rows"], widest: float) -> float:
    """Return the largest size that is at most `widest` times the median: larger ones would flatten the others."""
    sizes = np.sort(sizes[np.isfinite(sizes) & (sizes > 0)])
    return float(sizes[sizes <= widest * sizes[(len(sizes) - 1) // 2]][-1]) if len(sizes) else 1.0


def _arrange_rows(title: str, text: str, marks: Sequence[Mark], x: Axis, labels: Sequence[str]) -> Figure:
    """Return a figure with one row per run, the best at the top."""
    y = Axis(ticks=tuple(labels), limits=(len(labels) - 0.4, -0.6))
    row = max(ROW, LINE * max(len(wrap(label, 28)) for label in labels))
    return Figure(title, text, (Panel(marks, x, y),), height=110 + row * max(3, len(labels)))


def _plot_differences(comparison: Comparison) -> Figure:
    looks, unit = _looks(comparison), comparison.unit
    labels = [*looks]
    pairs = {pair.run: pair for pair in comparison.pairs if pair.other == labels[0]}
    marks: list[Mark] = [Stripe(low=0.0, high=0.0, color=SOFT)]
    for i, label in enumerate(labels):
        pair = pairs.get(label)
        marker = "diamond" if pair is None else "circle-open" if pair.verdict == "noise" else "circle"
        x, *ends = (_numbers([pair[key] if pair else 0.0]) for key in ("mean", "low", "high"))
        note = _say_difference(pair) if pair else "best"
        point = {"width": 0.0, "marker": marker, "size": 10.0, "notes": (note,)}
        marks.append(Curve(x=x, y=np.array([float(i)]), ends=np.array(ends), **looks[label], **point))
    text = (
        f"Difference to {labels[0]} with its 95 % interval, from a paired bootstrap over "
        f"{comparison.evaluation.rollouts} test rollouts. Open circles: noise, the interval contains 0 or the "
        f"difference is below {100 * MATTERS:g} % of the error."
    )
    low, high = (np.array([0.0, *_numbers(pair[end] for pair in pairs.values())]) for end in ("low", "high"))
    limit = _limit(np.maximum(-low, high), FRAME)
    limits = 1.1 * max(-limit, min(np.nanmin(low), -0.1 * limit)), 1.1 * limit
    x_axis = Axis("MAE above the best", unit, limits=limits)
    return _arrange_rows("Differences to the best run", text, marks, x_axis, labels)


def _say_difference(pair: Pair) -> str:
    numbers = [format_digits(end, 2) for end in (pair.mean, pair.low, pair.high) if end is not None]
    interval = f"{numbers[0]} [{numbers[1]}, {numbers[2]}]" if len(numbers) == 3 else "diverged"
    return f"{interval}, {pair.verdict}"


def _plot_errors_over(
    comparison: Comparison, section: Literal["by_horizon", "by_speed", "by_load"], axis: Axis
) -> Figure:
    evaluation, errors_of = comparison.evaluation, comparison[section]
    if section == "by_horizon":
        x, marker = _numbers(errors_of.horizon), ""
        text = f"Mean position error over the first seconds of {evaluation.long_rollouts} test rollouts of "
        text += f"{evaluation.long_horizon:g} s."
    else:
        x, marker, windows = _numbers(errors_of.centre), "circle", errors_of.windows
        text = f"Position error of {sum(windows)} short test rollouts in {len(windows)} bins of the {axis.label} with "
        text += "equal counts."
    errors = {label: _numbers(values) for label, values in errors_of.position_mae.items()}
    points: dict[str, Any] = {"marker": "circle" if len(x) == 1 else marker, "size": 5.0}
    marks = [Curve(x=x, y=errors[label], **points, **look) for label, look in _looks(comparison).items()]
    y = scale_errors("position MAE", comparison.unit, list(errors.values()), (), RUNAWAY)
    shown = replace(axis, limits=(0.0, 1.02 * float(x.max(initial=0.0)) or 1.0))
    panel = Panel(marks, shown, y, say_above(marks, y))
    return Figure(f"Error by {section.removeprefix('by_')}", text, (panel,))


def _plot_friction(comparison: Comparison) -> Iterator[Figure]:
    for joint, name in enumerate(comparison.joints):
        marks: list[Mark] = [Stripe(low=0.0, high=0.0, level=True, color=GRID)]
        for label, look in _looks(comparison).items():
            law = comparison.friction[label]
            torque, low, high = (_numbers(law[part][joint]) for part in ("torque", "low", "high"))
            velocity = _numbers(law.velocity)
            if np.isfinite([low, high]).all() and not np.array_equal(low, high):
                marks.append(Band(x=velocity, low=low, high=high, **look))
            marks.append(Curve(x=velocity, y=torque, **look))
        x, y = Axis("velocity", comparison.velocity_unit), Axis("friction", comparison.torque_unit)
        text = f"Friction torque of each run at joint {name}, opposing the velocity. If it depends on more than the "
        text += "velocity, the curve is the median over recorded states and the band contains 80 % of them."
        yield Figure(f"Friction of {name}", text, (Panel(marks, x, y),))


def _plot_autocorrelation(comparison: Comparison) -> Figure:
    section = comparison.autocorrelation
    lag, band = _numbers(section.lag), section.band
    noise = {"level": True, "name": "white noise, 95 %", "color": SOFT, "opacity": 0.3}
    coefficients = ((look, section.coefficient[label]) for label, look in _looks(comparison).items())
    curves = [Curve(x=lag, y=_numbers(coefficient), **look) for look, coefficient in coefficients]
    text = "Autocorrelation of the position error: a complete model leaves white noise, within the grey "
    text += f"band (±{band:.2g}). Mean over {comparison.evaluation.long_rollouts} long test rollouts."
    marks = [Stripe(low=-band, high=band, **noise), *curves]
    panel = Panel(marks, Axis("lag", "s"), Axis("autocorrelation of the error", "1"))
    return Figure("Autocorrelation of the error", text, (panel,))


def _plot_loss(comparison: Comparison, runs: Sequence[Run]) -> Figure:
    marks: list[Curve] = []
    looks = _looks(comparison)
    for run in runs:
        fit, history, look = run.result.fit, run.curves.history, looks[run.label]
        iteration, loss = history["iteration"].astype(np.float64), history["loss"]
        loss = np.fmin.accumulate(loss) if fit.method == "grid" else loss
        reported = iteration == fit.best_iteration
        marks.append(Curve(x=iteration, y=loss, **look))
        marks.append(Curve(x=iteration[reported], y=loss[reported], **{**REPORTED, **look, "name": ""}))
    text = "Training loss over the iterations; the reported iteration is marked. Grid search: lowest loss so far."
    if any(entry.option.startswith(("loss.", "segments.")) for entry in comparison.differences):
        text += " Runs with different segments or losses are not comparable here."
    y = scale_values("training loss", "", np.concatenate([mark.y for mark in marks]), apart=10.0)
    return Figure("Training loss", text, (Panel(marks, Axis("iteration"), y),))
