"""Writes a card of each drive that the experiments measured: `python experiments/cards.py --licence cc-by-4.0`.

Of each experiment on recordings of hardware whose runs `python experiments/reproduce.py` has left, it is the run that
their comparison recommends, of several folds that of the first one. An experiment that was not run has no card.
Parameter files of BAM that are named besides are judged on the recordings of their servo, and labelled as BAM's.
"""

import argparse
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from reproduce import EXPERIMENTS, read_expected

from frictionzoo.card.write import write_card
from frictionzoo.cli.run import NOT_IDENTIFIED
from frictionzoo.comparison.record import compare_runs
from frictionzoo.comparison.runs import read_runs
from frictionzoo.core.errors import ConfigError, FrictionzooError, RunError, closest
from frictionzoo.export.read_bam import BamDrive, read_bam

RECORDED = ("xl330",)
"""Servos of BAM of which there are recordings, as the data set of this name."""
SOURCE = "Rhoban, https://github.com/Rhoban/bam"


def find_drives(runs: Path) -> Iterator[tuple[str, Path]]:
    """Name of each experiment, and the folder of its recommended run.

    Args:
        runs: Folder of the experiments' runs, by their names.

    Raises:
        RunError: A run cannot be read, or runs of one experiment cannot be compared.
    """
    for page in sorted(EXPERIMENTS.glob("*/expected.yaml")):
        folder = runs / page.parent.name
        if not folder.exists():
            continue
        found, failures = read_runs([folder / "0" if "folds" in read_expected(folder.name) else folder])
        recommended = compare_runs(found, failures)["recommendation"]
        if recommended and found[0].result["data"]["origin"] != "simulated":
            yield folder.name, next(run.folder for run in found if run.label == recommended["run"])


def judge(file: Path, drive: BamDrive, folder: Path) -> None:
    """A run of the values of one of BAM's parameter files.

    Raises:
        ConfigError: There are no recordings of its servo.
        RunError: The run ended with a mistake.
    """
    if drive.actuator not in RECORDED:
        raise ConfigError(
            f"{file}: actuator={drive.actuator}; {closest(drive.actuator, RECORDED)}; no others are recorded"
        )
    command = [sys.executable, "-m", "frictionzoo.run", f"data={drive.actuator}", *drive.overrides()]
    done = subprocess.run([*command, f"hydra.run.dir={folder}"], capture_output=True, text=True)
    if done.returncode not in (0, NOT_IDENTIFIED):
        raise RunError(f"{file}: {done.stderr.strip().splitlines()[-1]}")


def write(name: str, folder: Path, options: argparse.Namespace, **others: str) -> None:
    """A card by this name, and what is to be said of it."""
    place, left = write_card(folder, {"licence": options.licence, "output": str(options.output / name), **others})
    print("\n".join([*(f"warning: {line}" for line in left), f"{name}: {place}"]), flush=True)


def main() -> int:
    """Entry point; the exit status is 1 where a card cannot be written."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--licence", required=True, metavar="ID", help="of the cards, such as cc-by-4.0")
    parser.add_argument("--runs", type=Path, metavar="FOLDER", default=Path("multirun"), help="where the runs are")
    parser.add_argument("--output", type=Path, metavar="FOLDER", default=Path("cards"), help="where cards go")
    parser.add_argument("--bam", type=Path, metavar="FILE", nargs="*", default=[], help="of the published ones of BAM")
    options = parser.parse_args()
    try:
        for name, folder in find_drives(options.runs):
            write(name, folder, options)
        for file in options.bam:
            drive = read_bam(file)
            name = f"bam_{drive.actuator}_{file.stem}"
            judge(file, drive, options.runs / name)
            write(name, options.runs / name, options, bam=str(file), source=SOURCE)
    except FrictionzooError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
