"""Command line: `python -m frictionzoo.watch FOLDER` follows a run or a sweep until its jobs have ended."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from frictionzoo.cli.mistakes import REFUSED, mistakes_in_one_line
from frictionzoo.core.telling import Parser


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; `arguments` default to `sys.argv`.

    A user's mistake ends it with one line and status 2, a failed or stopped job with status 2. Ctrl-C ends it with
    status 130; the watched jobs continue.
    """
    parsed = _parse(arguments)
    with mistakes_in_one_line(lambda: "the watched jobs continue"):
        # Imported here, so that --help need not wait for it.
        from frictionzoo.watch.follow import follow, show
        from frictionzoo.watch.jobs import Watched

        watched = Watched(parsed.folder)
        if parsed.once:
            show(watched)
        elif any(job.state != "finished" for job in follow(watched)):
            sys.exit(REFUSED)


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        prog="python -m frictionzoo.watch",
        description="Follow a run, or the jobs of a sweep, from their files: state, iteration, loss and parameters, "
        "refreshed in place on a terminal, else one line for each change. It ends when all jobs have ended.",
        epilog="Progress is read from the files of logger=tensorboard or logger=csv. TensorBoard shows more.",
    )
    parser.add_argument(
        "folder", metavar="FOLDER", type=Path, help="folder of a run or a sweep, or one that contains them"
    )
    parser.add_argument("--once", action="store_true", help="print the present state and end")
    return parser.parse_args(arguments)
