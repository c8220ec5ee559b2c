"""Pilot fits, on which the automatic settings are based."""

import contextlib
import copy
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from frictionzoo.bench import Bench
from frictionzoo.core.described import remake
from frictionzoo.core.errors import FitError, FrictionzooError
from frictionzoo.core.log import Log
from frictionzoo.core.segments import Segments, cut_rollouts, cut_segments
from frictionzoo.fit import Objective, Space
from frictionzoo.fit.blocks import measured_states
from frictionzoo.fit.motion import Filtering, Recordings
from frictionzoo.fit.normal_equations import DAMPING, NormalEquations, bounded_step
from frictionzoo.fit.several import Searches
from frictionzoo.fit.torque_balance import balance
from frictionzoo.fit.torque_equation import TorqueEquation
from frictionzoo.fit.uncertainty import WIDEST, assess
from frictionzoo.identification.choices import GAIN, OPTIONAL
from frictionzoo.models import FrictionModel
from frictionzoo.simulation.drive import Drive

_EXACT = 3e-3  # narrow enough half interval, relative to the value, or to its scale if larger
_COLLINEAR = 1e-8
"""`COLLINEAR` of a pilot. A delay is nearly collinear with armature and damping, and a parameter without an interval
counts as doubtful even if a long log determines it."""
_MOST_TRIES, _TOLERANCE = 40, 1e-5
_PATIENCE = (3, 1e-3)
"""Vectors within which the loss must fall by this share. Where a model lacks something, a fit can follow corners of the
motion for dozens of vectors; the final fit goes on."""
_ROLLOUTS = 64  # number of rollouts from which errors are measured
_DISTURBED = 1e-3  # disturbance of initial velocities, as a share of a joint's RMS speed
Coordinates = Float[np.ndarray, "coordinates"]
States = Float[np.ndarray, "blocks segments twice_nv"]
Errors = Float[np.ndarray, "segments time nv"]


class PilotResult(NamedTuple):
    """Result of a pilot fit.

    Attributes:
        labels: Name of each coordinate, as in `Space.labels`.
        half: Half width of each coordinate's 95 % interval; NaN if it has none.
        enough: Half width that is narrow enough: a small share of the value, or of its scale if that is larger.
        measured: Measured positions of the segments.
        states: Estimated initial states of the segments; None if none were estimated.
        sizes: `Objective.sizes` of the fit.
    """

    labels: list[str]
    vector: Coordinates
    half: Coordinates
    enough: Coordinates
    at_bound: Bool[np.ndarray, "coordinates"]
    loss: float
    measured: Errors
    states: States | None
    sizes: Float[np.ndarray, "nv 2"] | None = None

    @classmethod
    def begun(cls, labels: list[str], vector: Coordinates) -> "PilotResult":
        """Return the start of a search: coordinates without intervals, loss and states."""
        unknown = np.full(len(vector), np.nan)
        return cls(labels, vector, unknown, unknown, np.zeros(len(vector), bool), np.inf, np.zeros((0, 0, 0)), None)

    def states_of(self, segments: Segments) -> States | None:
        """Return the estimated initial states if these are the fitted segments, else None."""
        return self.states if np.array_equal(segments.qpos, self.measured) else None

    @property
    def owners(self) -> set[str]:
        """Names of the parameters, without the prefix `bench.`."""
        return {label.partition("/")[0].removeprefix("bench.") for label in self.labels}

    def among(self, labels: Sequence[str], otherwise: Float[np.ndarray, "others"]) -> Float[np.ndarray, "others"]:
        """Return the coordinates with these labels; `otherwise` fills missing ones."""
        by_label = dict(zip(self.labels, self.vector, strict=True))
        return np.array([by_label.get(label, value) for label, value in zip(labels, otherwise, strict=True)])

    def in_halves(self, step: Coordinates) -> Coordinates:
        """Return a step's size in half intervals; `enough` replaces narrower or missing ones."""
        return np.abs(step) / np.fmax(self.half, self.enough)


