"""Picture of README: a recording and its simulations from the same initial state, with and without friction."""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

import frictionzoo as fz
from frictionzoo.report.colors import BASELINE, GRID, MEASURED, MODEL, TEXT

PICTURE = Path(__file__).parent / "landing.svg"
JOB = ("data=twin", "model=mujoco_default", "fit=lm", "loop.progress=false")
EVERY = 12  # samples of 1 ms; a screen does not resolve more in 3 s
STYLE: dict[Any, Any] = {
    "font.size": 18,  # at a width of 720 points: legible on a phone
    "text.color": TEXT,
    "axes.labelcolor": TEXT,
    "axes.edgecolor": TEXT,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "xtick.color": TEXT,
    "ytick.color": TEXT,
    "legend.frameon": False,
    "svg.hashsalt": "landing",  # the same drawing gives the same file
}


def draw(fit: fz.Identified) -> Figure:
    """Draw position and error in the first long test rollout, on a white background for pages of any colour.

    Args:
        fit: Identified drive of simulated data: the picture must not publish a real recording.
    """
    assert fit.result["data"]["origin"] == "simulated", "expected simulated data"
    curves = fit.curves
    measured = curves.measured_qpos[0, 1:, 0]
    simulated = {
        "without friction": (curves.baseline_qpos[0, :, 0], BASELINE),
        "with friction": (curves.qpos[0, :, 0], MODEL),
    }
    time = fit.segments.timestep * np.arange(1, 1 + len(measured))
    figure = Figure(figsize=(10, 4.1), layout="constrained", facecolor="white")
    position, error = figure.subplots(2, 1, sharex=True)
    thick = {"color": MEASURED, "linewidth": 9, "alpha": 0.25}
    position.plot(time[::EVERY], measured[::EVERY], label="measured", **thick)
    error.plot(time[[0, -1]], [0, 0], **thick)
    for name, (states, color) in simulated.items():
        position.plot(time[::EVERY], states[::EVERY], color=color, linewidth=3, label=name)
        error.plot(time[::EVERY], 1e3 * (states - measured)[::EVERY], color=color, linewidth=3)
    position.set_ylabel("angle [rad]")
    error.set(ylabel="error [mrad]", xlabel="time [s], open loop from the first state on", xlim=(0, time[-1]))
    figure.legend(loc="outside upper center", ncols=3, handlelength=1.2, columnspacing=1.2)
    return figure


def main() -> None:
    """Draw the picture of a given run, or of a new one."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", nargs="?", type=Path, help="folder of a run; left out, one is made first")
    given = parser.parse_args().run
    with tempfile.TemporaryDirectory() as folder, matplotlib.rc_context(STYLE):
        if given is None:
            subprocess.run([sys.executable, "-m", "frictionzoo.run", *JOB, f"hydra.run.dir={folder}"], check=True)
        draw(fz.load(given or folder)).savefig(PICTURE, metadata={"Date": None})


if __name__ == "__main__":
    main()
