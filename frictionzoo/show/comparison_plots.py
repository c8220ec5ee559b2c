"""Figures of `comparison.html`: every run in its own colour and line, the same in all of them."""

import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from frictionzoo.comparison.record import Comparison
from frictionzoo.comparison.runs import Run
from frictionzoo.comparison.statistics import MATTERS
from frictionzoo.result.evaluate import moving_mean_and_std
from frictionzoo.show.comparison_figures import COLORS
from frictionzoo.show.page import (
    DARK,
    GRID,
    MEASURED,
    SOFT,
    TEXT,
    Plot,
    draw_band,
    draw_points,
    escape,
    find_frame,
    format_number,
    make_axis,
    make_layout,
    round_points,
    spans_decades,
    with_start,
)
from frictionzoo.show.run_figures import FLATTENED

# Seven lines for six colours: each pair of both occurs once in 42 runs, and neighbours differ in both.
DASHES = ("solid", "8px,3px", "2px,3px", "10px,3px,2px,3px", "6px,2px,2px,2px,2px,2px", "15px,5px", "4px,6px")
_PALE = {"#0072B2": "#56B4E9", "#56B4E9": "#B5E0FF"}  # what two of them become on a dark page
POINTS = 2000  # of a curve; a comparison has many of them
ROW, LINE = 28, 17  # px for each run of a figure with a row a run, and for each line of its label
FRAME = 4.0  # times the middle one of the differences is what a frame shows; one beyond is named at its edge
TICK = 28  # characters of a label on one line


@dataclass(frozen=True)
class Style:
    """How a run is drawn.

    Attributes:
        color: Of its curves on a light page.
        dash: Lengths of strokes and gaps, for plotly.
        fill: Of its bands.
    """

    color: str
    dash: str
    fill: str

    @property
    def dark(self) -> str:
        """Its colour on a dark page."""
        return _PALE.get(self.color, self.color)

    @property
    def strokes(self) -> str:
        """Its dash, for SVG."""
        return "none" if self.dash == "solid" else self.dash.replace("px", "").replace(",", " ")


def choose_styles(labels: Iterable[str]) -> dict[str, Style]:
    """A style for each run.

    Args:
        labels: Of the runs, best first.
    """
    return {
        label: Style(COLORS[i % len(COLORS)], DASHES[i % len(DASHES)], _fade(COLORS[i % len(COLORS)]))
        for i, label in enumerate(labels)
    }


def dark_colors() -> dict[str, str]:
    """What each colour becomes on a dark page."""
    return DARK | _PALE | {_fade(color): _fade(pale) for color, pale in _PALE.items()}


