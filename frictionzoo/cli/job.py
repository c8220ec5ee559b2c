"""One job from recordings to an identified drive, in the order in which data flow."""

import copy
import json
import logging
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np
import safetensors.torch
from jaxtyping import Float
from omegaconf import DictConfig, OmegaConf

from frictionzoo import __version__
from frictionzoo.bench import Bench
from frictionzoo.bench.doubts import doubt_motion, doubt_recordings
from frictionzoo.core.build import build
from frictionzoo.core.config import list_options
from frictionzoo.core.errors import ConfigError, RunError
from frictionzoo.core.log import Dataset
from frictionzoo.core.output import write_atomically
from frictionzoo.core.segments import Sampling, Segments, cut_segments
from frictionzoo.core.state import DriveState
from frictionzoo.export.bench import write_bench
from frictionzoo.export.nearest import find_nearest
from frictionzoo.fit import Fit, Objective, Outcome, Space, estimate_uncertainty, fit_reference, run_fit
from frictionzoo.logs.cache import cache_folder, digest
from frictionzoo.models import Baseline
from frictionzoo.result.curves import Curves, sample_friction, write_curves
from frictionzoo.result.evaluate import Evaluation, Judgement
from frictionzoo.result.identified import Identified
from frictionzoo.result.record import build_result, describe_data, pick_metrics, write_result
from frictionzoo.show.run_page import write_report
from frictionzoo.show.run_plots import write_figures
from frictionzoo.show.terminal import summarise_in_markdown
from frictionzoo.simulate import Values
from frictionzoo.simulate.drive import Drive
from frictionzoo.simulate.proof import Proof, Recorded, initial_values, prove
from frictionzoo.simulate.rollout import make_observer

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Problem:
    """An identification that is ready to begin: all of the input has been looked at.

    Attributes:
        bench: The test stand.
        dataset: Recordings, train and test.
        doubts: What of them is likely to be wrong.
        sampling: From their samples to simulation steps.
        segments: What the fit compares.
        evaluation: The rollouts that judge.
        drive: The bench with the chosen law.
        proof: That it is simulated as MuJoCo does.
        samples: What the law sees in the training samples.
        objective: What the fit minimises.
        fit: How.
        device: Where it runs.
    """

    bench: Bench
    dataset: Dataset
    doubts: list[str]
    sampling: Sampling
    segments: Segments
    evaluation: Evaluation
    drive: Drive
    proof: Proof
    samples: DriveState
    objective: Objective
    fit: Fit
    device: str

    @classmethod
    def pose(cls, settings: Mapping[str, Any]) -> "Problem":
        """The problem that the settings describe.

        Raises:
            FrictionzooError: The input is at fault.
        """
        device = _configure_jax(settings["dtype"], settings["device"], settings["compilation_cache"])
        bench, dataset = build(settings["bench"]), build(settings["data"]).load()
        model = build(settings["model"], nv=bench.nv)
        bench = bench.observing(model.inputs)
        dataset = bench.accept_all(dataset)
        doubts = doubt_recordings(dataset, bench) + doubt_motion(dataset, bench)
        sampling = bench.sampling(dataset.logs[0].timestep)
        segments = cut_segments(dataset.train, **settings["segments"], history=sampling.history)
        evaluation = Evaluation(dataset, bench.joint_type, **settings["evaluation"], history=sampling.history)
        drive = Drive.assemble(bench, model, settings["engine"], sampling)
        proof = prove(bench, model, drive.engine.name, initial_values(bench, model), Recorded.of(dataset.train))
        samples = _training_samples(drive, bench, dataset)
        drive.model.prepare(samples)
        space = Space(bench, drive.model, settings["dtype"])
        objective = Objective(space, drive.rollout, segments, **settings["loss"])
        fit = build(settings["fit"]).choose(objective)
        posed = (bench, dataset, doubts, sampling, segments, evaluation, drive, proof, samples, objective, fit, device)
        return cls(*posed)

    def following(self, teacher: Identified, settings: Mapping[str, Any]) -> "Problem":
        """The same problem with a fitted drive's rollouts in place of the measured segments, judged as before.

        The bench starts with the fitted values; its armature alone is free.

        Args:
            teacher: The drive, from a run with the same bench, data and evaluation.
            settings: Those of this problem.

        Raises:
            RunError: The recordings are not those of the teacher's run any more, or the teacher diverges.
        """
        came = {"data": describe_data(self.dataset)["sha256"], "evaluation": self.evaluation.sha256}
        for what, sha256 in came.items():
            if sha256 != (expected := teacher.result[what]["sha256"]):
                raise RunError(
                    f"{teacher.folder}: {what} with SHA-256 {sha256[:12]}, expected {expected[:12]} as when it ran; "
                    "restore its recordings or run it again"
                )
        # The teacher's law may look at something that the student's does not, and the other way round.
        train = tuple(map(teacher.bench.accept, self.dataset.train))
        followed = teacher.follow(cut_segments(train, **settings["segments"], history=self.sampling.history))
        segments = replace(self.segments, qpos=followed.qpos, qvel=followed.qvel)
        bench = self.bench.restarted(teacher.values["bench"])
        drive = Drive.assemble(bench, self.drive.model, settings["engine"], self.sampling)
        space = Space(bench, drive.model, settings["dtype"])
        objective = Objective(space, drive.rollout, segments, **settings["loss"])
        return replace(self, bench=bench, segments=segments, drive=drive, objective=objective)


