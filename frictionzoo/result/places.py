"""What an error of the torque may go with: functions of the motion, of the commands and of what links need."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from frictionzoo.result.attribution import Candidate, pick

SLOW = 0.1, 0.3  # of the root mean square speed, over which friction may fall
SINCE = 0.05, 0.2  # s since a reversal, over which friction may build up
PERIODS = 200  # harmonics of the position that are looked through
THIN = 1000  # rows by which they are
WITHIN = 0.8  # share of the bandwidth in which a ripple may lie
LIMITS = 0.8, 0.9, 0.95, 0.97, 0.98, 0.99, 0.995, 0.998  # quantiles of the torque asked for at which a limit may lie
WELL_BEYOND = 0.05  # share of the largest excess, from which on the commands ask for more than a limit
UNLIKE = 0.5  # share of the error there that may be something else
CROSSING = 0.05  # s before and after the motor's torque changes its sign, in which a gap may be crossed
PULL = "pull"
"""What changes with the position alike in both directions: no friction."""
OF_BENCH = ("constant", "scale", "limit", "late", PULL)
"""What no friction law has."""

Signal = Float[np.ndarray, "time"]
Rows = Float[np.ndarray, "rows"]
Filter = Callable[[Float[np.ndarray, "time _"]], Float[np.ndarray, "rows _"]]


class Seen(NamedTuple):
    """What a joint did, in each sample.

    Attributes:
        qpos: [rad or m].
        qvel: [rad/s or m/s].
        motor: Torque that the actuator has to give for the motion by the law, that is without the error: what it does
            give answers to any error, and goes with it [N m or N].
        external: Torque of everything but actuator and friction [N m or N].
        since: Time since the motion last turned round [s].
        asked: Torque that the commands ask for by the actuator law [N m or N].
        begins: First sample of each log.
        timestep: [s].
        temperature: [degC]; None where it is not recorded.
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
    """Time since a velocity, say, last changed its sign, or since its log began [s].

    Args:
        signal: Of logs, one after the other.
        begins: First sample of each.
        timestep: [s].
    """
    turned = np.flatnonzero(np.diff(np.sign(signal), prepend=0.0))
    last = np.zeros(len(signal), int)
    last[np.union1d(turned, begins)] = np.union1d(turned, begins)
    return timestep * (np.arange(len(signal)) - np.maximum.accumulate(last))


def list_places(seen: Seen) -> Iterator[tuple[str, Float[np.ndarray, "time _"]]]:
    """Functions by the name of what they change with, of `SEES`, or `PULL`; the simplest first."""
    side, speed = np.sign(seen.qvel), np.abs(seen.qvel)
    share = speed / max(float(np.sqrt(np.mean(np.square(speed)))), 1e-300)
    plain = [side, side * share]
    yield "constant", _stack(np.ones_like(side))
    yield "scale", _stack(seen.motor)
    yield "late", _stack(np.gradient(seen.motor, seen.timestep))
    yield "speed", _stack(*plain)
    yield "slow", _stack(*plain, *(side * np.exp(-np.square(share / over)) for over in SLOW))
    yield "fast", _stack(*plain, side * share**2, side * share**3)
    yield "direction", _stack(np.ones_like(side), share)
    loads = seen.motor, seen.external, seen.motor - seen.external
    yield "load", _stack(*(side * np.abs(load) for load in loads))
    shapes = _polynomials(seen.qpos)
    yield "position", side[:, None] * shapes
    yield PULL, shapes
    if seen.temperature is not None and np.ptp(seen.temperature) > 0:
        warmer = (seen.temperature - seen.temperature.mean()) / seen.temperature.std()
        yield "temperature", _stack(side * warmer, side * share * warmer)
    yield "reversal", _stack(*(side * np.exp(-seen.since / over) for over in SINCE))


def near_crossings(seen: Seen, at: Int[np.ndarray, "rows"]) -> Bool[np.ndarray, "rows"]:
    """Return which rows, by their samples, are near a change of the motor's direction, when a gap is crossed."""
    turned = np.flatnonzero(np.diff(np.sign(seen.motor)))
    if not len(turned):
        return np.zeros(len(at), bool)
    after = np.minimum(np.searchsorted(turned, at), len(turned) - 1)
    nearest = np.minimum(np.abs(turned[after] - at), np.abs(turned[np.maximum(after - 1, 0)] - at))
    return nearest * seen.timestep < CROSSING


