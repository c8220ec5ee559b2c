"""Writes a card of each drive that the experiments measured: `python experiments/cards.py --licence cc-by-4.0`.

Of each experiment on recordings of hardware whose runs `python experiments/reproduce.py` has left, it is the run that
their comparison recommends, of several folds that of the first one. An experiment that was not run has no card.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

from reproduce import EXPERIMENTS, read_expected

from frictionzoo.card.write import write_card
from frictionzoo.comparison.record import compare_runs
from frictionzoo.comparison.runs import read_runs
from frictionzoo.core.errors import FrictionzooError


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
        if recommended and not found[0].result["data"]["simulated"]:
            yield folder.name, next(run.folder for run in found if run.label == recommended["run"])


def main() -> int:
    """Entry point; the exit status is 1 where a card cannot be written."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--licence", required=True, metavar="ID", help="of the cards, such as cc-by-4.0")
    parser.add_argument("--runs", type=Path, metavar="FOLDER", default=Path("multirun"), help="where the runs are")
    parser.add_argument("--output", type=Path, metavar="FOLDER", default=Path("cards"), help="where cards go")
    options = parser.parse_args()
    try:
        for name, folder in find_drives(options.runs):
            place, left = write_card(folder, {"licence": options.licence, "output": str(options.output / name)})
            print("\n".join([*(f"warning: {line}" for line in left), f"{name}: {place}"]), flush=True)
    except FrictionzooError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
