"""Coverage of 95 % confidence intervals over many simulated data sets of one drive.

    python benchmarks/coverage.py
    python benchmarks/coverage.py --cases load --logs 50 --recordings 1

Each data set has ten recordings (`--recordings`) with different excitation and noise. `event_exact.py` simulates the
drive's sticking and sliding from event to event, without MuJoCo and its friction constraint. With the right model, the
table gives for each parameter the share of data sets whose interval contains the true value. A model that lacks a term
has no true values. The table therefore also gives, for every model, the share of speeds at which the drive's mean
friction lies within the band of curves drawn from the intervals.
"""

import argparse
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from event_exact import Drive, Link, simulate
from jaxtyping import Float
from measure import make_parser, report
from omegaconf import OmegaConf

import frictionzoo as fz
from frictionzoo.core.config import compose_config
from frictionzoo.core.log import Log
from frictionzoo.core.segments import cut_rollouts, cut_segments
from frictionzoo.core.state import DriveState
from frictionzoo.data.twin import Excitation
from frictionzoo.fit import LevenbergMarquardt, Objective, estimate_uncertainty
from frictionzoo.fit.blocks import divide, into_blocks
from frictionzoo.fit.loss import soft_width
from frictionzoo.fit.uncertainty import Uncertainty
from frictionzoo.identification import Parts, Problem, solve
from frictionzoo.identification.pilot import Pilot
from frictionzoo.models.base import sliding_torque

RATE, SECONDS = 200, 20  # Hz, s of each data set
TIMESTEP = 1e-3  # s, simulation timestep of the fit, as automatic settings choose it
POSITION_NOISE, VELOCITY_NOISE = 2e-4, 0.02  # rad, rad/s
EXCITATION = Excitation(12, (0.2, 1.0), (0.5, 10.0), (0.0, 2 * np.pi), 4.0)
ROD = Link(-1, (0, 1, 0), (0, 0, 0), 0.26, (0, 0, -0.1127), (0.0011, 0.0011, 0.0011))  # of knee_rod.xml
GRAVITY_TORQUE = 9.81 * 0.26 * 0.1127  # N m, of the rod at 90 degrees
DRAWS, SPEEDS = 1000, 40
NEAREST = 1 / 400  # share of all samples, on either side of a speed, for its mean friction

DRIVE = Drive(armature=0.05, viscous=0.2, forward=0.25, kp=20.0, kd=1.0)  # published gains of the bench
STRIBECK = replace(DRIVE, breakaway=1.6, stribeck=0.2)
CASES: dict[str, tuple[Drive, str]] = {
    "coulomb": (DRIVE, "mujoco_default"),
    "stribeck": (STRIBECK, "stribeck"),
    "rounded": (STRIBECK, "stribeck"),
    "ripple": (replace(DRIVE, ripple=0.1), "mujoco_default"),
    "load": (replace(DRIVE, load=0.38, forward=0.11), "mujoco_default"),
    "all": (replace(STRIBECK, load=0.38, ripple=0.1), "mujoco_default"),
}
"""Drive and fitted model. The first three models are right."""
RIGHT = ("coulomb", "stribeck", "rounded")
ENCODERS = {"rounded": 2 * np.pi / 2**12}
"""Encoder step of a case [rad]. Positions have no other noise, and errors count only beyond half a step."""


@dataclass(frozen=True)
class Recorded:
    """Logs with true velocity and friction at their samples.

    Attributes:
        logs: Measured logs.
        qvel: True velocity [rad/s].
        friction: True friction torque [N m]; NaN while the joint sticks.
    """

    logs: Sequence[Log]
    qvel: Float[np.ndarray, "logs time"]
    friction: Float[np.ndarray, "logs time"]


def record(drive: Drive, count: int, first: int, seconds: float, encoder: float = 0.0) -> Recorded:
    """Simulate `count` logs from event to event."""
    times, logs, states = np.arange(round(RATE * seconds)) / RATE, [], []
    for number in range(count):
        rng = np.random.default_rng(first + number)
        ctrl = EXCITATION.command(times, rng)[:, None]
        qpos, qvel, _ = simulate([ROD], [drive], ctrl, 1 / RATE)
        load = drive.kp * (ctrl - qpos) - drive.kd * qvel + GRAVITY_TORQUE * np.sin(qpos)
        states.append((qvel[:, 0], np.where(qvel == 0, np.nan, drive.friction(qvel, qpos, load))[:, 0]))
        noise = rng.standard_normal((2, *qpos.shape))
        qpos = np.round(qpos / encoder) * encoder if encoder else qpos + POSITION_NOISE * noise[0]
        columns = qpos, qvel + VELOCITY_NOISE * noise[1], ctrl
        logs.append(Log(f"log {number}", times, *columns, sha256=64 * "0", simulated=True))
    return Recorded(logs, *(np.array(each) for each in zip(*states, strict=True)))


