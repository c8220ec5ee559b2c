"""Files of a comparison: JSON, page, figures, and a LaTeX table."""

from collections.abc import Sequence
from pathlib import Path

from frictionzoo.core.errors import ConfigError, RunError, closest
from frictionzoo.core.output import claim, write_atomically, write_json
from frictionzoo.core.telling import tell
from frictionzoo.result.comparison.record import compare_runs
from frictionzoo.result.comparison.runs import Run, read_runs
from frictionzoo.result.comparison.types import Comparison

FIGURES = (
    *("figure3_parameters", "figure4_trajectories", "figure5_error", "figure6_mae", "error_by_horizon"),
    *("error_by_speed", "error_by_load", "friction", "autocorrelation", "differences"),
)
FILES = (
    *("comparison.json", "comparison.html", "table.tex"),
    *(f"figures/{name}.{suffix}" for name in FIGURES for suffix in ("png", "pdf")),
)
"""All files that a comparison may write."""


def write_comparison(folders: Sequence[Path], output: Path, font: str = "sans") -> Comparison:
    """Compare the runs in these folders of runs or sweeps, and write the files of the comparison; `font` of the PDFs.

    Raises:
        RunError: A folder holds no run, runs are not comparable, or no run has a result.
        OutputError: A file cannot be written.
    """
    with claim(output, "comparison", FILES):  # an unusable output folder raises before the work
        runs, failures = read_runs(folders)
    if not runs:
        reasons = "; ".join(f"{failure.run}: {failure.reason}" for failure in failures)
        raise RunError(f"no run has a result to compare: {reasons}")
    comparison = compare_runs(runs, failures)
    save_comparison(comparison, runs, output, font)
    return comparison


def save_comparison(comparison: Comparison, runs: Sequence[Run], output: Path, font: str = "sans") -> None:
    """Write the files of a comparison of these runs, `comparison.json` last; `font` of the PDFs: `sans` or `serif`.

    Raises:
        ConfigError: The font is another one.
        OutputError: A file cannot be written.
    """
    # Imported late: a comparison without files needs no plotting libraries.
    from frictionzoo.report.comparison_page import write_page
    from frictionzoo.report.comparison_plots import write_figures
    from frictionzoo.report.latex import tabulate_latex
    from frictionzoo.report.with_matplotlib import FONTS

    if font not in FONTS:
        raise ConfigError(f"font={font}: {closest(font, FONTS)}")
    tell("drawing the figures of the comparison")
    with claim(output, "comparison", FILES):
        write_figures(output / "figures", comparison, runs, font)
        write_atomically(output / "table.tex", tabulate_latex(comparison).encode())
        write_page(output / "comparison.html", comparison, runs)
        write_json(output / "comparison.json", comparison)
