"""Residual analysis: whether the residual torque is noise, and which residual factors explain it."""

import logging
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.stats
from jaxtyping import Float, Int

from frictionzoo.core.units import UNITS
from frictionzoo.fit import Space
from frictionzoo.fit.motion import Decimation
from frictionzoo.models import FrictionModel
from frictionzoo.models.sees import suggest_law
from frictionzoo.result import attribution, places
from frictionzoo.result import section_types as types
from frictionzoo.result.evaluate import rms
from frictionzoo.result.residual_torque import FEWEST, Left, follow, list_samples

STEP = 1e-2  # of a coordinate, for finite differences
LITTLE = 0.01  # share of the friction; smaller factors are not reported
WRONG = 0.05  # relative error of the actuator torque above which a scale factor is always reported
RIPPLES = {"ripple": "position", "cogging": places.PULL}
"""Factor of a ripple: against the motion, or alike in both directions."""
GAP = "backlash"
"""Friction model of a gear with a gap."""
CONCENTRATED = 0.7  # smallest share of the squared residual near motor reversals that indicates a gap
CLEAR = 2.0  # times the noise; smaller residuals are not tested for a gap
ALONE = 50  # inverse of the smallest share of rows on either side
ALIKE = 15.0  # neighbouring rows that count as one independent row
_log = logging.getLogger(__name__)
Slopes = Float[np.ndarray, "rows nv parameters"]
Coordinates = Float[np.ndarray, "coordinates"]


def describe_residual(left: Left, space: Space, vector: Coordinates) -> types.Residual | None:
    """Return the section `residual`: residual factors of the torque in motion, as defined in `Residual`.

    None: the residual torque has no finite derivative by the values, and a log line says so.
    """
    bench = left.recordings.bench
    slopes = [_slopes(residual, space, vector) for residual in (left, left.nothing) if residual is not None]
    if not all(np.isfinite(part).all() for part in slopes):
        _log.info("no residual analysis: the residual torque has no derivative with these values")
        return None
    rows = [_describe(left, joint, slopes) for joint in range(bench.nv)]
    unit: Any = UNITS[bench.joint_type]["torque"]
    return types.Residual(unit, left.bandwidth, [row for row in rows if row is not None])


def _slopes(left: Left, space: Space, vector: Coordinates) -> Slopes:
    """Return the derivative of the residual torque by each identified parameter, changed in all joints at once.

    Values at a bound stay. Actuator parameters other than torques are skipped: with free gains, zero torque solves the
    torque equation.
    """
    bench, model, logs = left.recordings
    friction = follow(model, logs)
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


def _describe(left: Left, joint: int, slopes: Sequence[np.ndarray]) -> types.JointResidual | None:
    rows = np.flatnonzero(left.counts[:, joint])
    if len(rows) < FEWEST:
        return None
    error, noise, friction = left.of(joint), left.noise(joint), left.friction[rows, joint]
    total = rms(friction + error)
    return types.JointResidual(
        joint=left.recordings.bench.joints[joint],
        rows=len(rows),
        residual=rms(error),
        noise=rms(noise),
        friction=total,
        correlation=attribution.correlation(error),
        noise_correlation=attribution.correlation(noise),
        kurtosis=attribution.excess(error),
        places=[
            row
            for row in _attribute(left, joint, slopes)
            if row.torque > LITTLE * total or (row.place == "scale" and row.value and abs(np.log(row.value)) > WRONG)
        ],
    )


def _attribute(left: Left, joint: int, slopes: Sequence[np.ndarray]) -> list[types.ResidualFactor]:
    """Find the residual factors that exceed those of the reference, and the models that have them."""
    looked = _look(left, joint, slopes[0])
    if (gap := _find_gap(looked, left, joint)) is not None:
        return [gap]
    chosen = _choose(looked)
    ideal = None if left.nothing is None else _look(left.nothing, joint, slopes[-1])
    candidates, factors = _candidates(looked, chosen), _candidates(ideal, chosen) if ideal else {}

    def usual(name: str, before: Sequence[str]) -> attribution.Factors:
        if ideal is None or name not in factors:
            return 0.0
        columns = [factors[earlier].columns for earlier in before if earlier in factors]
        return attribution.find_factors(ideal.error, np.column_stack([ideal.known, *columns]), factors[name].columns)

    explained = attribution.attribute(looked.error, looked.known, candidates, left.recordings.bench.nv, usual)
    return [
        _name_law(one, looked, chosen, candidates[one.name].columns, usual(one.name, ()), left.law(joint))
        for one in explained
    ]


class _Looked(NamedTuple):
    """Residual torque of a joint with the data to explain it: parameter effects, rows that count, and motion."""

    error: Float[np.ndarray, "counted"]
    known: Float[np.ndarray, "counted _"]
    rows: Int[np.ndarray, "counted"]
    seen: places.Seen
    decimate: Decimation
    periods: Float[np.ndarray, "periods"]


