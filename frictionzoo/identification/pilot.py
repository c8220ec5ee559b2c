"""A fit ahead of the fit: what settings are chosen by."""

import copy
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from frictionzoo.bench import Bench
from frictionzoo.core.errors import FitError
from frictionzoo.core.log import Log
from frictionzoo.core.segments import Segments, cut_rollouts, cut_segments
from frictionzoo.fit import Objective, Space
from frictionzoo.fit.chunk import search
from frictionzoo.fit.lm import LevenbergMarquardt
from frictionzoo.fit.normal_equations import NormalEquations
from frictionzoo.fit.recordings import Recordings
from frictionzoo.fit.several import Several
from frictionzoo.fit.uncertainty import WIDEST, assess
from frictionzoo.models import FrictionModel
from frictionzoo.simulate import Values
from frictionzoo.simulate.drive import Drive

_EXACT = 3e-3  # of a value, or of its scale where that is more: half an interval that need not be narrower
_COLLINEAR = 1e-8
"""`COLLINEAR` of a pilot: a delay is nearly collinear with armature and damping, and what has no interval is in doubt,
however much a long log says of it."""
_TRIES, _TOLERANCE = 40, 1e-6
_ROLLOUTS = 64  # by which errors are told
_DISTURBED = 1e-3  # share of a joint's speed by which initial velocities are disturbed


class Found(NamedTuple):
    """Where a pilot ended.

    Attributes:
        labels: Name of each coordinate, as `Space.labels` has it.
        vector: The coordinates.
        half: Half of the 95 % interval of each; NaN where there is none.
        enough: Half an interval that need not be narrower, a small share of the value, or of its scale if that is more.
        at_bound: Whether its value ended at a bound.
        loss: The objective there.
        measured: Positions of the segments.
        states: Initial states of these there; None where none were refined.
    """

    labels: list[str]
    vector: Float[np.ndarray, "coordinates"]
    half: Float[np.ndarray, "coordinates"]
    enough: Float[np.ndarray, "coordinates"]
    at_bound: Bool[np.ndarray, "coordinates"]
    loss: float
    measured: Float[np.ndarray, "segments time nv"]
    states: Float[np.ndarray, "blocks segments twice_nv"] | None

    def states_of(self, segments: Segments) -> Float[np.ndarray, "blocks segments twice_nv"] | None:
        """Initial states of these segments, where they are the same."""
        return self.states if np.array_equal(segments.qpos, self.measured) else None

    def among(self, labels: Sequence[str], otherwise: Float[np.ndarray, "others"]) -> Float[np.ndarray, "others"]:
        """The coordinates of these names, another's where there is none."""
        known = dict(zip(self.labels, self.vector, strict=True))
        return np.array([known.get(label, value) for label, value in zip(labels, otherwise, strict=True)])

    def in_halves(self, step: Float[np.ndarray, "coordinates"]) -> Float[np.ndarray, "coordinates"]:
        """A step's size in half intervals, of which one that is narrower than `enough`, or none, counts as that."""
        return np.abs(step) / np.fmax(self.half, self.enough)


