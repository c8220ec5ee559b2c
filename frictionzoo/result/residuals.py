"""Residual analysis: whether the residual torque is noise, and which residual factors explain it."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
import scipy.stats
import torch
from jaxtyping import Bool, Float, Int

from frictionzoo.core.errors import FrictionzooError
from frictionzoo.core.log import Log
from frictionzoo.core.params import UNITS
from frictionzoo.core.state import DriveState
from frictionzoo.data.signals import find_noise
from frictionzoo.fit import Space
from frictionzoo.fit.motion import Decimation, Filtering, Recordings
from frictionzoo.fit.torque_equation import TorqueEquation
from frictionzoo.models import FrictionModel
from frictionzoo.models.base import sliding_torque
from frictionzoo.models.formula import torch_state
from frictionzoo.models.sees import observe, suggest_law
from frictionzoo.result import residual_types as types
from frictionzoo.result.attribution import (
    LEVEL,
    Candidate,
    Explained,
    Factors,
    attribute,
    correlation,
    excess,
    find_factors,
)
from frictionzoo.result.imitation import add_noise, imitate
from frictionzoo.result.places import (
    LIMITS,
    OF_BENCH,
    PULL,
    Seen,
    as_candidates,
    beyond_limit,
    find_limit,
    find_ripple,
    is_limited,
    list_periods,
    near_crossings,
    ripple,
    time_since_reversal,
)
from frictionzoo.result.portrait import Rows

LONGEST = 40_000  # most samples analysed, shared by the logs
SHORTEST = 1.0  # s; shorter logs consist mostly of filter transients
FEWEST = 100  # fewest rows in total, and of a joint
BANDWIDTHS = 10.0, 5.0  # Hz, tried if noise dominates at a higher bandwidth
DROWNED = 0.5  # largest share of noise in the residual variance
SOFTER = 1.1  # largest ratio of the imitation's residual torque to the recording's
STEP = 1e-2  # of a coordinate, for finite differences
LITTLE = 0.01  # share of the friction; smaller factors are not reported
WRONG = 0.05  # relative error of the actuator torque above which a scale factor is always reported
RIPPLES = {"ripple": "position", "cogging": PULL}
"""Factor of a ripple: against the motion, or alike in both directions."""
GAP = "backlash"
"""Friction model of a gear with a gap."""
CONCENTRATED = 0.7  # smallest share of the squared residual near motor reversals that indicates a gap
CLEAR = 2.0  # times the noise; smaller residuals are not tested for a gap
ALONE = 50  # inverse of the smallest share of rows on either side
ALIKE = 15.0  # neighbouring rows that count as one independent row
_log = logging.getLogger(__name__)

Friction = Callable[[Mapping[str, Any], DriveState], np.ndarray]
Torque = Float[np.ndarray, "rows nv"]


class Left(NamedTuple):
    """Residual torque of the training recordings.

    Attributes:
        torque: Residual torque [N m or N].
        friction: Model friction, filtered and decimated [N m or N].
        unfiltered: Model friction at the rows' instants, not filtered [N m or N].
        counts: Rows of each joint that count: those in motion.
        recordings: Bench, friction model and analysed logs.
        state: Inputs of the model in all samples.
        bandwidth: Bandwidth of the comparison [Hz].
        nothing: Reference without model error: the identified drive, simulated under the same commands and measured by
            the same encoders. If its motion differs too much from the recording: the effect of encoder noise.
    """

    equation: TorqueEquation
    torque: Torque
    friction: Torque
    unfiltered: Torque
    counts: Bool[np.ndarray, "rows nv"]
    recordings: Recordings
    state: DriveState
    bandwidth: float
    nothing: "Left | None" = None

    def of(self, joint: int) -> Float[np.ndarray, "counted"]:
        """Return the residual torque of a joint in the rows that count."""
        return self.torque[self.counts[:, joint], joint]

    def noise(self, joint: int) -> Float[np.ndarray, "counted"]:
        """Return the reference's residual torque of a joint."""
        return np.zeros(1) if self.nothing is None else self.nothing.of(joint)

    def law(self, joint: int) -> tuple[FrictionModel, set[str]]:
        """Return the friction model of a joint and the quantities on which it depends."""
        model = self.recordings.model
        law = model.of_joint(joint)[0]
        return law, {*law.sees} or observe(model, self.state)

    @property
    def time(self) -> Float[np.ndarray, "rows"]:
        """Time of each row, with the logs one after the other [s]."""
        return self.recordings.logs[0].timestep * self._places

    @property
    def rows(self) -> Rows:
        """Rows for friction curves, with the needed actuator torque, because the applied one correlates with errors."""
        state = self.state.map(lambda signal: signal[self._places])
        motor = state.motor_torque - self.torque
        return Rows(state._replace(motor_torque=motor), self.counts, self.unfiltered + self.torque)

    @property
    def _places(self) -> Int[np.ndarray, "rows"]:
        return _places(self.equation.decimate)


