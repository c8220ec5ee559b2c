"""Whether what an identified drive leaves of the torque is noise, and if not, what of the motion it goes with."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
import torch
from jaxtyping import Bool, Float, Int

from frictionzoo.bench import Bench
from frictionzoo.core.errors import FrictionzooError
from frictionzoo.core.log import Log
from frictionzoo.core.params import UNITS
from frictionzoo.core.state import DriveState
from frictionzoo.fit import Space
from frictionzoo.fit.motion import Decimation, Filtering
from frictionzoo.fit.recordings import Recordings
from frictionzoo.fit.torque_equation import TorqueEquation
from frictionzoo.logs.signals import find_noise
from frictionzoo.models import FrictionModel
from frictionzoo.models.base import sliding_torque
from frictionzoo.models.formula import torch_state
from frictionzoo.models.sees import observe, suggest_law
from frictionzoo.result import residual_types as types
from frictionzoo.result.attribution import Candidate, Explained, attribute, correlation, excess
from frictionzoo.result.places import PULL, Seen, as_candidates, find_ripple, list_periods, ripple, time_since_reversal
from frictionzoo.result.portrait import Rows

LONGEST = 40_000  # samples that are looked at, shared by the logs
SHORTEST = 1.0  # s; shorter logs are mostly the ends of filters
FEWEST = 100  # rows of a joint; fewer tell nothing
BANDWIDTHS = 10.0, 5.0  # Hz, where noise drowns what lies above
DROWNED = 0.5  # share of the variance that is left, of which noise may be the cause
STEP = 1e-2  # of a coordinate, in the difference by it
LITTLE = 0.02  # share of the friction below which nothing is told
_log = logging.getLogger(__name__)

Friction = Callable[[Mapping[str, Any], DriveState], np.ndarray]
Torque = Float[np.ndarray, "rows nv"]


class Left(NamedTuple):
    """What is left of the torque.

    Attributes:
        equation: What it was found with.
        torque: What is left [N m or N].
        noise: As much of it as the encoders' noise makes [N m or N].
        friction: The law's torque, filtered and decimated [N m or N].
        unfiltered: The same at the rows' instants.
        counts: Which rows count, joint by joint: those in motion.
        recordings: Bench, law and the logs that were looked at.
        state: What the law sees in all their samples.
        bandwidth: Up to which torques are compared [Hz].
    """

    equation: TorqueEquation
    torque: Torque
    noise: Torque
    friction: Torque
    unfiltered: Torque
    counts: Bool[np.ndarray, "rows nv"]
    recordings: Recordings
    state: DriveState
    bandwidth: float

    def law(self, joint: int) -> tuple[FrictionModel, set[str]]:
        """The law of a joint, and what it sees."""
        model = self.recordings.model
        law = model.of_joint(joint)[0]
        return law, {*law.sees} or observe(model, self.state)

    @property
    def time(self) -> Float[np.ndarray, "rows"]:
        """Of each row, the time since the first log began, as if the logs were one after the other [s]."""
        return self.recordings.logs[0].timestep * self._places

    @property
    def rows(self) -> Rows:
        """The rows as a portrait of the law takes them.

        The actuator's torque is that which the law asks for: what it does give answers to any error, and goes with it.
        """
        state = self.state.map(lambda signal: signal[self._places])
        motor = state.motor_torque - self.torque
        return Rows(state._replace(motor_torque=motor), self.counts, self.unfiltered + self.torque)

    @property
    def _places(self) -> Int[np.ndarray, "rows"]:
        return _places(self.equation.decimate)


def find_left(
    recordings: Recordings, space: Space, vector: Float[np.ndarray, "coordinates"], filtering: Filtering
) -> Left | None:
    """What is left of the torque that the actuators give, up to the highest bandwidth in which noise is not most of it.

    Args:
        recordings: Bench, law with the values that were found, and the training logs.
        space: Coordinates of the values.
        vector: The values.
        filtering: How positions become accelerations, and up to which frequency torques are compared.

    Returns:
        None where the recordings are too short, or it is not finite; a line tells why.
    """
    bench, model, logs = recordings
    logs = _shorten(logs)
    try:
        if sum(filtering.decimation(logs).rows) < FEWEST:
            return None
        left = _narrow(Recordings(bench, model, logs), space, vector, filtering)
    except FrictionzooError as error:
        _log.info("what is left of the torque is not looked at: %s", error)
        return None
    if not all(np.isfinite(part).all() for part in (left.torque, left.noise)):
        _log.info("what is left of the torque is not looked at: it is not finite with these values")
        return None
    return left


def describe_residual(left: Left, space: Space, vector: Float[np.ndarray, "coordinates"]) -> types.ResidualRow | None:
    """What the torque that is left in motion goes with, as `ResidualRow` says.

    Args:
        left: What is left.
        space: Coordinates of the values.
        vector: The values.

    Returns:
        None where it has no finite derivative by the values; a line tells why.
    """
    bench, model, logs = left.recordings
    slopes = _slopes(left, _follow(model, logs), bench, space, vector)
    if not np.isfinite(slopes).all():
        _log.info("what is left of the torque is not looked at: it has no derivative with these values")
        return None
    rows = [_describe(left, joint, slopes) for joint in range(bench.nv)]
    found = {"unit": UNITS[bench.joint_type]["torque"], "bandwidth": left.bandwidth}
    return cast(types.ResidualRow, {**found, "by_joint": [row for row in rows if row is not None]})


def _shorten(logs: Sequence[Log]) -> tuple[Log, ...]:
    """Logs that are long enough, some of many, and of long ones the beginning: as many samples as are looked at."""
    kept = [log for log in logs if log.samples * log.timestep > SHORTEST] or list(logs)
    whole = sum(log.samples for log in kept)
    if whole > LONGEST:
        kept = kept[:: max(1, round(whole / LONGEST))]
    most = max(LONGEST // len(kept), round(SHORTEST / kept[0].timestep))
    return tuple(log if log.samples <= most else log.between(0, most, "start") for log in kept)


def _narrow(
    recordings: Recordings, space: Space, vector: Float[np.ndarray, "coordinates"], filtering: Filtering
) -> Left:
    """What is left up to the highest bandwidth in which noise is not most of it."""
    left = _leave(recordings, space, vector, filtering)
    for bandwidth in BANDWIDTHS:
        drowned = np.square(left.noise).mean(axis=0) > DROWNED * np.square(left.torque).mean(axis=0)
        if not drowned.any() or bandwidth >= filtering.bandwidth:
            break
        try:
            narrower = replace(filtering, bandwidth=bandwidth)
            if sum(narrower.decimation(recordings.logs).rows) < FEWEST:
                break
            left, filtering = _leave(recordings, space, vector, narrower), narrower
        except FrictionzooError:  # too short for it
            break
    return left


def _leave(
    recordings: Recordings, space: Space, vector: Float[np.ndarray, "coordinates"], filtering: Filtering
) -> Left:
    """What is left in this bandwidth, and how much of it comes with noise as large as the encoders' own."""
    random, (bench, model, logs) = np.random.default_rng(0), recordings
    noises = [np.array([find_noise(column) for column in log.qpos.T]) for log in logs]
    spoilt = tuple(
        replace(log, qpos=log.qpos + noise * random.normal(size=log.qpos.shape))
        for log, noise in zip(logs, noises, strict=True)
    )
    substeps = bench.sampling(logs[0].timestep).substeps
    equations = [
        TorqueEquation(space, recordings._replace(logs=each), filtering, held=True, substeps=substeps)
        for each in (logs, spoilt)
    ]
    friction, values = _follow(model, logs), space.values(jnp.asarray(vector, space.start.dtype))["friction"]
    states = [equation.state(vector) for equation in equations]
    frictions = [friction(values, state) for state in states]
    torque, worse = (e.left(vector, own) for e, own in zip(equations, frictions, strict=True))
    equation, speeds = equations[0], [np.abs(e.motion.qvel) for e in equations]
    error = np.sqrt(np.mean(np.square(equations[1].motion.qvel - equation.motion.qvel), axis=0))
    slow = speeds[0] < np.maximum(filtering.slow * np.sqrt(np.mean(np.square(speeds[0]), axis=0)), 3 * error)
    near = max(1, round(0.5 / filtering.bandwidth / logs[0].timestep))
    decimate, places = equation.decimate, _places(equation.decimate)
    own = decimate(frictions[0]), frictions[0][places], ~_near_rest(slow, near, decimate)[places]
    return Left(equation, torque, worse - torque, *own, recordings, states[0], filtering.bandwidth)


