"""The paper's figures 3 to 6 for several runs, and what else tells them apart, as PNG and PDF."""

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, NullFormatter

from frictionzoo.comparison.record import Comparison, position_error
from frictionzoo.comparison.runs import Run
from frictionzoo.result.evaluate import moving_mean_and_std
from frictionzoo.show.run_figures import (
    BEST,
    COLUMN,
    FLATTENED,
    INSET,
    MEASURED,
    WIDTH,
    cut_divergence,
    limit_frame,
    magnify,
    save_figure,
    scale_errors,
    tidy,
)

FORMATS = ("png", "pdf")
# Okabe and Ito (2008) without black, which is measured, and yellow, faint on paper. As many lines as make each pair of
# colour and line occur once in 42 runs, and neighbours differ in both.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
LINES = (
    "-",
    (0, (5, 2)),
    (0, (1.2, 1.2)),
    (0, (7, 2, 1.5, 2)),
    (0, (3, 1.5, 1, 1.5, 1, 1.5)),
    (0, (10, 3)),
    (0, (2, 3)),
)
POINTS = ("o", "x", "^", "+", "s", "v", "D")  # of parameters in a grid search
MEASURED_LINE: Mapping[str, Any] = {"color": MEASURED, "alpha": 0.3, "linewidth": 3.5}
TRAIN: Mapping[str, Any] = {"alpha": 0.45, "hatch": "////"}
NOISE: Mapping[str, Any] = {"facecolor": "black", "alpha": 0.15, "linewidth": 0}
RUNAWAY = 1000.0  # ratio of two runs' largest errors from which a logarithmic axis hides how others differ
MAGNIFIED = 6.0  # times the largest difference of the curves is what the measured one may move in the inset
NARROWEST = 0.01  # share of the trajectory in the inset
ROW, LINE = 0.42, 0.17  # inches for each run of a figure with a row a run, and for each line of its name
TICK, PANEL, LEGEND = 30, 45, 100  # characters on one line: at an axis, over a small panel, in a legend

Style = Mapping[str, Any]


def write_figures(folder: Path, comparison: Comparison, runs: Sequence[Run]) -> None:
    """All figures of a comparison, each as PNG and as PDF.

    A figure with nothing to show, such as parameters where no run has any, is not written, and an older one removed.

    Args:
        folder: Where to write them.
        comparison: The runs side by side.
        runs: The same runs with their curves.

    Raises:
        OutputError: They cannot be written.
    """
    figures = {
        "figure3_parameters": draw_parameters(comparison, runs),
        "figure4_trajectories": draw_trajectories(comparison, runs),
        "figure5_error": draw_error(comparison, runs),
        "figure6_mae": draw_mae(comparison),
        "error_by_horizon": draw_error_by_horizon(comparison),
        "error_by_speed": draw_error_by_bin(comparison, "by_speed"),
        "error_by_load": draw_error_by_bin(comparison, "by_load"),
        "friction": draw_friction(comparison),
        "autocorrelation": draw_autocorrelation(comparison),
        "differences": draw_differences(comparison),
    }
    paths = {name: [folder / f"{name}.{suffix}" for suffix in FORMATS] for name in figures}
    drawn = {name: figure for name, figure in figures.items() if figure}
    for name, figure in drawn.items():
        for path in paths[name]:
            save_figure(figure, path)
    for name in figures.keys() - drawn.keys():
        for path in paths[name]:
            path.unlink(missing_ok=True)


def choose_styles(labels: Iterable[str]) -> dict[str, Style]:
    """Colour and line of each run, the same in every figure.

    Args:
        labels: Of the runs, best first.
    """
    return {
        label: {"color": COLORS[i % len(COLORS)], "linestyle": LINES[i % len(LINES)]} for i, label in enumerate(labels)
    }


