"""Cards of the drives measured in the experiments: `python experiments/cards.py --licence cc-by-4.0`.

Each experiment on hardware recordings gets a card of the run that the comparison of its runs recommends; with folds,
the comparison of the first fold. `python experiments/reproduce.py` makes the runs; an experiment without runs gets no
card. BAM parameter files given with `--bam` are evaluated on the recordings of their servo and labelled as BAM's.
"""

import argparse
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from reproduce import EXPERIMENTS, read_expected

from frictionzoo.bench.read_bam import BamDrive, read_bam
from frictionzoo.cli.run import NOT_IDENTIFIED
from frictionzoo.core.errors import ConfigError, FrictionzooError, RunError, closest
from frictionzoo.report.card import write_card
from frictionzoo.result.comparison.record import compare_runs
from frictionzoo.result.comparison.runs import read_runs

RECORDED = ("xl330",)
"""BAM servos with recordings, in a data set of the same name."""
SOURCE = "Rhoban, https://github.com/Rhoban/bam"


def find_drives(runs: Path) -> Iterator[tuple[str, Path]]:
    """Yield the name of each experiment and the folder of its recommended run.

    Args:
        runs: Folder of the experiments' runs, one subfolder per experiment.

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
    """Run and evaluate the values of a BAM parameter file.

    Raises:
        ConfigError: There are no recordings of its servo.
        RunError: The run failed.
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
    """Write a card with this name; print its path and warnings."""
    place, left = write_card(folder, {"licence": options.licence, "output": str(options.output / name), **others})
    print("\n".join([*(f"warning: {line}" for line in left), f"{name}: {place}"]), flush=True)


def main() -> int:
    """Write all cards; return 1 if a card cannot be written."""
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