def find_left(
    recordings: Recordings, space: Space, vector: Float[np.ndarray, "coordinates"], filtering: Filtering
) -> Left | None:
    """Compute the residual torque up to the highest bandwidth in which noise does not dominate.

    `recordings` holds the training logs and the fitted model, `vector` its values in the coordinates of `space`.

    Returns:
        Residual torque. None: fewer than `FEWEST` rows, or it cannot be computed and a log line gives the reason.
    """
    bench, model, logs = recordings
    logs = _shorten(logs)
    try:
        if sum(filtering.decimation(logs).rows) < FEWEST:
            return None
        residual = _narrow(Recordings(bench, model, logs), space, vector, filtering)
    except FrictionzooError as error:
        _log.info("no residual analysis: %s", error)
        return None
    if not np.isfinite(residual.torque).all():
        _log.info("no residual analysis: the residual torque is not finite with these values")
        return None
    return residual


def describe_residual(left: Left, space: Space, vector: Float[np.ndarray, "coordinates"]) -> types.ResidualRow | None:
    """Return the section `residual`: residual factors of the torque in motion, as defined in `ResidualRow`.

    Returns:
        Section. None: the residual torque has no finite derivative by the values, and a log line says so.
    """
    bench = left.recordings.bench
    slopes = [_slopes(residual, space, vector) for residual in (left, left.nothing) if residual is not None]
    if not all(np.isfinite(part).all() for part in slopes):
        _log.info("no residual analysis: the residual torque has no derivative with these values")
        return None
    rows = [_describe(left, joint, slopes) for joint in range(bench.nv)]
    section = {"unit": UNITS[bench.joint_type]["torque"], "bandwidth": left.bandwidth}
    return cast(types.ResidualRow, {**section, "by_joint": [row for row in rows if row is not None]})


