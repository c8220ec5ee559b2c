"""Prints runs beside the published numbers: `python experiments/kovalev2026/table.py RUN_FOLDER...`."""

import json
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

PUBLISHED = {  # MAE and its sigma over ten rollouts of 1 s on the real drive [rad]; Kovalev et al. 2026, Table 2
    "baseline": (0.0192, 0.0079),
    "mujoco_default": (0.0070, 0.0042),
    "mujoco_grid_search": (0.0086, 0.0053),
    "coulomb_smooth": (0.0072, 0.0039),
    "coulomb_stribeck": (0.0072, 0.0039),
    "neural_friction": (0.0072, 0.0040),
}
HEAD = (
    "| model | MAE (sigma), twin [rad] | change | MAE of 3 s, twin [rad] | armature [kg m^2] | fit [s] | "
    "MAE (sigma), published, real drive [rad] |\n|---|---|---|---|---|---|---|"
)


def tabulate(results: Iterable[Mapping[str, Any]]) -> str:
    """A Markdown table, one row a run, in the order of the paper.

    Args:
        results: Contents of `result.json` files; the change is against the baseline without friction of each run.
    """
    order = list(PUBLISHED)
    rows = sorted(results, key=lambda result: order.index(result["model"]))
    return "\n".join([HEAD, *map(_row, rows)])


def _row(result: Mapping[str, Any]) -> str:
    places, trajectory = result["paper"]["b"], result["paper"]["a"]["model"]["position_mae"]
    mae, without = places["model"]["position_mae"], places["baseline"]["position_mae"]
    armature = next(p["value"] for p in result["parameters"] if p["name"] == "armature")
    cells = [
        f"`{result['model']}`",
        f"{mae:.4f} ({places['model']['position_mae_std']:.4f})",
        f"{100 * (mae / without - 1):+.0f} %",
        f"{trajectory:.4f}",
        f"{armature:.4f}",
        f"{result['timing']['fit']:.0f}",
        "{:.4f} ({:.4f})".format(*PUBLISHED[result["model"]]),
    ]
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    print(tabulate(json.loads((Path(folder) / "result.json").read_text()) for folder in sys.argv[1:]))
