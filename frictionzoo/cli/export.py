"""Command line: `python -m frictionzoo.export RUN target=NAME` exports a run's drive to another program."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from frictionzoo.cli.mistakes import mistakes_in_one_line
from frictionzoo.core.options import read_options
from frictionzoo.core.telling import Parser, say, tell

_OPTIONS = """options: target=NAME or target=all; timestep=SECONDS and integrator=NAME of the simulator (Euler,
implicitfast or RK4), by default as in the model file; output=FOLDER, by default export/NAME in the run's folder; and
options of the target."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; `arguments` default to `sys.argv`. A user's mistake ends it with one line and status 2."""
    parsed = _parse(arguments)
    with mistakes_in_one_line():
        options = read_options(parsed.options, "target=mjcf")
        # Imported late: neither --help nor a mistake waits for torch and JAX.
        from frictionzoo.core.jobs import refuse_unfinished

        refuse_unfinished(parsed.folder)
        tell("loading torch and JAX")
        from frictionzoo.export.write import summarise_exports, write_exports

        say(summarise_exports(write_exports(parsed.folder, options)))


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        prog="python -m frictionzoo.export",
        description="Export the identified drive of a run to another program, run the export there, and print its "
        "distance from the fitted drive and what it cannot represent.",
        epilog=_OPTIONS,
    )
    parser.add_argument("folder", metavar="RUN", type=Path, help="the folder of a finished run")
    parser.add_argument("options", metavar="KEY=VALUE", nargs="*", help="target=NAME, and other options")
    return parser.parse_args(arguments)
