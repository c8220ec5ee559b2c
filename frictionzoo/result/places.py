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
        qpos: Position [rad or m].
        qvel: Velocity [rad/s or m/s].
        motor: Actuator torque that the model needs for the motion, without the residual torque [N m or N]. The applied
            torque reacts to any error and so correlates with it.
        external: Torque of everything but actuator and friction [N m or N].
        since: Time since the last reversal of the motion [s].
        asked: Torque commanded according to the actuator model [N m or N].
        begins: First sample of each log.
        timestep: Sample interval [s].
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
    """Return the time since a signal, such as a velocity, last changed its sign or its log began [s].

    Args:
        signal: Signal of all logs, one after the other.
        begins: First sample of each log.
        timestep: Sample interval [s].
    """
    turned = np.flatnonzero(np.diff(np.sign(signal), prepend=0.0))
    last = np.zeros(len(signal), int)
    last[np.union1d(turned, begins)] = np.union1d(turned, begins)
    return timestep * (np.arange(len(signal)) - np.maximum.accumulate(last))


def list_places(seen: Seen) -> Iterator[tuple[str, Float[np.ndarray, "time _"]]]:
    """Yield the functions of each residual factor with its name, the simplest first."""
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
    """Return which samples are near a sign change of the motor torque, where a gap may be crossed."""
    turned = np.flatnonzero(np.diff(np.sign(seen.motor)))
    if not len(turned):
        return np.zeros(len(at), bool)
    after = np.minimum(np.searchsorted(turned, at), len(turned) - 1)
    nearest = np.minimum(np.abs(turned[after] - at), np.abs(turned[np.maximum(after - 1, 0)] - at))
    return nearest * seen.timestep < CROSSING


def beyond_limit(seen: Seen, limit: float) -> Float[np.ndarray, "time 1"]:
    """Return the commanded torque beyond a limit [N m or N]."""
    return _stack(seen.asked - np.clip(seen.asked, -limit, limit))


def is_limited(excess: Float[np.ndarray, "rows 1"], error: Rows) -> bool:
    """Return whether a limit acts on the torque: where commands exceed it, the error is about the excess.

    Args:
        excess: `beyond_limit`, filtered like the error [N m or N].
        error: Error in the same rows.
    """
    beyond = np.abs(excess[:, 0]) > WELL_BEYOND * np.abs(excess).max()
    rest = np.square(error - excess[:, 0])[beyond].sum()
    return bool(rest < UNLIKE * np.square(error[beyond]).sum())


def find_limit(seen: Seen, decimate: Filter, rows: np.ndarray, error: Rows, known: np.ndarray) -> float:
    """Return the torque limit that explains most of an error, from quantiles of commanded torque [N m or N].

    Args:
        seen: Motion and torques of the joint.
        decimate: Filter of the error.
        rows: Index of the rows.
        error: Error in these rows.
        known: Columns beyond which the limit explains the error.
    """
    limits = np.quantile(np.abs(seen.asked), LIMITS)
    return float(limits[pick(error, known, [decimate(beyond_limit(seen, limit))[rows] for limit in limits])])


def ripple(seen: Seen, periods: float, alike: bool) -> Float[np.ndarray, "time 4"]:
    """Return two harmonics of the position, against the motion unless `alike` in both directions."""
    phase, side = periods * seen.qpos, np.ones_like(seen.qpos) if alike else np.sign(seen.qvel)
    return _stack(*(side * wave(times * phase) for times in (1, 2) for wave in (np.sin, np.cos)))


def list_periods(seen: Seen, hinge: bool, bandwidth: float) -> Float[np.ndarray, "periods"]:
    """Return the ripple periods that the motion covers within a bandwidth [Hz].

    On a hinge, periods per turn, whole numbers; on a slide, 2 pi / period [1/m].
    """
    reach, usual = float(np.ptp(seen.qpos)), float(np.median(np.abs(seen.qvel)))
    most = WITHIN * 2 * np.pi * bandwidth / max(usual, 1e-300)
    step = 1.0 if hinge else np.pi / max(reach, 1e-300)
    found = step * np.arange(1, PERIODS + 1)
    return found[(found * reach >= 2 * np.pi) & (found <= most)]


def find_ripple(
    seen: Seen, periods: Float[np.ndarray, "periods"], alike: bool, error: Rows, known: np.ndarray, at: np.ndarray
) -> float:
    """Return the periods of the ripple that explains most of an error.

    Args:
        seen: Motion of the joint.
        periods: Values to choose from.
        alike: As in `ripple`.
        error: Error in some samples.
        known: Columns beyond which the ripple explains the error.
        at: Index of these samples.
    """
    thin = slice(None, None, max(1, len(at) // THIN))
    few = seen._replace(qpos=seen.qpos[at[thin]], qvel=seen.qvel[at[thin]])
    first = [ripple(few, each, alike)[:, :2] for each in periods]  # with both harmonics, half the periods fit as well
    return float(periods[pick(error[thin], known[thin], first)])


def as_candidates(seen: Seen, decimate: Filter, rows: np.ndarray) -> dict[str, Candidate]:
    """Return the functions of `list_places` as candidates, filtered like the error.

    Args:
        seen: Motion and torques of the joint.
        decimate: Filter of the error.
        rows: Index of the rows that count.
    """
    found = {name: Candidate(decimate(columns)[rows]) for name, columns in list_places(seen)}
    return {name: one for name, one in found.items() if np.any(one.columns)}


def _stack(*columns: Signal) -> Float[np.ndarray, "time _"]:
    return np.stack(columns, axis=1)


def _polynomials(qpos: Signal) -> Float[np.ndarray, "time 3"]:
    """Return Legendre polynomials of orders 1 to 3 of the position over its range."""
    reach = float(np.ptp(qpos))
    share = (2 * qpos - qpos.min() - qpos.max()) / max(reach, 1e-300)
    return np.polynomial.legendre.legvander(share, 3)[:, 1:]
