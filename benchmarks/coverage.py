"""How often 95 % intervals hold the truth, over many simulated data sets of one drive.

    python benchmarks/coverage.py
    python benchmarks/coverage.py --cases load --logs 50 --recordings 1

Each data set is ten recordings, each with an excitation and noise of its own. With the right law, the share of data
sets whose interval holds the true value counts, for each parameter. Where the law lacks a term, there is no true value:
then the share of speeds counts at which the drive's mean friction lies within the band of curves that are drawn from
the intervals.
"""

import argparse
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from measure import make_parser, report
from omegaconf import OmegaConf

import frictionzoo as fz
from frictionzoo.core.config import compose_config
from frictionzoo.core.described import remake
from frictionzoo.core.log import Log
from frictionzoo.core.segments import cut_rollouts, cut_segments
from frictionzoo.core.state import DriveState
from frictionzoo.fit import LevenbergMarquardt, Objective, estimate_uncertainty
from frictionzoo.fit.blocks import divide, into_blocks
from frictionzoo.fit.loss import soft_width
from frictionzoo.fit.uncertainty import Uncertainty
from frictionzoo.identification import Parts, Problem, solve
from frictionzoo.identification.pilot import Pilot
from frictionzoo.logs.twin import Controller, Excitation, HiddenDrive
from frictionzoo.models.base import sliding_torque

RATE, SECONDS = 200, 20  # Hz, s of each data set
SUBSTEPS = 10  # of a sample interval, steps of Runge and Kutta by which logs are simulated
TIMESTEP = 2.5e-4  # s, of the fitted simulation
POSITION_NOISE, VELOCITY_NOISE = 2e-4, 0.02  # rad, rad/s
EXCITATION = Excitation(12, (0.2, 1.0), (0.5, 10.0), (0.0, 2 * np.pi), 4.0)
CONTROLLER = Controller(20.0, 1.0)  # as published of the bench
MASS, CENTRE, INERTIA = 0.26, 0.1127, 0.0011  # of the rod of knee_rod.xml
GRAVITY = 9.81
DRAWS, SPEEDS = 1000, 40
NEAREST = 1 / 400  # of all samples, on either side of a speed, make its mean friction

DRIVE = HiddenDrive(
    armature=0.05,
    coulomb_torque=0.25,
    static_torque=0.25,
    stribeck_velocity=0.2,
    viscous_coefficient=0.2,
    smoothing_velocity=0.05,
    load_share=0.0,
    ripple_torque=0.0,
    ripple_periods=12.0,
    command_delay=0.0,
)
CASES: dict[str, tuple[HiddenDrive, str]] = {
    "coulomb": (DRIVE, "coulomb_smooth"),
    "stribeck": (replace(DRIVE, static_torque=0.4), "coulomb_stribeck"),
    "rounded": (replace(DRIVE, static_torque=0.4), "coulomb_stribeck"),
    "ripple": (replace(DRIVE, ripple_torque=0.1), "coulomb_smooth"),
    "load": (replace(DRIVE, load_share=0.38, coulomb_torque=0.11, static_torque=0.11), "coulomb_smooth"),
    "all": (replace(DRIVE, load_share=0.38, ripple_torque=0.1, static_torque=0.4), "coulomb_smooth"),
}
"""Drive and fitted law. The first three laws are right."""
RIGHT = ("coulomb", "stribeck", "rounded")
ENCODERS = {"rounded": 2 * np.pi / 2**12}
"""Steps of the encoder of a case [rad]: its positions have no other noise, and errors count beyond half of it."""


@dataclass(frozen=True)
class Recorded:
    """Logs, and what is true in the intervals between their samples, means of shape (logs, time).

    Attributes:
        logs: As measured.
        qvel: True velocity [rad/s].
        friction: True friction torque [N m].
    """

    logs: Sequence[Log]
    qvel: Float[np.ndarray, "logs time"]
    friction: Float[np.ndarray, "logs time"]


