"""Automatic settings against hand-made settings: each ready experiment, and the same with `recipe=auto`.

    python benchmarks/recipe.py
    python benchmarks/recipe.py --cases emps xl330
    python benchmarks/recipe.py --cases twin -- data.samples=30000

Both runs of a case fit the same model to the same recordings and are evaluated on the same held-out rollouts.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from measure import make_parser, report

OPEN = ("segments.count=auto", "segments.length=auto")  # settings fixed in the experiment's file
CASES = {  # options of the hand-made experiment, and options that recipe=auto needs in addition
    "twin": (("experiment=kovalev2026", "model=coulomb_stribeck"), OPEN),
    "twin_gear": (("experiment=zoo", "model=harmonic_drive"), (*OPEN, "bench.params.delay.identify=auto")),
    "emps": (("experiment=emps",), ()),
    "sts3215": (("experiment=sts3215",), ()),
    "xl330": (("experiment=xl330",), ()),
}
COLUMNS = {
    "case": "data",
    "law": "law",
    "rollouts": "rollouts",
    "by_hand": "by hand, MAE",
    "automatic": "automatic, MAE",
    "ratio": "ratio",
    "rmse_by_hand": "by hand, RMSE",
    "rmse_automatic": "automatic, RMSE",
    "rmse_ratio": "ratio of RMSE",
    "seconds_by_hand": "by hand [s]",
    "seconds": "automatic [s]",
}


def main() -> None:
    """Run each case and report a table."""
    options, more = parse()
    rows = []
    for case in options.cases:
        by_hand, left_open = CASES[case]
        found, seconds_by_hand = run(*by_hand, *more)
        automatic, seconds = run(*by_hand, "recipe=auto", *left_open, *more)
        rows.append(compare(case, found, automatic) | {"seconds_by_hand": seconds_by_hand, "seconds": seconds})
        print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    for what in ("ratio", "rmse_ratio"):
        print(f"{what}: largest {max(row[what] for row in rows):.3f}")
    report(options.out, rows, COLUMNS, options=more)


def parse() -> tuple[argparse.Namespace, list[str]]:
    """Parse the command line; return it with the options of all runs, given after `--`."""
    parser = make_parser("recipe", __doc__)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("overrides", nargs="*", metavar="OPTION=VALUE", help="options of every run")
    options = parser.parse_args()
    return options, options.overrides


def run(*options: str) -> tuple[dict[str, Any], float]:
    """Run a job; return its result and its duration [s]."""
    with tempfile.TemporaryDirectory() as scratch:
        command = [sys.executable, "-m", "frictionzoo.run", *options, f"hydra.run.dir={scratch}/run"]
        began = time.perf_counter()
        finished = subprocess.run(command, capture_output=True, text=True)
        seconds = time.perf_counter() - began
        if finished.returncode not in (0, 3):  # 3: the fit did not identify the drive
            raise SystemExit(f"{' '.join(options)}: {finished.stderr}")
        return json.loads((Path(scratch) / "run" / "result.json").read_text()), seconds


def compare(case: str, by_hand: dict[str, Any], automatic: dict[str, Any]) -> dict[str, Any]:
    """Return the held-out position errors of both runs, in rollouts of the main horizon."""
    if (one := by_hand["evaluation"]["sha256"]) != (other := automatic["evaluation"]["sha256"]):
        raise SystemExit(f"{case}: rollouts {one[:12]} and {other[:12]}, expected the same")
    tested = [result["by_horizon"][0]["test"] for result in (by_hand, automatic)]
    row: dict[str, Any] = {"case": case, "law": by_hand["model"], "rollouts": tested[0]["rollouts"]}
    for key, prefix in (("position_mae", ""), ("position_rmse", "rmse_")):
        errors = [each[key] for each in tested]
        row |= {f"{prefix}by_hand": errors[0], f"{prefix}automatic": errors[1], f"{prefix}ratio": errors[1] / errors[0]}
    return row


if __name__ == "__main__":
    main()
