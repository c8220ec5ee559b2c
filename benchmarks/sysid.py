"""frictionzoo against mujoco.sysid on the same samples, parameters, bounds, initial values and residuals.

    python benchmarks/sysid.py

Needs `pip install -e ".[sysid]"`. Both tools minimise the sum of squared errors of position and velocity over 39
open-loop rollouts: sysid with finite differences of MuJoCo C, frictionzoo with Levenberg-Marquardt on exact Jacobians
of its rollouts. The same MuJoCo C rollouts evaluate both optima. sysid's residuals use states, because it stamps
sensors one step late.
"""

import argparse
import time
from typing import Any

import absl.logging
import jax
import mujoco
import numpy as np
from measure import make_parser, report
from mujoco import rollout as mujoco_rollout
from mujoco import sysid
from omegaconf import OmegaConf

from frictionzoo.bench import Bench
from frictionzoo.core.build import build
from frictionzoo.core.config import compose_config
from frictionzoo.core.log import Log
from frictionzoo.core.segments import Segments, cut_segments
from frictionzoo.fit import LevenbergMarquardt, Objective, Space
from frictionzoo.fit.chunk import begin, make_chunk
from frictionzoo.models import FrictionModel
from frictionzoo.simulation import friction_of, make_engine
from frictionzoo.simulation.rollout import make_rollout

NAMES = ("armature", "damping", "frictionloss")
SEQUENCES = 39
COLUMNS = {
    "tool": "tool",
    "seconds": "whole [s]",
    "compile": "compile [s]",
    "fit": "fit [s]",
    "default": "default/whole",
    "fastest": "fastest/whole",
    "fastest/fit": "fastest/fit",
    "loss": "loss",
    **{name: name for name in NAMES},
}


