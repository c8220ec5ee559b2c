"""Solution of an identification problem: fit, uncertainty and evaluation; once more with other recordings."""

import copy
import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, cast

import jax
import numpy as np
from jaxtyping import Float
from omegaconf import OmegaConf

from frictionzoo.bench import Bench
from frictionzoo.core.build import build
from frictionzoo.core.config import compose_settings, create_literal, keep_caches_at_home
from frictionzoo.core.described import remake
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.segments import Segments
from frictionzoo.core.telling import tell
from frictionzoo.data.cache import cache_folder
from frictionzoo.data.logs import Logs
from frictionzoo.fit import Fit, Objective, Outcome, Space, estimate_uncertainty, fit_reference, run_fit
from frictionzoo.fit.loop import FitFiles
from frictionzoo.fit.motion import Recordings
from frictionzoo.fit.posterior import Fitted
from frictionzoo.fit.uncertainty import Uncertainty
from frictionzoo.identification.commands import Origin, suggest_commands
from frictionzoo.identification.pilot import halve_step, in_other_steps
from frictionzoo.identification.problem import Problem
from frictionzoo.identification.recipe import Parts
from frictionzoo.models import Baseline
from frictionzoo.result.curves import Curves
from frictionzoo.result.draws import draw_parameters
from frictionzoo.result.evaluate import Judgement
from frictionzoo.result.fitted_drive import FittedDrive
from frictionzoo.result.portrait import DRAWS, Rows, portray, sample_friction
from frictionzoo.result.record import build_result
from frictionzoo.result.residual_torque import Left, find_left
from frictionzoo.result.residuals import describe_residual
from frictionzoo.result.section_types import FitRecord, Residual, Timing, Torque
from frictionzoo.result.torque import choose_filtering, measure_torque
from frictionzoo.result.types import EvaluationRollouts, Result
from frictionzoo.simulation import Values
from frictionzoo.simulation.drive import Drive
from frictionzoo.simulation.rollout import make_observer

_log = logging.getLogger(__name__)
LATE = 0.1  # share of the iterations at the end in which a parameter must not move
MOVING = 1 / 3  # of half its interval; larger moves are reported
MOVING_BLINDLY = 0.01  # of its value, if it has no interval
_CHECKED = ("segments", "loss", "evaluation", "loop", "scale", "checkup", "discretisation", "seed")
_CHECKED += ("dtype", "engine", "device", "compilation_cache", "threads")
"""Settings that another identification of a drive takes from its run."""


def solve(
    problem: Problem, name: str, device: str, *, record: FitFiles | None = None, origin: Origin | None = None
) -> FittedDrive:
    """Identify a drive, in the `computing` context in which the problem was built.

    `record` is where the fit's course is written; None: memory only. `origin` is the shell command of the run, from
    which the next commands are derived; None for a call from Python. `name` of the friction model and `device` are for
    the record.

    Raises:
        FrictionzooError: The fit cannot begin, or the record cannot be written.
    """
    began, refine = time.perf_counter(), finer(problem)
    show = tell if problem.settings["loop"].get("progress", True) else lambda _: tell("")
    show("starting the fit, compiling")
    engine, segments, note = problem.drive.engine, problem.segments, problem.drive.engine.note
    _log.info("engine %s, matches MuJoCo C within %.1g%s", engine.name, problem.proof.rollout, note and f": {note}")
    if problem.objective.devices > 1:
        _log.info("segments run on %d devices", problem.objective.devices)
    _log.info("%s: training on %d segments of %d samples", problem.dataset.name, segments.count, segments.length)
    outcome = run_fit(problem.fit, problem.objective, problem.drive.model, record, **problem.settings["loop"])

    show("computing intervals")
    intervals_began = time.perf_counter()
    uncertainty = estimate_uncertainty(problem.objective, outcome.vector, problem.fit, refine)

    evaluation_began = time.perf_counter()
    show(f"evaluation: {problem.evaluation.count} rollouts")
    judgement = problem.evaluation.judge(problem.drive.rollout.compiled, outcome.values)
    show(f"evaluation: {problem.evaluation.count} rollouts without friction")
    baseline, reference = judge_baseline(problem.measured or problem)
    show("residual torque")
    residual_torque, torque, residual = _find_residual(problem, outcome)

    result = build_result(
        model=problem.drive.model,
        bench=problem.bench,
        values=outcome.values,
        dataset=problem.dataset,
        judgement=judgement,
        baseline=baseline,
        reference=reference["bench"],
        uncertainty=uncertainty,
        links=problem.links,
        settings=problem.settings,
        commands=suggest_commands(problem, outcome.values["bench"], residual, origin) if origin else [],
        model_name=name,
        torque=torque,
        residual=residual,
        evaluation=EvaluationRollouts(problem.evaluation.sha256, problem.evaluation.window),
        fit=_describe_fit(problem.objective.space, outcome, uncertainty),
        timing=Timing(
            setup=problem.seconds,
            compile=outcome.compile_seconds,
            fit=outcome.fit_seconds,
            uncertainty=evaluation_began - intervals_began,
            evaluate=(ended := time.perf_counter()) - evaluation_began,
            total=problem.seconds + ended - began,
        ),
        recipe=list(problem.choices),
        engine=problem.drive.engine.name,
        proof=problem.proof,
        warnings=[doubt.text for doubt in problem.doubts],
        device=device,
    )
    curves = _collect_curves(problem, outcome, judgement, baseline)
    return _hand_over(problem, outcome, result, replace(curves, **_portray(problem, result, residual_torque)))


