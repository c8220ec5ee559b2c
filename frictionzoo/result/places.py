"""Residual factors: functions of motion, commands and load that may explain the residual torque."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from frictionzoo.result.attribution import Candidate, pick

SLOW = 0.1, 0.3  # shares of the root mean square speed over which friction may fall
SINCE = 0.05, 0.2  # s after a reversal over which friction may build up
PERIODS = 200  # most ripple periods tried
THIN = 1000  # rows used to choose the period
WITHIN = 0.8  # largest ripple frequency as a share of the bandwidth
LIMITS = 0.8, 0.9, 0.95, 0.97, 0.98, 0.99, 0.995, 0.998  # quantiles of commanded torque, tried as limits
WELL_BEYOND = 0.05  # share of the largest excess from which a row counts as beyond the limit
UNLIKE = 0.5  # largest share of the squared error in these rows that the excess may not explain
CROSSING = 0.05  # s before and after a sign change of the motor torque in which a gap may be crossed
PULL = "pull"
"""Position-dependent torque alike in both directions, which is not friction."""
OF_BENCH = ("constant", "scale", "limit", "late", PULL)
"""Factors that no friction model has."""

Signal = Float[np.ndarray, "time"]
Rows = Float[np.ndarray, "rows"]
Filter = Callable[[Float[np.ndarray, "time _"]], Float[np.ndarray, "rows _"]]


class Seen(NamedTuple):
    """Motion, torques and temperature of a joint in each sample.

    Attributes:
        motor: Actuator torque that the model needs for the motion [N m or N]: the applied torque correlates with any
            error.
        external: Torque of everything but actuator and friction [N m or N].
        since: Time since the last reversal of the motion [s].
        asked: Torque commanded according to the actuator model [N m or N].
        begins: First sample of each log.
        temperature: Temperature [degC]; None: not recorded.
    """

    qpos: Signal
    qvel: Signal
    motor: Signal
    external: Signal
    since: Signal
    asked: Signal
    begins: Int[np.ndarray, "logs"]
    timestep: float
    temperature: Signal | None


def time_since_reversal(signal: Signal, begins: Int[np.ndarray, "logs"], timestep: float) -> Signal:
    """Return the time since a signal, such as a velocity, last changed its sign or its log began [s]."""
    last = np.zeros(len(signal), int)
    resets = np.union1d(np.flatnonzero(np.diff(np.sign(signal), prepend=0.0)), begins)
    last[resets] = resets
    return timestep * (np.arange(len(signal)) - np.maximum.accumulate(last))


def _list_factors(seen: Seen) -> Iterator[tuple[str, Float[np.ndarray, "time _"]]]:
    side, speed = np.sign(seen.qvel), np.abs(seen.qvel)
    share = speed / max(float(np.sqrt(np.mean(np.square(speed)))), 1e-300)
    plain = [side, side * share]
    yield "constant", _stack(np.ones_like(side))
    yield "scale", _stack(seen.motor)
    yield "late", _stack(np.gradient(seen.motor, seen.timestep))
    yield "speed", _stack(*plain)
    yield "slow", _stack(*plain, *(side * np.exp(-np.square(share / scale)) for scale in SLOW))
    yield "fast", _stack(*plain, side * share**2, side * share**3)
    yield "direction", _stack(np.ones_like(side), share)
    loads = seen.motor, seen.external, seen.motor - seen.external
    yield "load", _stack(*(side * np.abs(load) for load in loads))
    span = (2 * seen.qpos - seen.qpos.min() - seen.qpos.max()) / max(float(np.ptp(seen.qpos)), 1e-300)
    shapes = np.polynomial.legendre.legvander(span, 3)[:, 1:]  # of orders 1 to 3
    yield "position", side[:, None] * shapes
    yield PULL, shapes
    if seen.temperature is not None and np.ptp(seen.temperature) > 0:
        warmer = (seen.temperature - seen.temperature.mean()) / seen.temperature.std()
        yield "temperature", _stack(side * warmer, side * share * warmer)
    yield "reversal", _stack(*(side * np.exp(-seen.since / scale) for scale in SINCE))


def near_crossings(seen: Seen, at: Int[np.ndarray, "rows"]) -> Bool[np.ndarray, "rows"]:
    """Return which samples are near a sign change of the motor torque, where a gap may be crossed."""
    crossings = np.flatnonzero(np.diff(np.sign(seen.motor)))
    if not len(crossings):
        return np.zeros(len(at), bool)
    after = np.minimum(np.searchsorted(crossings, at), len(crossings) - 1)
    nearest = np.minimum(*(np.abs(crossings[index] - at) for index in (after, np.maximum(after - 1, 0))))
    return nearest * seen.timestep < CROSSING


def beyond_limit(seen: Seen, limit: float) -> Float[np.ndarray, "time 1"]:
    """Return the commanded torque beyond a limit [N m or N]."""
    return _stack(seen.asked - np.clip(seen.asked, -limit, limit))


def is_limited(excess: Float[np.ndarray, "rows 1"], error: Rows) -> bool:
    """Return whether a limit acts: where commands exceed it, the error is about the equally filtered excess."""
    beyond = np.abs(excess[:, 0]) > WELL_BEYOND * np.abs(excess).max()
    remainder = np.square(error - excess[:, 0])[beyond].sum()
    return bool(remainder < UNLIKE * np.square(error[beyond]).sum())


def find_limit(seen: Seen, decimate: Filter, rows: np.ndarray, error: Rows, known: np.ndarray) -> float:
    """Return the torque limit [N m or N], a quantile of commands, that explains most of an error beyond `known`."""
    limits = np.quantile(np.abs(seen.asked), LIMITS)
    return float(limits[pick(error, known, [decimate(beyond_limit(seen, limit))[rows] for limit in limits])])


def ripple(seen: Seen, periods: float, alike: bool) -> Float[np.ndarray, "time 4"]:
    """Return two harmonics of the position, against the motion unless `alike` in both directions."""
    phase, side = periods * seen.qpos, np.ones_like(seen.qpos) if alike else np.sign(seen.qvel)
    return _stack(*(side * wave(times * phase) for times in (1, 2) for wave in (np.sin, np.cos)))


def list_periods(seen: Seen, hinge: bool, bandwidth: float) -> Float[np.ndarray, "periods"]:
    """Return the ripple periods that the motion covers: whole ones per turn, or 2 pi / period [1/m] on a slide."""
    reach, speed = float(np.ptp(seen.qpos)), float(np.median(np.abs(seen.qvel)))
    highest = WITHIN * 2 * np.pi * bandwidth / max(speed, 1e-300)
    step = 1.0 if hinge else np.pi / max(reach, 1e-300)
    periods = step * np.arange(1, PERIODS + 1)
    return periods[(periods * reach >= 2 * np.pi) & (periods <= highest)]


def find_ripple(
    seen: Seen, periods: Float[np.ndarray, "periods"], alike: bool, error: Rows, known: np.ndarray, at: np.ndarray
) -> float:
    """Return the periods of the ripple that explains most of an error in samples `at`, beyond `known`."""
    thin = slice(None, None, max(1, len(at) // THIN))
    few = seen._replace(qpos=seen.qpos[at[thin]], qvel=seen.qvel[at[thin]])
    harmonics = [ripple(few, count, alike)[:, :2] for count in periods]  # with both harmonics, half the periods fit too
    return float(periods[pick(error[thin], known[thin], harmonics)])


def as_candidates(seen: Seen, decimate: Filter, rows: np.ndarray) -> dict[str, Candidate]:
    """Return the functions of all residual factors in these rows as candidates, filtered like the error."""
    candidates = {name: Candidate(decimate(columns)[rows]) for name, columns in _list_factors(seen)}
    return {name: candidate for name, candidate in candidates.items() if np.any(candidate.columns)}


def _stack(*columns: Signal) -> Float[np.ndarray, "time _"]:
    return np.stack(columns, axis=1)