def run_job(
    config: DictConfig, name: str, folder: Path, teacher: Identified | None = None
) -> tuple[dict[str, Any], str | None]:
    """Identify a drive and write what a run leaves behind.

    Args:
        config: The composed configuration.
        name: The chosen model, as in conf/model.
        folder: The run's folder.
        teacher: The fitted drive that this one is to follow instead of the measured training segments; None for none.

    Returns:
        What `result.json` holds, and one line of complaint if the fit diverged.

    Raises:
        FrictionzooError: The input is at fault.
    """
    began = time.perf_counter()
    settings = cast(dict[str, Any], OmegaConf.to_container(config, resolve=True))
    logger = build(settings["logger"])
    measured = Problem.pose(settings)
    problem = measured if teacher is None else measured.following(teacher, settings)
    timing = {"setup": time.perf_counter() - began}
    segments = problem.segments
    engine = problem.drive.engine
    note = f": {engine.note}" if engine.note else ""
    _log.info("engine %s, as MuJoCo C within %.1g%s", engine.name, problem.proof.rollout, note)
    if problem.objective.devices > 1:
        _log.info("segments are spread over %d devices", problem.objective.devices)
    _log.info("%s: %d segments of %d steps to train on", problem.dataset.name, segments.count, segments.length)

    identity = _identify(name, problem, settings)
    model = problem.drive.model
    outcome = run_fit(
        problem.fit,
        problem.objective,
        model,
        folder=folder,
        identity=identity,
        logger=logger,
        hyperparameters=_list_hyperparameters(name, problem, settings),
        **settings["loop"],
    )
    timing |= {"compile": outcome.compile_seconds, "fit": outcome.fit_seconds}

    asked = time.perf_counter()
    uncertainty = estimate_uncertainty(problem.objective, outcome.vector)
    timing |= {"uncertainty": time.perf_counter() - asked}

    judged = time.perf_counter()
    judgement = problem.evaluation.judge(problem.drive.rollout.compiled, outcome.values)
    baseline, reference = _judge_baseline(measured, settings["dtype"], cache_folder(settings["compilation_cache"]))
    timing |= {"evaluate": time.perf_counter() - judged}

    curves = _collect_curves(problem, outcome, judgement, baseline)
    _write_drive(folder, problem, curves)
    timing |= {"total": time.perf_counter() - began}
    result = build_result(
        name=name,
        bench=problem.bench,
        model=model,
        values=outcome.values,
        dataset=problem.dataset,
        evaluation=problem.evaluation,
        judgement=judgement,
        baseline=baseline,
        reference=reference["bench"],
        fit=_describe_fit(outcome),
        history=outcome.history,
        timing=timing,
        settings=settings,
        engine=engine.name,
        proof=problem.proof,
        warnings=problem.doubts,
        device=problem.device,
        uncertainty=uncertainty,
    )
    _write_mjcf(folder, problem, outcome, result)
    write_figures(folder / "figures", result, curves)
    result["timing"]["total"] = time.perf_counter() - began
    write_report(folder / "report.html", result, curves)
    figures = sorted((folder / "figures").glob("*.png"))
    logger.finish(outcome.iterations, pick_metrics(result), figures, summarise_in_markdown(result, folder))
    write_result(folder / "result.json", result)
    return result, outcome.message


def _write_drive(folder: Path, problem: Problem, curves: Curves) -> None:
    """Curves and the law's values; each is written whole or not at all."""
    model = problem.drive.model
    # One entry only: safetensors writes several in an order that changes from run to run.
    header = {"frictionzoo": f"{model.name}, version {__version__}"}
    write_atomically(folder / "friction.safetensors", safetensors.torch.save(model.state_dict(), header))
    write_curves(folder, curves)


def _write_mjcf(folder: Path, problem: Problem, outcome: Outcome, result: dict[str, Any]) -> None:
    """What `python -m frictionzoo.export RUN target=mjcf` writes, too."""
    model = copy.deepcopy(problem.drive.model).double()
    values = {owner: {k: np.array(v, np.float64) for k, v in own.items()} for owner, own in outcome.values.items()}
    drive = problem.bench, model, values, problem.evaluation.trajectories, problem.sampling
    fitted = Identified(folder, result, *drive)
    write_atomically(folder / "identified.xml", write_bench(fitted, find_nearest(fitted)).encode())


def _collect_curves(problem: Problem, outcome: Outcome, judgement: Judgement, baseline: Judgement) -> Curves:
    measured, local = problem.evaluation.trajectories, problem.evaluation.local
    velocity, friction, low, high = sample_friction(problem.drive.model, problem.samples)
    return Curves(
        measured_qpos=measured.qpos,
        measured_qvel=measured.qvel,
        ctrl=measured.ctrl,
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
    )


