"""Growth of time and memory with the data and with the network: `python benchmarks/growth.py`.

Three tables: one identification (`fit=lm model=mujoco_default`) over the number of samples, the same over the segment
length, and one gradient of `model=neural_friction` over the width of its two hidden layers. Each row runs in a separate
process to measure its peak memory. Samples are simulated from a known drive, with noise.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
from measure import compile_time, make_parser, median_time, peak_memory, print_table, write_json

# Only the measuring processes import frictionzoo and jax; this one starts them.

FIT_COLUMNS = {
    "samples": "samples",
    "length": "steps",
    "segments": "segments",
    "setup": "setup [s]",
    "compile": "compile [s]",
    "fit": "fit [s]",
    "iterations": "iterations",
    "ns_per_sample": "ns/sample",
    "ns_per_sample_iteration": "ns/sample/iteration",
    "data_memory": "before [MB]",
    "peak_memory": "peak [MB]",
    "armature_error": "armature off by",
}
NETWORK_COLUMNS = {
    "width": "width",
    "weights": "weights",
    "samples": "samples",
    "compile": "compile [s]",
    "gradient": "gradient [s]",
    "ns_per_sample": "ns/sample",
    "peak_memory": "peak [MB]",
}
SAMPLES = (10_000, 100_000, 1_000_000, 10_000_000)
LENGTHS = (5, 50, 500, 3000)
WIDTHS = (16, 64, 256)
LENGTH = 5  # steps per segment, where the number of samples grows
FIXED = 100_000  # samples, where the segment length grows
RECORDING = 10_000  # maximum samples per recording
TRUTH = {"armature": 0.04, "frictionloss": 0.2, "damping": 0.1}
NOISE = {"qpos": 1e-5, "qvel": 2e-3}  # rad and rad/s
SEED = 0


def main() -> None:
    """Start a process for each row, print and write the results; or measure a row as such a process."""
    options = parse()
    if options.row is not None:
        print(json.dumps(measure(**json.loads(options.row))))
        return
    rows = {name: [in_own_process(what) for what in wanted] for name, wanted in plan(options).items() if wanted}
    for name, table in rows.items():
        print(f"\nagainst {name}")
        print_table(table, NETWORK_COLUMNS if name == "width" else FIT_COLUMNS)
    flat = [{"against": name, **row} for name, table in rows.items() for row in table]
    write_json(options.out, {"settings": {"truth": TRUTH, "noise": NOISE}, "rows": flat})


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser("growth", __doc__)
    count = {"type": lambda text: int(float(text)), "nargs": "*", "metavar": "N"}
    parser.add_argument("--samples", default=SAMPLES, help="lengths of the data; 1e5 is a number too", **count)
    parser.add_argument("--lengths", default=LENGTHS, help=f"steps in a segment, at {FIXED} samples", **count)
    parser.add_argument("--widths", default=WIDTHS, help="of the hidden layers", **count)
    parser.add_argument("--segments", type=int, default=20_000, metavar="N", help=f"of {LENGTH} steps, for the network")
    parser.add_argument("--row", help=argparse.SUPPRESS)
    return parser.parse_args()


def plan(options: argparse.Namespace) -> dict[str, list[dict[str, Any]]]:
    """Return the rows of each table as arguments of `measure`."""
    return {
        "samples": [{"kind": "fit", "samples": samples, "length": LENGTH} for samples in options.samples],
        "length": [{"kind": "fit", "samples": FIXED, "length": length} for length in options.lengths],
        "width": [{"kind": "network", "segments": options.segments, "width": width} for width in options.widths],
    }


def in_own_process(what: dict[str, Any]) -> dict[str, Any]:
    """Measure a row in a new process.

    Raises:
        SystemExit: The process failed; its message is on standard error.
    """
    print(", ".join(f"{key} {value}" for key, value in what.items()), flush=True)
    command = [sys.executable, __file__, "--row", json.dumps(what)]
    environment = os.environ | {"JAX_ENABLE_COMPILATION_CACHE": "false"}  # time a first run
    finished = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True)
    if finished.returncode:
        sys.exit(f"{what}: exit status {finished.returncode}")
    return json.loads(finished.stdout.splitlines()[-1])


def measure(kind: str, **what: int) -> dict[str, Any]:
    """Measure a row."""
    return measure_fit(**what) if kind == "fit" else measure_network(**what)


def measure_fit(samples: int, length: int) -> dict[str, Any]:
    """Measure one identification, on data simulated before."""
    from frictionzoo.core.build import build
    from frictionzoo.core.segments import cut_segments
    from frictionzoo.fit import Objective, Space, run_fit
    from frictionzoo.fit.loop import FitFiles
    from frictionzoo.simulation.drive import Drive

    settings = compose("model=mujoco_default", "fit=lm", f"segments.length={length}", "segments.count=null")
    bench = build(settings["bench"])
    drive = Drive.assemble(bench, build(settings["model"], nv=1), settings["engine"])
    logs = list(record(drive.rollout, bench, samples))
    data_memory = peak_memory()

    began = time.perf_counter()
    segments = cut_segments(logs, **settings["segments"])
    space = Space(bench, drive.model, settings["dtype"])
    objective = Objective(space, drive.rollout, segments, **settings["loss"])
    setup = time.perf_counter() - began
    fit, model = build(settings["fit"]), drive.model
    loop = settings["loop"] | {"progress": False}
    with tempfile.TemporaryDirectory() as folder:
        outcome = run_fit(fit, objective, model, FitFiles(Path(folder), build(settings["logger"])), **loop)
    armature = float(outcome.values["bench"]["armature"][0])
    samples = sum(log.samples for log in logs)
    return {
        "samples": samples,
        "length": length,
        "segments": segments.count,
        "setup": setup,
        "compile": outcome.compile_seconds,
        "fit": outcome.fit_seconds,
        "iterations": outcome.iterations,
        "ns_per_sample": 1e9 * outcome.fit_seconds / samples,
        "ns_per_sample_iteration": 1e9 * outcome.fit_seconds / samples / outcome.iterations,
        "data_memory": data_memory,
        "peak_memory": peak_memory(),
        "armature_error": abs(armature / TRUTH["armature"] - 1),
    }


def record(rollout: Any, bench: Any, samples: int) -> Iterator[Any]:
    """Yield recordings of the known drive one at a time, to keep memory low."""
    from frictionzoo.core.log import Log
    from frictionzoo.core.state import Signals

    truth = {name: np.array([value]) for name, value in TRUTH.items()}
    armature = {"armature": truth.pop("armature")}
    values = {"bench": bench.initial_values() | armature, "friction": truth}
    rng = np.random.default_rng(SEED)
    size = min(samples, RECORDING)
    time_axis = bench.timestep * np.arange(size)
    for number in range(samples // size):
        ctrl = command(time_axis, rng)
        start = ctrl[:1], np.zeros((1, 1))
        after = rollout.compiled(values, *start, Signals(ctrl[None, :-1]))
        qpos, qvel = (np.concatenate([first, states[0]]) for first, states in zip(start, after, strict=True))
        qpos = qpos + NOISE["qpos"] * rng.normal(size=qpos.shape)
        qvel = qvel + NOISE["qvel"] * rng.normal(size=qvel.shape)
        yield Log(f"recording {number}", time_axis, qpos, qvel, ctrl, sha256="0" * 64, simulated=True)


def command(time_axis: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a desired position [rad]: five sines of random frequency and phase."""
    frequency, phase = rng.uniform(0.5, 10.0, 5), rng.uniform(0, 2 * np.pi, 5)
    return (np.sin(time_axis[:, None] * frequency + phase) / frequency).sum(axis=1, keepdims=True)