class Pilot:
    """A problem with a fit but without an evaluation, in float64.

    Args:
        model: Copied, not changed.
        segments: Arguments of `cut_segments`.
        loss: Arguments of `Objective`.
        begun: Result of another pilot, at which `loss.by_joint` takes the error sizes; None: the initial values.

    Raises:
        FrictionzooError: The input is at fault.
    """

    def __init__(
        self,
        bench: Bench,
        model: FrictionModel,
        logs: Sequence[Log],
        segments: Mapping[str, Any],
        loss: Mapping[str, Any],
        engine: str,
        begun: PilotResult | None = None,
    ) -> None:
        self.bench: Bench = bench.observing(model.inputs)
        accepted = tuple(map(self.bench.accept, logs))
        self.robust: bool = loss["robust"] != "none"
        self._sampling = self.bench.sampling(accepted[0].timestep)
        self._drive = Drive.assemble(self.bench, copy.deepcopy(model), engine, self._sampling)
        self.segments = cut_segments(accepted, **segments, history=self._sampling.history)
        self._simulated: dict[tuple[float, ...], Objective] = {}  # by timestep and softness: each is compiled once
        space = Space(self.bench, self._drive.model, "float64")
        objective = Objective(space, self._drive.rollout, self.segments, **loss)
        self._recordings = objective.recordings = Recordings(self.bench, self._drive.model, accepted)
        initial = np.asarray(space.start, np.float64)
        vector = initial if begun is None else begun.among(space.labels, initial)
        sizes = None if begun is None else begun.sizes
        self.objective: Objective = objective.starting(vector).balanced(sizes).starting(initial)

    @property
    def space(self) -> Space:
        """The optimiser's coordinates."""
        return self.objective.space

    @property
    def start(self) -> Coordinates:
        """Initial coordinates of the physical parameters."""
        return np.asarray(self.space.start, np.float64)[: len(self.space.labels)]

    def balance(self, bench: Bench) -> PilotResult:
        """Return a start from the torque balance with the free parameters of `bench`, or the initial values if better.

        Rollout errors decide between both: with widely spaced samples, accelerations are unknown.
        """
        recordings = self._recordings._replace(bench=bench.observing(self._drive.model.inputs))
        starts = [PilotResult.begun(self.space.labels, self.start)]
        with contextlib.suppress(FrictionzooError):  # such as a recording that is too short
            space = Space(recordings.bench, self._drive.model, "float64")
            equation = TorqueEquation(space, recordings, Filtering(), held=True)
            vector = balance(equation).vector
            # Poorly determined parameters end at a bound, from which a search returns slowly.
            vector = np.where(space.at_bound(vector), space.start, vector)
            balanced = self.whole(PilotResult.begun(space.labels, vector))
            starts.append(PilotResult.begun(self.space.labels, balanced))
        # Errors from measured states; those of a diverged rollout are not numbers.
        return min(starts, key=lambda start: float(np.nan_to_num(np.abs(self.residuals(start)).mean(), nan=np.inf)))

    def fit(
        self,
        begun: PilotResult,
        without: Collection[str] = (),
        thorough: bool = False,
        kept: Bool[np.ndarray, "segments"] | None = None,
    ) -> PilotResult:
        """Fit by Levenberg-Marquardt; the result lacks the bench parameters `without`, which are `absent`.

        `thorough` uses a multi-start: with nested models if the model has several minima, and with other delays. `kept`
        are the segments that count; None for all.

        Raises:
            FitError: The loss is not finite at the start.
        """
        moving = self._moving(without)
        objective = self.objective.beginning(begun.states_of(self.segments)).among(kept)
        searches = Searches(objective, _MOST_TRIES, _TOLERANCE, moving, [_PATIENCE])
        end = searches.go_on(np.where(moving, self.whole(begun), self.absent))
        if thorough and self._drive.model.valleys:
            end = min(end, searches.look(), key=lambda end: end.loss)
        vector, loss = (searches.best(end) if thorough else end)[1:]
        if not np.isfinite([loss, *vector]).all():
            raise FitError("the loss is not finite at the start of the fit")
        self._end = objective.beginning(searches.begun).compile_scores()(vector)
        return self._conclude(vector, loss, moving, searches.begun and searches.begun.states)

    def foresee(self, found: PilotResult, without: str, instead: str) -> PilotResult:
        """Predict the last fit's result, linearised, with bench parameter `without` absent and `instead` free."""
        (equations, scores), vector = self._end, self.whole(found)
        moving = self._moving({without, *(OPTIONAL.keys() - found.owners - {instead})})
        change = np.where(moving, 0.0, self.absent - vector)
        shifted = equations._replace(gradient=equations.gradient + equations.hessian @ change)
        change[moving] = self._step_within(shifted, vector, np.flatnonzero(moving))
        delta = equations.hessian @ change
        loss = float(equations.loss + 2 * change @ equations.gradient + change @ delta)
        self._end = (equations._replace(gradient=equations.gradient + delta), scores + delta / len(scores))
        predicted = self._conclude(vector + change, loss, moving, found.states)
        self._end = equations, scores
        return predicted

    def _moving(self, without: Collection[str]) -> Bool[np.ndarray, "coordinates"]:
        return np.array([label.partition("/")[0].removeprefix("bench.") not in without for label in self.space.labels])

    def _conclude(
        self, vector: Coordinates, loss: float, moving: Bool[np.ndarray, "coordinates"], states: Any
    ) -> PilotResult:
        """Return the result at a vector whose `moving` coordinates were fitted; `_end` has the equations there."""
        half, (equations, scores) = np.full(len(vector), np.nan), self._end
        if self.objective.stretches > 1:  # intervals need a spread between segments
            equations = equations._replace(hessian=np.where(np.outer(moving, moving), equations.hessian, 0.0))
            intervals = assess(self.space, vector, equations, scores, _COLLINEAR).intervals
            for row, (label, ends) in enumerate(self.space.pick(intervals).items()):
                low, high = self.space.params[label.partition("/")[0]].to_coordinate(np.asarray(ends), np)
                half[row] = float(high - low) / 2
        return PilotResult(
            labels=[label for label, moves in zip(self.space.labels, moving, strict=True) if moves],
            vector=vector[moving],
            half=half[moving],
            enough=exact_enough(self.space, vector)[moving],
            at_bound=self.space.at_bound(vector)[moving],
            loss=loss,
            measured=self.segments.qpos,
            states=states,
            sizes=self.objective.sizes,
        )

    def simulate(self, bench: Bench) -> Objective:
        """Return the objective on a bench with another timestep or softness of its friction."""
        key = (bench.timestep, *bench.solreffriction)
        if key not in self._simulated:
            observing = bench.observing(self._drive.model.inputs)
            self._simulated[key] = in_other_steps(self.objective, self._drive, observing)
        return self._simulated[key]

    def approaching(self, other: Objective, found: PilotResult) -> "Pilot":
        """Return this pilot with the residuals of another simulation (see `simulate`), linearised at a result."""
        near, objective = copy.copy(self), self.objective.beginning(found.states_of(self.segments))
        near.objective = objective.approaching(other, self.whole(found))
        return near

    def step(self, found: PilotResult) -> tuple[Coordinates, float]:
        """Return a Gauss-Newton step (0 for coordinates undetermined or at a bound), and the loss it predicts."""
        objective = self.objective.beginning(self.objective.begun)
        equations = objective.compile_normal_equations()(self.whole(found))
        free = (found.half < WIDEST) & ~found.at_bound  # False for NaN
        places = [self.space.labels.index(label) for label in np.array(found.labels)[free]]
        step = np.zeros(len(free))
        step[free] = self._step_within(equations, self.whole(found), places)
        return step, equations.loss + float(step[free] @ equations.gradient[places])

    def _step_within(self, equations: NormalEquations, vector: Coordinates, places: Any) -> Float[np.ndarray, "places"]:
        """Return the step of these coordinates to the minimum within their bounds; raise FitError if not finite."""
        if not equations.finite:
            raise FitError("the loss is not finite at the end of the fit")
        hessian = equations.hessian[np.ix_(places, places)] * (1 + DAMPING.least * np.eye(len(places)))
        low, high = (side[places] - vector[places] for side in self.space.box[1:])
        return bounded_step(equations.gradient[places], hessian, low, high)

    @property
    def absent(self) -> Coordinates:
        """Coordinates without optional parameters: 0 for each, the initial ones for gains and all others."""
        zero = {f"bench.{name}" for name in OPTIONAL if name != GAIN}
        is_zero = [label.partition("/")[0] in zero for label in self.space.labels]
        return np.where(is_zero, 0.0, self.start)

    def whole(self, found: PilotResult) -> Coordinates:
        """Return all coordinates; missing ones are `absent`."""
        labels, start = self.space.labels, np.array(self.space.start, np.float64)
        start[: len(labels)] = found.among(labels, self.absent)
        return start

    def residuals(self, found: PilotResult) -> Errors:
        """Return position errors in the fitted segments [rad or m], from estimated initial states if there are any."""
        qpos, _ = self.objective.beginning(found.states_of(self.segments)).predict(self.whole(found))
        return self._by_segment(qpos) - self.segments.qpos[:, 1:]

    def _by_segment(self, qpos: Any) -> Errors:
        return np.asarray(qpos).reshape(-1, *qpos.shape[2:])[: self.segments.count]

    def errors(self, found: PilotResult, logs: Sequence[Log], horizon: float) -> Float[np.ndarray, "batch time nv"]:
        """Return position errors [rad or m] of consecutive rollouts of `horizon` seconds from measured states."""
        accepted = tuple(map(self.bench.accept, logs))
        windows = cut_rollouts(accepted, horizon, _ROLLOUTS, "consecutive", 0, self._sampling.history)
        values = self.space.values(jnp.asarray(self.whole(found), self.space.start.dtype))
        start = windows.qpos[:, 0], windows.qvel[:, 0]
        qpos, _ = self._drive.rollout.compiled(values, *start, windows.signals, windows.loads)
        return np.asarray(qpos) - windows.qpos[:, 1:]

    def growth(self, found: PilotResult) -> Float[np.ndarray, "time"]:
        """Return the position error from a disturbed initial velocity over time, divided by the one without forces.

        The largest over joints; median over segments.
        """
        segments, data = self.segments, self.objective.data
        disturbed = _DISTURBED * np.sqrt(np.square(segments.qvel).mean(axis=(0, 1))) + np.finfo(float).tiny
        measured = measured_states(data.qpos, data.qvel)
        starts = measured, measured.at[..., self.bench.nv :].add(disturbed)
        undisturbed, disturbed_qpos = (
            self._by_segment(self.objective.predict(self.whole(found), states)[0]) for states in starts
        )
        time = np.arange(1, segments.length + 1) * segments.timestep
        growth = np.abs(disturbed_qpos - undisturbed) / (disturbed * time[:, None])
        return np.nan_to_num(np.median(growth.max(axis=2), axis=0), nan=np.inf)


