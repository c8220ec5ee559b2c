"""Confidence intervals from a designed command: `python benchmarks/excitation.py`.

MuJoCo C records the hidden drive of `data=twin_clean` twice, with the same duration and sensors: under the paper's five
harmonics, and under the command that `frictionzoo.design` designs from the drive identified on the first recording,
within its ranges of position, speed and torque. The table compares predicted intervals with those of
`fit=lm segments.length=1000`.
"""

import argparse
import time
from typing import Any, cast

import numpy as np
from measure import make_parser, print_table, write_json
from omegaconf import OmegaConf

from frictionzoo.api.identified import Identified
from frictionzoo.core.build import build
from frictionzoo.core.config import compose_config
from frictionzoo.core.log import Dataset, Log
from frictionzoo.core.segments import split_by_time
from frictionzoo.data.twin import Twin
from frictionzoo.design.excitation import excite, prepare
from frictionzoo.design.information import relative
from frictionzoo.design.plan import Request
from frictionzoo.identification import Parts, Problem, solve
from frictionzoo.simulation.context import computing

COLUMNS = {
    "parameter": "parameter",
    "hidden": "hidden",
    "harmonics_predicted": "harmonics, predicted [%]",
    "harmonics": "found [%]",
    "designed_predicted": "designed, predicted [%]",
    "designed": "found [%]",
    "narrower_predicted": "narrower, predicted",
    "narrower": "found",
    "off": "value off by [%]",
}
HIDDEN = {  # the model's parameters and the twin's names for them
    "bench.armature": "armature",
    "friction.static_torque": "static_torque",
    "friction.kinetic_torque": "coulomb_torque",
    "friction.stribeck_velocity": "stribeck_velocity",
    "friction.viscous_coefficient": "viscous_coefficient",
}


def main() -> None:
    """Record and identify with both commands; print and write the results."""
    options = parse()
    settings = compose(options)
    twin: Twin = build(settings["data"])
    ctrl = twin.excitation.command(twin.timestep * np.arange(twin.samples), np.random.default_rng(twin.seed))
    first, reached = record(twin, ctrl)
    before = identify(settings, first)

    request = ask(options, twin, reached)
    began = time.perf_counter()
    designed = excite(request, before)
    seconds = time.perf_counter() - began
    expected = {row["name"]: row["share"] for row in designed.note["parameters"]}
    second, used = record(twin, designed.motion.ctrl[:, 0])
    after = identify(settings, second)

    harmonics = foresee(request, before, ctrl)
    rows = [compare(name, twin, (before, harmonics[name]), (after, expected[name])) for name in HIDDEN]
    print_table(rows, COLUMNS)
    kept = [{"limit": name, "harmonics": size, "designed": used[name]} for name, size in reached.items()]
    print_table(kept)
    print(f"designed in {seconds:.0f} s")
    write_json(options.out, {"settings": {"seconds": seconds, "limits": kept, **designed.note["search"]}, "rows": rows})


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser("excitation", __doc__)
    parser.add_argument("--starts", type=int, default=4, metavar="N", help="searches")
    parser.add_argument("--iterations", type=int, default=1500, metavar="N", help="steps of each")
    parser.add_argument("--period", type=float, default=4.0, metavar="S", help="longest one of the command [s]")
    parser.add_argument("overrides", nargs="*", help="options of the run, such as data.samples=20000")
    return parser.parse_args()


def compose(options: argparse.Namespace) -> dict[str, Any]:
    """Return the settings of a `twin_clean` run that identifies every parameter."""
    fit = ("fit=lm", "segments.length=1000", "segments.count=null", "bench.timestep=0.00025", "loop.progress=false")
    fit += ("discretisation=false",)  # the timestep would widen both intervals equally
    config = compose_config("experiment=twin_clean", *fit, *options.overrides)
    return cast(dict[str, Any], OmegaConf.to_container(config, resolve=True))


