"""The figures of a comparison as files, PNG and PDF."""

from collections.abc import Sequence
from pathlib import Path

from frictionzoo.comparison.record import Comparison
from frictionzoo.comparison.runs import Run
from frictionzoo.show import comparison_plots as plots
from frictionzoo.show.figure import Sheet
from frictionzoo.show.with_matplotlib import draw, save_figure

FORMATS = ("png", "pdf")
PIXELS = 75.0  # of a page for an inch of paper, where a figure's height is that of its rows


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
    for name, sheet in arrange(comparison, runs).items():
        figure = draw(sheet) if sheet.figures else None
        for path in (folder / f"{name}.{suffix}" for suffix in FORMATS):
            path.unlink(missing_ok=True) if figure is None else save_figure(figure, path)


def arrange(comparison: Comparison, runs: Sequence[Run]) -> dict[str, Sheet]:
    """What is drawn on which file; a sheet without figures has nothing to show.

    Args:
        comparison: The runs side by side.
        runs: The same runs with their curves.
    """
    named = {run.label: run for run in runs}
    runs = [named[entry["label"]] for entry in comparison["runs"]]
    joints, evaluation = len(comparison["joints"]), comparison["evaluation"]
    data = f"{comparison['data']['name']} ({'simulated' if comparison['data']['simulated'] else 'real'} data)"
    one = f"One rollout of the test part of {data}"
    all_short = f"{evaluation['rollouts']} rollouts of {evaluation['horizon']:g} s, {data}"
    all_long = f"Mean over {evaluation['long_rollouts']} rollouts of the test part of {data}"
    local = f"{sum(comparison['by_speed']['windows'])} short rollouts over the test part of {data}"
    window = f"moving mean and standard deviation over {runs[0].result['evaluation']['window']:g} s"
    fits = list(plots.plot_parameters(comparison, runs))
    lines = max((len(part.panels[0].marks) // 2 for part in fits), default=0)
    trajectories, friction = plots.plot_trajectories(comparison, runs), plots.plot_friction(comparison)
    errors, differences = plots.plot_errors(comparison), plots.plot_differences(comparison)
    rows = (errors.height or 0) / PIXELS
    return {
        "figure3_parameters": Sheet(
            f"Fits to the training part of {data}\nred: the best iteration and what it identified",
            fits,
            2.1 + 0.17 * lines,
            columns=2 if joints == 1 else joints,
            apart=True,
        ),
        "figure4_trajectories": Sheet(one, list(trajectories), 5.4, columns=joints, headings=True),
        "figure5_error": Sheet(f"{one}\n{window}", [plots.plot_error(comparison, runs)], 3.4),
        "figure6_mae": Sheet(f"{all_short}\nmean and standard deviation over rollouts", [errors], rows),
        "error_by_horizon": Sheet(all_long, [plots.plot_by_horizon(comparison)], 3.0),
        **{
            f"error_{section}": Sheet(
                f"{local}, in bins of equal number", [plots.plot_by_bin(comparison, section)], 3.0
            )
            for section in ("by_speed", "by_load")
        },
        "friction": Sheet(
            f"Friction identified from {data}\n"
            "band: 10 % to 90 % of recorded states, where friction depends on more than the velocity",
            list(friction),
            3.2,
            columns=joints,
            headings=True,
        ),
        "autocorrelation": Sheet(all_long, [plots.plot_autocorrelation(comparison)], 3.0),
        "differences": Sheet(
            f"{all_short}\nmean of paired differences and its 95 % interval",
            [differences] if len(runs) > 1 else [],
            rows,
        ),
    }
