"""End-to-end identification of a robot with many joints: `python benchmarks/whole_robot.py FILE`.

FILE is the maker's unmodified MJCF or URDF. Friction and armature of every joint are drawn at random and hidden.
MuJoCo C simulates recordings of position control along sums of sines, with encoder noise. `python -m frictionzoo.run`
identifies the values from these files in a separate process without caches. The row gives the cost and the errors.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float
from measure import make_parser, report

import frictionzoo as fz
from frictionzoo.bench import PositionPD, Robot

COLUMNS = {
    "joints": "joints",
    "branches": "joints of branches",
    "parameters": "parameters",
    "whole": "whole [s]",
    "cpu": "CPU [s]",
    "setup": "setup [s]",
    "compile": "compile [s]",
    "fit": "fit [s]",
    "iterations": "iterations",
    "memory": "memory [GB]",
    "armature": "armature, worst [%]",
    "frictionloss": "frictionloss, worst [%]",
    "damping": "damping, worst [%]",
    "test": "test [mrad]",
}
STEP = 0.002  # s
NOISE = 1e-5  # rad, standard deviation of the encoder noise
GAINS = {"kp": 200.0, "kd": 5.0}  # N m/rad, N m s/rad
SIGNALS = {"qpos": "rad", "qvel": "rad/s", "ctrl": "rad"}
RANGES = {"armature": (0.02, 0.2), "frictionloss": (0.2, 2.0), "damping": (0.1, 1.0)}
"""Ranges of the hidden values [kg m^2, N m, N m s/rad]."""


def main() -> None:
    """Simulate, identify and compare; print and write the results."""
    options = parse()
    robot = Robot(str(options.file.resolve()), actuator=PositionPD(kp=GAINS["kp"], kd=GAINS["kd"]), timestep=STEP)
    rng = np.random.default_rng(options.seed)
    hidden = {name: low * (high / low) ** rng.uniform(size=robot.nv) for name, (low, high) in RANGES.items()}
    with tempfile.TemporaryDirectory() as folder:
        for number in range(options.recordings):
            write(Path(folder) / f"recording_{number}.csv", simulate(robot, hidden, options.seconds, rng))
        row = identify(options, robot, Path(folder))
    found = row.pop("values")
    errors = {name: 100 * float(np.abs(np.array(found[name]) / value - 1).max()) for name, value in hidden.items()}
    branches = "+".join(str(robot.branches.count(number)) for number in sorted(set(robot.branches)))
    shown = {"joints": robot.nv, "branches": branches, "parameters": 3 * robot.nv, **row, **errors}
    used = {name: getattr(options, name) for name in ("recordings", "seconds", "segments", "length", "seed")}
    report(options.out, [shown], COLUMNS, file=options.file.name, **used)


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser("whole_robot", __doc__)
    parser.add_argument("file", type=Path, metavar="FILE", help="of the robot")
    parser.add_argument("--recordings", type=int, default=5, help="the last one tests")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each")
    parser.add_argument("--segments", type=int, default=60)
    parser.add_argument("--length", type=int, default=50, help=f"steps of {1e3 * STEP:g} ms in a segment")
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args()


def simulate(
    robot: Robot, hidden: Mapping[str, np.ndarray], seconds: float, rng: np.random.Generator
) -> Mapping[str, Float[np.ndarray, "samples nv"]]:
    """Simulate a recording: positions, velocities and commands."""
    text = robot.mjcf({**robot.initial_values(), "armature": hidden["armature"]}, hidden["frictionloss"])
    model = mujoco.MjModel.from_xml_string(text)
    model.dof_damping[:] = hidden["damping"]
    data, count = mujoco.MjData(model), round(seconds / STEP)
    clock = STEP * np.arange(count)[:, None, None]
    frequency, phase = rng.uniform(0.1, 2.0, (4, robot.nv)), rng.uniform(0, 2 * np.pi, (4, robot.nv))
    ctrl = 0.15 * np.sin(2 * np.pi * frequency * clock + phase).sum(axis=1)
    data.qpos[:] = ctrl[0]
    state = np.empty((2, count, robot.nv))
    for index in range(count):
        state[:, index] = data.qpos, data.qvel
        data.ctrl[:] = ctrl[index]
        mujoco.mj_step(model, data)
    return {"qpos": state[0] + rng.normal(0, NOISE, state[0].shape), "qvel": state[1], "ctrl": ctrl}


def write(path: Path, signals: Mapping[str, Float[np.ndarray, "samples nv"]]) -> None:
    """Write a CSV file with one column per signal and joint."""
    header = ["time", *(f"{name}_{joint}" for name, own in signals.items() for joint in range(own.shape[1]))]
    clock = STEP * np.arange(len(signals["ctrl"]))[:, None]
    np.savetxt(path, np.hstack([clock, *signals.values()]), delimiter=",", header=",".join(header), comments="")


def identify(options: argparse.Namespace, robot: Robot, folder: Path) -> dict[str, Any]:
    """Run the command; return its cost and the identified values."""
    files = sorted(map(str, folder.glob("*.csv")))
    joints = range(robot.nv)
    given: dict[str, Any] = {
        "data.train": files[:-1],
        "data.test": files[-1:],
        "data.columns.time": "time",
        **{f"data.columns.{name}": [f"{name}_{joint}" for joint in joints] for name in SIGNALS},
        **{f"data.units.{name}": unit for name, unit in {"time": "s", **SIGNALS}.items()},
        "data.clean.velocity": "measured",
        "bench.mjcf": options.file.resolve(),
        "bench.timestep": STEP,
        **{f"bench.actuator.params.{name}.init": value for name, value in GAINS.items()},
        "bench.params.armature.init": 0.05,
        "segments.count": options.segments,
        "segments.length": options.length,
        "loss.velocity": 0.01,
        "evaluation.horizons": [1.0],
        "evaluation.trajectory": 1.0,
        "scale.torque": 5,
        "recipe": "given",  # automatic settings would compile the whole robot for each choice
        "compilation_cache": "null",
        "loop.progress": "false",
    }
    overrides = [f"{name}={text(value)}" for name, value in given.items()]
    out, began = folder / "run", time.perf_counter()
    choices = ("data=files", "bench=robot", "model=mujoco_default", "fit=lm", f"hydra.run.dir={out}")
    command = [sys.executable, "-m", "frictionzoo.run", *choices, *overrides]
    environment = os.environ | {"JAX_ENABLE_COMPILATION_CACHE": "false"}
    finished = subprocess.run(command, env=environment, cwd=folder, stdout=subprocess.DEVNULL)
    if finished.returncode:
        sys.exit(f"{options.file}: exit status {finished.returncode}")
    whole, used = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    result, values = json.loads((out / "result.json").read_text()), fz.load(out).values
    return {
        "whole": whole,
        "cpu": used.ru_utime + used.ru_stime,
        **{name: result["timing"][name] for name in ("setup", "compile", "fit")},
        "iterations": result["fit"]["iterations"],
        "memory": used.ru_maxrss / 1e6,
        "test": 1e3 * result["metrics"]["test"]["position_rmse"],
        "values": {"armature": values["bench"]["armature"], **values["friction"]},
    }


def text(value: Any) -> str:
    """Format a value for Hydra."""
    return f"[{','.join(map(text, value))}]" if isinstance(value, list) else str(value)


if __name__ == "__main__":
    main()
