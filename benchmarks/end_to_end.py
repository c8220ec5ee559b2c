"""Wall time of whole jobs, cold and warm: `python benchmarks/end_to_end.py`.

`python -m frictionzoo.run model=MODEL` identifies each model twice: with empty caches, and again with the caches of the
first run. Options after `--` go to every run:
`python benchmarks/end_to_end.py --models baseline -- data.samples=30000`.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from measure import make_parser, report

COLUMNS = {
    "model": "model",
    "cold_wall": "wall cold [s]",
    "warm_wall": "wall warm [s]",
    "cold_compile": "compile cold [s]",
    "warm_compile": "compile warm [s]",
    "cold_fit": "fit cold [s]",
    "warm_fit": "fit warm [s]",
    "iterations": "iterations",
}
MODELS = (
    "baseline",
    "mujoco_default",
    "mujoco_grid_search",
    "coulomb_smooth",
    "coulomb_stribeck",
    "neural_friction",
)
EXHAUSTIVE = ("mujoco_grid_search",)  # tries all combinations, regardless of iterations


def main() -> None:
    """Run all models, print and write the results."""
    options = parse()
    run_python("-c", "import frictionzoo.cli.run")  # load packages from disk first, at no model's cost
    rows = []
    for model in options.models:
        rows.append(run_twice(model, overrides_of(model, options)))
        print(f"{model}: cold {rows[-1]['cold_wall']:.1f} s, warm {rows[-1]['warm_wall']:.1f} s", flush=True)
    print()
    report(options.out, rows, COLUMNS, overrides=options.overrides, iterations=options.iterations)


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser("end_to_end", __doc__)
    parser.add_argument("--models", nargs="+", choices=MODELS, default=MODELS, metavar="MODEL", help=" ".join(MODELS))
    parser.add_argument("--iterations", type=int, metavar="N", help="fit.iterations of all models but the grid search")
    parser.add_argument("overrides", nargs="*", metavar="OPTION=VALUE", help="options of every run")
    return parser.parse_args()


def overrides_of(model: str, options: argparse.Namespace) -> list[str]:
    """Return the options of this model's runs."""
    shortened = options.iterations is not None and model not in EXHAUSTIVE
    return [*options.overrides, *([f"fit.iterations={options.iterations}"] if shortened else [])]


def run_twice(model: str, overrides: Sequence[str]) -> dict[str, Any]:
    """Run a model with empty caches and then with filled ones; return the row."""
    row: dict[str, Any] = {"model": model}
    with tempfile.TemporaryDirectory() as folder:
        caches = [f"{option}={folder}/{option}" for option in ("compilation_cache", "data.cache_dir")]
        for start in ("cold", "warm"):
            run = Path(folder) / start
            began = time.perf_counter()
            run_python("-m", "frictionzoo.run", f"model={model}", f"hydra.run.dir={run}", *caches, *overrides)
            row[f"{start}_wall"] = time.perf_counter() - began
            result = json.loads((run / "result.json").read_text())
            row |= {f"{start}_{part}": seconds for part, seconds in result["timing"].items()}
            row["iterations"] = result["fit"]["iterations"]
    return row


def run_python(*arguments: str) -> None:
    """Run Python with these arguments and wait for its end.

    Raises:
        SystemExit: The process failed; its message is on standard error.
    """
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    finished = subprocess.run([sys.executable, *arguments], env=environment, stdout=subprocess.DEVNULL)
    if finished.returncode:
        sys.exit(f"python {' '.join(arguments)}: exit status {finished.returncode}")


if __name__ == "__main__":
    main()