def _find_gap(looked: _Looked, left: Left, joint: int) -> types.ResidualFactor | None:
    """Return the factor `gap` if most of the squared error is near sign changes of the motor torque."""
    near = places.near_crossings(looked.seen, list_samples(looked.decimate)[looked.rows])
    squares, fewest = np.square(looked.error), max(len(near) // ALONE, 1)
    if not fewest < near.sum() < len(near) - fewest or rms(looked.error) < CLEAR * rms(left.noise(joint)):
        return None
    inside, outside = squares[near].mean(), max(squares[~near].mean(), 1e-300)
    share = float((inside - outside) * near.sum() / squares.sum())
    freedom = [part.sum() / ALIKE for part in (near, ~near)]
    chance = left.recordings.bench.nv * float(scipy.stats.f.sf(inside / outside, *freedom))
    law = left.law(joint)[0].name
    if share < CONCENTRATED or chance > attribution.LEVEL:
        return None
    torque, other = float(np.sqrt(share)) * rms(looked.error), None if law == GAP else GAP
    return types.ResidualFactor("gap", None, None, share, torque, chance, known=law == GAP, law=other, whole=False)


def _look(left: Left, joint: int, slopes: Slopes) -> _Looked:
    rows, seen = np.flatnonzero(left.counts[:, joint]), _see(left, joint)
    periods = places.list_periods(seen, left.recordings.bench.joint_type == "hinge", left.bandwidth)
    return _Looked(left.of(joint), slopes[rows, joint], rows, seen, left.equation.decimate, periods)


def _choose(looked: _Looked) -> dict[str, float]:
    error, known, rows, seen, decimate, periods = looked
    chosen = {"limit": places.find_limit(seen, decimate, rows, error, known)}
    if len(periods):
        for name in RIPPLES:
            alike = name == "cogging"
            chosen[name] = places.find_ripple(seen, periods, alike, error, known, list_samples(decimate)[rows])
    return chosen


def _candidates(looked: _Looked, chosen: Mapping[str, float]) -> dict[str, attribution.Candidate]:
    seen, decimate, rows = looked.seen, looked.decimate, looked.rows
    beyond = decimate(places.beyond_limit(seen, chosen["limit"]))[rows]
    candidates: dict[str, attribution.Candidate] = {}
    if places.is_limited(beyond, looked.error):
        candidates["limit"] = attribution.Candidate(beyond, len(places.LIMITS))
    candidates |= places.as_candidates(seen, decimate, rows)
    for name in chosen.keys() & RIPPLES.keys():
        columns = decimate(places.ripple(seen, chosen[name], name == "cogging"))[rows]
        candidates[name] = attribution.Candidate(columns, len(looked.periods))
    return candidates


def _name_law(
    one: attribution.Contribution,
    looked: _Looked,
    chosen: Mapping[str, float],
    columns: attribution.Columns,
    usual: attribution.Factors,
    joint: tuple[FrictionModel, set[str]],
) -> types.ResidualFactor:
    place: Any = RIPPLES.get(one.name, one.name)
    law, sees = joint
    name, whole = (None, False) if place in places.OF_BENCH else suggest_law(law, sees, place)
    return types.ResidualFactor(
        place=place,
        periods=chosen[one.name] if one.name in RIPPLES else None,
        value=chosen["limit"] if place == "limit" else _value(place, looked, columns, usual),
        share=one.share,
        torque=float(np.sqrt(one.share)) * rms(looked.error),
        chance=one.chance,
        known=place in sees,
        law=name,
        whole=whole,
    )


def _value(place: str, looked: _Looked, columns: attribution.Columns, usual: attribution.Factors) -> float | None:
    """Estimate a constant torque, factor of the actuator torque or delay, beyond its usual value in the reference."""
    if place not in ("constant", "scale", "late"):
        return None
    slope = float(attribution.find_factors(looked.error, looked.known, columns)[0] - np.ravel(usual)[0])
    return {"constant": -slope, "scale": 1 / (1 + slope) if slope > -1 else None, "late": slope}[place]


def _see(left: Left, joint: int) -> places.Seen:
    state, logs = left.state, left.recordings.logs
    begins = np.cumsum([0, *(log.samples for log in logs[:-1])])
    qpos, qvel = state.qpos[:, joint], state.qvel[:, joint]
    temperatures = [log.extras.get("temperature") for log in logs]
    recorded = [signal for signal in temperatures if signal is not None]
    temperature = np.concatenate(recorded)[:, joint] if len(recorded) == len(logs) else None
    since = places.time_since_reversal(qvel, begins, logs[0].timestep)
    samples, commanded = list_samples(left.equation.decimate), state.motor_torque[:, joint]
    motor = commanded - np.interp(np.arange(len(qpos)), samples, left.torque[:, joint])
    others = since, commanded, begins, logs[0].timestep, temperature
    return places.Seen(qpos, qvel, motor, state.external_torque[:, joint], *others)