def _fade(color: str) -> str:
    red, green, blue = (int(color[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},0.18)"


def plot_errors(comparison: Comparison, styles: Mapping[str, Style]) -> Plot:
    """Figure 6: test MAE with sigma, a bar a run, and the MAE on the training data.

    Args:
        comparison: The runs side by side.
        styles: Of the runs.
    """
    entries, unit = comparison["runs"], comparison["unit"]
    data: list[dict[str, Any]] = []
    for i, entry in enumerate(entries):
        style, test = styles[entry["label"]], entry["test"]
        error = {"array": [test["position_mae_std"]], "color": TEXT, "thickness": 1.2, "width": 4}
        shared = {"name": escape(entry["label"]), "meta": {"run": i}, "y": [i], "showlegend": False}
        data.append(
            shared
            | {"type": "bar", "orientation": "h", "width": 0.6, "x": [test["position_mae"]], "error_x": error}
            | {"marker": {"color": style.color}, "hovertemplate": f"test %{{x:.4g}} {unit}"}
        )
        data.append(
            shared
            | {"type": "scatter", "mode": "markers", "x": [entry["train"]["position_mae"]]}
            | {"marker": {"color": TEXT, "symbol": "diamond-open", "size": 9, "line": {"width": 1.8}}}
            | {"hovertemplate": f"train %{{x:.4g}} {unit}"}
        )
    horizontal = _choose_scale([[entry["test"]["position_mae"]] for entry in entries])
    layout = _layout_rows([entry["label"] for entry in entries], f"position MAE [{unit}]", **horizontal)
    layout["barmode"] = "overlay"
    labels = [entry["label"] for entry in entries]
    text = (
        f"Bars: mean absolute position error on test data [{unit}], whiskers its sigma; diamonds: on training data. "
        f"From {format_number(entries[0]['test']['position_mae'])} of {labels[0]} to "
        f"{format_number(entries[-1]['test']['position_mae'])} of {labels[-1]}."
    )
    return Plot("Error of each run", text, {"data": data, "layout": layout}, height=_height(labels))


def plot_differences(comparison: Comparison, styles: Mapping[str, Style]) -> Plot:
    """Each run's difference to the best with its interval from the paired bootstrap.

    Args:
        comparison: The runs side by side.
        styles: Of the runs.
    """
    labels, unit = [entry["label"] for entry in comparison["runs"]], comparison["unit"]
    pairs = {pair["run"]: pair for pair in comparison["pairs"] if pair["other"] == labels[0]}
    frame = _frame_differences(pairs.values())
    data: list[dict[str, Any]] = []
    notes: list[dict[str, Any]] = []
    for i, label in enumerate(labels):
        pair = pairs.get(label, {"mean": 0.0, "low": 0.0, "high": 0.0, "verdict": "best"})
        if pair["mean"] is None:
            continue
        data.append(_draw_interval(i, label, pair, styles[label], unit))
        if frame and pair["mean"] > frame[1]:
            note = {"text": f"{pair['mean']:.3g} →", "x": 1, "xref": "paper", "xanchor": "right", "y": i}
            notes.append(note | {"showarrow": False, "font": {"color": TEXT, "size": 12}})
    horizontal = {"range": frame} if frame else {}
    layout = _layout_rows(labels, f"difference to the best [{unit}]", **horizontal)
    zero = {"type": "line", "xref": "x", "x0": 0, "x1": 0, "yref": "paper", "y0": 0, "y1": 1}
    layout |= {"annotations": notes, "shapes": [zero | {"line": {"color": SOFT, "width": 1}, "layer": "below"}]}
    text = (
        f"Difference to {labels[0]} with its 95 % interval, from a paired bootstrap over "
        f"{comparison['evaluation']['rollouts']} test rollouts. Open circles are noise: the interval holds 0, or the "
        f"difference is below {100 * MATTERS:g} % of the error."
    )
    return Plot("How sure is the order?", text, {"data": data, "layout": layout}, height=_height(labels))


def _draw_interval(row: int, label: str, pair: Mapping[str, Any], style: Style, unit: str) -> dict[str, Any]:
    symbol = {"best": "diamond", "noise": "circle-open"}.get(pair["verdict"], "circle")
    return {
        "type": "scatter",
        "mode": "markers",
        "name": escape(label),
        "meta": {"run": row},
        "x": [pair["mean"]],
        "y": [row],
        "error_x": {
            "type": "data",
            "symmetric": False,
            "array": [pair["high"] - pair["mean"]],
            "arrayminus": [pair["mean"] - pair["low"]],
            "color": style.color,
            "thickness": 2,
            "width": 5,
        },
        "marker": {"color": style.color, "symbol": symbol, "size": 10, "line": {"width": 2}},
        "showlegend": False,
        "hovertemplate": f"%{{x:.3g}} {unit} ({pair['low']:.3g} to {pair['high']:.3g}), {pair['verdict']}",
    }


def _frame_differences(pairs: Iterable[Mapping[str, Any]]) -> list[float] | None:
    """Limits that keep the small intervals readable beside one that is far away; None where all fit in."""
    finite = [pair for pair in pairs if pair["mean"] is not None]
    if not finite:
        return None
    reach = FRAME * float(np.median([max(abs(pair["low"]), abs(pair["high"])) for pair in finite]))
    inside = [pair for pair in finite if pair["high"] <= reach]
    if len(inside) == len(finite) or not inside:
        return None
    low, high = min(0.0, *(pair["low"] for pair in inside)), max(0.0, *(pair["high"] for pair in inside))
    room = high - low or reach
    return round_points(np.array([low - 0.08 * room, high + 0.35 * room]))


def _layout_rows(labels: Sequence[str], title: str, **horizontal: Any) -> dict[str, Any]:
    """A row for each run, the best on top."""
    ticks = ["<br>".join(map(escape, _wrap(label))) for label in labels]
    vertical = {"tickvals": list(range(len(labels))), "ticktext": ticks, "range": [len(labels) - 0.4, -0.6]}
    layout = make_layout(
        xaxis=make_axis(title, **{"nticks": 5, "tickangle": 0} | horizontal),
        yaxis=make_axis("", **vertical, showgrid=False, fixedrange=True),
    )
    return layout | {"hovermode": "closest", "showlegend": False, "margin": {"l": 20, "r": 12, "t": 30, "b": 44}}


def _height(labels: Sequence[str]) -> int:
    row = max(ROW, LINE * max(len(_wrap(label)) for label in labels))
    return 110 + row * max(3, len(labels))


def _wrap(label: str) -> list[str]:
    """A label on at most three lines."""
    return textwrap.wrap(label, TICK, max_lines=3, placeholder=" …") or [" "]


def plot_trajectories(comparison: Comparison, runs: Sequence[Run], styles: Mapping[str, Style]) -> Iterator[Plot]:
    """Figure 4, for each joint: measured and simulated position above velocity in the first long test rollout.

    Args:
        comparison: The runs side by side.
        runs: The same runs with their curves, best first.
        styles: Of the runs.
    """
    first = runs[0].curves
    time = np.arange(first.measured_qpos.shape[1]) * comparison["data"]["timestep"]
    rows = (("qpos", "y", "position", comparison["unit"]), ("qvel", "y2", "velocity", comparison["velocity_unit"]))
    for joint, name in enumerate(comparison["joints"]):
        layout = make_layout(xaxis=make_axis("time [s]", range=[0, time[-1]], anchor="y2"))
        data: list[dict[str, Any]] = []
        for signal, axis, quantity, unit in rows:
            measured = getattr(first, f"measured_{signal}")[0, :, joint]
            curves = [with_start(measured, getattr(run.curves, signal)[0, :, joint]) for run in runs]
            data += _draw_trajectories(time, measured, dict(zip(styles, curves, strict=True)), styles, axis, unit)
            domain = [0.44, 1] if axis == "y" else [0, 0.38]
            frame = find_frame([measured, curves[0]], curves[1:])
            layout[f"yaxis{axis[1:]}"] = make_axis(f"{quantity} [{unit}]", range=frame, domain=domain)
        text = (
            f"Measured and simulated position and velocity of joint {name} over {time[-1]:g} s of test data, all "
            f"{len(runs)} runs under the same command."
        )
        yield Plot(f"Trajectory of {name}", text, {"data": data, "layout": layout}, time=True)


def _draw_trajectories(
    time: Float[np.ndarray, "samples"],
    measured: Float[np.ndarray, "samples"],
    curves: Mapping[str, Float[np.ndarray, "samples"]],
    styles: Mapping[str, Style],
    axis: str,
    unit: str,
) -> list[dict[str, Any]]:
    """The measured curve, broad and pale, behind the simulated ones, the best of them in front."""
    broad = {"line": {"color": MEASURED, "width": 5}, "opacity": 0.28, "showlegend": axis == "y"}
    back = _draw_line("measured", broad, draw_points(time, measured, POINTS), unit)
    ranked = list(enumerate(curves.items()))
    lines = [_draw_run(i, label, styles[label], draw_points(time, y, POINTS), unit) for i, (label, y) in ranked]
    return [trace | {"yaxis": axis} for trace in (back, *reversed(lines))]


def _draw_line(name: str, look: Mapping[str, Any], points: Mapping[str, Any], unit: str) -> dict[str, Any]:
    return {
        "type": "scatter",
        "mode": "lines",
        "name": escape(name),
        "hovertemplate": f"%{{y:.4g}} {unit}".rstrip(),
        **points,
        **look,
    }


def _draw_run(run: int, label: str, style: Style, points: Mapping[str, Any], unit: str, **look: Any) -> dict[str, Any]:
    line = {"line": {"color": style.color, "dash": style.dash, "width": 1.7}, "meta": {"run": run}, "showlegend": False}
    return _draw_line(label, line | look, points, unit)


def plot_error(comparison: Comparison, runs: Sequence[Run], styles: Mapping[str, Style]) -> Plot:
    """Figure 5: moving mean of the absolute position error in the first long test rollout, mean over joints.

    The band of one standard deviation belongs to the run that the page shows.

    Args:
        comparison: The runs side by side.
        runs: The same runs with their curves, best first.
        styles: Of the runs.
    """
    timestep, unit = comparison["data"]["timestep"], comparison["unit"]
    window = runs[0].result["evaluation"]["window"]
    measured = runs[0].curves.measured_qpos[0]
    errors = [np.abs(with_start(measured, run.curves.qpos[0]) - measured).mean(axis=1) for run in runs]
    vertical = _choose_scale(errors)
    data: list[dict[str, Any]] = []
    for i, (label, style) in enumerate(styles.items()):
        error = errors[i][np.isfinite(errors[i])]
        span = min(max(1, round(window / timestep)), len(error))
        mean, std = moving_mean_and_std(error, span)
        time = timestep * (np.arange(len(mean)) + (span - 1) / 2)
        band, curve = draw_band(mean, std, time, escape(label), style.color, style.fill, unit, POINTS)
        if vertical.get("type") != "log":  # where a band that reaches below 0 has no place
            data.append(band | {"meta": {"run": i, "only": True}})
        line = {"color": style.color, "dash": style.dash, "width": 1.7}
        data.append(curve | {"line": line, "meta": {"run": i}, "showlegend": False})
    duration = timestep * (len(measured) - 1)
    axes = {"xaxis": make_axis("time [s]", range=[0, duration])}
    axes["yaxis"] = make_axis(f"absolute position error [{unit}]", **{"rangemode": "tozero"} | vertical)
    text = (
        f"Moving mean over {window:g} s of the absolute position error in the same rollout; for the selected run the "
        "band of one standard deviation around it."
    )
    return Plot("Error over time", text, {"data": data, "layout": _tighten(make_layout(**axes))}, time=True)


def _choose_scale(curves: Iterable[Sequence[float | None] | Float[np.ndarray, "points"]]) -> dict[str, Any]:
    """A logarithmic axis where a linear one would hide the smaller errors beside the larger."""
    values = [np.array(curve, dtype=np.float64) for curve in curves]
    largest = [float(np.nanmax(curve)) for curve in values if np.isfinite(curve).any()]
    hidden = bool(largest) and max(largest) > FLATTENED * min(largest) > 0
    return _scale_logarithmically(np.concatenate(values)) if hidden else {}


def _scale_logarithmically(values: Float[np.ndarray, "points"]) -> dict[str, Any]:
    """A logarithmic axis with whole numbers at its ticks: each decade, or 1, 2 and 5 where there are few."""
    positive = values[np.isfinite(values) & (values > 0)]
    few = positive.max() < 100 * positive.min()
    return {"type": "log", "dtick": "D2" if few else 1, "tickformat": ".1~g"}


def plot_by_horizon(comparison: Comparison, styles: Mapping[str, Style]) -> Plot:
    """How the error grows with the length of the rollout.

    Args:
        comparison: The runs side by side.
        styles: Of the runs.
    """
    section, evaluation = comparison["by_horizon"], comparison["evaluation"]
    text = (
        f"Mean position error over the first seconds of {evaluation['long_rollouts']} test rollouts of "
        f"{evaluation['long_horizon']:g} s."
    )
    x = np.array(section["horizon"])
    return _plot_errors_over("Against the horizon", text, x, "horizon [s]", section, comparison["unit"], styles)


def plot_by_bin(comparison: Comparison, styles: Mapping[str, Style]) -> Iterator[Plot]:
    """The error of short test rollouts against the speed and against the load that were measured in them.

    Args:
        comparison: The runs side by side.
        styles: Of the runs.
    """
    for key, title, axis, unit in (
        ("by_speed", "Against the speed", "mean absolute velocity", comparison["velocity_unit"]),
        ("by_load", "Against the load", "mean absolute motor torque", comparison["torque_unit"]),
    ):
        section = comparison[key]
        windows = sum(section["windows"])
        bins = len(section["windows"])
        text = f"Position error of {windows} short test rollouts in {bins} bins of the {axis}, each with as many."
        x = np.array(section["centre"], dtype=np.float64)
        yield _plot_errors_over(title, text, x, f"{axis} [{unit}]", section, comparison["unit"], styles, marked=True)


def _plot_errors_over(
    title: str,
    text: str,
    x: Float[np.ndarray, "points"],
    horizontal: str,
    section: Mapping[str, Any],
    unit: str,
    styles: Mapping[str, Style],
    marked: bool = False,
) -> Plot:
    curves = {label: np.array(section["position_mae"][label], dtype=np.float64) for label in styles}
    look = {"mode": "lines+markers", "marker": {"size": 6}} if marked or len(x) == 1 else {}
    data = [
        _draw_run(i, label, style, draw_points(x, curves[label]), unit, **look)
        for i, (label, style) in enumerate(styles.items())
    ]
    vertical = make_axis(f"position MAE [{unit}]", **{"rangemode": "tozero"} | _choose_scale(curves.values()))
    layout = make_layout(xaxis=make_axis(horizontal, rangemode="tozero"), yaxis=vertical)
    return Plot(title, text, {"data": data, "layout": _tighten(layout)})


def _tighten(layout: dict[str, Any]) -> dict[str, Any]:
    """Without the room for a legend: the page has one for all figures."""
    return layout | {"margin": layout["margin"] | {"t": 30}, "showlegend": False}


def plot_friction(comparison: Comparison, styles: Mapping[str, Style]) -> Iterator[Plot]:
    """Friction torque against velocity, a figure a joint.

    Args:
        comparison: The runs side by side.
        styles: Of the runs.
    """
    unit = comparison["torque_unit"]
    for joint, name in enumerate(comparison["joints"]):
        data = [
            trace
            for i, (label, style) in enumerate(styles.items())
            for trace in _draw_friction(i, label, style, comparison["friction"][label], joint, unit)
        ]
        layout = make_layout(
            xaxis=make_axis(f"velocity [{comparison['velocity_unit']}]"),
            yaxis=make_axis(f"friction [{unit}]", zeroline=True, zerolinecolor=GRID),
        )
        text = (
            f"Torque of each run's friction law at joint {name}, opposing the velocity. Where it depends on more than "
            "the velocity, the curve is the median over recorded states and the band holds 80 % of them."
        )
        yield Plot(f"Friction of {name}", text, {"data": data, "layout": _tighten(layout)})


def _draw_friction(
    run: int, label: str, style: Style, curves: Mapping[str, Any], joint: int, unit: str
) -> Iterator[dict[str, Any]]:
    velocity = np.array(curves["velocity"], dtype=np.float64)
    torque, low, high = (np.array(curves[key][joint], dtype=np.float64) for key in ("torque", "low", "high"))
    if np.isfinite([low, high]).all() and not np.array_equal(low, high):
        outline = {"x": round_points(np.concatenate([velocity, velocity[::-1]]))}
        outline["y"] = round_points(np.concatenate([high, low[::-1]]))
        area = {"fill": "toself", "fillcolor": style.fill, "hoverinfo": "skip"}
        yield _draw_run(run, label, style, outline, unit, **area, line={"width": 0, "color": style.color})
    yield _draw_run(run, label, style, draw_points(velocity, torque), unit)


def plot_autocorrelation(comparison: Comparison, styles: Mapping[str, Style]) -> Plot:
    """What structure is left in the errors.

    Args:
        comparison: The runs side by side.
        styles: Of the runs.
    """
    section = comparison["autocorrelation"]
    lag, band = np.array(section["lag"], dtype=np.float64), section["band"]
    data = [
        _draw_run(i, label, style, draw_points(lag, np.array(section["coefficient"][label], dtype=np.float64)), "")
        for i, (label, style) in enumerate(styles.items())
    ]
    white = {"type": "rect", "xref": "paper", "x0": 0, "x1": 1, "y0": -band, "y1": band, "layer": "below"}
    layout = make_layout(xaxis=make_axis("lag [s]"), yaxis=make_axis("autocorrelation of the position error"))
    layout["shapes"] = [white | {"fillcolor": SOFT, "opacity": 0.45, "line": {"width": 0}}]
    text = (
        f"What one error tells about the next: a law that explains everything leaves white noise, within the grey band "
        f"(±{band:.2g}). Mean over {comparison['evaluation']['long_rollouts']} long test rollouts."
    )
    return Plot("Structure left in the error", text, {"data": data, "layout": _tighten(layout)})


def plot_loss(comparison: Comparison, runs: Sequence[Run], styles: Mapping[str, Style]) -> Plot:
    """The training loss of every fit, its reported iteration marked.

    Args:
        comparison: The runs side by side.
        runs: The same runs with their curves, best first.
        styles: Of the runs.
    """
    data: list[dict[str, Any]] = []
    losses: list[np.ndarray] = []
    for i, run in enumerate(runs):
        style, fit, history = styles[run.label], run.result["fit"], run.curves.history
        iteration, loss = history["iteration"], history["loss"]
        if fit["method"] == "grid":
            loss = np.fmin.accumulate(loss)
        losses.append(loss[np.isfinite(loss)])
        data.append(_draw_run(i, run.label, style, draw_points(iteration, loss, POINTS), ""))
        at = iteration == fit["best_iteration"]
        marker = {"mode": "markers", "marker": {"color": style.color, "size": 10, "symbol": "diamond"}}
        data.append(
            _draw_run(i, run.label, style, draw_points(iteration[at], loss[at]), "", hoverinfo="skip", **marker)
        )
        data[-1].pop("hovertemplate")
    every = np.concatenate(losses)
    scale = _scale_logarithmically(every) if spans_decades(every) else {}
    layout = make_layout(xaxis=make_axis("iteration"), yaxis=make_axis("training loss", **scale))
    text = "Training loss over the iterations, the reported one marked; of a grid search the lowest so far."
    if any(entry["option"].startswith(("loss.", "segments.")) for entry in comparison["differences"]):
        text += " Runs with other segments or another loss cannot be compared here."
    return Plot("Loss of all fits", text, {"data": data, "layout": _tighten(layout)})