def _shorten(logs: Sequence[Log]) -> tuple[Log, ...]:
    """Reduce the logs to about `LONGEST` samples: drop short logs, thin out many logs, and cut long ones."""
    chosen = [log for log in logs if log.samples * log.timestep > SHORTEST] or list(logs)
    samples = sum(log.samples for log in chosen)
    if samples > LONGEST:
        chosen = chosen[:: max(1, round(samples / LONGEST))]
    longest = max(LONGEST // len(chosen), round(SHORTEST / chosen[0].timestep))
    return tuple(log if log.samples <= longest else log.between(0, longest, "start") for log in chosen)


def _narrow(
    recordings: Recordings, space: Space, vector: Float[np.ndarray, "coordinates"], filtering: Filtering
) -> Left:
    imitations, joints = imitate(recordings, space, vector), range(recordings.bench.nv)
    noisy_logs = tuple(map(add_noise, recordings.logs))

    def leave(logs: Sequence[Log], filtering: Filtering) -> Left:
        return _leave(recordings._replace(logs=logs), space, vector, filtering)

    def compare(filtering: Filtering) -> tuple[Left, bool]:
        """Compute the residual torque with its reference, and whether encoder noise dominates."""
        residual, noisy = leave(recordings.logs, filtering), leave(noisy_logs, filtering)
        noise = noisy._replace(torque=noisy.torque - residual.torque, counts=residual.counts)
        dominated = (np.square(noise.torque).mean(axis=0) > DROWNED * np.square(residual.torque).mean(axis=0)).any()
        return residual._replace(nothing=noise if imitations is None else leave(imitations, filtering)), bool(dominated)

    residual, dominated = compare(filtering)
    # At reversals, a soft constraint gives the imitation more residual torque than a real drive has.
    if imitations is not None and any(
        _rms(residual.noise(joint)) > SOFTER * _rms(residual.of(joint)) for joint in joints
    ):
        imitations = imitate(recordings, space, vector, stiff=True) or imitations
        residual = residual._replace(nothing=leave(imitations, filtering))
    for bandwidth in BANDWIDTHS:
        if not dominated or bandwidth >= filtering.bandwidth:
            break
        try:
            narrower = replace(filtering, bandwidth=bandwidth)
            if sum(narrower.decimation(recordings.logs).rows) < FEWEST:
                break
            (residual, dominated), filtering = compare(narrower), narrower
        except FrictionzooError:  # too short for this bandwidth
            break
    return residual


def _leave(
    recordings: Recordings, space: Space, vector: Float[np.ndarray, "coordinates"], filtering: Filtering
) -> Left:
    """Compute the residual torque in this bandwidth."""
    bench, model, logs = recordings
    substeps = bench.sampling(logs[0].timestep).substeps
    equation = TorqueEquation(space, recordings, filtering, held=True, substeps=substeps)
    values, state = space.values(jnp.asarray(vector, space.start.dtype))["friction"], equation.state(vector)
    friction = _follow(model, logs)(values, state)
    speed = np.abs(equation.motion.qvel)
    noise = np.concatenate([np.broadcast_to(_velocity_noise(log, filtering), log.qpos.shape) for log in logs])
    slow = speed < np.maximum(filtering.slow * np.sqrt(np.mean(np.square(speed), axis=0)), 3 * noise)
    near = max(1, round(0.5 / filtering.bandwidth / logs[0].timestep))
    decimate, places = equation.decimate, _places(equation.decimate)
    rows = decimate(friction), friction[places], ~_near_rest(slow, near, decimate)[places]
    return Left(equation, equation.left(vector, friction), *rows, recordings, state, filtering.bandwidth)


def _velocity_noise(log: Log, filtering: Filtering) -> Float[np.ndarray, "nv"]:
    """Return the standard deviation of velocity noise caused by encoder noise [rad/s or m/s]."""
    noise = np.array([find_noise(column) for column in log.qpos.T])
    white = np.random.default_rng(0).normal(size=log.qpos.shape)
    return noise * np.sqrt(np.mean(np.square(filtering.motion(replace(log, qpos=white)).qvel), axis=0))


def _near_rest(slow: Bool[np.ndarray, "time nv"], near: int, decimate: Decimation) -> Bool[np.ndarray, "time nv"]:
    """Return the samples within `near` of a rest, where friction is whatever holds the joint; the filter spreads it."""
    parts = []
    for part in np.split(slow, np.cumsum(decimate.lengths)[:-1]):
        lasting = scipy.ndimage.binary_opening(part, np.ones((max(2, near // 2), 1)))
        parts.append(scipy.ndimage.binary_dilation(lasting, np.ones((2 * near + 1, 1))))
    return np.concatenate(parts)


def _places(decimate: Decimation) -> Int[np.ndarray, "rows"]:
    """Return the index of each row's sample."""
    starts = np.cumsum((0, *decimate.lengths[:-1]))
    ends = zip(starts, decimate.lengths, strict=True)
    return np.concatenate(
        [start + np.arange(decimate.edge, length - decimate.edge, decimate.factor) for start, length in ends]
    )


def _follow(model: FrictionModel, logs: Sequence[Log]) -> Friction:
    """Return a function for the model torque over recorded motion [N m or N]; memory restarts with each log."""
    if model.memory:
        return _remember(model, logs)

    def friction(values: Mapping[str, Any], state: DriveState) -> Float[np.ndarray, "time nv"]:
        tensors = {name: torch.tensor(np.asarray(value, np.float64)) for name, value in values.items()}
        with torch.no_grad():
            inputs = torch_state(state)
            return sliding_torque(torch, model.terms(torch, tensors, inputs), inputs.qvel).numpy()

    return friction


def _remember(model: FrictionModel, logs: Sequence[Log]) -> Friction:
    begins = np.zeros(sum(log.samples for log in logs), bool)
    begins[np.cumsum([0, *(log.samples for log in logs[:-1])])] = True

    @jax.jit
    def follow(values: Mapping[str, Any], state: DriveState) -> Any:
        def step(memory: Any, now: tuple[DriveState, Any]) -> tuple[Any, Any]:
            inputs, begin = now
            memory = jnp.where(begin, model.settle(jnp, values, inputs), memory)
            terms, memory = model.advance(jnp, values, inputs, memory, logs[0].timestep)
            return memory, sliding_torque(jnp, terms, inputs.qvel)

        initial = model.settle(jnp, values, state.map(lambda signal: signal[0]))
        return jax.lax.scan(step, initial, (state, jnp.asarray(begins)))[1]

    return lambda values, state: np.asarray(follow(values, state.map(jnp.asarray)), np.float64)


def _slopes(
    left: Left, space: Space, vector: Float[np.ndarray, "coordinates"]
) -> Float[np.ndarray, "rows nv parameters"]:
    """Return the derivative of the residual torque by each identified parameter, changed in all joints at once.

    Values at a bound stay. Actuator parameters other than torques are skipped: with free gains, zero torque solves the
    torque equation.
    """
    bench, model, logs = left.recordings
    friction = _follow(model, logs)
    at_bound, slopes = space.at_bound(vector), [np.zeros((*left.torque.shape, 0))]
    scales = {f"bench.{name}" for name, dimension in bench.actuator.dimensions.items() if dimension != "torque"}
    for name, indices in space.split(np.arange(len(vector))).items():
        if name in scales:
            continue
        moved = np.array(vector, np.float64)
        moved[indices[~at_bound[indices]]] += STEP
        values = space.values(jnp.asarray(moved, space.start.dtype))["friction"]
        torque = left.equation.left(moved, friction(values, left.equation.state(moved)))
        slopes.append((torque - left.torque)[:, :, None] / STEP)
    return np.concatenate(slopes, axis=2)


def _describe(left: Left, joint: int, slopes: Sequence[np.ndarray]) -> types.JointResidualRow | None:
    """Return the residual analysis of one joint; None if it hardly moves."""
    rows = np.flatnonzero(left.counts[:, joint])
    if len(rows) < FEWEST:
        return None
    error, noise, friction = left.of(joint), left.noise(joint), left.friction[rows, joint]
    total = _rms(friction + error)
    return {
        "joint": left.recordings.bench.joints[joint],
        "rows": len(rows),
        "residual": _rms(error),
        "noise": _rms(noise),
        "friction": total,
        "correlation": correlation(error),
        "noise_correlation": correlation(noise),
        "kurtosis": excess(error),
        "places": [row for row in _attribute(left, joint, slopes) if _counts(row, total)],
    }


def _counts(place: types.PlaceRow, friction: float) -> bool:
    """Return whether a residual factor is large enough to report."""
    scale = place["value"] if place["place"] == "scale" else None
    return place["torque"] > LITTLE * friction or (scale is not None and abs(np.log(scale)) > WRONG)


def _attribute(left: Left, joint: int, slopes: Sequence[np.ndarray]) -> list[types.PlaceRow]:
    """Find the residual factors that exceed those of the reference, and the models that have them."""
    looked = _look(left, joint, slopes[0])
    if (gap := _find_gap(looked, left, joint)) is not None:
        return [gap]
    chosen = _choose(looked)
    ideal = looked if left.nothing is None else _look(left.nothing, joint, slopes[-1])
    factors = _candidates(ideal, chosen)

    def usual(name: str, before: Sequence[str]) -> Factors:
        columns = [factors[earlier].columns for earlier in before if earlier in factors]
        exists = name in factors and ideal is not looked
        return (
            find_factors(ideal.error, np.column_stack([ideal.known, *columns]), factors[name].columns)
            if exists
            else 0.0
        )

    explained = attribute(looked.error, looked.known, _candidates(looked, chosen), left.recordings.bench.nv, usual)
    return [_name_law(factor, looked, chosen, usual(factor.name, ()), left.law(joint)) for factor in explained]


class _Looked(NamedTuple):
    """Residual torque of a joint with the data to explain it: parameter effects, rows that count, and motion."""

    error: Float[np.ndarray, "counted"]
    known: Float[np.ndarray, "counted _"]
    rows: Int[np.ndarray, "counted"]
    seen: Seen
    decimate: Decimation
    periods: Float[np.ndarray, "periods"]


def _find_gap(looked: _Looked, left: Left, joint: int) -> types.PlaceRow | None:
    """Return the factor `gap` if most of the squared error is near sign changes of the motor torque."""
    near = near_crossings(looked.seen, _places(looked.decimate)[looked.rows])
    squares, fewest = np.square(looked.error), max(len(near) // ALONE, 1)
    if not fewest < near.sum() < len(near) - fewest or _rms(looked.error) < CLEAR * _rms(left.noise(joint)):
        return None
    inside, outside = squares[near].mean(), max(squares[~near].mean(), 1e-300)
    share = float((inside - outside) * near.sum() / squares.sum())
    freedom = [part.sum() / ALIKE for part in (near, ~near)]
    chance = left.recordings.bench.nv * float(scipy.stats.f.sf(inside / outside, *freedom))
    law = left.law(joint)[0].name
    if share < CONCENTRATED or chance > LEVEL:
        return None
    row = {"place": "gap", "periods": None, "value": None, "share": share, "chance": chance}
    torque = float(np.sqrt(share)) * _rms(looked.error)
    law_fields = {"known": law == GAP, "law": None if law == GAP else GAP, "whole": False}
    return cast(types.PlaceRow, row | {"torque": torque} | law_fields)


def _look(left: Left, joint: int, slopes: Float[np.ndarray, "rows nv parameters"]) -> _Looked:
    rows, seen = np.flatnonzero(left.counts[:, joint]), _see(left, joint)
    periods = list_periods(seen, left.recordings.bench.joint_type == "hinge", left.bandwidth)
    return _Looked(left.of(joint), slopes[rows, joint], rows, seen, left.equation.decimate, periods)


def _choose(looked: _Looked) -> dict[str, float]:
    """Choose the torque limit and the ripple periods that explain most of an error."""
    error, known, rows, seen, decimate, periods = looked
    chosen = {"limit": find_limit(seen, decimate, rows, error, known)}
    if len(periods):
        for name in RIPPLES:
            alike = name == "cogging"
            chosen[name] = find_ripple(seen, periods, alike, error, known, _places(decimate)[rows])
    return chosen


def _candidates(looked: _Looked, chosen: Mapping[str, float]) -> dict[str, Candidate]:
    seen, decimate, rows = looked.seen, looked.decimate, looked.rows
    beyond = decimate(beyond_limit(seen, chosen["limit"]))[rows]
    candidates = {"limit": Candidate(beyond, len(LIMITS))} if is_limited(beyond, looked.error) else {}
    candidates |= as_candidates(seen, decimate, rows)
    for name in chosen.keys() & RIPPLES.keys():
        columns = decimate(ripple(seen, chosen[name], name == "cogging"))[rows]
        candidates[name] = Candidate(columns, len(looked.periods))
    return candidates


def _name_law(
    one: Explained,
    looked: _Looked,
    chosen: Mapping[str, float],
    usual: Factors,
    joint: tuple[FrictionModel, set[str]],
) -> types.PlaceRow:
    place = RIPPLES.get(one.name, one.name)
    law, sees = joint
    name, whole = (None, False) if place in OF_BENCH else suggest_law(law, sees, place)
    row = {
        "place": place,
        "periods": chosen[one.name] if one.name in RIPPLES else None,
        "value": chosen["limit"] if place == "limit" else _value(place, looked, usual),
        "share": one.share,
        "torque": float(np.sqrt(one.share)) * _rms(looked.error),
        "chance": one.chance,
        "known": place in sees,
        "law": name,
        "whole": whole,
    }
    return cast(types.PlaceRow, row)


def _value(place: str, looked: _Looked, usual: Factors) -> float | None:
    """Estimate a constant torque, factor of the actuator torque or delay, beyond its usual value in the reference."""
    if place not in ("constant", "scale", "late"):
        return None
    column = as_candidates(looked.seen, looked.decimate, looked.rows)[place].columns
    slope = float(find_factors(looked.error, looked.known, column)[0] - np.ravel(usual)[0])
    return {"constant": -slope, "scale": 1 / (1 + slope) if slope > -1 else None, "late": slope}[place]


def _see(left: Left, joint: int) -> Seen:
    state, logs = left.state, left.recordings.logs
    begins = np.cumsum([0, *(log.samples for log in logs[:-1])])
    qpos, qvel = state.qpos[:, joint], state.qvel[:, joint]
    temperatures = [log.extras.get("temperature") for log in logs]
    recorded = [signal for signal in temperatures if signal is not None]
    temperature = np.concatenate(recorded)[:, joint] if len(recorded) == len(logs) else None
    since = time_since_reversal(qvel, begins, logs[0].timestep)
    places, commanded = _places(left.equation.decimate), state.motor_torque[:, joint]
    motor = commanded - np.interp(np.arange(len(qpos)), places, left.torque[:, joint])
    others = since, commanded, begins, logs[0].timestep, temperature
    return Seen(qpos, qvel, motor, state.external_torque[:, joint], *others)


def _rms(values: Float[np.ndarray, "rows"]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
