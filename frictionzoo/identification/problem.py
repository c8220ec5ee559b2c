"""The identification problem: checked input, objective and evaluation."""

import contextlib
import logging
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import numpy as np

from frictionzoo.bench import Bench
from frictionzoo.bench.given import Given
from frictionzoo.bench.signals import pair_all
from frictionzoo.core.build import build
from frictionzoo.core.described import describe, remake
from frictionzoo.core.errors import RunError
from frictionzoo.core.log import Dataset
from frictionzoo.core.params import AUTO
from frictionzoo.core.segments import Sampling, Segments, cut_segments
from frictionzoo.core.state import DriveState
from frictionzoo.core.telling import align, list_columns
from frictionzoo.data.pairing import describe_columns
from frictionzoo.diagnostics.findings import Doubt
from frictionzoo.diagnostics.recordings import check_up
from frictionzoo.fit import Fit, Objective, Space
from frictionzoo.fit.link_inertia import LinkInertia
from frictionzoo.fit.motion import Recordings
from frictionzoo.fit.start import begin_where
from frictionzoo.identification.choices import Choice, widen_bounds
from frictionzoo.identification.pilot import Pilot
from frictionzoo.identification.recipe import Settled, settle
from frictionzoo.models import FrictionModel
from frictionzoo.models.by_name import complete_laws
from frictionzoo.result.evaluate import Evaluation
from frictionzoo.result.fitted_drive import FittedDrive
from frictionzoo.result.record import describe_data
from frictionzoo.result.torque import choose_filtering
from frictionzoo.simulation.context import computing, refuse_precision
from frictionzoo.simulation.drive import Drive, refuse_other_joints
from frictionzoo.simulation.proof import Proof, Recorded, initial_values, prove

_log = logging.getLogger(__name__)
_AT_ONCE = 25_000  # samples in one batch


class Parts(NamedTuple):
    """Input of a problem.

    Attributes:
        settled: The bench and all options that the record reports; among them `segments`, `loss` and `evaluation`, the
            arguments of `cut_segments`, `Objective` and `Evaluation`.
        model: The friction model; it is prepared for the data, and a fit leaves the best values in it.
        doubts: Likely faults of the recordings.
        seconds: Time to prepare the parts [s].
    """

    settled: Settled
    dataset: Dataset
    model: FrictionModel
    fit: Fit
    doubts: list[Doubt]
    seconds: float

    @classmethod
    def from_settings(
        cls, settings: Mapping[str, Any], given: Given | None = None, choose: Callable[..., Settled] = settle
    ) -> "Parts":
        """Build the parts that the settings describe; `given` are bench and recordings that have been read already.

        Raises:
            FrictionzooError: The input is at fault.
        """
        began = time.perf_counter()
        bench, dataset, earlier, settings = given or Given.read(settings)._replace(seconds=0.0)
        settings = {**settings, "model": complete_laws(settings["model"], settings)}
        model = build(settings["model"], FrictionModel, nv=bench.nv)
        model.bind(bench.joints)
        model.begin(bench.initial_friction(model.params))
        parts = cls.settle(settings, bench, dataset, model, build(settings["fit"], Fit), choose)
        return parts._replace(seconds=earlier + time.perf_counter() - began)

    @classmethod
    def settle(
        cls,
        settings: Mapping[str, Any],
        bench: Bench,
        dataset: Dataset,
        model: FrictionModel,
        fit: Fit,
        choose: Callable[..., Settled] = settle,
    ) -> "Parts":
        """Return the parts, with open options (`auto`) chosen on the training recordings.

        `bench` has no open options. `choose` chooses them, as `frictionzoo.identification.recipe.settle` does.

        Raises:
            FrictionzooError: The input is at fault.
        """
        began = time.perf_counter()
        if settings["dtype"] != AUTO:
            refuse_precision(settings["dtype"])  # before the first fit
        for note in bench.notes:
            _log.info("%s: %s", bench.source, note)
        refuse_other_joints(model, bench)
        model.bind(bench.joints)
        dataset = pair_all(dataset, bench.joints)
        bench, settings = _divide_interval(bench, settings, dataset.train[0].timestep)
        for columns in describe_columns(dataset.logs, bench.joints) if bench.nv > 1 else ():
            others = len(columns["logs"]) - 1
            names = columns["logs"][0] + (f" and {others} more" if others else "")
            _log.info("%s: columns by joint\n%s", names, align(list_columns(columns)))
        observing = bench.observing(model.inputs)
        train, test = (tuple(map(observing.accept, logs)) for logs in (dataset.train, dataset.test))
        doubts = check_up(Dataset(dataset.name, train, test), observing, settings["checkup"])
        settings, bench, widened = widen_bounds(settings, bench, train, model)
        with computing("float64", settings["device"], settings["compilation_cache"]):
            settled = choose(settings, bench, dataset, model, fit)
        settled = replace(settled, choices=(*widened, *settled.choices))
        return cls(settled, dataset, model, fit, doubts, time.perf_counter() - began)

    def computing(self) -> contextlib.AbstractContextManager[str]:
        """Return a context with JAX in the precision and on the device of the settings."""
        settings = self.settled.settings
        return computing(settings["dtype"], settings["device"], settings["compilation_cache"])