def exact_enough(space: Space, vector: Coordinates) -> Coordinates:
    """Return `PilotResult.enough`; a step of a logarithm is already relative to the value."""
    logarithms = [space.params[label.partition("/")[0]].scale == "log" for label in space.labels]
    return _EXACT * np.where(logarithms, 1.0, np.fmax(1.0, np.abs(vector)))


def halve_step(bench: Bench, softness: Sequence[float] | None = None) -> Bench:
    """Return the test stand with half the timestep and `solreffriction=softness`.

    Without `softness`, a friction constraint as stiff as the timestep allows stays so; others do not change.
    """
    constant, ratio = bench.solreffriction
    if bench.is_stiff:  # the timestep alone makes the constraint softer than the drive's friction
        constant /= 2
    softness = list(softness or (constant, ratio))
    return remake(bench, timestep=bench.timestep / 2, solreffriction=softness).observing(bench.observed)


def in_other_steps(objective: Objective, drive: Drive, bench: Bench) -> Objective:
    """Return the same objective on a test stand with another timestep."""
    sampling = bench.sampling(objective.interval)
    other = Drive.assemble(bench, drive.model, drive.engine.name, sampling)
    space = Space(bench, other.model, str(objective.space.start.dtype))
    return objective.for_drive(space, other.rollout).beginning(np.asarray(objective.data.begun))
