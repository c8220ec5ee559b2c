"""The paper's figures 3, 4 and 5 for one model, as PNG."""

import io
import logging
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float, Shaped
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from frictionzoo.bench.base import Bench
from frictionzoo.core.log import Dataset
from frictionzoo.core.output import write_atomically
from frictionzoo.core.params import UNITS
from frictionzoo.core.segments import Segments
from frictionzoo.models.base import FrictionModel
from frictionzoo.result.curves import Curves
from frictionzoo.result.evaluate import Evaluation, Judgement, Prediction, moving_mean_and_std
from frictionzoo.show.colors import BASELINE, BEST, JOINTS, MODEL

# Under PDF, it tells how it takes each glyph out of a font.
logging.getLogger("fontTools").setLevel(logging.WARNING)

DPI = 150
WIDTH = 8.0  # inch; 1200 px
MEASURED = "black"
FLATTENED = 20.0  # ratio of two curves' largest errors from which a linear axis hides the smaller one
BAND = 1.5  # times the largest of an error's moving mean is as high as a band around it is shown
LARGEST = 1e100  # rad or m, of what is drawn
COLUMN = 3.5  # inches for each joint of several
INSET = 0.08  # share of the trajectory that the inset magnifies


def write_figures(
    folder: Path,
    bench: Bench,
    model: FrictionModel,
    dataset: Dataset,
    evaluation: Evaluation,
    judgement: Judgement,
    baseline: Judgement,
    history: Mapping[str, Shaped[np.ndarray, "iterations ..."]],
    best_iteration: int,
) -> None:
    """Figures 3, 4 and 5 of a run as PNG files.

    Args:
        folder: Where to write them.
        bench: The bench.
        model: The friction law.
        dataset: What was fitted and judged on.
        evaluation: The rollouts of the judgements.
        judgement: Of the identified drive.
        baseline: Of the same bench without friction.
        history: What the fit passed through, as in `draw_parameters`.
        best_iteration: Entry of `iteration` whose values are the identified ones.

    Raises:
        OutputError: They cannot be written.
    """
    kind = "simulated" if any(log.simulated for log in dataset.logs) else "real"
    fitted = f"{model.name}, fit to the training part of {dataset.name} ({kind} data)"
    tested = f"{model.name}, one rollout of the test part of {dataset.name} ({kind} data)"
    units = {
        f"{owner}.{name}": param.unit(bench.joint_type)
        for owner, params in (("bench", bench.params), ("friction", model.params))
        for name, param in params.items()
        if param.identify
    }
    rollouts = (evaluation.trajectories, judgement.prediction, baseline.prediction, bench.joint_type)
    moved = len(history["iteration"]) > 1  # known values have no course
    figures = {
        **({"figure3_parameters.png": draw_parameters(history, best_iteration, units, fitted)} if moved else {}),
        "figure4_trajectory.png": draw_trajectory(*rollouts, bench.joints, tested),
        "figure5_error.png": draw_error(*rollouts, evaluation.window, tested),
    }
    for name, figure in figures.items():
        save_figure(figure, folder / name)


def draw_parameters(
    history: Mapping[str, Shaped[np.ndarray, "iterations ..."]],
    best_iteration: int,
    units: Mapping[str, str],
    title: str,
) -> Figure:
    """Figure 3: every parameter over the iterations of the fit, the best iteration marked.

    A law without parameters of its own to show (a network) has loss and gradient norm shown instead.

    Args:
        history: `iteration`, `loss`, `grad_norm`, and values under `bench.NAME` and `friction.NAME`.
        best_iteration: Entry of `iteration` whose values are the identified ones.
        units: Unit of each `bench.NAME` and `friction.NAME` to draw.
        title: Model and data.
    """
    names = [name for name in history if name in units]
    if not any(name.startswith("friction.") for name in names):
        names += [name for name in ("loss", "grad_norm") if name in history]
    rows = (len(names) + 1) // 2
    figure = Figure(figsize=(WIDTH, 1.0 + 1.9 * rows), layout="constrained")
    panels = figure.subplots(rows, min(2, len(names)), squeeze=False).ravel()
    for axes, name in zip(panels, names, strict=False):
        _draw_history(axes, history["iteration"], history[name], best_iteration)
        axes.set_ylabel(f"{name.partition('.')[2]}\n[{units[name]}]" if name in units else name)
        if name not in units:
            axes.set_yscale("log")
    for axes in panels[len(names) :]:
        axes.set_axis_off()
    figure.suptitle(f"{title}\nred: iteration {best_iteration}, the lowest training loss", fontsize="medium")
    figure.supxlabel("iteration", fontsize="medium")
    return figure


