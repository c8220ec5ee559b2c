"""frictionzoo against mujoco.sysid on a quadruped's twelve joints and on a chain of seven.

    FRICTIONZOO_DATA=FOLDER python benchmarks/robot.py
    python benchmarks/robot.py --variants chain --parts whole --seconds 4

Needs `pip install -e ".[sysid]"`. The quadruped uses the recordings of `conf/data/go2.yaml`; the chain is a hidden
chain of `newcomer.py`, without offsets. Both tools identify armature, frictionloss and damping of each joint, a
constant torque or an encoder offset of each joint, and the command delay. They use the same segments, initial values,
bounds and timestep of 5 ms (chain: 2 ms), and minimise squared position errors. sysid uses finite differences of
MuJoCo C. Its variant `plain` follows its documentation. `whole` and `legs` roll out all segments together with one
compiled model per vector, which sysid leaves to its user: for the whole robot, or for each leg with a separate delay.
Closed-loop rollouts of whole test runs in MuJoCo C, with a timestep of 1 ms, evaluate all results. Each row runs in a
separate process.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import mujoco
import numpy as np
from jaxtyping import Float
from measure import make_parser, report
from mujoco import rollout as mujoco_rollout
from newcomer import Hidden
from omegaconf import OmegaConf
from robot_sysid import SETTINGS, TOLERANCE, Search, aim_of, delayed, load, text_of

from frictionzoo.bench import Bench, Robot
from frictionzoo.core.build import build
from frictionzoo.core.config import compose_config
from frictionzoo.core.segments import Segments, cut_rollouts

EXPERIMENTS = {"torque": "go2_torque", "bias": "go2"}
"""Experiment by the additional parameter of each joint: a constant torque, or an encoder offset."""
CHAIN, SEED = "chain", 7
PARTS = {"plain": ", plain", "whole": "", "legs": ", leg by leg"}
JUDGED = 0.001  # s, timestep of the evaluation rollouts
COLUMNS = {
    "variant": "variant",
    "tool": "tool",
    "parameters": "parameters",
    "whole": "whole [s]",
    "cpu": "CPU [s]",
    "setup": "setup [s]",
    "compile": "compile [s]",
    "fit": "fit [s]",
    "iterations": "iterations",
    "rollouts": "rollout sets",
    "whole_ratio": "whole/ours",
    "cpu_ratio": "CPU/ours",
    "fit_ratio": "fit/ours",
    "fit_cpu_ratio": "fit's CPU/ours",
    "train": "train [mrad]",
    "test": "test [mrad]",
}

Found = dict[str, list[float]]
"""Values of each parameter, one per joint."""


def main() -> None:
    """Start a process per identification and evaluate the results; or identify as such a process."""
    options = parse()
    if options.row is not None:
        print(json.dumps(measure(**json.loads(options.row))))
        return
    with tempfile.TemporaryDirectory() as options.scratch:
        compare(options)


def compare(options: argparse.Namespace) -> None:
    """Identify each variant with each tool, evaluate and report."""
    rows = []
    for variant in options.variants:
        judge = Judge(compose(variant, options), options.seconds)
        wanted = [("mujoco.sysid", parts, name) for parts in options.parts for name in options.optimizers]
        found = [in_own_process(options, variant, *what) for what in [*wanted, ("frictionzoo", "whole", "lm")]]
        found = [{**row, **judge.judge(values)} for row, values in found]
        rows += [
            {**row, **{f"{part}_ratio": row[part] / found[-1][part] for part in ("whole", "cpu", "fit", "fit_cpu")}}
            for row in found
        ]
    if options.variants[-1] != CHAIN:
        rows += [{"variant": "-", "tool": "published", "parameters": 3 * judge.bench.nv, **judge.judge(published())}]
    segments = {"segments": judge.segments.count, "length": judge.segments.length, "seconds": options.seconds}
    report(options.out, rows, COLUMNS, **segments, settings=SETTINGS)


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser("robot", __doc__)
    parser.add_argument("--variants", nargs="+", choices=[*EXPERIMENTS, CHAIN], default=[*EXPERIMENTS])
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=[*PARTS], help="of sysid")
    parser.add_argument("--optimizers", nargs="+", choices=SETTINGS, default=["scipy_parallel_fd"], help="of sysid")
    parser.add_argument("--segments", type=int, default=150, help="that the fits compare")
    parser.add_argument("--length", type=int, default=100, help="steps of 5 ms in each")
    parser.add_argument("--iterations", type=int, default=100, help="of any fit, at most")
    parser.add_argument("--seconds", type=float, default=23.4, help="of a test run that are rolled out")
    parser.add_argument("--row", help=argparse.SUPPRESS)
    return parser.parse_args()


def compose(variant: str, options: argparse.Namespace) -> dict[str, Any]:
    """Return the settings of the experiment, without the compilation cache."""
    cut = (f"segments.count={options.segments}", f"segments.length={options.length}")
    fit = (f"fit.iterations={options.iterations}", f"fit.tolerance={TOLERANCE}", "loop.progress=false")
    judged = (f"evaluation.horizons=[{options.seconds}]", f"evaluation.trajectory={options.seconds}")
    named = [f"experiment={EXPERIMENTS[variant]}"] if variant in EXPERIMENTS else describe_chain(Path(options.scratch))
    config = compose_config(*named, "compilation_cache=null", *cut, *fit, *judged)
    return cast(dict[str, Any], OmegaConf.to_container(config, resolve=True))


def describe_chain(scratch: Path) -> list[str]:
    """Return the options of the hidden chain, and simulate its recording on the first call."""
    hidden, folder = Hidden.draw(CHAIN, SEED), scratch / CHAIN
    if not folder.exists():
        hidden.record(folder)
    late = "bench.params.delay.identify=true"
    return [*hidden.options(folder), "recipe=given", "fit=lm", "bench.timestep=0.002", late]


def in_own_process(
    options: argparse.Namespace, variant: str, tool: str, parts: str, method: str
) -> tuple[dict[str, Any], Found]:
    """Measure an identification in a new process; return its row and its values.

    Raises:
        SystemExit: The process failed; its message is on standard error.
    """
    named = {"variant": variant, "tool": f"{tool}, {method}{PARTS[parts]}"}
    print(*named.values(), flush=True)
    what = {"settings": compose(variant, options), "tool": tool, "parts": parts, "method": method}
    command = [sys.executable, __file__, "--row", json.dumps(what)]
    environment = os.environ | {"JAX_ENABLE_COMPILATION_CACHE": "false"}  # time a first run
    clock = Clock(resource.RUSAGE_CHILDREN)
    finished = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True)
    if finished.returncode:
        sys.exit(f"{named}: exit status {finished.returncode}")
    row = json.loads(finished.stdout.splitlines()[-1])
    values = row.pop("values")
    took = dict(zip(("whole", "cpu"), clock.read(), strict=True))
    return {**named, **took, **row}, values


class Clock:
    """Wall time since its creation, and processor time of this process or of its children.

    Other load on the machine lengthens the wall time, but hardly the processor time.
    """

    def __init__(self, whose: int = resource.RUSAGE_SELF) -> None:
        self._whose = whose
        self._began = self._now()

    def read(self) -> tuple[float, float]:
        """Return wall time and processor time [s]."""
        wall, cpu = (float(now - began) for now, began in zip(self._now(), self._began, strict=True))
        return wall, cpu

    def _now(self) -> tuple[float, float]:
        usage = resource.getrusage(self._whose)
        return time.perf_counter(), usage.ru_utime + usage.ru_stime


def measure(settings: dict[str, Any], tool: str, parts: str, method: str) -> dict[str, Any]:
    """Measure one identification, from files to parameters."""
    return run_ours(settings) if tool == "frictionzoo" else run_sysid(settings, parts, method)


def run_ours(settings: dict[str, Any]) -> dict[str, Any]:
    """Identify with frictionzoo, as `python -m frictionzoo.run` does up to the parameters."""
    from frictionzoo.fit import run_fit
    from frictionzoo.identification import Problem
    from frictionzoo.simulation.context import computing

    with computing(settings["dtype"], settings["device"], settings["compilation_cache"]):
        problem = Problem.from_settings(settings)
        compiling = Clock()
        problem.fit.prepare(problem.objective)
        compiled, fitting = compiling.read(), Clock()
        outcome = run_fit(problem.fit, problem.objective, problem.drive.model, **settings["loop"])
        fitted = fitting.read()
    values = {name: np.asarray(value).tolist() for part in outcome.values.values() for name, value in part.items()}
    return {
        "parameters": len(problem.objective.space.start),
        "setup": problem.seconds,
        "compile": compiled[0],
        "fit": fitted[0],
        "fit_cpu": fitted[1],
        "iterations": outcome.iterations,
        "values": values,
    }


def run_sysid(settings: dict[str, Any], parts: str, optimizer: str) -> dict[str, Any]:
    """Identify with mujoco.sysid, for the whole robot or for each leg separately."""
    whole = Clock()  # starts after the imports: a user of mujoco.sysid has other imports
    bench, params, segments, _ = load(settings)
    branches = np.array(bench.branches if parts == "legs" else [0] * bench.nv)
    legs = [np.flatnonzero(branches == branch) for branch in np.unique(branches)]
    (setup, _), fitting = whole.read(), Clock()
    searches = [Search(bench, params, segments, joints.tolist(), parts != "plain") for joints in legs]
    found = [search.run(optimizer, settings["fit"]["iterations"]) for search in searches]
    fitted, took = fitting.read(), whole.read()
    values = {name: np.zeros(bench.nv) for name in params}
    for joints, part in zip(legs, found, strict=True):
        for name, value in part.items():
            values[name][joints] = value
    return {
        "parameters": sum(search.parameters for search in searches),
        "whole": took[0],
        "cpu": took[1],
        "setup": setup,
        "compile": 0.0,
        "fit": fitted[0],
        "fit_cpu": fitted[1],
        "iterations": max(search.iterations for search in searches),
        "rollouts": sum(search.rollouts for search in searches) / len(searches),
        "values": {name: value.tolist() for name, value in values.items()},
    }


class Judge:
    """Evaluation by rollouts in MuJoCo C, of the test runs with a short timestep and of the fitted segments."""

    def __init__(self, settings: dict[str, Any], seconds: float) -> None:
        self.fitted, _, self.segments, dataset = load(settings)
        self.bench = build({**settings["bench"], "timestep": JUDGED})
        history = self.bench.sampling(self.segments.timestep).history
        # Cut runs separately, for an error per run.
        self.runs = [cut_rollouts([log], seconds, None, "consecutive", 0, history).first for log in dataset.test]

    def judge(self, values: Mapping[str, Sequence[float]]) -> dict[str, float]:
        """Return root mean square position errors over all joints [mrad]."""
        squares = [self._squares(self.bench, values, run) for run in self.runs]
        runs = {f"test_{number}": 1e3 * float(np.sqrt(each.mean())) for number, each in enumerate(squares)}
        train = self._squares(self.fitted, values, self.segments)
        joint = np.sqrt(np.mean(squares, axis=(0, 1, 2)).max())
        return {
            "train": 1e3 * float(np.sqrt(train.mean())),
            "test": 1e3 * float(np.sqrt(np.mean(squares))),
            "worst_joint": 1e3 * float(joint),
            **runs,
        }

    def _squares(
        self, bench: Bench, values: Mapping[str, Sequence[float]], segments: Segments
    ) -> Float[np.ndarray, "batch time nv"]:
        given = {name: np.array(value) for name, value in values.items()}
        model = mujoco.MjModel.from_xml_string(text_of(bench, given))
        late = delayed(aim_of(bench, segments), given["delay"], segments, bench.timestep)
        begin = [np.zeros((segments.count, 1)), segments.qpos[:, 0], segments.qvel[:, 0]]
        data = [mujoco.MjData(model) for _ in range(os.cpu_count() or 1)]
        state, _ = mujoco_rollout.rollout(model, data, np.concatenate(begin, axis=1), late)
        each = late.shape[1] // segments.length
        predicted = np.asarray(state)[:, each - 1 :: each, 1 : 1 + bench.nv]
        return np.square(predicted - segments.qpos[:, 1:])


def published() -> Found:
    """Return the values that the recordings' owners published, identified with mujoco.sysid."""
    file = Robot(str(Path(os.environ["FRICTIONZOO_DATA"]) / "go2" / "go2_published.xml")).file
    return {**{name: value.tolist() for name, value in file.values.items()}, "delay": [0.0] * len(file.joints)}


if __name__ == "__main__":
    main()
