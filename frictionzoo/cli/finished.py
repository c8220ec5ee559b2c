"""Commands on finished runs: `python -m frictionzoo.NAME`, with NAME one of `card`, `compare`, `design` and so on."""

import argparse
import contextlib
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from frictionzoo.cli.mistakes import mistakes_in_one_line
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.telling import Parser, say, tell

_HELP = {
    "card": (
        "licence=ID",
        "Write the identified drive of a run as a card: values with intervals, model, conditions, hashes of the "
        "recordings and held-out errors, as a page and for programs, with MJCF. frictionzoo.load reads it.",
        """options: licence=ID, required, the card's licence as model hubs name it: cc-by-4.0, apache-2.0; name=TEXT,
        its title; supply=TEXT, temperature=TEXT, payload=TEXT, conditions of the recording, not stated by default;
        output=FOLDER, by default card in the run's folder. For a run that evaluated published values: bam=FILE, their
        BAM parameter file, and source=TEXT, who published it and where.""",
    ),
    "compare": (
        "",
        "Compare runs on the same data and the same rollouts, and write comparison.json, comparison.html, figures and "
        "a LaTeX table.",
        None,
    ),
    "design": (
        "limits",
        "Design the next command to record, with maximal information within limits; verify it in MuJoCo C, and predict "
        "the accuracy of each parameter. RUN is the folder of a finished run, whose values describe the drive; without "
        "RUN, the initial values do.",
        """options: position=REACH or [LOW,HIGH], velocity=, torque=, limits of the drive, in rad, rad/s and N m, or m,
        m/s and N; home, the rest position; seconds, rate, ramp, period, bandwidth, margin; quantum, position_noise and
        velocity_noise of the sensors; criterion=determinant or worst, starts, iterations, seed; points and fps of the
        files for ROS 2 and LeRobot; inputs.NAME=VALUE; output=FOLDER; without RUN also bench=NAME, model=NAME and
        their options.""",
    ),
    "distill": (
        "model=NAME",
        "Fit another model to the identified drive of a run with the recorded commands, and print the loss of "
        "accuracy on held-out recordings.",
        """options: model=NAME; output=FOLDER, by default distilled/NAME in the run's folder; and fit options of a run,
        such as fit, model.*, fit.*, segments.*, loop.*, seed. Defaults come from the run, except fit=auto and segments
        as long as the evaluation rollouts.""",
    ),
    "drift": (
        "data.KEY=VALUE",
        "Check whether a drive has changed: identify it again from new recordings, with the settings of RUN, and "
        "compare each parameter. Exit status: 0 unchanged, 4 changed, 3 cannot tell, 2 refused.",
        """options: data.*, how to read the recordings, by default as in RUN; alarm=0.01, probability of a false alarm,
        over all parameters together; smallest=0.01, smallest change that counts, as a share; output=FOLDER, for
        drift.json and the new identification, by default outputs/DATE/TIME_drift.""",
    ),
    "export": (
        "target=NAME",
        "Export the identified drive of a run to another program, run the export there, and print its distance from "
        "the fitted drive and its limits.",
        """options: target=NAME or target=all; timestep=SECONDS and integrator=NAME of the simulator (Euler,
        implicitfast or RK4), by default as in the model file; output=FOLDER, by default export/NAME in the run's
        folder; and options of the target.""",
    ),
}
"""Help of each command: main option, description, and further options."""


def card(arguments: Sequence[str]) -> None:
    """Publish a run's drive as a card."""
    with _checked("card", arguments, "licence=cc-by-4.0") as (folder, options):
        from frictionzoo.report.card import write_card

        place, warnings = write_card(folder, options)
        say("\n".join([*(f"warning: {line}" for line in warnings), f"files: {place}"]))


def compare(arguments: Sequence[str]) -> None:
    """Compare finished runs."""
    parsed = parse("compare", arguments)
    output = parsed.output or (parsed.folders[0] if len(parsed.folders) == 1 else Path()) / "comparison"
    with mistakes_in_one_line():
        # Imported late: neither --help nor a mistake waits for torch and JAX.
        from frictionzoo.core.jobs import find_runs

        for folder in parsed.folders:
            find_runs(folder)
        tell("loading torch and JAX")
        from frictionzoo.api.comparison_files import write_comparison
        from frictionzoo.report.terminal import summarise_comparison

        tell("comparing the runs")
        say(summarise_comparison(write_comparison(parsed.folders, output, parsed.font), output))


def design(arguments: Sequence[str]) -> None:
    """Design the next recording, of a run's drive or of the initial values."""
    with _checked("design", arguments, "velocity=4") as (run, options):
        from frictionzoo.api.design import design_recording
        from frictionzoo.core.output import refuse_existing
        from frictionzoo.report.terminal import summarise_excitation
        from frictionzoo.result.fitted_drive import FittedDrive

        folder = Path(options.pop("output", (run or Path()) / "excitation"))
        refuse_existing(folder)  # before the search
        excitation = design_recording(options, FittedDrive.load(run) if run else None)
        excitation.save(folder)
        say(summarise_excitation(excitation.note, folder))