def true_values(drive: Drive) -> dict[str, float]:
    """Return the true parameters of the right models."""
    return {
        "bench.armature": drive.armature,
        "friction.frictionloss": drive.forward,
        "friction.damping": drive.viscous,
        "friction.stribeck_torque": drive.forward * (drive.breakaway - 1),
        "friction.stribeck_velocity": drive.stribeck,
        "friction.stribeck_exponent": 2.0,
    }


class Fits:
    """Fits of one model to one data set after another, all with the functions compiled for the first."""

    def __init__(self, law: fz.FrictionModel, logs: Sequence[Log], length: int, encoder: float = 0.0) -> None:
        stand = partial(fz.Bench, "knee_rod.xml", actuator=fz.PositionPD(kp=DRIVE.kp, kd=DRIVE.kd), second_order=True)
        benches = [stand(timestep=step, solreffriction=(2 * step, 1.0)) for step in (TIMESTEP, TIMESTEP / 2)]
        noise = soft_width(encoder) if encoder else POSITION_NOISE
        loss = {"velocity": (noise / VELOCITY_NOISE) ** 2, "robust": "none", "refine": True, "encoder_step": encoder}
        segments, self._length = {"length": length, "count": None}, length
        self.pilot, self._finer = (Pilot(bench, law, logs, segments, loss, "specialised") for bench in benches)
        self._law, self._curves = law, jax.jit(jax.vmap(self._curve, in_axes=(0, None)))

    def fit(self, logs: Sequence[Log]) -> tuple[np.ndarray, Uncertainty]:
        """Fit these logs; return the best vector and its uncertainty."""
        objective, finer = self.pilot.objective, self._finer.objective
        segments = cut_segments([self.pilot.bench.accept(log) for log in logs], None, self._length)
        for own in (objective, finer):
            own.data = into_blocks(segments, divide(segments), jnp.float64, own._rollout)
        vector = minimise(objective)
        self.pilot.objective = objective.starting(vector)  # the next data set has its minimum nearby
        return vector, estimate_uncertainty(objective, vector, finer=lambda at: objective.approaching(finer, at))

    def curves(self, vectors: Float[np.ndarray, "draws coordinates"], speed: np.ndarray) -> np.ndarray:
        """Return friction over speed [N m] for each vector, (draws, speeds)."""
        return np.asarray(self._curves(jnp.asarray(vectors), jnp.asarray(speed)))

    def _curve(self, vector: Any, speed: Any) -> Any:
        at = DriveState(*[jnp.zeros((len(speed), 1))] * 5)._replace(qvel=speed[:, None])
        terms = self._law.terms(jnp, self.pilot.space.values(vector)["friction"], at)
        return sliding_torque(jnp, terms, at.qvel)[:, 0]


def minimise(objective: Objective) -> np.ndarray:
    """Return the best vector of Levenberg-Marquardt, without the fit record, which would compile for each fit."""
    method = LevenbergMarquardt()
    vector, state = method.init(objective)
    tried = []
    while not method.done(state) and len(tried) < method.total(objective):
        tried.append(vector)
        _, vector, state = method.step(objective, vector, state, objective.data)
    return np.asarray(tried[int(np.argmin(state.loss[: len(tried)]))], np.float64)


def mean_friction(recorded: Recorded, speed: np.ndarray) -> np.ndarray:
    """Return the drive's mean friction at each speed [N m], over the samples of all logs."""
    slides = np.isfinite(recorded.friction)
    qvel, friction = recorded.qvel[slides], recorded.friction[slides]
    order = np.argsort(qvel)
    count = math.ceil(NEAREST * len(qvel))
    at = np.clip(np.searchsorted(qvel[order], speed), count, len(qvel) - count)
    # Evaluate a line through the nearest samples at the speed, which need not be their mean.
    near = order[at[:, None] + np.arange(-count, count)]
    lines = [np.polyfit(qvel[own] - v, friction[own], 1)[1] for own, v in zip(near, speed, strict=True)]
    return np.array(lines)