def friction_of(drive: HiddenDrive, qpos: Any, qvel: Any, motor: Any) -> Any:
    """`HiddenDrive.friction` of arrays."""
    excess = (drive.static_torque - drive.coulomb_torque) * np.exp(-np.square(qvel / drive.stribeck_velocity))
    ripple = drive.ripple_torque * np.sin(drive.ripple_periods * qpos)
    dry = drive.coulomb_torque + excess + drive.load_share * np.abs(motor) + ripple
    return dry * np.tanh(qvel / drive.smoothing_velocity) + drive.viscous_coefficient * qvel


def record(drive: HiddenDrive, count: int, first: int, seconds: float, encoder: float = 0.0) -> Recorded:
    """So many logs, simulated side by side and nearly without an error of the step."""
    samples, step = round(RATE * seconds), 1 / RATE / SUBSTEPS
    times = np.arange(samples) / RATE
    rngs = [np.random.default_rng(first + number) for number in range(count)]
    ctrl = np.stack([EXCITATION.command(times, rng) for rng in rngs])
    state = np.stack([ctrl[:, 0], np.zeros(count)])
    states, means = np.empty((2, count, samples)), np.zeros((2, count, samples))
    for sample, command in enumerate(ctrl.T):
        states[:, :, sample] = state
        for _ in range(SUBSTEPS):
            slope, friction = move(drive, state, command)
            means[:, :, sample] += np.stack([state[1], friction]) / SUBSTEPS
            second = move(drive, state + step / 2 * slope, command)[0]
            third = move(drive, state + step / 2 * second, command)[0]
            last = move(drive, state + step * third, command)[0]
            state = state + step / 6 * (slope + 2 * second + 2 * third + last)
    noise = np.array([POSITION_NOISE, VELOCITY_NOISE])[:, None]
    logs = []
    for number, rng in enumerate(rngs):
        qpos, qvel = states[:, number] + noise * rng.standard_normal((2, samples))
        if encoder:
            qpos = np.round(states[0, number] / encoder) * encoder
        columns = [qpos, qvel, ctrl[number]]
        columns = [signal[:, None] for signal in columns]
        logs.append(Log(f"log {number}", times, *columns, sha256=64 * "0", simulated=True))
    return Recorded(logs, *means)


def move(drive: HiddenDrive, state: Float[np.ndarray, "2 logs"], command: Any) -> tuple[np.ndarray, np.ndarray]:
    """Derivative of position and velocity by time, and friction torque [N m]."""
    qpos, qvel = state
    motor = CONTROLLER.kp * (command - qpos) - CONTROLLER.kd * qvel
    friction = friction_of(drive, qpos, qvel, motor)
    torque = motor - friction - MASS * GRAVITY * CENTRE * np.sin(qpos)
    return np.stack([qvel, torque / (INERTIA + MASS * CENTRE**2 + drive.armature)]), friction


def law_of(name: str, drive: HiddenDrive) -> fz.FrictionModel:
    """The fitted law; what belongs to the simulation rather than to the drive is known."""
    params: dict[str, Any] = (
        {"smoothing_velocity": {"init": drive.smoothing_velocity}} if name == "coulomb_stribeck" else {}
    )
    return fz.law(name, params=params)


def true_values(drive: HiddenDrive) -> dict[str, float]:
    """Of the parameters of the right laws."""
    return {
        "bench.armature": drive.armature,
        "friction.static_torque": drive.static_torque,
        "friction.kinetic_torque": drive.coulomb_torque,
        "friction.stribeck_velocity": drive.stribeck_velocity,
        "friction.viscous_coefficient": drive.viscous_coefficient,
        "friction.smoothing": 0.1 / drive.smoothing_velocity,
    }


