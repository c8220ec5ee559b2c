"""False alarms and missed changes of `frictionzoo.drift` over many simulated recordings of one drive.

    python benchmarks/drift.py
    python benchmarks/drift.py --changes 0 0.02 0.05 0.1 --runs 4

`event_exact.py` simulates the drive's sticking and sliding from event to event, without MuJoCo and its friction
constraint. Every recording has another random command and other noise. The first ones are identified as the finished
runs; each further one, with the drive's dry friction changed by a share, is compared with them as `frictionzoo.drift`
does. All fits share the functions compiled for the first.
"""

import argparse
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import jax
import numpy as np
from coverage import CASES, Fits, record
from measure import make_parser, report

import frictionzoo as fz
from frictionzoo.api.drift import ALARM, SMALLEST
from frictionzoo.core.log import Log
from frictionzoo.result.comparison.drift import Estimates, decide, find_differences

BETWEEN = 1000  # seeds between the recordings of two changes
Estimated = dict[str, tuple[float, float, float]]
"""Middle, variance and degrees of freedom of each parameter that the data determine."""


def estimate(fits: Fits, log: Log) -> Estimated:
    """Identify the drive from one recording, with the functions compiled for the first."""
    _, found = fits.fit([log])
    row = found.covariance
    assert row is not None
    variances = np.diag(row.matrix)
    return {
        label: (float(row.centre[index]), float(variances[index]), row.freedom)
        for index, label in enumerate(row.labels)
        if found.identifiable[label]
    }


def judge(
    case: str, fits: Fits, runs: Sequence[Estimated], change: float, options: argparse.Namespace
) -> dict[str, Any]:
    """Compare recordings of the drive with changed dry friction, and return the row."""
    labels = [label for label in runs[0] if all(label in run for run in runs)]
    earlier = Estimates(*np.moveaxis(np.array([[run[label] for label in labels] for run in runs]), 2, 0))
    at, drive = labels.index("friction.frictionloss"), CASES[case][0]
    drive = replace(drive, forward=(1 + change) * drive.forward)
    first, began = options.first + BETWEEN * (1 + options.changes.index(change)), time.perf_counter()
    counts, changes, halves = Counter[str](), [], []
    for log in record(drive, options.logs, first, options.seconds).logs:
        now = estimate(fits, log)
        if not all(label in now for label in labels):
            counts["cannot tell"] += 1
            continue
        latest = Estimates(*np.transpose([now[label] for label in labels]))
        found = find_differences(earlier, latest, options.alarm / len(labels))
        verdicts = decide(found, [True] * len(labels), options.smallest)
        counts[next((v for v in ("changed", "cannot tell") if v in verdicts), "unchanged")] += 1
        changes.append(100 * np.expm1(found.change[at]))
        halves.append(100 * found.half[at])
    return {
        "case": case,
        "change": 100 * change,
        "logs": options.logs,
        **{verdict.replace(" ", "_"): counts[verdict] for verdict in ("changed", "unchanged", "cannot tell")},
        "found": float(np.mean(changes)),
        "scatter": float(np.std(changes, ddof=1)),
        "half": float(np.mean(halves)),
        "seconds": (time.perf_counter() - began) / options.logs,
    }


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser("drift", __doc__)
    parser.add_argument("--cases", nargs="*", choices=("coulomb", "load", "ripple"), default=["coulomb"])
    parser.add_argument("--changes", nargs="*", type=float, default=[0.0, 0.1], help="of the dry friction, as shares")
    parser.add_argument("--logs", type=int, default=20, metavar="N", help="how many recordings of each change")
    parser.add_argument("--runs", type=int, default=1, metavar="N", help="how many runs of the unchanged drive")
    parser.add_argument("--seconds", type=float, default=10.0, help="of a recording")
    parser.add_argument("--length", type=int, default=40, metavar="SAMPLES", help="of a segment")
    parser.add_argument("--alarm", type=float, default=ALARM, help="probability of a false alarm")
    parser.add_argument("--smallest", type=float, default=SMALLEST, help="smallest change that counts, as a share")
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="seed of the first")
    return parser.parse_args()


def main() -> None:
    """Identify the runs of each case, compare its recordings, and report a table."""
    options, rows = parse(), []
    for case in options.cases:
        drive, law = CASES[case]
        logs = record(drive, options.runs, options.first, options.seconds).logs
        with jax.enable_x64(True):
            fits = Fits(fz.law(law), logs[:1], options.length)
            runs = [estimate(fits, log) for log in logs]
            rows += [judge(case, fits, runs, change, options) for change in options.changes]
    columns = {key: key for row in rows for key in row}
    drives = {case: asdict(CASES[case][0]) for case in options.cases}
    report(options.out, rows, columns, runs=options.runs, seconds=options.seconds, drives=drives)


if __name__ == "__main__":
    main()