class Pilot:
    """A problem of which only the fit is posed, in float64.

    Args:
        bench: The test stand.
        model: The law; it stays as it is.
        logs: Recordings that it is fitted on.
        segments: Arguments of `cut_segments`.
        loss: Of `Objective`.
        engine: Name of the engine.
        sized: Where each joint's errors have the size over which they count, with `loss.by_joint`, as the fit's own
            have where it begins; None: at the initial values.

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
        sized: Found | None = None,
    ) -> None:
        self.bench: Bench = bench.observing(model.inputs)
        accepted = tuple(map(self.bench.accept, logs))
        self.robust: bool = loss["robust"] != "none"
        self._sampling = self.bench.sampling(accepted[0].timestep)
        self._drive = Drive.assemble(self.bench, copy.deepcopy(model), engine, self._sampling)
        self.segments = cut_segments(accepted, **segments, history=self._sampling.history)
        space = Space(self.bench, self._drive.model, "float64")
        objective = Objective(space, self._drive.rollout, self.segments, **loss)
        objective.recordings = Recordings(self.bench, self._drive.model, accepted)
        initial = np.asarray(space.start, np.float64)
        where = initial if sized is None else sized.among(space.labels, initial)
        self.objective: Objective = objective.starting(where).balanced().starting(initial)

    @property
    def space(self) -> Space:
        """What it moves."""
        return self.objective.space

    @property
    def start(self) -> Float[np.ndarray, "coordinates"]:
        """Where it begins of itself."""
        return np.asarray(self.space.start, np.float64)

    def fit(
        self,
        start: Float[np.ndarray, "coordinates"] | None = None,
        tries: int = _TRIES,
        beside: Found | None = None,
        shifted: bool = False,
    ) -> Found:
        """The best vector, by Levenberg-Marquardt of at most so many; of several starts where none is given.

        Args:
            start: Where to begin.
            tries: How many vectors are tried at most, of each search.
            beside: Where another pilot ended, near the start.
            shifted: Whether other delays are tried from a start that is given.

        Raises:
            FitError: The loss is not finite where it begins.
        """
        several = start is None or shifted
        fit = Several(tries, _TOLERANCE, start is None) if several else LevenbergMarquardt(tries, _TOLERANCE)
        begun = self._beside(beside)
        progress, _ = search(fit, begun if start is None else begun.starting(start))
        states = progress.method if several else progress.method.states
        vector = np.asarray(progress.best, np.float64)
        if bool(progress.broken) or not np.isfinite(vector).all():
            raise FitError("the loss is not finite where the fit begins")
        half = np.full(len(vector), np.nan)
        if self.objective.stretches > 1:  # there is a spread between segments
            equations, scores = self.objective.beginning(states).compile_scores()(vector)
            intervals = assess(self.space, vector, equations, scores, _COLLINEAR).intervals
            ends = self.space.pick({name: intervals[name] for name in self.space.places})
            half = np.array([self._half(label, np.asarray(ends[label])) for label in self.space.labels])
        return Found(
            labels=self.space.labels,
            vector=vector,
            half=half,
            enough=exact_enough(self.space, vector),
            at_bound=self.space.at_bound(vector),
            loss=float(progress.best_loss),
            measured=self.segments.qpos,
            states=states,
        )

    def step_from(self, found: Found) -> Float[np.ndarray, "coordinates"]:
        """How each coordinate would move from where another pilot of the same ended.

        One step of Gauss and Newton; 0 of what the data do not determine.
        """
        equations = self._beside(found).compile_normal_equations()(found.vector)
        free = (found.half < WIDEST) & ~found.at_bound  # of NaN, False
        step = np.zeros(len(free))
        step[free] = -_solve(equations, np.flatnonzero(free))
        return step

    def _beside(self, found: Found | None) -> Objective:
        """The objective, with the initial states that another pilot of the same segments ended with."""
        return self.objective.beginning(found and found.states_of(self.segments))

    def values(self, vector: Float[np.ndarray, "coordinates"]) -> Values:
        """Of all parameters."""
        return self.space.values(jnp.asarray(vector, self.space.start.dtype))

    def errors(
        self, vector: Float[np.ndarray, "coordinates"], logs: Sequence[Log], horizon: float
    ) -> Float[np.ndarray, "batch time nv"]:
        """Errors of position in rollouts of this length [s] from measured states, one after the other in recordings."""
        accepted = tuple(map(self.bench.accept, logs))
        windows = cut_rollouts(accepted, horizon, _ROLLOUTS, "consecutive", 0, self._sampling.history)
        qpos, _ = self._drive.rollout.compiled(
            self.values(vector), windows.qpos[:, 0], windows.qvel[:, 0], windows.signals, windows.loads
        )
        return np.asarray(qpos) - windows.qpos[:, 1:]

    def growth(self) -> Float[np.ndarray, "time"]:
        """How far a disturbed initial velocity carries the position, over what it does without any force.

        Median over segments, of the joint in which it is largest, at the initial values.
        """
        cut, values = self.segments, self.values(self.start)
        kept = np.unique(np.linspace(0, cut.count - 1, _ROLLOUTS).astype(int))
        qpos, qvel = cut.qpos[kept, 0], cut.qvel[kept, 0]
        signals = cut.signals.map(lambda signal: signal[kept])
        disturbed = _DISTURBED * np.sqrt(np.square(cut.qvel).mean(axis=(0, 1))) + np.finfo(float).tiny
        ends = [
            np.asarray(self._drive.rollout.compiled(values, qpos, start, signals, cut.loads[kept])[0])
            for start in (qvel, qvel + disturbed)
        ]
        time = np.arange(1, cut.length + 1) * cut.timestep
        grown = np.abs(ends[1] - ends[0]) / (disturbed * time[:, None])
        return np.nan_to_num(np.median(grown.max(axis=2), axis=0), nan=np.inf)

    def _half(self, label: str, ends: Float[np.ndarray, "2"]) -> float:
        """Half an interval in the optimiser's coordinate."""
        param = self.space.params[label.partition("/")[0]]
        low, high = param.to_coordinate(ends, np)
        return float(high - low) / 2


def exact_enough(space: Space, vector: Float[np.ndarray, "coordinates"]) -> Float[np.ndarray, "coordinates"]:
    """See `Found.enough`; a step of a logarithm is a share of the value by itself."""
    logarithms = [space.params[label.partition("/")[0]].scale == "log" for label in space.labels]
    return _EXACT * np.where(logarithms, 1.0, np.fmax(1.0, np.abs(vector)))


def _solve(equations: NormalEquations, free: Any) -> Float[np.ndarray, "free"]:
    """H^-1 g of these coordinates."""
    hessian, gradient = equations.hessian[np.ix_(free, free)], equations.gradient[free]
    scale = np.sqrt(np.diag(hessian))
    return np.linalg.lstsq(hessian / np.outer(scale, scale), gradient / scale, rcond=1e-10)[0] / scale
