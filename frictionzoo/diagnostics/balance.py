"""Torque balance of a recording: actuator torque against the torque that the links need for the motion.

    torque = share * links(qpos, qvel, qacc) + inertia * qacc + viscous * qvel + dry * sign(qvel) + offset

All signals pass one low-pass filter. The share is 1 if signs, units, gears and the order of the joints match the bench.
The torque comes from the actuator law at initial values, the links' torque from MuJoCo's inverse dynamics of the bench
without armature. Each joint is a linear regression; no simulation is needed.

Source: the inverse dynamic model of M. Gautier, "Dynamic identification of robots with power model", ICRA 1997.
"""

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from frictionzoo.bench import Bench
from frictionzoo.bench.regressor import inverse_torque
from frictionzoo.bench.torque import actuator_torque
from frictionzoo.core.errors import ConfigError, LogError
from frictionzoo.core.log import Log
from frictionzoo.data.signals import smooth

BANDWIDTH = 10.0  # Hz, cutoff of the low-pass; at most a tenth of the sample rate
ORDER = 2
EDGE = 0.5  # s ignored at either end: affected by the filter, and needed for delayed torques
LONGEST = 20_000  # samples used
ROWS = 1000  # of the regression, about
SLOW = 0.05  # share of the top speed below which dry friction may hold the joint
BOTH_WAYS = 0.1  # smallest share of the rows in either direction
FEW = 50  # rows needed
CORRELATED = 15.0  # neighbouring rows that count as one independent row
FARTHEST, FINEST = 0.5, 0.002  # s, largest delay of a torque in either direction, and smallest step between delays
ALIKE = 1e-6  # share of the links' torque not explained by inertia, below which a joint counts as unloaded
Torque = Float[np.ndarray, "time nv"]
Rows = Float[np.ndarray, "rows nv"]


class BalanceRows(NamedTuple):
    """Filtered signals of one recording, in rows spread evenly over it.

    Attributes:
        torque: Actuator torque [N m or N].
        links: Torque that links, springs and dampers of the bench need [N m or N].
        rows: Sample index of each row.
        when: Time of each row [s].
        whole: Actuator torque in all samples [N m or N].
        timestep: Sample interval [s].
    """

    torque: Rows
    links: Rows
    qvel: Rows
    qacc: Rows
    rows: Int[np.ndarray, "rows"]
    when: Float[np.ndarray, "rows"]
    whole: Torque
    timestep: float


class TorqueRegression(NamedTuple):
    """Regression of a joint's torque, with standard errors.

    Attributes:
        left: Unexplained share of the torque's variance.
        share: Factor on the links' torque; NaN if that is constant or explained by acceleration alone.
        inertia: Armature, including the links' inertia if `share` is NaN [kg m^2 or kg].
        links: Share of the torque's variance that the links' torque explains beyond inertia and friction.
        acceleration: Acceleration of `inertia` under the largest torque [rad/s^2 or m/s^2].
    """

    left: float
    share: float
    error: float
    inertia: float
    inertia_error: float
    links: float
    acceleration: float


def commanded_torque(log: Log, bench: Bench, qvel: Torque | None = None) -> Torque:
    """Return actuator torques of an accepted log [N m or N], at initial values and `qvel` if set, without delay."""
    values = {name: value for name, value in bench.initial_values().items() if name != "delay"}
    return actuator_torque(bench, log, values, qvel)


