"""Command line: `python -m frictionzoo.design velocity=4 torque=2 position=1.5` designs the next recording."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from frictionzoo.cli.mistakes import fail, mistakes_in_one_line
from frictionzoo.core.options import read_options
from frictionzoo.core.telling import Parser, say, tell

_OPTIONS = """options: position=REACH or [LOW,HIGH], velocity=, torque=, limits of the drive, in rad, rad/s and N m,
or m, m/s and N; home, where it rests; seconds, rate, ramp, period, bandwidth, margin; quantum, position_noise and
velocity_noise of the sensors; criterion=determinant or worst, starts, iterations, seed; points and fps of the files
for ROS 2 and LeRobot; inputs.NAME=VALUE; output=FOLDER; without RUN also bench=NAME, model=NAME and their options."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; `arguments` default to `sys.argv`. A user's mistake ends it with one line and status 2."""
    parsed = _parse(arguments)
    runs = parsed.folders
    if len(runs) > 1:
        fail(f"{runs[1]}: expected KEY=VALUE, or the folder of one run")
    with mistakes_in_one_line():
        options = read_options(parsed.options, "velocity=4")
        # Imported late: neither --help nor a mistake waits for torch and JAX.
        from frictionzoo.core.jobs import refuse_unfinished

        for run in runs:
            refuse_unfinished(Path(run))
        tell("loading torch and JAX")
        from frictionzoo.api.design import design_recording, refuse_existing
        from frictionzoo.report.design_terminal import summarise_excitation
        from frictionzoo.result.fitted_drive import FittedDrive

        run = FittedDrive.load(Path(runs[0])) if runs else None
        folder = Path(options.pop("output", Path(*runs) / "excitation"))
        refuse_existing(folder)  # before the search
        excitation = design_recording(options, run)
        excitation.save(folder)
        say(summarise_excitation(excitation.note, folder))


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse the arguments into folders, which contain no `=`, and options."""
    parser = Parser(
        prog="python -m frictionzoo.design",
        usage="python -m frictionzoo.design [RUN] KEY=VALUE ...",
        description="Design the next command to record, with maximal information within limits; verify it in MuJoCo C, "
        "and predict the accuracy of each parameter. RUN is the folder of a finished run, whose values describe the "
        "drive; without it, initial values do.",
        epilog=_OPTIONS,
    )
    parser.add_argument("options", metavar="KEY=VALUE", nargs="+", help="limits, and other options")
    parsed = parser.parse_args(arguments)
    parsed.folders = [text for text in parsed.options if "=" not in text]
    parsed.options = [text for text in parsed.options if "=" in text]
    return parsed