def _draw_history(
    axes: Axes, iteration: Shaped[np.ndarray, "iterations"], values: Shaped[np.ndarray, "iterations ..."], best: int
) -> None:
    """One quantity, a line a joint, with the best iteration and its values in red."""
    columns = np.reshape(values, (len(values), -1)).T
    at = int(np.flatnonzero(iteration == best)[0])
    axes.axvline(best, color=BEST, linestyle="--", linewidth=1.2)
    for joint, column in enumerate(columns):
        axes.plot(iteration, column, color=JOINTS[joint % len(JOINTS)], label=f"joint {joint}")
        axes.plot(best, column[at], "o", color=BEST, markeredgecolor="white", markersize=7, zorder=3, clip_on=False)
    if len(columns) > 1:
        axes.legend(fontsize="small", ncols=3)
    else:
        axes.set_title(f"{columns[0, at]:.4g}", loc="right", color=BEST, fontsize="small")
    tidy(axes)


def plot_rollout(result: Mapping[str, Any], curves: Curves, segments: Segments, bench: Bench) -> Figure:
    """Figure 4 of a finished run.

    Args:
        result: What its `result.json` holds.
        curves: What its `curves.safetensors` holds.
        segments: The measured rollouts that these belong to.
        bench: The bench.
    """
    kind = "simulated" if result["data"]["simulated"] else "real"
    title = f"{result['model']}, one rollout of the test part of {result['data']['name']} ({kind} data)"
    model, baseline = Prediction(curves.qpos, curves.qvel), Prediction(curves.baseline_qpos, curves.baseline_qvel)
    return draw_trajectory(segments, model, baseline, bench.joint_type, bench.joints, title)


def draw_trajectory(
    segments: Segments, model: Prediction, baseline: Prediction, joint_type: str, joints: tuple[str, ...], title: str
) -> Figure:
    """Figure 4: measured and simulated position and velocity, and a magnified stretch.

    Args:
        segments: One measured window; of several, the first is drawn.
        model: Of the identified drive.
        baseline: Of the bench without friction.
        joint_type: `hinge` or `slide`, for the units.
        joints: Names of the joints.
        title: Model and data.
    """
    figure = Figure(figsize=(max(WIDTH, COLUMN * len(joints)), 6.5), layout="constrained")
    panels = figure.subplots(2, len(joints), sharex=True, squeeze=False, height_ratios=(3, 2))
    time = np.arange(segments.length + 1) * segments.timestep
    for quantity, signal, row in (("position", "qpos", panels[0]), ("velocity", "qvel", panels[1])):
        for joint, axes in enumerate(row):
            curves = [_with_start(segments, signal, prediction)[:, joint] for prediction in (model, baseline)]
            curves = [getattr(segments, signal)[0, :, joint], *curves]
            _draw_curves(axes, slice(None), time, curves)
            axes.set_ylabel(f"{quantity} [{UNITS[joint_type][quantity]}]")
            if quantity == "position":
                axes.set_title(joints[joint], fontsize="medium")
                centre = int(np.nanargmax(np.abs(curves[1] - curves[0])))  # the model's largest error
                magnify(axes, time, centre, INSET, 0.45, partial(_draw_curves, time=time, curves=curves))
                axes.legend(loc="upper left", fontsize="small")
            else:
                axes.set_xlabel("time [s]")
    figure.suptitle(title, fontsize="medium")
    return figure


def draw_error(
    segments: Segments, model: Prediction, baseline: Prediction, joint_type: str, window: float, title: str
) -> Figure:
    """Figure 5: absolute position error over time, its moving mean and +- one standard deviation, mean over joints.

    Args:
        segments: One measured window; of several, the first is drawn.
        model: Of the identified drive.
        baseline: Of the bench without friction.
        joint_type: `hinge` or `slide`, for the units.
        window: Length of the moving window [s].
        title: Model and data.
    """
    figure = Figure(figsize=(WIDTH, 4.2), layout="constrained")
    axes = figure.subplots()
    width = min(max(1, round(window / segments.timestep)), segments.length + 1)
    for label, prediction, color in (("this model", model, MODEL), ("no friction", baseline, BASELINE)):
        error = np.abs(_with_start(segments, "qpos", prediction) - segments.qpos[0]).mean(axis=1)
        mean, std = moving_mean_and_std(error, width)
        centre = (np.arange(len(mean)) + (width - 1) / 2) * segments.timestep
        axes.plot(centre, mean, color=color, label=label)
        axes.fill_between(centre, mean - std, mean + std, color=color, alpha=0.25, linewidth=0)
    axes.set_xlim(0, segments.length * segments.timestep)
    scale_errors(axes, room=0.17, widest=np.inf)
    axes.set_xlabel("time [s]")
    axes.set_ylabel(f"absolute position error [{UNITS[joint_type]['position']}]")
    axes.set_title(f"{title}\nmoving mean and standard deviation over {window:g} s", fontsize="medium")
    axes.legend(loc="upper left", ncols=2)
    tidy(axes)
    return figure