def draw_parameters(comparison: Comparison, runs: Sequence[Run]) -> Figure | None:
    """Figure 3: identified parameters over the iterations of each fit, the best iteration and its values marked.

    A panel for each run and joint. Of a grid search, the combinations that were better than all before are drawn as
    points. None without parameters.

    Args:
        comparison: The runs side by side.
        runs: The same runs with their curves.
    """
    joints = comparison["joints"]
    shown = [run for run in _rank(comparison, runs) if _identified(run)]
    if not shown:
        return None
    columns = min(2, len(shown)) if len(joints) == 1 else len(joints)
    rows = -(-len(shown) * len(joints) // columns)
    tallest = max(len(_identified(run)) for run in shown)
    figure = Figure(figsize=(_width(columns), 0.6 + rows * (2.1 + LINE * tallest)), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    styles = choose_styles(_labels(comparison))
    for place, axes in enumerate(panels):
        if place >= len(shown) * len(joints):
            axes.set_axis_off()
            continue
        run, joint = shown[place // len(joints)], place % len(joints)
        _draw_history(axes, run, joint, styles[run.label])
        where = f", {joints[joint]}" if len(joints) > 1 else ""
        network = f" ({run.result['network']['weights']} weights not shown)" if run.result["network"] else ""
        axes.get_legend().set_title(_name(run.label + where + network, PANEL))
    figure.suptitle(
        f"Fits to the training part of {_describe_data(comparison)}\nred: the best iteration and what it identified",
        fontsize="medium",
    )
    return figure


def _draw_history(axes: Axes, run: Run, joint: int, style: Style) -> None:
    """The parameters of one joint, a line each, with the best iteration and its values in red."""
    history, fit = run.curves.history, run.result["fit"]
    grid = fit["method"] == "grid"
    shown = _improvements(history["loss"]) if grid else slice(None)
    values = []
    for i, (name, parameter) in enumerate(_identified(run).items()):
        curve = np.reshape(history[name], (len(history["iteration"]), -1))[shown, joint]
        value = float(np.ravel(parameter["value"])[joint])
        label = _name(f"{parameter['name']} = {value:.4g} {parameter['unit']}", LEGEND)
        points = {"linestyle": "none", "marker": POINTS[i % len(POINTS)], "markersize": 4}
        line = {"linestyle": LINES[i % len(LINES)], "linewidth": 1.4}
        axes.plot(history["iteration"][shown], curve, color=style["color"], label=label, **(points if grid else line))
        axes.plot(fit["best_iteration"], value, "o", color=BEST, markeredgecolor="white", markersize=6, zorder=3)
        values.append(curve)
    _scale_values(axes, np.concatenate(values))
    axes.axvline(fit["best_iteration"], color=BEST, linestyle="--", linewidth=1.2)
    first, last = history["iteration"][[0, -1]]
    axes.set_xlim(first - 0.02 * (last - first) - 0.5, last + 0.02 * (last - first) + 0.5)
    axes.set_xlabel("combination" if grid else "iteration")
    axes.set_ylabel("value [unit as named]")
    axes.legend(loc="lower left", bbox_to_anchor=(-0.02, 1.0), alignment="left", frameon=False, fontsize="x-small")
    tidy(axes)


def _identified(run: Run) -> dict[str, Mapping[str, Any]]:
    """The parameters that the fit chose and whose course it kept, by their names in the history."""
    parameters = {f"{parameter['owner']}.{parameter['name']}": parameter for parameter in run.result["parameters"]}
    return {key: value for key, value in parameters.items() if value["identified"] and key in run.curves.history}


def _improvements(loss: Float[np.ndarray, "iterations"]) -> Int[np.ndarray, "improvements"]:
    """Combinations with a lower loss than all before."""
    loss = np.where(np.isnan(loss), np.inf, loss)
    return np.flatnonzero(loss < np.concatenate([[np.inf], np.minimum.accumulate(loss)[:-1]]))


def _scale_values(axes: Axes, values: Float[np.ndarray, "values"]) -> None:
    """Logarithmic, since parameters differ in size; linear where a value is not positive."""
    positive = values[np.isfinite(values) & (values > 0)]
    if len(positive) == 0 or (values <= 0).any():
        return
    decades = np.log10(positive.max() / positive.min())
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if decades < 2 else (1.0,)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())


def draw_trajectories(comparison: Comparison, runs: Sequence[Run]) -> Figure:
    """Figure 4: position and velocity of the first long test rollout, measured and of each run; a column a joint.

    An inset magnifies the stretch where the runs are furthest apart, not counting the one without friction.

    Args:
        comparison: The runs side by side.
        runs: The same runs with their curves.
    """
    joints, styles = comparison["joints"], choose_styles(_labels(comparison))
    figure = Figure(figsize=(_width(len(joints)), 6.0), layout="constrained")
    panels = figure.subplots(2, len(joints), sharex=True, squeeze=False, height_ratios=(3, 2))
    ranked = _rank(comparison, runs)
    time = np.arange(ranked[0].curves.measured_qpos.shape[1]) * comparison["data"]["timestep"]
    for row, signal in zip(panels, ("qpos", "qvel"), strict=True):
        measured = getattr(ranked[0].curves, f"measured_{signal}")[0]
        paths = {run.label: _with_start(measured, getattr(run.curves, signal)[0]) for run in ranked}
        for joint, axes in enumerate(row):
            curves = {label: path[:, joint] for label, path in paths.items()}
            close = _find_close(measured[:, joint], curves, comparison["reference"])
            draw = partial(_draw_paths, time=time, measured=measured[:, joint], curves=curves, styles=styles)
            draw(axes, slice(None), kept=[])
            if signal == "qpos":
                centre, share = _find_difference(measured[:, joint], close)
                magnify(axes, time, centre, share, 0.2, partial(draw, kept=close))
                axes.set_title(_name(joints[joint], TICK), fontsize="medium")
    _label_trajectories(panels, comparison)
    _finish(figure, comparison, [Line2D([], [], **MEASURED_LINE)], ["measured"])
    figure.suptitle(f"One rollout of the test part of {_describe_data(comparison)}", fontsize="medium")
    return figure


def _with_start(
    measured: Float[np.ndarray, "states nv"], simulated: Float[np.ndarray, "steps nv"]
) -> Float[np.ndarray, "states nv"]:
    return cut_divergence(np.concatenate([measured[:1], simulated]))


def _find_close(
    measured: Float[np.ndarray, "states"], curves: Mapping[str, Float[np.ndarray, "states"]], reference: str | None
) -> list[Float[np.ndarray, "states"]]:
    """Curves that stay in sight of the measured one to the end, without the drive that has no friction."""
    sight = np.ptp(measured) or 1.0
    others = [curve for label, curve in curves.items() if label != reference]
    return [curve for curve in others if np.isfinite(curve).all() and np.abs(curve - measured).max() <= sight]


def _find_difference(
    measured: Float[np.ndarray, "states"], close: Sequence[Float[np.ndarray, "states"]]
) -> tuple[int, float]:
    """The sample at which the curves are furthest apart, and how wide a stretch around it lets one see that."""
    spread = np.ptp(close if len(close) > 1 else [measured, *close], axis=0)
    centre, share = int(np.argmax(spread)), INSET
    while share > NARROWEST and _travel(measured, centre, share) > MAGNIFIED * spread[centre]:
        share /= 2
    return centre, share


def _travel(measured: Float[np.ndarray, "states"], centre: int, share: float) -> float:
    half = round(share * len(measured) / 2)
    return float(np.ptp(measured[max(0, centre - half) : centre + half + 1]))


def _draw_paths(
    axes: Axes,
    shown: slice,
    time: Float[np.ndarray, "states"],
    measured: Float[np.ndarray, "states"],
    curves: Mapping[str, Float[np.ndarray, "states"]],
    styles: Mapping[str, Style],
    kept: Sequence[Float[np.ndarray, "states"]],
) -> None:
    axes.plot(time[shown], measured[shown], **MEASURED_LINE)
    _draw_curves(axes, time[shown], {label: curve[shown] for label, curve in curves.items()}, styles)
    axes.set_xlim(time[shown][0], time[shown][-1])
    limit_frame(axes, [measured[shown], *(curve[shown] for curve in kept)])
    tidy(axes)


def _label_trajectories(panels: np.ndarray, comparison: Comparison) -> None:
    for row, quantity, unit in zip(panels, ("position", "velocity"), ("unit", "velocity_unit"), strict=True):
        for axes in row:
            axes.set_ylabel(f"{quantity} [{comparison[unit]}]")
    for axes in panels[-1]:
        axes.set_xlabel("time [s]")


def draw_error(comparison: Comparison, runs: Sequence[Run]) -> Figure:
    """Figure 5: absolute position error in the first long test rollout, moving mean and +- one standard deviation.

    Args:
        comparison: The runs side by side.
        runs: The same runs with their curves.
    """
    figure = Figure(figsize=(WIDTH, 4.0), layout="constrained")
    axes = figure.subplots()
    styles, timestep = choose_styles(_labels(comparison)), comparison["data"]["timestep"]
    window = runs[0].result["evaluation"]["window"]
    means = {}
    for run in _rank(comparison, runs):
        error = cut_divergence(position_error(run)[0][:, None])[:, 0]
        width = min(max(1, round(window / timestep)), len(error))
        mean, std = moving_mean_and_std(error, width)
        centre = (1 + np.arange(len(mean)) + (width - 1) / 2) * timestep
        axes.fill_between(centre, mean - std, mean + std, color=styles[run.label]["color"], alpha=0.15, linewidth=0)
        means[run.label] = mean
    _draw_curves(axes, centre, means, styles)
    axes.set_xlim(0, len(error) * timestep)
    _label_errors(axes, comparison, "absolute position error", "time [s]")
    figure.suptitle(
        f"One rollout of the test part of {_describe_data(comparison)}\n"
        f"moving mean and standard deviation over {window:g} s",
        fontsize="medium",
    )
    _finish(figure, comparison)
    return figure


def draw_mae(comparison: Comparison) -> Figure:
    """Figure 6: position MAE on test data as bars, with the standard deviation over rollouts; on training data beside.

    Args:
        comparison: The runs side by side.
    """
    labels = _labels(comparison)
    figure, axes = _rows(labels)
    ends = []
    for part, offset, looks in (("test", -0.2, {"alpha": 1.0}), ("train", 0.2, TRAIN)):
        mean, std = (
            _numbers(run[part][key] for run in comparison["runs"]) for key in ("position_mae", "position_mae_std")
        )
        rows = np.arange(len(labels)) + offset
        colors = [style["color"] for style in choose_styles(labels).values()]
        axes.barh(rows, mean, height=0.38, color=colors, edgecolor="black", linewidth=0.5, **looks)
        axes.errorbar(mean, rows, xerr=std, fmt="none", ecolor="black", elinewidth=1, capsize=2.5)
        for row, run in zip(rows, comparison["runs"], strict=True):
            _write_beside(axes, float(row), _describe_error(run[part]))
        ends.append(mean + std)
    axes.set_xlim(0, 1.05 * _limit(np.concatenate(ends)))
    axes.set_xlabel(f"position MAE [{comparison['unit']}]")
    handles = [Patch(facecolor="grey", edgecolor="black"), Patch(facecolor="grey", edgecolor="black", **TRAIN)]
    figure.legend(handles, ["test", "train"], loc="outside lower center", ncols=2, fontsize="small")
    figure.suptitle(f"{_describe_rollouts(comparison)}\nmean and standard deviation over rollouts", fontsize="medium")
    return figure


def draw_error_by_horizon(comparison: Comparison) -> Figure:
    """How the position error grows over the first seconds of the long test rollouts.

    Args:
        comparison: The runs side by side.
    """
    figure = Figure(figsize=(WIDTH, 3.6), layout="constrained")
    axes, table = figure.subplots(), comparison["by_horizon"]
    _draw_curves(axes, _numbers(table["horizon"]), table["position_mae"], choose_styles(_labels(comparison)))
    _label_errors(axes, comparison, "position MAE", "horizon [s]")
    rollouts = comparison["evaluation"]["long_rollouts"]
    figure.suptitle(
        f"Mean over {rollouts} rollouts of the test part of {_describe_data(comparison)}", fontsize="medium"
    )
    _finish(figure, comparison)
    return figure


def draw_error_by_bin(comparison: Comparison, section: str) -> Figure:
    """Position error of short test rollouts in bins of the measured speed or load.

    Args:
        comparison: The runs side by side.
        section: `by_speed` or `by_load`.
    """
    figure = Figure(figsize=(WIDTH, 3.6), layout="constrained")
    axes, table = figure.subplots(), comparison[section]
    styles = {label: {**style, "marker": "o"} for label, style in choose_styles(_labels(comparison)).items()}
    _draw_curves(axes, _numbers(table["centre"]), table["position_mae"], styles)
    quantity, unit = {"by_speed": ("speed", "velocity_unit"), "by_load": ("motor torque", "torque_unit")}[section]
    _label_errors(axes, comparison, "position MAE", f"mean absolute {quantity} [{comparison[unit]}]")
    windows = sum(table["windows"])
    figure.suptitle(
        f"{windows} short rollouts over the test part of {_describe_data(comparison)}, in bins of equal number",
        fontsize="medium",
    )
    _finish(figure, comparison, [], [], marker="o")
    return figure


def draw_friction(comparison: Comparison) -> Figure:
    """Friction torque over velocity, a panel a joint; a band where it depends on more than the velocity.

    Args:
        comparison: The runs side by side.
    """
    joints, styles = comparison["joints"], choose_styles(_labels(comparison))
    figure = Figure(figsize=(_width(len(joints)), 3.8), layout="constrained")
    for joint, axes in enumerate(figure.subplots(1, len(joints), squeeze=False)[0]):
        for label in reversed(_labels(comparison)):
            law = comparison["friction"][label]
            velocity, low, high = (
                _numbers(values) for values in (law["velocity"], law["low"][joint], law["high"][joint])
            )
            if not np.array_equal(low, high, equal_nan=True):
                axes.fill_between(velocity, low, high, color=styles[label]["color"], alpha=0.2, linewidth=0)
            _draw_curves(axes, velocity, {label: law["torque"][joint]}, styles)
        axes.set_title(_name(joints[joint], TICK), fontsize="medium")
        axes.set_xlabel(f"velocity [{comparison['velocity_unit']}]")
        axes.set_ylabel(f"friction [{comparison['torque_unit']}]")
        tidy(axes)
    figure.suptitle(
        f"Friction identified from {_describe_data(comparison)}\n"
        "band: 10 % to 90 % of recorded states, where friction depends on more than the velocity",
        fontsize="medium",
    )
    _finish(figure, comparison)
    return figure


def draw_autocorrelation(comparison: Comparison) -> Figure:
    """Autocorrelation of the position errors, and the band in which white noise would lie.

    Args:
        comparison: The runs side by side.
    """
    figure = Figure(figsize=(WIDTH, 3.6), layout="constrained")
    axes, table = figure.subplots(), comparison["autocorrelation"]
    axes.axhspan(-table["band"], table["band"], **NOISE)
    _draw_curves(axes, _numbers(table["lag"]), table["coefficient"], choose_styles(_labels(comparison)))
    axes.set_xlabel("lag [s]")
    axes.set_ylabel("autocorrelation of the error [1]")
    tidy(axes)
    rollouts = comparison["evaluation"]["long_rollouts"]
    figure.suptitle(
        f"Mean over {rollouts} rollouts of the test part of {_describe_data(comparison)}", fontsize="medium"
    )
    _finish(figure, comparison, [Patch(**NOISE)], ["white noise, 95 %"])
    return figure


def draw_differences(comparison: Comparison) -> Figure | None:
    """How much larger each run's test error is than the best one's, with 95 % intervals; None for a single run.

    Args:
        comparison: The runs side by side.
    """
    best, *others = _labels(comparison)
    if not others:
        return None
    pairs = {pair["run"]: pair for pair in comparison["pairs"] if pair["other"] == best}
    mean, low, high = (_numbers(pairs[label][key] for label in others) for key in ("mean", "low", "high"))
    styles = choose_styles(_labels(comparison))
    figure, axes = _rows(others)
    axes.axvline(0, color="black", linewidth=0.8)
    for row, label in enumerate(others):
        interval = [[mean[row] - low[row]], [high[row] - mean[row]]]
        axes.errorbar(mean[row], row, xerr=interval, fmt="o", color=styles[label]["color"], capsize=4, elinewidth=1.8)
        _write_beside(axes, float(row), _describe_difference(pairs[label]))
    limit = _limit(np.maximum(np.abs(low), np.abs(high)))
    beyond = np.flatnonzero(mean > 1.1 * limit)
    axes.plot(np.ones(len(beyond)), beyond, "k>", transform=axes.get_yaxis_transform(), clip_on=False)
    axes.set_xlim(1.1 * max(-limit, min(np.nanmin(low, initial=0.0), -0.1 * limit)), 1.1 * limit)
    axes.set_xlabel(f"position MAE above that of {_name(best, TICK)} [{comparison['unit']}]")
    figure.suptitle(
        f"{_describe_rollouts(comparison)}\nmean of paired differences and its 95 % interval", fontsize="medium"
    )
    return figure


def _labels(comparison: Comparison) -> list[str]:
    return [run["label"] for run in comparison["runs"]]


def _rank(comparison: Comparison, runs: Sequence[Run]) -> list[Run]:
    by_label = {run.label: run for run in runs}
    return [by_label[label] for label in _labels(comparison)]


def _numbers(values: Iterable[float | None]) -> Float[np.ndarray, "values"]:
    """What JSON holds, NaN for null."""
    return np.array(list(values), dtype=np.float64)


def _name(text: str, width: int) -> str:
    """A user's text on lines of this width, and not as mathematics."""
    return textwrap.fill(text, width).replace("$", r"\$")


def _describe_data(comparison: Comparison) -> str:
    data = comparison["data"]
    return _name(f"{data['name']} ({'simulated' if data['simulated'] else 'real'} data)", LEGEND)


def _describe_rollouts(comparison: Comparison) -> str:
    evaluation = comparison["evaluation"]
    return f"{evaluation['rollouts']} rollouts of {evaluation['horizon']:g} s, {_describe_data(comparison)}"


def _describe_error(metrics: Mapping[str, Any]) -> str:
    if metrics["position_mae"] is None:
        return "all diverged"
    lost = f", {metrics['diverged']} of {metrics['rollouts']} diverged" if metrics["diverged"] else ""
    return f"{_round(metrics['position_mae'], 3)} \u00b1 {_round(metrics['position_mae_std'], 2)}{lost}"


def _describe_difference(pair: Mapping[str, Any]) -> str:
    if pair["mean"] is None:
        return f"diverged, {pair['verdict']}"
    mean, low, high = (_round(pair[key], 2) for key in ("mean", "low", "high"))
    return f"{mean} [{low}, {high}], {pair['verdict']}"


def _round(value: float, digits: int) -> str:
    """With so many significant digits, also where the last ones are 0."""
    return f"{value:#.{digits}g}".rstrip(".")


def _width(columns: int) -> float:
    return max(WIDTH, COLUMN * columns)


def _limit(sizes: Float[np.ndarray, "rows"]) -> float:
    """The largest size that does not flatten most of the others."""
    sizes = np.sort(sizes[np.isfinite(sizes) & (sizes > 0)])
    return float(sizes[sizes <= FLATTENED * sizes[(len(sizes) - 1) // 2]][-1]) if len(sizes) else 1.0


def _draw_curves(
    axes: Axes,
    abscissa: Float[np.ndarray, "points"],
    curves: Mapping[str, Iterable[float | None]],
    styles: Mapping[str, Style],
) -> None:
    """A line a run, the best on top."""
    for label in reversed([label for label in styles if label in curves]):
        axes.plot(abscissa, _numbers(curves[label]), label=label, linewidth=1.4, markersize=3, **styles[label])


def _label_errors(axes: Axes, comparison: Comparison, error: str, abscissa: str) -> None:
    scale_errors(axes, room=0.05, widest=RUNAWAY)
    top = axes.get_ylim()[1]
    errors = {str(line.get_label()): np.asarray(line.get_ydata(), np.float64) for line in axes.get_lines()}
    above = [_name(label, TICK) for label, error in errors.items() if (error > top).any() and not (error <= top).any()]
    if above:
        axes.set_title(f"above the frame: {', '.join(above)}", loc="right", fontsize="small")
    axes.set_xlabel(abscissa)
    axes.set_ylabel(f"{error} [{comparison['unit']}]")
    tidy(axes)


def _rows(labels: Sequence[str]) -> tuple[Figure, Axes]:
    """A panel with a row a run, the best at the top."""
    names = [_name(label, TICK) for label in labels]
    height = max(ROW, LINE * max(1 + name.count("\n") for name in names))
    figure = Figure(figsize=(WIDTH, 1.7 + height * len(labels)), layout="constrained")
    axes = figure.subplots()
    axes.set_yticks(range(len(labels)), names)
    axes.set_ylim(len(labels) - 0.4, -0.6)
    axes.grid(axis="x", alpha=0.3)
    axes.set_axisbelow(True)
    return figure, axes


def _write_beside(axes: Axes, row: float, text: str) -> None:
    """Numbers to the right of the frame, so that they can be read where a bar leaves it."""
    axes.text(1.02, row, text, transform=axes.get_yaxis_transform(), va="center", fontsize="x-small")


def _finish(
    figure: Figure, comparison: Comparison, handles: Sequence[Any] = (), names: Sequence[str] = (), **looks: Any
) -> None:
    """A legend of all runs below the panels, and what else is drawn; the figure grows by its height."""
    styles = choose_styles(_labels(comparison))
    names = [*names, *(_name(label, LEGEND) for label in styles)]
    handles = [*handles, *(Line2D([], [], markersize=3, **style, **looks) for style in styles.values())]
    longest = max(len(line) for name in names for line in name.splitlines())
    columns = int(np.clip(LEGEND * figure.get_figwidth() / WIDTH // (longest + 8), 1, len(names)))
    lines = max(1, -(-sum(1 + name.count("\n") for name in names) // columns))
    figure.set_figheight(figure.get_figheight() + 0.1 + 0.2 * lines)
    figure.legend(handles, names, loc="outside lower center", ncols=columns, fontsize="small", handlelength=3.5)