def _hand_over(problem: Problem, outcome: Outcome, result: Result, curves: Curves) -> FittedDrive:
    """Return the identified drive; it keeps the fit's objective while it is in memory."""
    return FittedDrive(
        folder=None,
        result=result,
        bench=problem.bench,
        model=copy.deepcopy(problem.drive.model).double(),
        state={name: tensor.detach().clone() for name, tensor in problem.drive.model.state_dict().items()},
        values={
            owner: {key: np.array(value, np.float64) for key, value in params.items()}
            for owner, params in outcome.values.items()
        },
        segments=problem.evaluation.trajectories,
        sampling=problem.sampling,
        curves=curves,
        complaint=outcome.message,
        fitted=Fitted(problem.objective, outcome.vector, problem.fit),
    )


def finer(problem: Problem) -> Callable[[Float[np.ndarray, "coordinates"]], Objective] | None:
    """Return a function that makes the objective near a vector with half the timestep.

    None if `discretisation` is false, or if the fit minimises an objective without rollouts; ConfigError as
    `is_wanted`.
    """
    by_rollouts = type(problem.fit).compile_scores is Fit.compile_scores
    if not (is_wanted(problem.settings["discretisation"]) and by_rollouts):
        return None
    objective, pilot, halved = problem.objective, problem.pilot, halve_step(problem.bench)

    def approach(vector: Float[np.ndarray, "coordinates"]) -> Objective:
        if pilot is None:
            return objective.approaching(in_other_steps(objective, problem.drive, halved), vector)
        pilot_bench = remake(pilot.bench, timestep=halved.timestep, solreffriction=list(halved.solreffriction))
        return objective.approaching(pilot.simulate(pilot_bench), vector)

    return approach


def is_wanted(asked: Any) -> bool:
    """Return whether the result is checked with half the timestep; ConfigError if this is neither true nor false."""
    if not isinstance(asked, bool):
        raise ConfigError(f"discretisation={asked}: expected true or false")
    return asked


def judge_baseline(problem: Problem) -> tuple[Judgement, Values]:
    """Fit and evaluate the bench without friction on the same segments and rollouts; return evaluation and values."""
    settings = problem.settings

    def assemble(bench: Bench) -> Drive:
        sampling = bench.sampling(problem.objective.interval)
        return Drive.assemble(bench, Baseline(bench.nv), problem.drive.engine.name, sampling)

    drive = assemble(problem.bench)
    space = Space(problem.bench, drive.model, settings["dtype"])
    if space.names:
        cache = cache_folder(settings["compilation_cache"])
        folder = None if cache is None else cache / "reference"
        coarse = assemble(remake(problem.bench, timestep=problem.objective.timestep).observing(problem.bench.observed))
        values = fit_reference(problem.objective.for_drive(space, coarse.rollout), folder)
    else:
        values = jax.tree.map(np.asarray, space.values(space.start))
    return problem.evaluation.judge(drive.rollout.compiled, values), values


def _find_residual(problem: Problem, outcome: Outcome) -> tuple[Left | None, Torque | None, Residual | None]:
    """Return the residual torque of the training recordings, and the sections `torque` and `residual`."""
    filtering = choose_filtering(problem.fit, problem.evaluation.torque)
    train, space = problem.dataset.train, problem.objective.space
    recordings = Recordings(problem.bench, problem.drive.model, problem.dataset.logs)
    torque = measure_torque(recordings, len(train), space, outcome.vector, filtering)
    residual_torque = find_left(recordings._replace(logs=train), space, outcome.vector, filtering[0])
    residual = describe_residual(residual_torque, space, outcome.vector) if residual_torque else None
    return residual_torque, torque, residual


def _portray(problem: Problem, result: Result, left: Left | None) -> dict[str, Any]:
    """Return friction curves with data, and the residual torque over time, as fields of `Curves`."""
    model, samples = problem.drive.model, problem.samples
    draws = result["covariance"] and draw_parameters("", result, problem.bench, model, DRAWS, seed=0)
    if left is None:
        return {"portraits": portray(model, draws or {}, Rows(samples, samples.qvel != 0))}
    torque = np.where(left.counts, left.torque, np.nan)
    return {"portraits": portray(model, draws or {}, left.rows), "left_time": left.time, "left": torque}


