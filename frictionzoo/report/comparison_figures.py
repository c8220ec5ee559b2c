"""Figures of a comparison as PNG and PDF files."""

from collections.abc import Sequence
from pathlib import Path

from frictionzoo.core.output import remove_written
from frictionzoo.report.comparison_plots import plot_comparison
from frictionzoo.report.figure import Sheet
from frictionzoo.report.run_plots import COLUMNS
from frictionzoo.report.text import say_origin
from frictionzoo.report.with_matplotlib import LINE, draw, save_figure
from frictionzoo.result.comparison.runs import Run
from frictionzoo.result.comparison.types import Comparison

FORMATS = ("png", "pdf")
PIXELS = 75.0  # page pixels per inch of paper, for figures whose height depends on the number of rows


def write_figures(folder: Path, comparison: Comparison, runs: Sequence[Run]) -> None:
    """Write all figures of a comparison, each as PNG and PDF; an older file of a figure that is now empty is removed.

    Raises:
        OutputError: A file cannot be written.
    """
    for name, sheet in arrange(comparison, runs).items():
        figure = draw(sheet) if sheet.figures else None
        for path in (folder / f"{name}.{suffix}" for suffix in FORMATS):
            remove_written(path) if figure is None else save_figure(figure, path)


def arrange(comparison: Comparison, runs: Sequence[Run]) -> dict[str, Sheet]:
    """Return the sheet of each file; an empty figure has a sheet without figures."""
    plots, evaluation, joints = plot_comparison(comparison, runs), comparison["evaluation"], len(comparison["joints"])
    data = f"{comparison['data']['name']} ({say_origin(comparison['data']['origin'])})"
    fits = f"Fits to the training part of {data}\nred: the reported iteration and its values; axis from the lower "
    fits += "to the upper bound of each parameter, logarithmic if both are positive"
    single = f"One rollout of the test part of {data}"
    window = f"moving mean and standard deviation over {runs[0].result['evaluation']['window']:g} s"
    short = f"{evaluation['rollouts']} rollouts of {evaluation['horizon']:g} s, {data}"
    long = f"Mean over {evaluation['long_rollouts']} rollouts of the test part of {data}"
    windows = sum(comparison["by_speed"]["windows"])
    local = f"{windows} short rollouts over the test part of {data}, in bins of equal count"
    friction = f"Friction identified from {data}\nband: 10 % to 90 % of recorded states, if friction depends on more"
    names = max((len(figure.panels[0].marks) // 2 for figure in plots["parameters"]), default=0)
    rows = (plots["mae"][0].height or 0) / PIXELS
    columns = min(joints, COLUMNS)
    return {
        "figure3_parameters": Sheet(
            fits, plots["parameters"], 2.1 + LINE * names, 2 if joints == 1 else columns, apart=True
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
