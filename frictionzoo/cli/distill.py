"""Command line: `python -m frictionzoo.distill RUN model=NAME` fits a simpler model to a run's drive."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from frictionzoo.cli.mistakes import mistakes_in_one_line
from frictionzoo.core.options import read_options
from frictionzoo.core.telling import Parser, tell

_OPTIONS = """options: model=NAME; output=FOLDER, by default distilled/NAME in the run's folder; and fit options of a
run, such as fit, model.*, fit.*, segments.*, loop.*, seed. Defaults come from the run, except fit=auto and segments as
long as the evaluation rollouts."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; `arguments` default to `sys.argv`. A user's mistake ends it with one line and status 2."""
    parsed = _parse(arguments)
    with mistakes_in_one_line():
        options = read_options(parsed.options, "model=stribeck")
        # Imported late: neither --help nor a mistake waits for torch and JAX.
        from frictionzoo.core.jobs import refuse_unfinished

        refuse_unfinished(parsed.folder)
        tell("loading torch and JAX")
        from frictionzoo.cli.student import distill

        distill(parsed.folder, options)


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        prog="python -m frictionzoo.distill",
        description="Fit another model to the identified drive of a run under the recorded commands, and print the "
        "loss of accuracy on held-out recordings.",
        epilog=_OPTIONS,
    )
    parser.add_argument("folder", metavar="RUN", type=Path, help="the folder of a finished run, the teacher")
    parser.add_argument("options", metavar="KEY=VALUE", nargs="*", help="model=NAME, and other options")
    return parser.parse_args(arguments)
