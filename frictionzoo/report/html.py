"""`report.html`: one run on one page that opens without a network, from the answer down to the curves behind it."""

import html
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Shaped
from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from plotly.offline import get_plotlyjs

from frictionzoo.evaluate import Prediction, moving_mean_and_std
from frictionzoo.output import write_atomically
from frictionzoo.report.figures import BASELINE, BEST, FLATTENED, JOINTS, MODEL
from frictionzoo.report.terminal import ERRORS
from frictionzoo.types import Segments

POINTS = 4000  # largest number of points of a curve; a screen has fewer columns of pixels
DIGITS = 6  # significant digits of a point, about what float32 holds
OVERFIT = 1.5  # ratio of test to train error from which the page asks for caution
FALLING = 0.01  # share of the loss that the last tenth of the iterations may still take off
MEASURED, TEXT, SOFT, GRID, TRAIN = "#000000", "#3d4450", "#7d8794", "#dfe3e8", "#009E73"
BANDS = {MODEL: "rgba(0,114,178,0.2)", BASELINE: "rgba(230,159,0,0.25)"}
DARK = {  # what each colour becomes on a dark page; all others are legible on both
    MEASURED: "#f4f4f4",
    MODEL: "#56B4E9",
    "#56B4E9": "#0072B2",
    BEST: "#ff6b6b",
    TEXT: "#c3c9d2",
    GRID: "#323945",
    BANDS[MODEL]: "rgba(86,180,233,0.25)",
}
METHODS = {"adam": "Adam", "lm": "Levenberg-Marquardt", "grid": "The grid search"}
FILES = {  # what else a run leaves behind, by path beside the page
    "result.json": "every number of this page, for programs",
    "identified.xml": "the test stand with the identified drive, for MuJoCo",
    "friction.safetensors": "the friction law's values or weights",
    "figures/figure3_parameters.png": "parameters over iterations, as an image",
    "figures/figure4_trajectory.png": "the trajectory, as an image",
    "figures/figure5_error.png": "its error, as an image",
    "tensorboard/": "the course of the fit and its result, for TensorBoard",
    "csv/": "the course of the fit and its result, as tables and text",
    "wandb/": "the course of the fit and its result, for Weights & Biases",
    "mlflow/": "the course of the fit and its result, for MLflow",
    "checkpoints/": "what an interrupted run goes on from",
    ".hydra/config.yaml": "the configuration of the run",
}


@dataclass(frozen=True)
class Check:
    """One reason to trust the result, or to doubt it.

    Attributes:
        state: `good`, `note`, `caution` or `bad`.
        title: What was looked at.
        text: What was seen, in plain sentences.
    """

    state: str
    title: str
    text: str


@dataclass(frozen=True)
class Plot:
    """One figure of the page.

    Attributes:
        title: Its heading.
        text: Its content in one sentence, the alternative for those who do not see it.
        figure: `data` and `layout` of plotly.js.
        time: Whether its horizontal axis is the time of the rollout, which all such figures share.
    """

    title: str
    text: str
    figure: dict[str, Any]
    time: bool = False


def write_report(
    path: Path,
    result: Mapping[str, Any],
    *,
    segments: Segments,
    model: Prediction,
    baseline: Prediction,
    joints: tuple[str, ...],
    history: Mapping[str, Shaped[np.ndarray, "iterations ..."]],
    window: float,
) -> None:
    """Write the page of a run.

    Args:
        path: The file, in the run's folder, to whose other files the page links.
        result: What `result.json` holds.
        segments: One measured window; of several, the first is drawn.
        model: Of the identified drive, over that window.
        baseline: Of the bench without friction.
        joints: Names of the joints.
        history: `iteration`, `loss`, and values under `bench.NAME` and `friction.NAME`.
        window: Length of the moving window over the error [s].

    Raises:
        OutputError: It cannot be written.
    """
    checks = list(check_result(result, history))
    sections = {
        "rollout": [
            *plot_trajectory(result, segments, model, baseline, joints),
            plot_error(result, segments, model, baseline, window),
        ],
        "history": list(plot_history(result, history, joints)),
        "horizons": [plot_horizons(result)] if len(result["by_horizon"]) > 1 else [],
    }
    page = _template().render(
        result=result,
        joints=joints if any(isinstance(p["value"], list) for p in result["parameters"]) else ("value",),
        headline=_say_headline(result),
        checks=checks,
        doubts=sum(check.state in ("caution", "bad") for check in checks),
        errors=list(_list_errors(result["metrics"])),
        evaluations=list(_list_evaluations(result)),
        timing=_list_timing(result["timing"]),
        files={name: text for name, text in FILES.items() if name == "result.json" or (path.parent / name).exists()},
        sections=sections,
        figures=[plot.figure for plots in sections.values() for plot in plots],
        dark=DARK,
        plotly=get_plotlyjs().replace("</script", "<\\/script"),
    )
    write_atomically(path, page.encode())


