"""Command line: `python -m frictionzoo.compare FOLDER...` compares finished runs."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from frictionzoo.cli.mistakes import mistakes_in_one_line
from frictionzoo.core.telling import Parser, say, tell


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; `arguments` default to `sys.argv`. A user's mistake ends it with one line and status 2."""
    options = _parse(arguments)
    output = options.output or (options.folders[0] if len(options.folders) == 1 else Path()) / "comparison"
    with mistakes_in_one_line():
        # Imported late: neither --help nor a mistake waits for torch and JAX.
        from frictionzoo.core.jobs import find_runs

        for folder in options.folders:
            find_runs(folder)
        tell("loading torch and JAX")
        from frictionzoo.api.comparison_files import write_comparison
        from frictionzoo.report.terminal import summarise_comparison

        say(summarise_comparison(write_comparison(options.folders, output), output))


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        prog="python -m frictionzoo.compare",
        description="Compare runs on the same data and the same rollouts, and write comparison.json, comparison.html, "
        "figures and a LaTeX table.",
    )
    parser.add_argument("folders", metavar="FOLDER", nargs="+", type=Path, help="a run's folder, or a sweep's")
    parser.add_argument(
        "--output",
        metavar="FOLDER",
        type=Path,
        help="output folder; by default comparison/ in the given folder, or here if several are given",
    )
    return parser.parse_args(arguments)