def _collect_curves(problem: Problem, outcome: Outcome, judgement: Judgement, baseline: Judgement) -> Curves:
    measured, local = problem.evaluation.trajectories, problem.evaluation.local
    velocity, friction, low, high = sample_friction(problem.drive.model, problem.samples)
    return Curves(
        measured_qpos=measured.qpos,
        measured_qvel=measured.qvel,
        signals=measured.signals,
        load=measured.loads,
        qpos=judgement.prediction.qpos,
        qvel=judgement.prediction.qvel,
        baseline_qpos=baseline.prediction.qpos,
        baseline_qvel=baseline.prediction.qvel,
        train_mae=judgement.rollout_mae["train"],
        test_mae=judgement.rollout_mae["test"],
        local_mae=judgement.local_mae,
        local_speed=np.abs(local.qvel).mean(axis=(1, 2)),
        local_load=np.abs(_motor_torque(problem, local)).mean(axis=(1, 2)),
        velocity=velocity,
        friction=friction,
        friction_low=low,
        friction_high=high,
        history=outcome.history,
        train_errors=judgement.train_errors,
        recording=np.array(measured.recording, np.float64),
        begins=np.array(measured.begins, np.float64),
    )


def _motor_torque(problem: Problem, segments: Segments) -> Float[np.ndarray, "batch time nv"]:
    """Return the actuators' torque at measured states [N m or N], at initial values: the same for all models."""
    values = {"bench": problem.bench.initial_values()}
    observe = make_observer(problem.drive.engine, problem.sampling)
    # Only the torque: other inputs need the links' dynamics, which take seconds to compile.
    torque = problem.drive.rollout.compile(lambda *states: observe(*states).motor_torque)
    states = segments.qpos[:, :-1], segments.qvel[:, :-1]
    return np.asarray(torque(values, *states, segments.signals, segments.loads), np.float64)


def _describe_fit(space: Space, outcome: Outcome, uncertainty: Uncertainty) -> FitRecord:
    # Iterations of a grid search do not descend, and a converged or diverged fit reports that itself.
    descended = outcome.stopped == "finished" and outcome.method != "grid"
    history = space.pick({name: values.T for name, values in outcome.history.items()})
    return FitRecord(
        method=outcome.method,
        iterations=outcome.iterations,
        best_iteration=outcome.best_iteration,
        loss=outcome.loss,
        stopped=outcome.stopped,
        falling=still_falling(outcome.history["loss"]) if descended else 0.0,
        moving=list_moving(history, space.pick(uncertainty.intervals)) if descended else [],
    )


def list_moving(
    history: Mapping[str, Float[np.ndarray, "iterations"]], intervals: Mapping[str, Float[np.ndarray, "2"]]
) -> list[str]:
    """List the parameters that still moved when the fit ended.

    A parameter moves if its means over the two halves of the last tenth of the iterations differ by more than a third
    of half its 95 % interval, or by more than 1 % of its value if it has no interval. Labels are `bench.armature`, or
    `bench.armature/knee` with several joints.
    """
    moving = []
    for name, values in history.items():
        half = int(LATE * len(values)) // 2
        if not half:
            continue
        before, last = values[-2 * half : -half].mean(), values[-half:].mean()
        width = MOVING * np.ptp(intervals.get(name, np.full(2, np.nan))) / 2
        if abs(last - before) > (width if np.isfinite(width) else MOVING_BLINDLY * abs(last)):
            moving.append(name)
    return moving


def still_falling(loss: Float[np.ndarray, "iterations"]) -> float:
    """Return the relative decrease of the lowest loss in the last tenth of the iterations."""
    finite = np.where(np.isfinite(loss), loss, np.inf).astype(np.float64)
    before = finite[: len(finite) - len(finite) // 10].min(initial=np.inf)
    return max(0.0, 1 - float(finite.min() / before)) if np.isfinite(before) and before > 0 else 0.0


def repeat_fit(drive: FittedDrive, logs: Logs) -> FittedDrive:
    """Identify a drive again from other recordings, starting at its values, with the settings of its run.

    Automatic settings stay as the run chose them: step, segments, loss, known values and optional parameters.
    Link inertia and gravity stay as the run identified them.

    Raises:
        FrictionzooError: The recordings do not fit the drive or have a definite fault, or a setting is invalid.
    """
    settings = {**_settle(drive.result.settings), "data": dict(logs.section)}
    bench, fit = drive.bench.begun(drive.values["bench"]), build(settings["fit"], Fit)
    parts = Parts.settle(settings, bench, logs.divide(), copy.deepcopy(drive.model), fit)
    with parts.computing() as device:
        return solve(Problem.pose(parts), drive.result.model, device)


def _settle(saved: Mapping[str, Any]) -> dict[str, Any]:
    """Return a run's settings, checked because they may be a stranger's, without searches before the fit."""
    saved = keep_caches_at_home(saved)
    chosen = create_literal({name: saved[name] for name in _CHECKED if name in saved})
    settings = compose_settings(cast(dict[str, Any], OmegaConf.to_container(chosen)), "recipe=given")
    fit = dict(saved["fit"])
    fit |= {name: value for name, value in {"start": None, "links": [], "tilt": False}.items() if name in fit}
    return {**settings, "bench": saved["bench"], "model": saved["model"], "fit": fit, "logger": None}
