"""The identification problem: checked input, objective and evaluation."""

import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from frictionzoo.bench import Bench
from frictionzoo.core.described import describe
from frictionzoo.core.errors import RunError
from frictionzoo.core.log import Dataset
from frictionzoo.core.segments import Sampling, Segments, cut_segments
from frictionzoo.core.state import DriveState
from frictionzoo.diagnostics.findings import Finding
from frictionzoo.fit import Fit, Objective, Space
from frictionzoo.fit.link_inertia import LinkInertia
from frictionzoo.fit.motion import Recordings
from frictionzoo.fit.start import begin_where
from frictionzoo.identification.pilot import Pilot
from frictionzoo.identification.recipe import Parts
from frictionzoo.models import TorchFriction
from frictionzoo.result.evaluate import Evaluator
from frictionzoo.result.fitted_drive import FittedDrive
from frictionzoo.result.record import describe_data
from frictionzoo.result.section_types import AutomaticSetting
from frictionzoo.result.torque import choose_filtering
from frictionzoo.simulation.drive import Drive
from frictionzoo.simulation.proof import Proof, Recorded, initial_values, prove

_log = logging.getLogger(__name__)
_AT_ONCE = 25_000  # samples in one batch


@dataclass(frozen=True)
class Problem:
    """An identification that is ready to begin: the input is checked.

    Attributes:
        sampling: Mapping from recorded samples to simulation steps.
        segments: Training segments that the fit compares.
        drive: The bench with the chosen friction model.
        samples: Inputs of the friction model in the training samples.
        seconds: Time to build the problem [s].
        links: Link inertias identified before the fit, which the bench has; None if there are none.
        pilot: The pilot fit whose compiled equations this fit uses; None if it compiles its own.
        measured: The problem with measured segments, if `segments` are another drive's rollouts; else None.
    """

    bench: Bench
    dataset: Dataset
    doubts: list[Finding]
    sampling: Sampling
    segments: Segments
    evaluation: Evaluator
    drive: Drive
    proof: Proof
    samples: DriveState
    objective: Objective
    fit: Fit
    settings: Mapping[str, Any]
    seconds: float
    links: LinkInertia | None = None
    choices: tuple[AutomaticSetting, ...] = ()
    pilot: Pilot | None = None
    measured: "Problem | None" = None

    @classmethod
    def from_settings(cls, settings: Mapping[str, Any]) -> "Problem":
        """Build the problem that the settings describe, in the current `computing` context; see `pose`."""
        return cls.pose(Parts.from_settings(settings))

    @classmethod
    def pose(cls, parts: Parts) -> "Problem":
        """Build the problem of these parts, in the current `computing` context.

        Raises:
            FrictionzooError: The input is at fault.
        """
        began = time.perf_counter()
        settings, model, fit, start = parts.settings, parts.model, parts.fit, parts.start
        if isinstance(model, TorchFriction):
            model.double()  # torch evaluates it with the module's own values too, at states in float64
        bench = parts.bench.observing(model.inputs)
        accepted = bench.accept_all(parts.dataset)
        if links := fit.revise(Recordings(bench, model, accepted.train)):
            for line in links.lines():
                _log.info("%s", line)
            bench = bench.with_inertia(links.inertia)
            if links.tilt is not None:
                bench = bench.with_gravity(links.tilt.gravity.tolist())
            identified = {name: describe(bench)[name] for name in ("inertia", "gravity")}
            settings = {**settings, "bench": {**settings["bench"], **identified}}
        dataset = bench.accept_all(parts.dataset) if links else accepted
        sampling = bench.sampling(dataset.logs[0].timestep)
        segments = cut_segments(dataset.train, **settings["segments"], history=sampling.history)
        evaluation = Evaluator(dataset, bench.joint_type, **settings["evaluation"], history=sampling.history)
        choose_filtering(fit, evaluation.torque)  # refuses an invalid filter before the fit
        drive = Drive.assemble(bench, model, settings["engine"], sampling)
        proof = prove(bench, model, drive.engine.name, initial_values(bench, model), Recorded.of(dataset.train))
        samples = _training_samples(drive, bench, dataset)
        drive.model.prepare(samples)
        space = Space(bench, drive.model, settings["dtype"])
        objective = Objective(space, drive.rollout, segments, **settings["loss"])
        objective.recordings = Recordings(bench, drive.model, dataset.train)
        if start is not None:
            objective = objective.starting(start.vector).beginning(start.states_of(segments))
        fit = fit.choose(objective)
        if fit.start is not None:
            objective = begin_where(fit.start, objective)
        objective = objective.balanced(None if start is None or links else start.sizes)
        pilot = None if start is None or links or objective.devices > 1 else parts.pilot
        if pilot is not None and start is not None:
            objective = objective.within(pilot.objective, pilot.whole(start))  # already compiled
        seconds = parts.seconds + time.perf_counter() - began
        fields = (bench, dataset, parts.doubts, sampling, segments, evaluation, drive, proof, samples, objective)
        return cls(*fields, fit, settings, seconds, links, parts.choices, pilot)

    def following(self, teacher: FittedDrive) -> "Problem":
        """Return the problem with a fitted drive's rollouts as training segments; the evaluation is unchanged.

        The bench starts at the fitted values, and only its armature is free.

        Raises:
            RunError: The recordings have changed since the teacher's run, or the teacher diverges.
        """
        settings = self.settings
        hashes = {"data": describe_data(self.dataset)["sha256"], "evaluation": self.evaluation.sha256}
        for part, sha256 in hashes.items():
            if sha256 != (expected := teacher.result[part]["sha256"]):
                raise RunError(
                    f"{teacher.place}: {part} with SHA-256 {sha256[:12]}, expected {expected[:12]} as in that run; "
                    "restore its recordings or run it again"
                )
        # The models of teacher and student may need different inputs.
        train = tuple(map(teacher.bench.accept, self.dataset.train))
        rollouts = teacher.follow(cut_segments(train, **settings["segments"], history=self.sampling.history))
        segments = replace(self.segments, qpos=rollouts.qpos, qvel=rollouts.qvel)
        bench = self.bench.restarted(teacher.values["bench"])
        drive = Drive.assemble(bench, self.drive.model, settings["engine"], self.sampling)
        space = Space(bench, drive.model, settings["dtype"])
        objective = Objective(space, drive.rollout, segments, **settings["loss"]).balanced()
        changed = {"bench": bench, "segments": segments, "drive": drive, "objective": objective}
        return replace(self, **changed, pilot=None, measured=self)


def _training_samples(drive: Drive, bench: Bench, dataset: Dataset) -> DriveState:
    """Return the friction model's inputs in all training samples, at the bench's initial values, as numpy arrays."""
    # Concatenated, because each length would compile anew; in batches, to bound memory.
    by_log = [
        (log.qpos, log.qvel, log.signals, np.broadcast_to(log.load, (log.samples, len(log.load))))
        for log in dataset.train
    ]
    samples = jax.tree.map(lambda *parts: np.concatenate(parts), *by_log)
    values = {"bench": bench.initial_values()}

    def observe(samples: tuple[Any, ...]) -> DriveState:
        return jax.lax.map(lambda sample: drive.engine.drive_state(values, *sample), samples, batch_size=_AT_ONCE)

    return jax.tree.map(np.asarray, drive.rollout.compile(observe)(samples))
