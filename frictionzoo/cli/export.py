"""Command line: `python -m frictionzoo.export RUN target=NAME` writes a run's drive for another program."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from frictionzoo.cli.mistakes import fail
from frictionzoo.core.errors import FrictionzooError
from frictionzoo.core.options import read_options

_OPTIONS = """options: target=NAME or target=all; timestep=SECONDS of the simulation, that of the run where it is left
out; output=FOLDER, export/NAME in the run's where it is left out; and those of the target."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point; without arguments, for those of the command line. A user's mistake is one line and exit status 2."""
    parsed = _parse(arguments)
    # Imported here, so that --help does not wait for it.
    from frictionzoo.export.write import summarise_exports, write_exports

    try:
        print(summarise_exports(write_exports(parsed.folder, read_options(parsed.options, "target=mjcf"))))
    except FrictionzooError as error:
        fail(str(error))


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m frictionzoo.export",
        description="Write the drive that a run identified for another program, run what was written there, and say "
        "how far it is from the fitted drive and what it cannot represent.",
        epilog=_OPTIONS,
    )
    parser.add_argument("folder", metavar="RUN", type=Path, help="the folder of a finished run")
    parser.add_argument("options", metavar="KEY=VALUE", nargs="*", help="target=NAME, and more")
    return parser.parse_args(arguments)