def measure_network(segments: int, width: int) -> dict[str, Any]:
    """Measure a loss with its gradient, as `fit=adam` evaluates it in each iteration."""
    from frictionzoo.identification import Problem

    hidden = f"model.hidden=[{width},{width}]"
    counts = (f"segments.count={segments}", f"segments.length={LENGTH}")
    problem = Problem.from_settings(compose("model=neural_friction", hidden, *counts))
    objective, start = problem.objective, problem.objective.space.start
    compiled, compile_seconds = compile_time(objective.compile, objective.value_and_grad("auto"), start, objective.data)
    seconds = median_time(compiled, start, objective.data).seconds
    samples = problem.segments.count * problem.segments.length
    return {
        "width": width,
        "weights": len(start) - len(objective.space.params),
        "samples": samples,
        "compile": compile_seconds,
        "gradient": seconds,
        "ns_per_sample": 1e9 * seconds / samples,
        "peak_memory": peak_memory(),
    }


def compose(*overrides: str) -> dict[str, Any]:
    """Return the settings of a job with these overrides, without the compilation cache."""
    from omegaconf import OmegaConf

    from frictionzoo.core.config import compose_config

    config = compose_config("compilation_cache=null", *overrides)
    return cast(dict[str, Any], OmegaConf.to_container(config, resolve=True))


if __name__ == "__main__":
    main()