@cache
def _template() -> Template:
    environment = Environment(
        loader=PackageLoader("frictionzoo", "report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"number": _number, "unit": _unit, "place": _place, "change": _change}
    return environment.get_template("report.html.jinja")


def check_result(
    result: Mapping[str, Any], history: Mapping[str, Shaped[np.ndarray, "iterations ..."]]
) -> Iterator[Check]:
    """What speaks for the result and what against it.

    Args:
        result: What `result.json` holds.
        history: With the `loss` of each iteration.
    """
    yield _check_gain(result)
    yield _check_held_out(result["data"])
    yield _check_train(result["metrics"])
    yield _check_fit(result["fit"], history["loss"])
    yield _check_bounds(result)
    yield _check_divergence(result)
    yield _check_origin(result["data"])


def _check_gain(result: Mapping[str, Any]) -> Check:
    test, baseline = (result["metrics"][part]["position_mae"] for part in ("test", "baseline"))
    if result["model"] == "baseline":
        return Check("note", "Gain", "This model is the drive without friction: it is compared with itself.")
    if test is None:
        return Check("bad", "Gain", "There is no test error: every test rollout diverged.")
    if not baseline:
        return Check("note", "Gain", "The drive without friction has no test error to compare with.")
    if test >= baseline:
        text = "On test data the model is no better than a drive without friction. Do not use its friction."
        return Check("bad", "Gain", text)
    text = f"On test data the model's position error is {baseline / test:.3g} times smaller than without friction."
    return Check("good", "Gain", text)


def _check_held_out(data: Mapping[str, Any]) -> Check:
    seconds = {
        part: data["timestep"] * sum(log["samples"] for log in data["logs"] if log["part"] == part)
        for part in ("train", "test")
    }
    hashes = {part: {log["sha256"] for log in data["logs"] if log["part"] == part} for part in ("train", "test")}
    text = f"The fit saw {seconds['train']:.3g} s of data and was tested on {seconds['test']:.3g} s that it did not see"
    if hashes["train"] & hashes["test"]:
        return Check("good", "Held-out data", f"{text}, another stretch of time of the same recording.")
    return Check("good", "Held-out data", f"{text}, from other recordings.")


def _check_train(metrics: Mapping[str, Any]) -> Check:
    train, test = (metrics[part]["position_mae"] for part in ("train", "test"))
    if train is None or test is None or train == 0:
        return Check("caution", "Test against train", "Test and training error cannot be compared: one is missing.")
    unit = metrics["test"]["unit"]
    text = f"The test error, {_number(test)} {unit}, is {test / train:.2g} times that on the training data"
    if test > OVERFIT * train:
        why = "the fit may have learnt its own data by heart, or the test data ask for more"
        return Check("caution", "Test against train", f"{text}: {why}.")
    return Check("good", "Test against train", f"{text}: no sign of overfitting.")


def _check_fit(fit: Mapping[str, Any], loss: Shaped[np.ndarray, "iterations"]) -> Check:
    method, count = METHODS.get(fit["method"], fit["method"]), fit["iterations"]
    kept = f"iteration {fit['best_iteration']}, that of the lowest training loss, is reported"
    match fit["stopped"]:
        case "converged":
            return Check("good", "Fit", f"{method} converged after {count} iterations; {kept}.")
        case "finished" if fit["method"] == "grid":
            return Check("good", "Fit", f"The grid search tried all of its {count} combinations; the best is reported.")
        case "finished" if fit["method"] == "lm":
            text = f"{method} made all of its {count} iterations without converging; {kept}. Raise fit.iterations."
            return Check("caution", "Fit", text)
        case "finished":
            text = f"{method} made all of its {count} iterations; {kept}."
            falling = _still_falling(loss)
            if falling > FALLING:
                text += f" The last tenth still took {100 * falling:.2g} % off the loss: more iterations may find more."
            return Check("caution" if falling > FALLING else "good", "Fit", text)
        case "patience":
            return Check("good", "Fit", f"{method} stopped after {count} iterations, as the loss fell no more; {kept}.")
        case "diverged":
            text = f"{method} diverged after {count} iterations; {kept}. Lower its step or start from other values."
            return Check("bad", "Fit", text)
        case other:
            return Check("bad", "Fit", f"{method} was {other} after {count} iterations; {kept}.")


def _still_falling(loss: Shaped[np.ndarray, "iterations"]) -> float:
    """Share by which the last tenth of the iterations lowered the lowest loss."""
    finite = np.where(np.isfinite(loss), loss, np.inf).astype(np.float64)
    before = finite[: len(finite) - len(finite) // 10].min(initial=np.inf)
    return 1 - float(finite.min() / before) if np.isfinite(before) and before > 0 else 0.0


def _check_bounds(result: Mapping[str, Any]) -> Check:
    identified = [parameter for parameter in result["parameters"] if parameter["identified"]]
    ended = [
        f"{p['owner']}.{p['name']} ended at a bound of [{_number(p['low'])}, {_number(p['high'])}] {_unit(p['unit'])}"
        for p in identified
        if p["at_bound"]
    ]
    if ended:
        return Check("caution", "Bounds", f"{'; '.join(ended)}. Widen the bounds or doubt the model.")
    return Check("good", "Bounds", f"No identified parameter, of {len(identified)}, ended at a bound.")


def _check_divergence(result: Mapping[str, Any]) -> Check:
    names = {"test": "test", "train": "training", "model": "test", "baseline": "frictionless test"}
    judged = [(names[part], entry[part]) for entry in result["by_horizon"] for part in ("test", "train", "baseline")]
    judged += [(names[part], metrics) for part, metrics in result["paper"]["a"].items()]
    lost = [(name, metrics) for name, metrics in judged if metrics["diverged"]]
    if not lost:
        total = sum(metrics["rollouts"] for _, metrics in judged)
        return Check("good", "Stability", f"All {total} rollouts stayed finite and count in the errors.")
    counts = [f"{m['diverged']} of {m['rollouts']} {name} rollouts of {m['horizon']:g} s" for name, m in lost]
    own = any(name != names["baseline"] for name, _ in lost)
    return Check(
        "bad" if own else "caution", "Stability", f"Diverged, and left out of the errors: {'; '.join(counts)}."
    )


def _check_origin(data: Mapping[str, Any]) -> Check:
    if data["simulated"]:
        text = "A simulator made these data. The numbers say how well the law imitates it, and nothing about hardware."
        return Check("note", "Simulated data", text)
    return Check("good", "Real data", "The data were recorded on hardware.")


def _say_headline(result: Mapping[str, Any]) -> str:
    test, baseline = result["metrics"]["test"], result["metrics"]["baseline"]
    if test["position_mae"] is None:
        return f"All {test['rollouts']} test rollouts of {test['horizon']:g} s diverged: there is no error to report."
    rollouts = f"{test['rollouts']} open-loop rollout{'s' * (test['rollouts'] > 1)} of {test['horizon']:g} s"
    text = f"Mean position error {_number(test['position_mae'])} {test['unit']} over {rollouts} on test data"
    if not baseline["position_mae"] or result["model"] == "baseline":
        return f"{text}."
    change = _change(test["position_mae"], baseline["position_mae"])
    return f"{text}; {_number(baseline['position_mae'])} {test['unit']} without friction ({change})."


def _list_errors(metrics: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Rows of the main table: each error of the model beside that without friction."""
    test, baseline = metrics["test"], metrics["baseline"]
    for name, (key, unit) in ERRORS.items():
        yield {"name": name, "unit": test[unit], "model": test[key], "baseline": baseline[key]}


def _list_evaluations(result: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Rows of the table of all evaluations: the metrics under a name of their rollouts and of the drive."""
    names = {"test": "test, this model", "train": "train, this model", "baseline": "test, no friction"}
    for entry in result["by_horizon"]:
        yield from ({"on": name, **entry[part]} for part, name in names.items())
    for key, where in (("a", "the trajectory above"), ("b", "random places")):
        for part, name in (("model", "this model"), ("baseline", "no friction")):
            yield {"on": f"{where}, {name}", **result["paper"][key][part]}


def _list_timing(timing: Mapping[str, float]) -> dict[str, float]:
    """Seconds of every part, the rest of the total last."""
    parts = {name: seconds for name, seconds in timing.items() if name != "total"}
    return parts | {"figures and files": max(0.0, timing["total"] - sum(parts.values()))}


def plot_trajectory(
    result: Mapping[str, Any], segments: Segments, model: Prediction, baseline: Prediction, joints: tuple[str, ...]
) -> Iterator[Plot]:
    """A figure a joint: measured and simulated position above velocity.

    Args:
        result: What `result.json` holds, for the units.
        segments: One measured window; of several, the first is drawn.
        model: Of the identified drive.
        baseline: Of the bench without friction.
        joints: Names of the joints.
    """
    metrics, duration = result["metrics"]["test"], segments.length * segments.timestep
    time = np.arange(segments.length + 1) * segments.timestep
    for joint, name in enumerate(joints):
        layout = _layout(xaxis=_axis("time [s]", range=[0, duration], anchor="y2"))
        data: list[dict[str, Any]] = []
        errors: list[str] = []
        rows = (("qpos", "y", "position", metrics["unit"]), ("qvel", "y2", "velocity", metrics["velocity_unit"]))
        for signal, axis, quantity, unit in rows:
            measured = getattr(segments, signal)[0, :, joint].astype(np.float64)
            curves = [_with_start(measured, getattr(p, signal)[0, :, joint]) for p in (model, baseline)]
            drawn = _draw_curves(time, measured, *curves, axis=axis, legend=axis == "y", unit=unit)
            # A measured velocity is noisy and would hide what is drawn under it.
            data += drawn if signal == "qpos" else [drawn[2] | {"opacity": 0.55}, *drawn[:2]]
            domain = [0.42, 1] if axis == "y" else [0, 0.36]
            frame = _frame(measured, *curves)
            layout[f"yaxis{axis[1:]}"] = _axis(f"{quantity} [{unit}]", range=frame, domain=domain)
            if signal == "qpos":
                errors = [_say_error(curve - measured, unit) for curve in curves]
        text = (
            f"Measured and simulated position and velocity of joint {name} over {duration:g} s; "
            f"the mean position error is {errors[0]} with the model and {errors[1]} without friction."
        )
        yield Plot(f"Trajectory of {name}", text, {"data": data, "layout": layout}, time=True)


def plot_error(
    result: Mapping[str, Any], segments: Segments, model: Prediction, baseline: Prediction, window: float
) -> Plot:
    """Absolute position error over time, mean over joints: its moving mean and +- one standard deviation.

    Args:
        result: What `result.json` holds, for the units.
        segments: One measured window; of several, the first is drawn.
        model: Of the identified drive.
        baseline: Of the bench without friction.
        window: Length of the moving window [s].
    """
    unit, duration = result["metrics"]["test"]["unit"], segments.length * segments.timestep
    width = min(max(1, round(window / segments.timestep)), segments.length + 1)
    measured = segments.qpos[0].astype(np.float64)
    errors = [np.abs(_with_start(measured, p.qpos[0]) - measured).mean(axis=1) for p in (model, baseline)]
    largest = [float(np.nanmax(error)) for error in errors]
    logarithmic = max(largest) > FLATTENED * min(largest) > 0
    data: list[dict[str, Any]] = []
    for name, color, error in zip(("this model", "no friction"), (MODEL, BASELINE), errors, strict=True):
        error = error[np.isfinite(error)]
        span = min(width, len(error))
        mean, std = moving_mean_and_std(error, span)
        data += _draw_band(mean, std, segments.timestep, (span - 1) / 2, name, color, unit)
    if logarithmic:
        # A band that reaches below 0 has no place on a logarithmic axis.
        data = [trace for trace in data if "fill" not in trace]
    vertical = {"type": "log"} if logarithmic else {"rangemode": "tozero"}
    layout = _layout(
        xaxis=_axis("time [s]", range=[0, duration]), yaxis=_axis(f"absolute position error [{unit}]", **vertical)
    )
    text = (
        f"Moving mean and standard deviation over {window:g} s of the absolute position error; the largest error is "
        f"{_number(largest[0])} {unit} with the model and {_number(largest[1])} {unit} without friction."
    )
    return Plot("Its error", text, {"data": data, "layout": layout}, time=True)


def plot_history(
    result: Mapping[str, Any],
    history: Mapping[str, Shaped[np.ndarray, "iterations ..."]],
    joints: tuple[str, ...],
) -> Iterator[Plot]:
    """The loss and every identified parameter over the iterations, the reported iteration marked.

    Args:
        result: What `result.json` holds.
        history: `iteration`, `loss`, and values under `bench.NAME` and `friction.NAME`.
        joints: Names of the joints.
    """
    units = {f"{p['owner']}.{p['name']}": _unit(p["unit"]) for p in result["parameters"] if p["identified"]}
    iteration, best = history["iteration"], result["fit"]["best_iteration"]
    at = int(np.flatnonzero(iteration == best)[0])
    mode = "markers" if result["fit"]["method"] == "grid" else "lines"
    for key in ("loss", *(key for key in units if key in history)):
        columns = np.reshape(history[key], (len(iteration), -1)).T.astype(np.float64)
        name, unit, several = key.rpartition(".")[2], units.get(key, ""), len(columns) > 1
        reached = ", ".join(_number(value) for value in columns[:, at])
        text = f"{name} over {len(iteration)} iterations; {reached} {unit}".rstrip()
        traces = [_draw_history(iteration, column, mode, i, joints) for i, column in enumerate(columns)]
        traces.append(_mark(best, columns[:, at]))
        vertical = _axis(unit, nticks=5, type="log" if key == "loss" and _spans_decades(columns) else "linear")
        layout = _layout(xaxis=_axis("iteration", nticks=6), yaxis=vertical)
        layout |= {"showlegend": several, "margin": layout["margin"] | {"t": 40 if several else 12}}
        figure = {"data": traces, "layout": layout}
        yield Plot(name, f"{text} at iteration {best}, which is reported and marked.", figure)


def plot_horizons(result: Mapping[str, Any]) -> Plot:
    """Position error at every horizon: train, test and without friction.

    Args:
        result: What `result.json` holds.
    """
    entries = sorted(result["by_horizon"], key=lambda entry: entry["horizon"])
    unit = entries[0]["test"]["unit"]
    parts = (("test", "test", MODEL), ("train", "train", TRAIN), ("baseline", "test, no friction", BASELINE))
    data = [
        {
            "type": "bar",
            "name": name,
            "x": [f"{entry['horizon']:g} s" for entry in entries],
            "y": [entry[part]["position_mae"] for entry in entries],
            "error_y": {"array": [entry[part]["position_mae_std"] for entry in entries], "color": TEXT, "thickness": 1},
            "marker": {"color": color},
            "hovertemplate": f"%{{y:.4g}} {unit}",
        }
        for part, name, color in parts
    ]
    layout = _layout(xaxis=_axis("length of the rollouts", type="category"), yaxis=_axis(f"position MAE [{unit}]"))
    text = "; ".join(
        f"at {entry['horizon']:g} s {_number(entry['test']['position_mae'])} {unit} on test data, "
        f"{_number(entry['baseline']['position_mae'])} {unit} without friction"
        for entry in entries
    )
    return Plot("Position error by horizon", f"Mean position error {text}.", {"data": data, "layout": layout})


def _with_start(
    measured: Float[np.ndarray, "samples ..."], predicted: Float[np.ndarray, "steps ..."]
) -> Float[np.ndarray, "samples ..."]:
    """A rollout with the measured state that it starts from, NaN from the first sample that is not finite."""
    curve = np.concatenate([measured[:1], predicted])
    finite = np.isfinite(curve.reshape(len(curve), -1)).all(axis=1)
    kept = np.logical_and.accumulate(finite)
    return np.where(kept.reshape(-1, *[1] * (curve.ndim - 1)), curve, np.nan)


def _frame(
    measured: Float[np.ndarray, "time"], model: Float[np.ndarray, "time"], baseline: Float[np.ndarray, "time"]
) -> list[float]:
    """Limits of the vertical axis: a drive without friction may run away, and leave the frame."""
    lowest, highest = float(np.nanmin([measured, model])), float(np.nanmax([measured, model]))
    room = highest - lowest or 1.0
    low = max(min(lowest, float(np.nanmin(baseline))), lowest - room / 2)
    high = min(max(highest, float(np.nanmax(baseline))), highest + room / 2)
    return [low - 0.04 * room, high + 0.04 * room]


def _draw_curves(
    time: Float[np.ndarray, "time"],
    measured: Float[np.ndarray, "time"],
    model: Float[np.ndarray, "time"],
    baseline: Float[np.ndarray, "time"],
    *,
    axis: str,
    legend: bool,
    unit: str,
) -> list[dict[str, Any]]:
    """Without friction at the back, measured in front, as in figure 4."""
    curves = (("no friction", baseline, BASELINE), ("this model", model, MODEL), ("measured", measured, MEASURED))
    return [
        {
            "type": "scatter",
            "mode": "lines",
            "name": name,
            "legendgroup": name,
            "showlegend": legend,
            "yaxis": axis,
            "line": {"color": color, "width": 1.6, "dash": "dash"} if name == "measured" else {"color": color},
            "hovertemplate": f"%{{y:.4g}} {unit}",
            **_points(time, curve),
        }
        for name, curve, color in curves
    ]


def _draw_band(
    mean: Float[np.ndarray, "windows"],
    std: Float[np.ndarray, "windows"],
    timestep: float,
    shift: float,
    name: str,
    color: str,
    unit: str,
) -> list[dict[str, Any]]:
    """A curve and the area within one standard deviation of it."""
    kept = _decimate(mean)
    time = timestep * (kept + shift)
    outline = np.concatenate([mean[kept] + std[kept], (mean[kept] - std[kept])[::-1]])
    area = {"x": _round(np.concatenate([time, time[::-1]])), "y": _round(outline)}
    shared = {"type": "scatter", "mode": "lines", "name": name, "legendgroup": name}
    hidden = {"showlegend": False, "hoverinfo": "skip"}
    return [
        {**shared, **area, **hidden, "fill": "toself", "fillcolor": BANDS[color], "line": {"width": 0, "color": color}},
        {
            **shared,
            "x": _round(time),
            "y": _round(mean[kept]),
            "line": {"color": color},
            "hovertemplate": f"%{{y:.4g}} {unit}",
        },
    ]


def _draw_history(
    iteration: Shaped[np.ndarray, "iterations"],
    values: Float[np.ndarray, "iterations"],
    mode: str,
    joint: int,
    joints: tuple[str, ...],
) -> dict[str, Any]:
    color = JOINTS[joint % len(JOINTS)]
    return {
        "type": "scatter",
        "mode": mode,
        # plotly.js reads a few HTML tags in a name; escaped, they are text.
        "name": html.escape(joints[joint]) if joint < len(joints) else f"joint {joint}",
        "line": {"color": color},
        "marker": {"color": color, "size": 4},
        "hovertemplate": "%{y:.5g}",
        **_points(iteration.astype(np.float64), values),
    }


def _spans_decades(values: Float[np.ndarray, "..."]) -> bool:
    """Whether positive values differ so much that a linear axis would hide the smaller ones."""
    finite = values[np.isfinite(values)]
    return bool(finite.min(initial=np.inf) > 0 and finite.max(initial=0) > 10 * finite.min(initial=np.inf))


def _mark(best: int, values: Float[np.ndarray, "joints"]) -> dict[str, Any]:
    return {
        "type": "scatter",
        "mode": "markers",
        "name": "reported",
        "x": [best] * len(values),
        "y": _round(values),
        "marker": {"color": BEST, "size": 9, "symbol": "diamond"},
        "hovertemplate": "%{y:.5g}",
        "cliponaxis": False,
    }


def _layout(**axes: dict[str, Any]) -> dict[str, Any]:
    """What all figures share; the page's script swaps the colours on a dark page."""
    return {
        "autosize": True,
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {"color": TEXT, "size": 12, "family": "system-ui, sans-serif"},
        "margin": {"l": 62, "r": 12, "t": 40, "b": 44},
        "legend": {"orientation": "h", "x": 0, "y": 1, "yanchor": "bottom"},
        "hovermode": "x unified",
        "uirevision": "keep",
        "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": SOFT, "activecolor": MODEL},
        **axes,
    }


def _axis(title: str, **options: Any) -> dict[str, Any]:
    shown = {"title": {"text": title, "standoff": 8}, "gridcolor": GRID, "linecolor": GRID, "zeroline": False}
    return shown | {"automargin": True, "nticks": 8} | options


def _points(x: Float[np.ndarray, "points"], y: Float[np.ndarray, "points"]) -> dict[str, list[float]]:
    """A curve as plotly.js takes it, without the samples that are not finite."""
    finite = np.isfinite(y)
    x, y = x[finite], y[finite]
    kept = _decimate(y)
    return {"x": _round(x[kept]), "y": _round(y[kept])}


def _decimate(curve: Float[np.ndarray, "points"]) -> Int[np.ndarray, "kept"]:
    """Indices of at most `POINTS` points that look like the whole curve: lowest and highest of each stretch."""
    if len(curve) <= POINTS:
        return np.arange(len(curve))
    edges = np.linspace(0, len(curve), POINTS // 2).astype(int)
    stretches = [(int(start), curve[start:stop]) for start, stop in pairwise(edges)]
    extremes = [start + int(at) for start, part in stretches for at in (part.argmin(), part.argmax())]
    return np.unique([0, *extremes, len(curve) - 1])


def _round(values: Float[np.ndarray, "points"]) -> list[float]:
    return [float(f"{value:.{DIGITS}g}") for value in values]


def _say_error(error: Float[np.ndarray, "samples"], unit: str) -> str:
    """The mean absolute error of a rollout's steps, or that it has none."""
    steps = np.abs(error[1:])
    return f"{steps.mean():.4g} {unit}" if np.isfinite(steps).all() else "without a value (the rollout diverged)"


def _number(value: float | Sequence[float] | None) -> str:
    if value is None:
        return "none"
    return f"{value:.4g}" if isinstance(value, int | float) else ", ".join(f"{joint:.4g}" for joint in value)


def _unit(unit: str) -> str:
    """A unit as it is printed; nothing for a pure number."""
    return "" if unit == "1" else unit.replace("^2", "²")


def _change(value: float | None, reference: float | None) -> str:
    """Relative change, where there is something to compare."""
    if value is None or not reference:
        return ""
    percent = round(100 * (value / reference - 1))
    return f"{'−' if percent < 0 else '+' if percent > 0 else '±'}{abs(percent)} %"


def _place(value: float, parameter: Mapping[str, Any]) -> float:
    """Where a value lies between its bounds, from 0 to 100; in decades where the bounds are positive."""
    low, high = parameter["low"], parameter["high"]
    if low > 0:
        low, high, value = math.log(low), math.log(high), math.log(max(value, low))
    return round(100 * min(1.0, max(0.0, (value - low) / (high - low))), 1)