def main() -> None:
    """Run all identifications one after another and report a table."""
    options = parse()
    absl.logging.set_verbosity(absl.logging.ERROR)  # sysid warns that states are not model sensors
    settings: Any = OmegaConf.to_container(compose_config("model=mujoco_default", "data=twin"), resolve=True)
    bench, model = build(settings["bench"]), build(settings["model"], nv=1)
    log = read_whole(settings["data"], options.samples)
    segments = cut_segments([log], None, (log.samples - 1) // SEQUENCES)
    judge = Judge(bench, segments)
    rows = []
    for optimizer in ("mujoco", "scipy_parallel_fd"):
        rows.append(repeat(options.repeats, lambda name=optimizer: run_sysid(bench, model, segments, judge, name)))
    for dtype in ("float64", "float32"):
        rows.append(repeat(options.repeats, lambda name=dtype: run_ours(bench, model, segments, judge, name)))
    fastest = min(row["seconds"] for row in rows[:2])
    for row in rows:
        row["default"], row["fastest"] = rows[0]["seconds"] / row["seconds"], fastest / row["seconds"]
        row["fit"] = row["seconds"] - row["compile"]
        row["fastest/fit"] = fastest / row["fit"]
    report(options.out, rows, COLUMNS, samples=log.samples, sequences=SEQUENCES, repeats=options.repeats)


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser("sysid", __doc__)
    parser.add_argument("--samples", type=int, default=119_981, help="samples of the recording")
    parser.add_argument("--repeats", type=int, default=3, help="runs of each; the median counts")
    return parser.parse_args()


def read_whole(settings: Any, samples: int) -> Log:
    """Load the twin's recording without its split into train and test."""
    settings["split"] = {"test_share": 0.5, "gap": 0.0}
    parts = build(settings).load().logs
    first = parts[0]
    time, qpos, qvel, ctrl = (
        np.concatenate([getattr(part, signal) for part in parts])[:samples]
        for signal in ("time", "qpos", "qvel", "ctrl")
    )
    return Log(first.name, time, qpos, qvel, ctrl, first.sha256, first.simulated)


def repeat(times: int, run: Any) -> dict[str, Any]:
    """Repeat a run and return the row of median duration."""
    runs = sorted((run() for _ in range(times)), key=lambda row: row["seconds"])
    return runs[len(runs) // 2]


class Judge:
    """Evaluation of the objective by MuJoCo C, and the inputs with which sysid evaluates it."""

    def __init__(self, bench: Bench, segments: Segments) -> None:
        self.bench, self.segments = bench, segments
        self.measured = np.concatenate([segments.qpos, segments.qvel], axis=2)

    def model(self, values: dict[str, float]) -> mujoco.MjModel:
        """Compile the bench with these values."""
        known = self.bench.initial_values() | {"armature": np.array([values["armature"]])}
        frictionloss, damping = (np.array([values[name]]) for name in ("frictionloss", "damping"))
        return mujoco.MjModel.from_xml_string(self.bench.mjcf(known, frictionloss, damping))

    def loss(self, values: dict[str, float]) -> float:
        """Return the mean squared error of position plus the mean squared error of velocity."""
        model = self.model(values)
        start = np.concatenate([np.zeros((len(self.measured), 1)), self.measured[:, 0]], axis=1)
        state, _ = mujoco_rollout.rollout(model, mujoco.MjData(model), start, self.segments.signals.ctrl)
        errors = np.asarray(state)[:, :, 1:3] - self.measured[:, 1:]
        return float(np.square(errors).sum(axis=2).mean())


def run_sysid(bench: Bench, model: FrictionModel, segments: Segments, judge: Judge, optimizer: str) -> dict[str, Any]:
    """Measure one identification by mujoco.sysid."""
    began = time.perf_counter()
    parameters, _, function = pose(bench, model, segments, judge)
    found, _ = sysid.optimize(parameters, function, optimizer, verbose=False)
    seconds = time.perf_counter() - began
    values = {name: float(found[name].value[0]) for name in NAMES}
    return {
        "tool": f"mujoco.sysid, {optimizer}",
        "seconds": seconds,
        "compile": 0.0,
        "loss": judge.loss(values),
        **values,
    }


def pose(bench: Bench, model: FrictionModel, segments: Segments, judge: Judge) -> tuple[Any, Any, Any]:
    """Return the inputs of mujoco.sysid: parameters, recordings, and the residual function."""
    params = {**bench.params, **model.params}

    def put(name: str) -> Any:
        def write(spec: mujoco.MjSpec, parameter: Any) -> None:
            value = parameter.value[0]
            # Damping is a polynomial of speed with the viscous coefficient first.
            setattr(spec.joint(bench.joints[0]), name, [value, 0.0, 0.0] if name == "damping" else value)

        return write

    parameters = sysid.ParameterDict(
        {
            name: sysid.Parameter(name, params[name].init, params[name].low, params[name].high, modifier=put(name))
            for name in NAMES
        }
    )
    start = judge.model({name: params[name].init for name in NAMES})
    spec = mujoco.MjSpec.from_string(
        bench.mjcf(bench.initial_values(), np.array([params["frictionloss"].init]), np.array([params["damping"].init]))
    )
    times = np.arange(segments.length + 1) * bench.timestep
    joint = bench.joints[0]
    control = [sysid.TimeSeries.from_control_names(times[:-1], ctrl, start) for ctrl in segments.signals.ctrl]
    kinds = [(f"{joint}_qpos", sysid.SignalType.MjStateQPos), (f"{joint}_qvel", sysid.SignalType.MjStateQVel)]
    states = [
        sysid.TimeSeries(times, measured, dict(zip(*_mapping(kinds), strict=True))) for measured in judge.measured
    ]
    sequences = sysid.ModelSequences(
        "bench",
        spec,
        [f"sequence {number}" for number in range(segments.count)],
        [sysid.create_initial_state(start, measured[0, :1], measured[0, 1:]) for measured in judge.measured],
        control,
        states,
        allow_missing_sensors=True,
    )

    def residual(params: Any, predicted: Any, measured: Any, *_: Any, state: np.ndarray, **__: Any) -> tuple:
        # Plain errors: sysid's default residual scales each signal by its size.
        return state[:, 1:3] - measured.data[1 : len(state) + 1], measured, measured

    function = sysid.build_residual_fn(models_sequences=[sequences], modify_residual=residual, resample_true=False)
    return parameters, sequences, function


def _mapping(kinds: list) -> tuple[list, list]:
    return [name for name, _ in kinds], [(kind, np.array([place])) for place, (_, kind) in enumerate(kinds)]


def run_ours(bench: Bench, model: FrictionModel, segments: Segments, judge: Judge, dtype: str) -> dict[str, Any]:
    """Measure one identification by frictionzoo, including tracing and compiling."""
    jax.clear_caches()
    jax.config.update("jax_enable_x64", dtype == "float64")
    began = time.perf_counter()
    engine = make_engine("auto", bench, friction_of(model), model.constraint)
    space = Space(bench, model, dtype)
    objective = Objective(space, make_rollout(engine), segments, 1.0, 1.0, "none", 1.0, False)
    fit = LevenbergMarquardt(100, 1e-8)
    chunk = make_chunk(fit, objective, 100)
    compiled = time.perf_counter() - began
    progress, _ = chunk(begin(fit, objective), 100)
    seconds = time.perf_counter() - began
    identified = space.identified(progress.best)
    values = {name.partition(".")[2]: float(value[0]) for name, value in identified.items()}
    return {
        "tool": f"frictionzoo fit=lm, {dtype}",
        "seconds": seconds,
        "compile": compiled,
        "loss": judge.loss(values),
        **{name: values[name] for name in NAMES},
    }


if __name__ == "__main__":
    main()
