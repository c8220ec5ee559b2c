"""Command line: `python -m frictionzoo.card RUN licence=cc-by-4.0` publishes a run's drive as a card."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from frictionzoo.cli.mistakes import mistakes_in_one_line
from frictionzoo.core.options import read_options
from frictionzoo.core.telling import Parser, say, tell

_OPTIONS = """options: licence=ID, required, the card's licence as model hubs name it: cc-by-4.0,
apache-2.0; name=TEXT, its title; supply=TEXT, temperature=TEXT, payload=TEXT, conditions of the recording, not stated
by default; output=FOLDER, by default card in the run's folder. For a run that evaluated published values: bam=FILE,
BAM's parameter file with them, and source=TEXT, who published it and where."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; `arguments` default to `sys.argv`. A user's mistake ends it with one line and status 2."""
    parsed = _parse(arguments)
    with mistakes_in_one_line():
        options = read_options(parsed.options, "licence=cc-by-4.0")
        # Imported late: neither --help nor a mistake waits for torch and JAX.
        from frictionzoo.core.jobs import refuse_unfinished

        refuse_unfinished(parsed.folder)
        tell("loading torch and JAX")
        from frictionzoo.report.card.write import write_card

        place, warnings = write_card(parsed.folder, options)
        say("\n".join([*(f"warning: {line}" for line in warnings), f"files: {place}"]))


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        prog="python -m frictionzoo.card",
        description="Write the identified drive of a run as a card: values with intervals, model, conditions, hashes "
        "of the recordings and held-out errors, as a page and for programs, with MJCF. frictionzoo.load reads it.",
        epilog=_OPTIONS,
    )
    parser.add_argument("folder", metavar="RUN", type=Path, help="the folder of a finished run")
    parser.add_argument("options", metavar="KEY=VALUE", nargs="*", help="licence=ID, and other options")
    return parser.parse_args(arguments)
