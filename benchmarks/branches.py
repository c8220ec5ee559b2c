"""Normal equations of a quadruped, computed leg by leg and as one problem.

    FRICTIONZOO_DATA=FOLDER python benchmarks/branches.py

In `experiment=go2_torque` the legs neither move each other nor share parameters. Both variants run the same simulation;
leg by leg, derivatives are computed only where a parameter acts, and legs share tangents.
"""

import argparse
import time
from dataclasses import replace
from typing import Any

import jax
import numpy as np
from measure import make_parser, median_time, report
from omegaconf import OmegaConf

from frictionzoo.core.build import build
from frictionzoo.core.config import compose_config
from frictionzoo.core.segments import cut_segments
from frictionzoo.fit import Objective, Space
from frictionzoo.simulation.drive import Drive

WAYS = ("leg by leg", "one problem")
COLUMNS = {
    "way": "normal equations",
    "dtype": "dtype",
    "coordinates": "coordinates",
    "tangents": "tangents",
    "compile": "compile [s]",
    "seconds": "equations [s]",
    "ratio": "ratio",
    "difference": "difference",
}


def main() -> None:
    """Measure each variant in each precision and report a table."""
    options = parse()
    jax.config.update("jax_enable_compilation_cache", False)  # time a first run
    rows = []
    for dtype in options.dtypes:
        jax.config.update("jax_enable_x64", dtype == "float64")
        found = [measure(way, dtype, options.segments, options.length) for way in WAYS]
        first, expected = found[0]
        for row, equations in found:
            row["ratio"] = row["seconds"] / first["seconds"]
            row["difference"] = difference(equations, expected)
            rows.append(row)
    report(options.out, rows, COLUMNS, segments=options.segments, length=options.length)


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser("branches", __doc__)
    parser.add_argument("--dtypes", nargs="+", choices=("float64", "float32"), default=["float64", "float32"])
    parser.add_argument("--segments", type=int, default=150, metavar="N")
    parser.add_argument("--length", type=int, default=100, help="steps in a segment")
    return parser.parse_args()


def measure(way: str, dtype: str, segments: int, length: int) -> tuple[dict[str, Any], Any]:
    """Time one evaluation; return its row and its result."""
    settings: Any = OmegaConf.to_container(compose_config("experiment=go2_torque"), resolve=True)
    bench = build(settings["bench"])
    model = build(settings["model"], nv=bench.nv)
    model.bind(bench.joints)
    dataset = bench.accept_all(build(settings["data"]).load())
    sampling = bench.sampling(dataset.logs[0].timestep)
    drive = Drive.assemble(bench, model, "specialised", sampling)
    rollout = drive.rollout if way == WAYS[0] else replace(drive.rollout, branches=(0,) * bench.nv)
    space = Space(bench, drive.model, dtype)
    windows = cut_segments(dataset.train, segments, length, sampling.history)
    objective = Objective(space, rollout, windows, **settings["loss"])
    began = time.perf_counter()
    evaluate = objective.compile_normal_equations()
    compiled = time.perf_counter() - began
    timed = median_time(evaluate, np.asarray(space.start), calls=3)
    named = {"way": way, "dtype": dtype, "coordinates": len(space.start), "tangents": len(objective._sparsity.seeds)}
    return {**named, "compile": compiled, "seconds": timed.seconds}, timed.answer


def difference(found: Any, expected: Any) -> float:
    """Return the largest difference in loss, gradient and second derivative, relative to the largest entry of each."""
    pairs = zip(found[:3], expected[:3], strict=True)
    return max(float(np.abs(one - other).max() / np.abs(other).max()) for one, other in pairs)


if __name__ == "__main__":
    main()