def distill(arguments: Sequence[str]) -> None:
    """Fit a simpler model to a run's drive."""
    with _checked("distill", arguments, "model=stribeck") as (folder, options):
        from frictionzoo.cli.student import distill

        distill(folder, options)


def drift(arguments: Sequence[str]) -> None:
    """Check whether a drive has changed since its runs."""
    parsed = parse("drift", arguments)
    with mistakes_in_one_line():
        from frictionzoo.core.jobs import refuse_unfinished
        from frictionzoo.core.output import RESULT

        options = read_options([text for text in parsed.paths if "=" in text], "data.sign.ctrl=-1")
        paths = [Path(text) for text in parsed.paths if "=" not in text]
        count = next((number for number, path in enumerate(paths) if not (path / RESULT).exists()), len(paths))
        for run in paths[:1]:
            refuse_unfinished(run)
        if count == len(paths):
            raise ConfigError("no recording, expected RUN and a new recording; name one, as in drift RUN b.csv")
        tell("loading torch and JAX, reading the runs")
        from frictionzoo.cli.drift import report_drift

        status = report_drift(paths[:count], list(map(str, paths[count:])), options)
    sys.exit(status)


def export(arguments: Sequence[str]) -> None:
    """Export a run's drive to another program."""
    with _checked("export", arguments, "target=mjcf") as (folder, options):
        from frictionzoo.export.write import summarise_exports, write_exports

        say(summarise_exports(write_exports(folder, options)))


@contextlib.contextmanager
def _checked(name: str, arguments: Sequence[str], example: str) -> Iterator[tuple[Any, dict[str, str]]]:
    """Yield the folder of the run (of a design, None without one) and the options of a command.

    Refuse wrong options and an unfinished run before slow imports; a user's mistake gives one line and status 2.
    """
    parsed = parse(name, arguments)
    with mistakes_in_one_line():
        runs = [text for text in parsed.options if "=" not in text] if name == "design" else [parsed.folder]
        if len(runs) > 1:
            raise ConfigError(f"{runs[1]}: expected KEY=VALUE, or the folder of one run")
        options = read_options([text for text in parsed.options if text not in runs], example)
        # Imported late: neither --help nor a mistake waits for torch and JAX.
        from frictionzoo.core.jobs import refuse_unfinished

        for run in runs:
            refuse_unfinished(Path(run))
        tell("loading torch and JAX, reading the run")
        yield Path(runs[0]) if runs else None, options


def parse(name: str, arguments: Sequence[str]) -> argparse.Namespace:
    """Parse the arguments of a command."""
    option, description, epilog = _HELP[name]
    usages = {"design": "[RUN] KEY=VALUE ...", "drift": "RUN ... RECORDING ... [KEY=VALUE ...]"}
    usage = f"python -m frictionzoo.{name} {usages[name]}" if name in usages else None
    parser = Parser(prog=f"python -m frictionzoo.{name}", usage=usage, description=description, epilog=epilog)
    if name == "compare":
        parser.add_argument("folders", metavar="FOLDER", nargs="+", type=Path, help="a run's folder, or a sweep's")
        default = "comparison/ in the given folder, or here if several are given"
        parser.add_argument("--output", metavar="FOLDER", type=Path, help=f"output folder; by default {default}")
        parser.add_argument("--font", choices=("sans", "serif"), default="sans", help="font of the PDF figures")
        return parser.parse_args(arguments)
    if name == "drift":
        paths = "folders of finished runs of the unchanged drive, then recordings, and options"
        parser.add_argument("paths", metavar="KEY=VALUE", nargs="+", help=paths)
        return parser.parse_args(arguments)
    if name != "design":
        run = "the folder of a finished run, the teacher" if name == "distill" else "the folder of a finished run"
        parser.add_argument("folder", metavar="RUN", type=Path, help=run)
    count = "+" if name == "design" else "*"
    parser.add_argument("options", metavar="KEY=VALUE", nargs=count, help=f"{option}, and other options")
    return parser.parse_args(arguments)


def read_options(texts: Sequence[str], example: str) -> dict[str, str]:
    """Return the values of KEY=VALUE arguments by key, as text; messages show the `example`.

    Raises:
        ConfigError: An argument is not KEY=VALUE, or a key is given twice.
    """
    options: dict[str, str] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not key or not value:
            raise ConfigError(f"{text}: expected KEY=VALUE, such as {example}")
        if key in options:
            raise ConfigError(f"{text}: {key} is given twice; give it once")
        options[key] = value
    return options