def judge(name: str, options: argparse.Namespace) -> dict[str, Any]:
    """Run one case and return its row."""
    (drive, law_name), encoder = CASES[name], ENCODERS.get(name, 0.0)
    each = options.recordings
    recorded = record(drive, options.logs * each, options.first, SECONDS / each, encoder)
    sets = [recorded.logs[start : start + each] for start in range(0, len(recorded.logs), each)]
    low, high = np.quantile(np.abs(recorded.qvel[recorded.qvel != 0]), [0.05, 0.99])
    speed = np.concatenate([-np.geomspace(low, high, SPEEDS // 2)[::-1], np.geomspace(low, high, SPEEDS // 2)])
    mean, truth = mean_friction(recorded, speed), true_values(drive)
    began, fits = time.perf_counter(), Fits(fz.law(options.law or law_name), sets[0], options.length, encoder)
    held, inside, errors, ratios = [], [], [], []
    space = fits.pilot.space
    for number, logs in enumerate(sets):
        vector, found = fits.fit(logs)
        ends = {name: rows[0] for name, rows in found.intervals.items()}
        held.append([ends[name][0] <= truth.get(name, np.nan) <= ends[name][1] for name in space.params])
        assert found.covariance is not None
        vectors = np.tile(vector, (DRAWS, 1))
        vectors[:, [space.labels.index(label) for label in found.covariance.labels]] = found.covariance.draw(
            DRAWS, np.random.default_rng(number)
        )
        lower, upper = np.quantile(fits.curves(vectors, speed), [0.025, 0.975], axis=0)
        inside.append((lower <= mean) & (mean <= upper))
        best = fits.curves(vector[None], speed)[0]
        errors.append(np.abs(best - mean).mean() / np.abs(mean).mean())
        ratios.append(((upper - lower) / 2).mean() / np.abs(mean).mean())
        if options.verbose:
            print(number, {k: v.round(4).tolist() for k, v in ends.items()}, np.mean(inside[-1]), file=sys.stderr)
    shares = dict(zip(space.params, np.mean(held, axis=0), strict=True)) if name in RIGHT else {}
    return {
        "case": name,
        "law": options.law or law_name,
        "logs": options.logs,
        "recordings": each,
        "length": options.length,
        **{key.partition(".")[2]: 100 * float(share) for key, share in shares.items()},
        "curve": 100 * float(np.mean(inside)),
        "off": 100 * float(np.mean(errors)),
        "band": 100 * float(np.mean(ratios)),
        "seconds": time.perf_counter() - began,
    }


def hold_out(name: str, draws: int) -> dict[str, Any]:
    """Run an experiment on real recordings; return the share of test positions within the prediction intervals."""
    settings = OmegaConf.to_container(compose_config(f"experiment={name}", "loop.progress=false"), resolve=True)
    parts = Parts.from_settings(cast(dict[str, Any], settings))
    with parts.computing() as place:
        problem = Problem.pose(parts)
        drive = solve(problem, problem.drive.model.name, place)
    horizon, history = problem.settings["evaluation"]["horizons"][0], problem.sampling.history
    windows = cut_rollouts(problem.dataset.test, horizon, None, "consecutive", 0, history)
    band, measured = drive.band(windows, draws), windows.qpos[:, 1:]
    inside = (band.low <= measured) & (measured <= band.high)
    return {
        "case": name,
        "law": drive.result["model"],
        "logs": windows.count,
        "held": 100 * float(inside.mean()),
        "band_width": float((band.high - band.low).mean() / 2),
        "error": float(np.abs(drive.rollout(windows)[0] - measured).mean()),
    }


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser("coverage", __doc__)
    parser.add_argument("--cases", nargs="*", choices=tuple(CASES), default=[*CASES])
    parser.add_argument(
        "--held-out", nargs="*", metavar="EXPERIMENT", default=[], help="experiments on real recordings"
    )
    parser.add_argument("--logs", type=int, default=200, metavar="N", help="how many simulated data sets")
    parser.add_argument("--recordings", type=int, default=10, metavar="N", help="of which each of them is made")
    parser.add_argument("--length", type=int, default=5, metavar="SAMPLES", help="of a segment")
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="seed of the first")
    parser.add_argument("--law", help="fitted law, in place of each case's own")
    parser.add_argument("--verbose", action="store_true", help="each log as it comes")
    return parser.parse_args()


def main() -> None:
    """Run each case and experiment, and report a table."""
    options = parse()
    rows = [hold_out(name, DRAWS // 10) for name in options.held_out]
    with jax.enable_x64(True):
        rows = [judge(name, options) for name in options.cases] + rows
    columns = {key: key for row in rows for key in row}
    report(options.out, rows, columns, drives={name: asdict(CASES[name][0]) for name in options.cases})


if __name__ == "__main__":
    main()