class Fits:
    """Fits of one law to one data set after the other; what the first compiles serves them all."""

    def __init__(self, law: fz.FrictionModel, logs: Sequence[Log], length: int, encoder: float = 0.0) -> None:
        actuator = fz.PositionPD(kp=CONTROLLER.kp, kd=CONTROLLER.kd)
        self._bench = fz.Bench("knee_rod.xml", actuator=actuator, timestep=TIMESTEP)
        noise = soft_width(encoder) if encoder else POSITION_NOISE
        loss = {"velocity": (noise / VELOCITY_NOISE) ** 2, "robust": "none", "refine": True, "encoder_step": encoder}
        segments, self._length = {"length": length, "count": None}, length
        self.pilot, self._finer = (
            Pilot(remake(self._bench, timestep=step), law, logs, segments, loss, "specialised")
            for step in (TIMESTEP, TIMESTEP / 2)
        )
        self._law, self._curves = law, jax.jit(jax.vmap(self._curve, in_axes=(0, None)))

    def fit(self, logs: Sequence[Log]) -> tuple[np.ndarray, Uncertainty]:
        """The best vector, and how far the logs determine it."""
        objective, finer = self.pilot.objective, self._finer.objective
        segments = cut_segments([self._bench.accept(log) for log in logs], None, self._length)
        for own in (objective, finer):
            own.data = into_blocks(segments, divide(segments), jnp.float64, own._rollout)
        vector = minimise(objective)
        self.pilot.objective = objective.starting(vector)  # the next data set has its minimum nearby
        return vector, estimate_uncertainty(objective, vector, finer=lambda: finer)

    def curves(self, vectors: Float[np.ndarray, "draws coordinates"], speed: np.ndarray) -> np.ndarray:
        """Friction over speed [N m] of each vector, (draws, speeds)."""
        return np.asarray(self._curves(jnp.asarray(vectors), jnp.asarray(speed)))

    def _curve(self, vector: Any, speed: Any) -> Any:
        at = DriveState(*[jnp.zeros((len(speed), 1))] * 5)._replace(qvel=speed[:, None])
        terms = self._law.terms(jnp, self.pilot.space.values(vector)["friction"], at)
        return sliding_torque(jnp, terms, at.qvel)[:, 0]


def minimise(objective: Objective) -> np.ndarray:
    """The best vector, by Levenberg-Marquardt without a record of its course, which is compiled for each fit."""
    method = LevenbergMarquardt()
    vector, state = method.init(objective)
    tried = []
    while not method.done(state) and len(tried) < method.total(objective):
        tried.append(vector)
        _, vector, state = method.step(objective, vector, state, objective.data)
    return np.asarray(tried[int(np.argmin(state.loss[: len(tried)]))], np.float64)


def mean_friction(recorded: Recorded, speed: np.ndarray) -> np.ndarray:
    """The drive's mean friction at each speed, over all that was visited in any log [N m]."""
    qvel, friction = recorded.qvel.ravel(), recorded.friction.ravel()
    order = np.argsort(qvel)
    count = math.ceil(NEAREST * len(qvel))
    at = np.clip(np.searchsorted(qvel[order], speed), count, len(qvel) - count)
    # Symmetric in speed: a straight line through the nearest has its value where its middle is.
    near = order[at[:, None] + np.arange(-count, count)]
    lines = [np.polyfit(qvel[own] - v, friction[own], 1)[1] for own, v in zip(near, speed, strict=True)]
    return np.array(lines)


def judge(name: str, options: argparse.Namespace) -> dict[str, Any]:
    """One case: a row of the table."""
    (drive, law_name), encoder = CASES[name], ENCODERS.get(name, 0.0)
    each = options.recordings
    recorded = record(drive, options.logs * each, options.first, SECONDS / each, encoder)
    sets = [recorded.logs[start : start + each] for start in range(0, len(recorded.logs), each)]
    low, high = np.quantile(np.abs(recorded.qvel), [0.05, 0.99])
    speed = np.concatenate([-np.geomspace(low, high, SPEEDS // 2)[::-1], np.geomspace(low, high, SPEEDS // 2)])
    mean, truth = mean_friction(recorded, speed), true_values(drive)
    began, fits = time.perf_counter(), Fits(law_of(options.law or law_name, drive), sets[0], options.length, encoder)
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
    """An experiment on real recordings: how much of those that only test is within the band of rollouts."""
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
    """The command line."""
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
    """Each case, each experiment, and their table."""
    options = parse()
    rows = [hold_out(name, DRAWS // 10) for name in options.held_out]
    with jax.enable_x64(True):
        rows = [judge(name, options) for name in options.cases] + rows
    columns = {key: key for row in rows for key in row}
    report(options.out, rows, columns, drives={name: asdict(CASES[name][0]) for name in options.cases})


if __name__ == "__main__":
    main()