def _configure_jax(dtype: str, device: str, compilation_cache: str | None) -> str:
    """Set JAX's precision, device and cache of compiled functions; returns the device's name."""
    # XLA would take most of a GPU's memory at once and leave torch none; it reads this when it first meets the GPU.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    if dtype not in ("float32", "float64"):
        raise ConfigError(f"dtype={dtype}; expected float32 or float64")
    if device not in ("auto", "cpu", "cuda"):
        raise ConfigError(f"device={device}; expected auto, cpu or cuda")
    jax.config.update("jax_enable_x64", dtype == "float64")
    try:
        chosen = jax.devices(None if device == "auto" else device)[0]
    except RuntimeError:
        raise ConfigError(
            f"device={device}: JAX finds none, expected a GPU; install frictionzoo[cuda] or set device=cpu"
        ) from None
    jax.config.update("jax_default_device", chosen)
    folder = cache_folder(compilation_cache)
    if folder is not None and jax.config.jax_compilation_cache_dir is None:  # JAX's own variable has the last word
        jax.config.update("jax_compilation_cache_dir", str(folder / "xla"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    return str(chosen.device_kind if chosen.platform != "cpu" else "cpu")


def _training_samples(drive: Drive, bench: Bench, dataset: Dataset) -> DriveState:
    """What the friction law sees in every training sample, with the bench's initial values, as numpy arrays."""
    values = {"bench": bench.initial_values()}
    state = drive.rollout.compile(jax.vmap(drive.engine.drive_state, in_axes=(None, 0, 0, 0, None)))
    signals = [(log.qpos, log.qvel, log.channels, log.load) for log in dataset.train]
    parts = [jax.tree.map(np.asarray, state(values, *of_log)) for of_log in signals]
    return jax.tree.map(lambda *signals: np.concatenate(signals), *parts)


def _motor_torque(problem: Problem, segments: Segments) -> Float[np.ndarray, "batch time nv"]:
    """The actuators' torque at each measured state, with the bench's initial values: the same for all laws."""
    values = {"bench": problem.bench.initial_values()}
    seen = problem.drive.rollout.compile(make_observer(problem.drive.engine, problem.sampling))
    state = seen(values, segments.qpos[:, :-1], segments.qvel[:, :-1], segments.ctrl, segments.loads)
    return np.asarray(state.motor_torque, np.float64)


def _judge_baseline(problem: Problem, dtype: str, cache: Path | None) -> tuple[Judgement, Values]:
    """The best that the bench does without friction, on the same segments and the same rollouts, and its values."""
    drive = Drive.assemble(problem.bench, Baseline(problem.bench.nv), problem.drive.engine.name, problem.sampling)
    space = Space(problem.bench, drive.model, dtype)
    if space.names:
        folder = None if cache is None else cache / "reference"
        values = fit_reference(problem.objective.for_drive(space, drive.rollout), folder)
    else:
        values = jax.tree.map(np.asarray, space.values(space.start))
    return problem.evaluation.judge(drive.rollout.compiled, values), values


def _identify(name: str, problem: Problem, settings: Mapping[str, Any]) -> dict[str, str]:
    """What a checkpoint must share with this run."""
    sections = {key: settings[key] for key in ("bench", "model", "fit", "segments", "loss", "seed", "dtype")}
    return {
        "frictionzoo": __version__,
        "model": name,
        "data": describe_data(problem.dataset)["sha256"],
        "engine": problem.drive.engine.name,
        **{section: json.dumps(value, sort_keys=True) for section, value in sections.items() if section != "model"},
        "model settings": json.dumps(sections["model"], sort_keys=True),
        "chunk": str(settings["loop"]["chunk"]),
        "training samples": _digest(problem.segments),
    }


def _digest(segments: Segments) -> str:
    """Hash of what a fit compares, as cleaning and payloads have it."""
    return digest({name: getattr(segments, name) for name in ("qpos", "qvel", "ctrl", "loads")})


def _list_hyperparameters(name: str, problem: Problem, settings: Mapping[str, Any]) -> dict[str, Any]:
    """What tells a run from others: the choices, and options that can change the result, by their names in conf/."""
    chosen = {"model": name, "data": problem.dataset.name, "fit": problem.fit.name}
    options = dict(list_options(settings))
    indifferent = ("resume", "compilation_cache", "loop.progress", "logger.")
    # Bounds and scales come with a choice. TensorBoard shows the first few that differ: they would hide the choice.
    implied = ("_target_", ".low", ".high", ".scale")
    return chosen | {k: v for k, v in options.items() if not k.startswith(indifferent) and not k.endswith(implied)}


def _describe_fit(outcome: Outcome) -> dict[str, Any]:
    return {
        "method": outcome.method,
        "iterations": outcome.iterations,
        "best_iteration": outcome.best_iteration,
        "loss": outcome.loss,
        "stopped": outcome.stopped,
    }