def scale_errors(axes: Axes, room: float, widest: float) -> None:
    """Errors from 0 upwards; logarithmic where one curve would flatten another.

    Args:
        axes: With the errors as lines.
        room: For the legend, above the curves, as a share of the axis.
        widest: How many times larger a curve may grow than the smallest one does; one beyond that leaves the frame.
    """
    curves = [np.asarray(line.get_ydata(), dtype=np.float64) for line in axes.get_lines()]
    curves = [curve[curve > 0] for curve in curves if (curve > 0).any()]
    lowest = min((curve.max() for curve in curves), default=1.0)
    curves = [curve for curve in curves if curve.max() <= widest * lowest] or [np.ones(1)]
    highest = max(curve.max() for curve in curves)
    if highest > FLATTENED * lowest:
        bottom = min(np.percentile(np.concatenate(curves), 1), lowest / 2)
        axes.set_yscale("log")
        axes.set_ylim(bottom, highest * (highest / bottom) ** (room / (1 - room)))
    else:
        # Bands around the curves reach higher than they do.
        axes.set_ylim(0, min(axes.get_ylim()[1], BAND * highest) / (1 - room))


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, or as PDF with its fonts embedded and without a date.

    Args:
        figure: What to write.
        path: The file; its suffix tells the format.

    Raises:
        OutputError: It cannot be written.
    """
    buffer = io.BytesIO()
    metadata = {"CreationDate": None} if path.suffix == ".pdf" else None
    with matplotlib.rc_context({"pdf.fonttype": 42}):  # TrueType: journals refuse type 3, the default
        FigureCanvasAgg(figure).print_figure(buffer, format=path.suffix[1:], dpi=DPI, metadata=metadata)
    write_atomically(path, buffer.getvalue())


def _with_start(segments: Segments, signal: str, prediction: Prediction) -> Float[np.ndarray, "samples nv"]:
    """The first rollout with the measured state that it starts from."""
    return cut_divergence(np.concatenate([getattr(segments, signal)[0, :1], getattr(prediction, signal)[0]]))


def cut_divergence(curve: Float[np.ndarray, "samples nv"]) -> Float[np.ndarray, "samples nv"]:
    """A rollout, NaN from the first sample that is not finite, or too large to be squared.

    Args:
        curve: The rollout.
    """
    finite = (np.abs(curve) < LARGEST).all(axis=1)
    return curve if finite.all() else np.where(np.arange(len(curve))[:, None] < np.argmin(finite), curve, np.nan)


def _draw_curves(
    axes: Axes, shown: slice, time: Float[np.ndarray, "time"], curves: Sequence[Float[np.ndarray, "time"]]
) -> None:
    time = time[shown]
    measured, model, baseline = (curve[shown] for curve in curves)
    axes.plot(time, baseline, color=BASELINE, label="no friction")
    axes.plot(time, model, color=MODEL, label="this model")
    axes.plot(time, measured, color=MEASURED, linestyle=(0, (4, 3)), linewidth=1.2, label="measured")
    axes.set_xlim(time[0], time[-1])
    limit_frame(axes, [measured, model])
    tidy(axes)


def limit_frame(axes: Axes, kept: Sequence[Float[np.ndarray, "time"]]) -> None:
    """Keep these curves in the frame, with room around: another that runs away would flatten them and may leave it.

    Args:
        axes: With all curves drawn.
        kept: What has to be seen.
    """
    lowest, highest = np.nanmin(kept), np.nanmax(kept)
    room = 0.5 * float(highest - lowest) or 0.5
    low, high = axes.get_ylim()
    axes.set_ylim(max(low, lowest - room), min(high, highest + room))


def magnify(
    axes: Axes,
    time: Float[np.ndarray, "time"],
    centre: int,
    share: float,
    left: float,
    draw: Callable[[Axes, slice], None],
) -> None:
    """An inset, above the curves, of the stretch around one sample.

    Args:
        axes: With the curves drawn.
        time: Of the samples [s].
        centre: The sample.
        share: Of the samples, that the stretch has.
        left: Where the inset begins, as a share of the width; free space before it is for a legend.
        draw: Draws a stretch of samples.
    """
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.9 * (high - low))
    half = max(2, round(share * len(time) / 2))
    start = min(max(0, centre - half), max(0, len(time) - 2 * half - 1))
    inset = axes.inset_axes((left, 0.56, 0.98 - left, 0.41))
    draw(inset, slice(start, start + 2 * half + 1))
    inset.tick_params(labelsize="x-small")
    axes.indicate_inset_zoom(inset, edgecolor="black")


def tidy(axes: Axes) -> None:
    """A light grid, and hardly any margin beside the curves.

    Args:
        axes: With the curves drawn.
    """
    axes.grid(alpha=0.3)
    axes.margins(x=0.01)