@dataclass(frozen=True)
class Problem:
    """An identification that is ready to begin: the input is checked.

    Attributes:
        sampling: Mapping from recorded samples to simulation steps.
        segments: Training segments that the fit compares.
        drive: The bench with the chosen friction model.
        proof: Verification against MuJoCo C.
        samples: Inputs of the friction model in the training samples.
        seconds: Time to build the problem [s].
        links: Link inertias identified before the fit, which the bench has; None if there are none.
        pilot: The pilot fit whose compiled equations this fit uses; None if it compiles its own.
    """

    bench: Bench
    dataset: Dataset
    doubts: list[Doubt]
    sampling: Sampling
    segments: Segments
    evaluation: Evaluation
    drive: Drive
    proof: Proof
    samples: DriveState
    objective: Objective
    fit: Fit
    settings: Mapping[str, Any]
    seconds: float
    links: LinkInertia | None = None
    choices: tuple[Choice, ...] = ()
    pilot: Pilot | None = None

    @classmethod
    def from_settings(cls, settings: Mapping[str, Any]) -> "Problem":
        """Build the problem that the settings describe, in the current `computing` context.

        Raises:
            FrictionzooError: The input is at fault.
        """
        return cls.pose(Parts.from_settings(settings))

    @classmethod
    def pose(cls, parts: "Parts") -> "Problem":
        """Build the problem of these parts, in the current `computing` context.

        Raises:
            FrictionzooError: The input is at fault.
        """
        began = time.perf_counter()
        settings, bench, dataset, model, fit = parts.settled.settings, parts.settled.bench, *parts[1:4]
        bench = bench.observing(model.inputs)
        accepted = bench.accept_all(dataset)
        if links := fit.revise(Recordings(bench, model, accepted.train)):
            for line in links.lines():
                _log.info("%s", line)
            bench = bench.with_inertia(links.inertia)
            if links.tilt is not None:
                bench = bench.with_gravity(links.tilt.gravity.tolist())
            identified = {name: describe(bench)[name] for name in ("inertia", "gravity")}
            settings = {**settings, "bench": {**settings["bench"], **identified}}
        dataset = bench.accept_all(dataset) if links else accepted
        doubts = [*parts.doubts, *parts.settled.doubts]
        sampling = bench.sampling(dataset.logs[0].timestep)
        segments = cut_segments(dataset.train, **settings["segments"], history=sampling.history)
        evaluation = Evaluation(dataset, bench.joint_type, **settings["evaluation"], history=sampling.history)
        choose_filtering(fit, evaluation.torque)  # refuses an invalid filter before the fit
        drive = Drive.assemble(bench, model, settings["engine"], sampling)
        proof = prove(bench, model, drive.engine.name, initial_values(bench, model), Recorded.of(dataset.train))
        samples = _training_samples(drive, bench, dataset)
        drive.model.prepare(samples)
        space = Space(bench, drive.model, settings["dtype"])
        objective = Objective(space, drive.rollout, segments, **settings["loss"])
        objective.recordings = Recordings(bench, drive.model, dataset.train)
        if (start := parts.settled.start) is not None:
            objective = objective.starting(start.vector).beginning(start.states_of(segments))
        fit = fit.choose(objective)
        if fit.start is not None:
            objective = begin_where(fit.start, objective)
        objective = objective.balanced(None if start is None or links else start.sizes)
        pilot = None if start is None or links or objective.devices > 1 else parts.settled.pilot
        if pilot is not None and start is not None:
            objective = objective.within(pilot.objective, pilot.whole(start))  # already compiled
        seconds = parts.seconds + time.perf_counter() - began
        fields = (bench, dataset, doubts, sampling, segments, evaluation, drive, proof, samples, objective)
        return cls(*fields, fit, settings, seconds, links, parts.settled.choices, pilot)

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
        return replace(self, bench=bench, segments=segments, drive=drive, objective=objective, pilot=None)


def _divide_interval(bench: Bench, settings: Mapping[str, Any], interval: float) -> tuple[Bench, Mapping[str, Any]]:
    """Make the timestep divide the sample interval [s] if none was set; an open one stays `auto` in the settings."""
    timestep, steps = settings["bench"].get("timestep"), interval / bench.timestep
    if timestep not in (None, AUTO) or bench.fits(interval):
        return bench, settings
    step = interval / math.ceil(steps)
    _log.info("%s: steps of %g s, not %g s: samples are %g s apart", bench.source, step, bench.timestep, interval)
    if timestep is None:
        settings = {**settings, "bench": {**settings["bench"], "timestep": step}}
    return remake(bench, timestep=step), settings


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