def _near_rest(slow: Bool[np.ndarray, "time nv"], near: int, decimate: Decimation) -> Bool[np.ndarray, "time nv"]:
    """Samples that have a rest as near, within their log: slow ones for half as many in a row, not those in passing.

    At rest friction is whatever holds the joint, and behind the filter that reaches as far.
    """
    parts = []
    for part in np.split(slow, np.cumsum(decimate.lengths)[:-1]):
        lasting = scipy.ndimage.binary_opening(part, np.ones((max(2, near // 2), 1)))
        parts.append(scipy.ndimage.binary_dilation(lasting, np.ones((2 * near + 1, 1))))
    return np.concatenate(parts)


def _places(decimate: Decimation) -> Int[np.ndarray, "rows"]:
    """Index of the sample of each row."""
    starts = np.cumsum((0, *decimate.lengths[:-1]))
    ends = zip(starts, decimate.lengths, strict=True)
    return np.concatenate(
        [start + np.arange(decimate.edge, length - decimate.edge, decimate.factor) for start, length in ends]
    )


def _follow(model: FrictionModel, logs: Sequence[Log]) -> Friction:
    """The law's torque along the recorded motion [N m or N]; a memory is carried along, log by log."""
    if model.memory:
        return _remember(model, logs)

    def friction(values: Mapping[str, Any], state: DriveState) -> Float[np.ndarray, "time nv"]:
        own = {name: torch.tensor(np.asarray(value, np.float64)) for name, value in values.items()}
        with torch.no_grad():
            seen = torch_state(state)
            return sliding_torque(torch, model.terms(torch, own, seen), seen.qvel).numpy()

    return friction


def _remember(model: FrictionModel, logs: Sequence[Log]) -> Friction:
    begins = np.zeros(sum(log.samples for log in logs), bool)
    begins[np.cumsum([0, *(log.samples for log in logs[:-1])])] = True

    @jax.jit
    def follow(values: Mapping[str, Any], state: DriveState) -> Any:
        def step(memory: Any, now: tuple[DriveState, Any]) -> tuple[Any, Any]:
            seen, begin = now
            memory = jnp.where(begin, model.settle(jnp, values, seen), memory)
            terms, memory = model.advance(jnp, values, seen, memory, logs[0].timestep)
            return memory, sliding_torque(jnp, terms, seen.qvel)

        first = model.settle(jnp, values, state.map(lambda signal: signal[0]))
        return jax.lax.scan(step, first, (state, jnp.asarray(begins)))[1]

    return lambda values, state: np.asarray(follow(values, state.map(jnp.asarray)), np.float64)


def _slopes(
    left: Left, friction: Friction, bench: Bench, space: Space, vector: Float[np.ndarray, "coordinates"]
) -> Float[np.ndarray, "rows nv parameters"]:
    """How what is left changes with each identified parameter, that of all joints at once, where it is at no bound.

    The actuator's are left out but for constants: with them, the balance has a solution in which all torques are 0.
    """
    reached, slopes = space.at_bound(vector), [np.zeros((*left.torque.shape, 0))]
    scales = {f"bench.{name}" for name, of in bench.actuator.dimensions.items() if of != "torque"}
    for name, own in space.split(np.arange(len(vector))).items():
        if name in scales:
            continue
        moved = np.array(vector, np.float64)
        moved[own[~reached[own]]] += STEP
        values = space.values(jnp.asarray(moved, space.start.dtype))["friction"]
        torque = left.equation.left(moved, friction(values, left.equation.state(moved)))
        slopes.append((torque - left.torque)[:, :, None] / STEP)
    return np.concatenate(slopes, axis=2)


def _describe(left: Left, joint: int, slopes: np.ndarray) -> types.JointResidualRow | None:
    """What is left of one joint's torque; None where it hardly moves."""
    rows = np.flatnonzero(left.counts[:, joint])
    if len(rows) < FEWEST:
        return None
    error, noise, friction = (part[rows, joint] for part in (left.torque, left.noise, left.friction))
    whole = _rms(friction + error)
    found = _attribute(left, joint, rows, slopes[rows, joint])
    return {
        "joint": left.recordings.bench.joints[joint],
        "rows": len(rows),
        "residual": _rms(error),
        "noise": _rms(noise),
        "friction": whole,
        "correlation": correlation(error),
        "noise_correlation": correlation(noise),
        "kurtosis": excess(error),
        "places": [row for row in found if row["torque"] > LITTLE * whole],
    }


def _attribute(
    left: Left, joint: int, rows: Int[np.ndarray, "counted"], known: Float[np.ndarray, "counted _"]
) -> list[types.PlaceRow]:
    """What the error of a joint goes with, and which law sees that."""
    error, decimate, bench = left.torque[rows, joint], left.equation.decimate, left.recordings.bench
    seen = _see(left, joint)
    candidates = as_candidates(seen, decimate, rows, left.noise[rows, joint])
    periods, chosen = list_periods(seen, bench.joint_type == "hinge", left.bandwidth), {}
    if len(periods):
        for name, alike in (("ripple", False), ("cogging", True)):
            chosen[name] = find_ripple(seen, periods, alike, error, known, _places(decimate)[rows])
            columns = decimate(ripple(seen, chosen[name], alike))[rows]
            candidates[name] = Candidate(columns, len(periods))
    law, sees = left.law(joint)
    return [_name_law(one, chosen, law, sees, _rms(error)) for one in attribute(error, known, candidates, bench.nv)]


def _name_law(
    one: Explained, periods: Mapping[str, float], law: FrictionModel, sees: set[str], left: float
) -> types.PlaceRow:
    place = {"ripple": "position", "cogging": PULL}.get(one.name, one.name)
    name, whole = (None, False) if place == PULL else suggest_law(law, sees, place)
    found = {
        "place": place,
        "periods": periods.get(one.name),
        "share": one.share,
        "torque": float(np.sqrt(one.share)) * left,
        "chance": one.chance,
        "known": place in sees,
        "law": name,
        "whole": whole,
    }
    return cast(types.PlaceRow, found)


def _see(left: Left, joint: int) -> Seen:
    state, logs = left.state, left.recordings.logs
    begins = np.cumsum([0, *(log.samples for log in logs[:-1])])
    qpos, qvel = state.qpos[:, joint], state.qvel[:, joint]
    warmth = [log.extras.get("temperature") for log in logs]
    known = [one for one in warmth if one is not None]
    temperature = np.concatenate(known)[:, joint] if len(known) == len(logs) else None
    since = time_since_reversal(qvel, begins, logs[0].timestep)
    at = _places(left.equation.decimate)
    motor = state.motor_torque[:, joint] - np.interp(np.arange(len(qpos)), at, left.torque[:, joint])
    return Seen(qpos, qvel, motor, state.external_torque[:, joint], since, temperature)


def _rms(values: Float[np.ndarray, "rows"]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