def record(twin: Twin, ctrl: np.ndarray) -> tuple[Dataset, dict[str, float]]:
    """Record the hidden drive under this command [rad]; return the data and the ranges reached."""
    qpos, qvel = twin.simulate(ctrl)
    torque = twin.controller.kp * (ctrl[:, None] - qpos) - twin.controller.kd * qvel
    reached = {
        "lowest position": float(qpos.min()),
        "highest position": float(qpos.max()),
        "speed": float(np.abs(qvel).max()),
        "torque": float(np.abs(torque).max()),
    }
    measured = twin.sensor.measure(qpos, qvel, np.random.default_rng(twin.seed))
    moment = twin.timestep * np.arange(twin.samples)
    log = Log(twin.name, moment, *measured, ctrl[:, None], sha256="0" * 64, simulated=True)
    train, test = split_by_time(log, **twin.split)
    return Dataset(twin.name, (train,), (test,)), reached


def identify(settings: dict[str, Any], dataset: Dataset) -> Identified:
    """Return the drive that a run identifies."""
    bench = build(settings["bench"])
    parts = Parts.settle(settings, bench, dataset, build(settings["model"], nv=bench.nv), build(settings["fit"]))
    with parts.computing() as device:
        return solve(Problem.pose(parts), "coulomb_stribeck", device)


def ask(options: argparse.Namespace, twin: Twin, reached: dict[str, float]) -> dict[str, str]:
    """Return the options of the design: the harmonics' duration, ranges and sensors."""
    given = {
        "position": [reached["lowest position"], reached["highest position"]],
        "velocity": reached["speed"],
        "torque": reached["torque"],
        "seconds": (twin.samples - 1) * twin.timestep,
        "rate": 1 / twin.timestep,
        "period": options.period,
        "bandwidth": 20,  # Hz
        "margin": 0.02,  # the drive is well known
        "quantum": twin.sensor.position_quantum,
        "velocity_noise": twin.sensor.velocity_noise,
        "bench.timestep": twin.timestep,  # a design needs no finer timestep
        "criterion": "worst",  # narrow every interval, not only their product
        "starts": options.starts,
        "iterations": options.iterations,
    }
    return {name: str(value) for name, value in given.items()}


def foresee(request: dict[str, str], run: Identified, ctrl: np.ndarray) -> dict[str, float]:
    """Predict half of each interval after a recording of this command, as a share of the value, by name."""
    with computing("float64"):
        task = prepare(Request.read(request, run), run)
        speed = np.gradient(ctrl, task.sampling.interval)
        see = task.drive.rollout.compile(lambda *command: task.see(*command, ctrl[:1])[1])
        segments = task.segments(len(ctrl))
        half = task.half_widths(see(ctrl[None, :, None], speed[None, :, None]), segments)[0]
        return {name: share for name, (*_, share) in relative(task.space, task.vector, half).items()}


def compare(
    name: str, twin: Twin, harmonics: tuple[Identified, float], designed: tuple[Identified, float]
) -> dict[str, Any]:
    """Return a row: the interval of a parameter after each recording, predicted and identified."""
    row: dict[str, Any] = {"parameter": name, "hidden": getattr(twin.drive, HIDDEN[name])}
    trained = 1 - twin.split["test_share"] - twin.split["gap"] / (twin.samples * twin.timestep)
    for label, (fit, share) in {"harmonics": harmonics, "designed": designed}.items():
        found = fit.parameters[name]
        row[f"{label}_predicted"] = 100 * share / trained**0.5  # a fit sees the training part only
        row[label] = 100 * float(np.ptp(found.interval[0])) / 2 / float(found.value[0])
    row["narrower_predicted"] = row["harmonics_predicted"] / row["designed_predicted"]
    row["narrower"] = row["harmonics"] / row["designed"]
    row["off"] = 100 * abs(float(designed[0].parameters[name].value[0]) / row["hidden"] - 1)
    return row


if __name__ == "__main__":
    main()