def beyond_limit(seen: Seen, limit: float) -> Float[np.ndarray, "time 1"]:
    """What the commands ask for beyond a limit of the torque [N m or N]."""
    return _stack(seen.asked - np.clip(seen.asked, -limit, limit))


def is_limited(excess: Float[np.ndarray, "rows 1"], error: Rows) -> bool:
    """Return whether the torque stays below a limit: where the commands ask for more, the error is that excess.

    Args:
        excess: `beyond_limit` behind the filter of the error [N m or N].
        error: In the same rows.
    """
    beyond = np.abs(excess[:, 0]) > WELL_BEYOND * np.abs(excess).max()
    rest = np.square(error - excess[:, 0])[beyond].sum()
    return bool(rest < UNLIKE * np.square(error[beyond]).sum())


def find_limit(seen: Seen, decimate: Filter, rows: np.ndarray, error: Rows, known: np.ndarray) -> float:
    """Limit of the torque that explains most of an error [N m or N], of those that a share of the torque exceeds.

    Arguments as in `as_candidates`, and the error in these rows, and columns that it has to explain more than.
    """
    limits = np.quantile(np.abs(seen.asked), LIMITS)
    return float(limits[pick(error, known, [decimate(beyond_limit(seen, limit))[rows] for limit in limits])])


def ripple(seen: Seen, periods: float, alike: bool) -> Float[np.ndarray, "time 4"]:
    """Two harmonics of the position; against the motion, unless they are alike in both directions."""
    phase, side = periods * seen.qpos, np.ones_like(seen.qpos) if alike else np.sign(seen.qvel)
    return _stack(*(side * wave(times * phase) for times in (1, 2) for wave in (np.sin, np.cos)))


def list_periods(seen: Seen, hinge: bool, bandwidth: float) -> Float[np.ndarray, "periods"]:
    """Periods in a rad or m of ripples that the motion shows within a bandwidth [Hz]: whole numbers of a turn."""
    reach, usual = float(np.ptp(seen.qpos)), float(np.median(np.abs(seen.qvel)))
    most = WITHIN * 2 * np.pi * bandwidth / max(usual, 1e-300)
    step = 1.0 if hinge else np.pi / max(reach, 1e-300)
    found = step * np.arange(1, PERIODS + 1)
    return found[(found * reach >= 2 * np.pi) & (found <= most)]


def find_ripple(
    seen: Seen, periods: Float[np.ndarray, "periods"], alike: bool, error: Rows, known: np.ndarray, at: np.ndarray
) -> float:
    """Periods of the ripple that explains most of an error.

    Args:
        seen: What the joint did.
        periods: To choose from.
        alike: As in `ripple`.
        error: In some samples.
        known: Columns that the ripple has to explain more than.
        at: Index of these samples.
    """
    thin = slice(None, None, max(1, len(at) // THIN))
    few = seen._replace(qpos=seen.qpos[at[thin]], qvel=seen.qvel[at[thin]])
    first = [ripple(few, each, alike)[:, :2] for each in periods]  # with both harmonics, half as many do as well
    return float(periods[pick(error[thin], known[thin], first)])


def as_candidates(seen: Seen, decimate: Filter, rows: np.ndarray) -> dict[str, Candidate]:
    """The functions of `list_places` behind the filter of the error, in those of its rows that count.

    Args:
        seen: What the joint did.
        decimate: The filter.
        rows: Index of the rows.
    """
    found = {name: Candidate(decimate(columns)[rows]) for name, columns in list_places(seen)}
    return {name: one for name, one in found.items() if np.any(one.columns)}


def _stack(*columns: Signal) -> Float[np.ndarray, "time _"]:
    return np.stack(columns, axis=1)


def _polynomials(qpos: Signal) -> Float[np.ndarray, "time 3"]:
    """Legendre polynomials of the position over its range, of the first three orders."""
    reach = float(np.ptp(qpos))
    share = (2 * qpos - qpos.min() - qpos.max()) / max(reach, 1e-300)
    return np.polynomial.legendre.legvander(share, 3)[:, 1:]