def balance(log: Log, bench: Bench, model: mujoco.MjModel, measured: Torque | None = None) -> BalanceRows | None:
    """Return an accepted log's torque balance; None if it is too short to filter or a value is not finite.

    `model` is the bench compiled without a friction constraint; the log's load is put into it. `measured` is a torque
    [N m or N] in place of the actuator's; None: the actuator's.
    """
    log = log.between(0, LONGEST, "start") if log.samples > LONGEST else log
    torque = commanded_torque(log, bench) if measured is None else measured[: log.samples]
    cutoff = min(BANDWIDTH, 0.1 / log.timestep)
    try:
        qpos, torque = (smooth(values, log.timestep, cutoff, ORDER, log.name, "") for values in (log.qpos, torque))
    except (LogError, ConfigError):
        return None
    qvel = np.gradient(qpos, log.timestep, axis=0)
    qacc = np.gradient(qvel, log.timestep, axis=0)
    edge = min(round(EDGE / log.timestep), log.samples // 10)
    rows = np.arange(edge, log.samples - edge, max(1, (log.samples - 2 * edge) // ROWS))
    bench.put_load(model, log.load)
    links = inverse_torque(model, qpos[rows], qvel[rows], qacc[rows])
    filtered = BalanceRows(torque[rows], links, qvel[rows], qacc[rows], rows, log.time[rows], torque, log.timestep)
    return filtered if all(np.isfinite(values).all() for values in filtered) else None


def explain(found: BalanceRows, joint: int) -> TorqueRegression | None:
    """Fit the regression of a joint's torque; None if the joint moves too little or in one direction."""
    moving, columns = _passive(found, joint)
    if moving.sum() < FEW:
        return None
    torque, links = found.torque[moving, joint], found.links[moving, joint]
    forward = float(np.mean(found.qvel[moving, joint] > 0))
    if not np.ptp(torque) > 0 or not BOTH_WAYS < forward < 1 - BOTH_WAYS:
        return None
    inertial = columns[:, [0, -1]]
    noninertial = links - inertial @ np.linalg.lstsq(inertial, links, rcond=None)[0]
    loaded = np.std(noninertial) > ALIKE * np.std(links) and np.ptp(links) > 0
    without_links = _regress(columns, torque)[2] if loaded else np.nan
    columns = np.column_stack([links, columns]) if loaded else columns
    values, errors, unexplained = _regress(columns, torque)
    share, error = (values[0], errors[0]) if loaded else (np.nan, np.nan)
    index = int(loaded)
    fastest = float(np.quantile(np.abs(torque), 0.99)) / max(abs(float(values[index])), 1e-300)
    numbers = unexplained, float(share), float(error), float(values[index]), float(errors[index])
    return TorqueRegression(*numbers, without_links - unexplained if loaded else 0.0, fastest)


def mismatch(found: BalanceRows) -> Float[np.ndarray, "nv"]:
    """Return the unexplained variance share of each joint's torque with `share` fixed at 1; 0 if too few rows move."""
    unexplained = np.zeros(found.torque.shape[1])
    for joint in range(len(unexplained)):
        moving, columns = _passive(found, joint)
        torque, links = found.torque[moving, joint], found.links[moving, joint]
        if moving.sum() >= FEW and np.ptp(torque) > 0:
            residual = torque - links
            residual = residual - columns @ np.linalg.lstsq(columns, residual, rcond=None)[0]
            unexplained[joint] = np.var(residual) / np.var(torque)
    return unexplained


def delayed(
    found: BalanceRows, joints: Sequence[int], part: slice
) -> tuple[Float[np.ndarray, "lags"], Float[np.ndarray, "lags"]]:
    """Return lags [s] of the torque and the unexplained variance share for each, mean over `joints`, in rows `part`."""
    rows = found.rows[part]
    step = max(1, round(FINEST / found.timestep))
    steps = np.arange(-(FARTHEST // found.timestep), FARTHEST // found.timestep + 1, step).astype(int)
    steps = steps[(rows[0] - steps >= 0) & (rows[-1] - steps < len(found.whole))]
    unexplained, counted = np.zeros(len(steps)), 0
    cut = found._replace(
        torque=found.torque[part], links=found.links[part], qvel=found.qvel[part], qacc=found.qacc[part]
    )
    for joint in joints:
        moving, columns = _passive(cut, joint)
        columns = np.column_stack([cut.links[moving, joint], columns])
        if moving.sum() >= FEW:
            scaled = columns / np.maximum(np.abs(columns).max(axis=0), 1e-300)
            basis, sizes, _ = np.linalg.svd(scaled, full_matrices=False)
            basis = basis[:, sizes > 1e-9 * sizes.max()]
            for index, samples in enumerate(steps):
                torque = found.whole[rows[moving] - samples, joint]
                torque = torque - torque.mean()
                total = max(float(torque @ torque), 1e-300)
                unexplained[index] += (total - float(np.sum((basis.T @ torque) ** 2))) / total
            counted += 1
    return (steps * found.timestep, unexplained / counted) if counted else (np.zeros(0), np.zeros(0))


def _passive(found: BalanceRows, joint: int) -> tuple[Bool[np.ndarray, "rows"], Float[np.ndarray, "moving 4"]]:
    """Return which rows move a joint, and their regression columns of inertia and friction."""
    speed = np.abs(found.qvel[:, joint])
    moving = speed > SLOW * np.quantile(speed, 0.99)
    qvel, qacc = found.qvel[moving, joint], found.qacc[moving, joint]
    return moving, np.column_stack([qacc, qvel, np.sign(qvel), np.ones(len(qvel))])


def _regress(
    columns: Float[np.ndarray, "rows n"], torque: Float[np.ndarray, "rows"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], float]:
    size = np.maximum(np.abs(columns).max(axis=0), 1e-300)
    scaled = columns / size
    values = np.linalg.lstsq(scaled, torque, rcond=None)[0]
    residual = torque - scaled @ values
    spread = CORRELATED * np.var(residual) * np.diag(np.linalg.pinv(scaled.T @ scaled))
    return values / size, np.sqrt(spread) / size, float(np.var(residual) / np.var(torque))
