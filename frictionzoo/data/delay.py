"""Estimate of the delay from a command to its effect.

Inertia and damping cause a lag too, so a correlation cannot show the delay.

Torque command: the acceleration is regressed on the delayed command, the velocity, its sign and gravity, all from
signals behind the same zero-phase filter. The delay with the smallest residual is the estimate.

Position command: it acts through a controller. In smooth motion its delay looks like additional damping; only motion
over seconds separates the two. Therefore the drive

    qacc = stiffness * e(t - delay) - damping * qvel - dry * sign(qvel) - gravity * sin(qpos) + offset

is rolled out from measured states. `e` is the difference of command and position, limited as a motor's voltage. Damped
Gauss-Newton fits the delay and six parameters: the five above and the limit.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy.signal
from jaxtyping import Float, Int

from frictionzoo.data.recording import Recording
from frictionzoo.data.signals import GAP, Signal, estimate_velocity, find_breaks, regular_stretch, repair_spikes

FOLLOWS = 0.5  # correlation with the position above which a command is a position command
EARLIEST, LATEST = -0.03, 0.17  # s; search interval
MARGIN = 0.002  # s; a delay closer to an end of the search interval counts as not found
SPREAD = 0.03  # s; estimates with a larger interquartile range are rejected

RECORDINGS = 32  # most recordings of a torque drive, evenly spread
MOVING = 0.05  # share of the top speed below which dry friction may hold the joint
UNEXPLAINED = 0.5  # largest share of the acceleration's variance in the residual of a torque drive

STEP = 0.0025  # s; timestep of the simulation
WINDOW = 4.5  # s; with 1.5 s, delays of one drive scattered three times as much
SHORTEST = 1.0  # s; shortest window
BEFORE = 0.2  # s of commands before a window, at least the longest delay
GROUPS, WINDOWS = 12, 8  # most groups, and most windows a group
ITERATIONS = 25
OUTLIER = 0.02  # share of the spread of the positions above which the Huber loss is linear
FIT = 0.3  # largest root of the mean loss, as a share of the spread of the positions, of an accepted fit
LOGARITHMIC = 4  # number of leading parameters that are positive and fitted as logarithms
START = (800.0, 40.0, 5.0, 1.0, 0.0, 0.0, 0.02)  # stiffness, damping, dry, limit, gravity, offset, delay
LONGEST_STEP = np.array([1.0, 1.0, 1.0, 1.0, 50.0, 50.0, 0.03])  # largest step of an iteration, in the same order
DIFFERENCES = np.array([1e-3, 1e-3, 1e-3, 1e-3, 1e-2, 1e-2, 0.2 * STEP])  # steps of finite differences


class Delay(NamedTuple):
    """Delay from a command (`position` or `torque`) to its effect: median and quartiles over its estimates [s]."""

    seconds: float
    low: float
    high: float
    estimates: int
    command: str


class Windows(NamedTuple):
    """Stretches of recordings on one uniform grid, each with its group.

    Measured position [rad or m], estimated velocity at the start [rad/s or m/s], and command from `BEFORE` seconds
    before the start on.
    """

    qpos: Float[np.ndarray, "windows time"]
    qvel: Float[np.ndarray, "windows"]
    ctrl: Float[np.ndarray, "windows longer"]
    group: Int[np.ndarray, "windows"]


def estimate_delay(recordings: Sequence[Recording], joint: int = 0) -> Delay | None:
    """Estimate the delay from a command to its effect, counted from the sample on; the command is held between samples.

    Args:
        recordings: Recordings of one drive before cleaning. Under a position command, those whose fields contain the
            same numbers (gains, payload) share one simple drive.
        joint: Column of qpos and ctrl.

    Returns:
        The delay; None if recordings are too short, contain too little motion or give scattered delays.
    """
    usable = [recording for recording in recordings if recording.signals["ctrl"].shape[1] > joint]
    correlations = [_correlate(recording, joint) for recording in usable]
    if not np.isfinite(correlations).any():
        return None
    command = "position" if np.nanmedian(correlations) > FOLLOWS else "torque"
    if command == "position":
        windows = _choose_windows(usable, joint)
        delays, errors = _fit(windows) if windows else np.zeros((2, 0))
        delays = np.where(errors < FIT, delays, np.nan)
    else:
        chosen = np.unique(np.linspace(0, len(usable) - 1, RECORDINGS).astype(int))
        delays = np.array([_regress(usable[i], joint) for i in chosen])
    identified = delays[(delays > EARLIEST + MARGIN) & (delays < LATEST - MARGIN)]
    if len(identified) < max(1, 0.5 * len(delays)):
        return None
    # A held command, drawn as straight lines between samples, acts half an interval early.
    interval = float(np.median([np.median(np.diff(recording.time)) for recording in usable]))
    low, middle, high = (float(value) for value in np.quantile(identified, [0.25, 0.5, 0.75]) - interval / 2)
    return Delay(middle, low, high, len(identified), command) if high - low < SPREAD else None


def _correlate(recording: Recording, joint: int) -> float:
    """Return the correlation of command and position; NaN if one is constant."""
    pair = np.stack([recording.signals[name][:, joint] for name in ("ctrl", "qpos")])
    pair = pair[:, np.isfinite(pair).all(axis=0)]
    return float(np.corrcoef(pair)[0, 1]) if pair.shape[1] > 2 and (np.ptp(pair, axis=1) > 0).all() else np.nan


def _regress(recording: Recording, joint: int) -> float:
    """Return the torque command's delay that explains the acceleration best [s]; NaN if none does."""
    qpos, ctrl = (recording.signals[name][:, joint] for name in ("qpos", "ctrl"))
    time, qpos, ctrl = regular_stretch(recording.time, repair_spikes(qpos), ctrl)
    if len(time) < 100:
        return np.nan
    timestep = float(time[1] - time[0])
    sections = np.asarray(scipy.signal.butter(4, min(0.1 / timestep, 50.0), fs=1 / timestep, output="sos"))
    position, gravity = (scipy.signal.sosfiltfilt(sections, signal) for signal in (qpos, np.sin(qpos)))
    velocity = np.gradient(position, timestep)
    acceleration = np.gradient(velocity, timestep)
    moving = np.abs(velocity) > MOVING * np.abs(velocity).max()
    others = np.stack([velocity, np.sign(velocity), gravity, np.ones_like(velocity)], axis=1)[moving]
    delays = np.arange(EARLIEST, LATEST, max(timestep, 0.001))
    delayed = (scipy.signal.sosfiltfilt(sections, np.interp(time - delay, time, ctrl))[moving] for delay in delays)
    residuals = np.array([_unexplained(acceleration[moving], command, others) for command in delayed])
    best = int(np.argmin(residuals))
    if residuals[best] > UNEXPLAINED or best in (0, len(residuals) - 1):
        return np.nan
    before, least, after = residuals[best - 1 : best + 2]
    return float(delays[best] + 0.5 * (before - after) / (before - 2 * least + after) * (delays[1] - delays[0]))


def _unexplained(acceleration: Signal, command: Signal, others: Float[np.ndarray, "time terms"]) -> float:
    terms = np.column_stack([command, others])
    factors = np.linalg.lstsq(terms, acceleration, rcond=None)[0]
    return float(np.mean((acceleration - terms @ factors) ** 2) / max(acceleration.var(), 1e-300))


def _choose_windows(recordings: Sequence[Recording], joint: int) -> Windows | None:
    duration = float(np.median([recording.time[-1] - recording.time[0] for recording in recordings]))
    length = round(min(WINDOW, duration - 2 * BEFORE) / STEP)
    if length * STEP < SHORTEST:
        return None
    groups: dict[tuple[tuple[str, float], ...], list[Recording]] = {}
    for recording in recordings:
        numbers = {name: value for name, value in recording.fields.items() if isinstance(value, int | float)}
        groups.setdefault(tuple(sorted(numbers.items())), []).append(recording)
    ordered = [groups[key] for key in sorted(groups)]
    kept = np.unique(np.linspace(0, len(ordered) - 1, GROUPS).astype(int))
    chosen = [cut for i in kept if (cut := _cut_farthest(ordered[i], joint, length))]
    if len(chosen) == 1:  # a single group has no spread, so each window becomes a group
        chosen = [[window] for window in chosen[0]]
    if not chosen:
        return None
    group = np.repeat(np.arange(len(chosen)), [len(windows) for windows in chosen])
    qpos, qvel, ctrl = zip(*(window for windows in chosen for window in windows), strict=True)
    return Windows(np.array(qpos), np.array(qvel), np.array(ctrl), group)


Cut = tuple[Signal, float, Float[np.ndarray, "longer"]]


def _cut_farthest(recordings: Sequence[Recording], joint: int, length: int) -> list[Cut]:
    windows = [window for recording in recordings for window in _cut(recording, joint, length)]
    travelled = [float(np.abs(np.diff(qpos)).sum()) for qpos, _, _ in windows]
    return [windows[i] for i in np.argsort(travelled)[::-1][:WINDOWS] if travelled[i] > 0]


def _cut(recording: Recording, joint: int, length: int) -> list[Cut]:
    """Cut a recording into consecutive windows without gaps and with the drive enabled."""
    time, before = recording.time, round(BEFORE / STEP)
    qpos, ctrl = repair_spikes(recording.signals["qpos"][:, joint]), recording.signals["ctrl"][:, joint]
    enable = recording.signals.get("enable", np.ones((len(time), 1))).min(axis=1)
    finite = np.isfinite(qpos) & np.isfinite(ctrl) & np.isfinite(enable)
    windows = []
    for first, last in pairwise([0, *find_breaks(time, GAP), len(time)]):
        valid = first + np.flatnonzero((np.diff(time[first:last], prepend=-np.inf) > 0) & finite[first:last])
        grid = np.arange(float(time[first]), float(time[last - 1]), STEP)
        if len(valid) < 2 or len(grid) < before + length:
            continue
        q, u, on = (np.interp(grid, time[valid], values[valid]) for values in (qpos, ctrl, enable))
        interval = float(np.median(np.diff(time[valid])))
        v = estimate_velocity(q, STEP, min(0.15 / interval, 15.0), 2, recording.name)
        for start in range(before, len(grid) - length + 1, length):
            kept = slice(start - before, start + length)
            if (on[kept] > 0.5).all():
                windows.append((q[start : start + length], float(v[start]), u[kept]))
    return windows


def _fit(windows: Windows) -> tuple[Float[np.ndarray, "groups"], Float[np.ndarray, "groups"]]:
    """Fit each group; return delays [s] and root mean losses as shares of the spread of the positions."""
    count, groups = len(DIFFERENCES), int(windows.group.max()) + 1
    spread = windows.qpos.std(axis=1).clip(1e-12)
    trial = np.tile(START, (groups, 1))
    trial[:, :LOGARITHMIC] = np.log(trial[:, :LOGARITHMIC])
    best, damping, lowest = trial, np.full(groups, 1e-2), np.full(groups, np.inf)
    hessian, gradient = np.zeros((groups, count, count)), np.zeros((groups, count))
    for _ in range(ITERATIONS):
        cost, slope, curvature = _linearise(trial, windows, spread)
        better = cost < lowest
        lowest, best = np.where(better, cost, lowest), np.where(better[:, None], trial, best)
        gradient = np.where(better[:, None], slope, gradient)
        hessian = np.where(better[:, None, None], curvature, hessian)
        damping = np.where(better, damping / 4, damping * 6).clip(1e-7, 1e6)
        diagonal = np.einsum("gii->gi", hessian) + 1e-9
        damped = hessian + damping[:, None, None] * diagonal[:, None] * np.eye(count)
        step = np.linalg.solve(damped, gradient[..., None])[..., 0]
        trial = best - step.clip(-LONGEST_STEP, LONGEST_STEP)
        trial[:, :LOGARITHMIC] = trial[:, :LOGARITHMIC].clip(-6, 12)
        trial[:, -1] = trial[:, -1].clip(EARLIEST, LATEST)
    return best[:, -1], np.sqrt(lowest)


def _linearise(
    parameters: Float[np.ndarray, "groups parameters"], windows: Windows, spread: Float[np.ndarray, "windows"]
) -> tuple[
    Float[np.ndarray, "groups"],
    Float[np.ndarray, "groups parameters"],
    Float[np.ndarray, "groups parameters parameters"],
]:
    """Return each group's mean Huber loss, with Gauss-Newton gradient and Hessian by finite differences."""
    shifted = parameters[:, None] + np.vstack([np.zeros(len(DIFFERENCES)), np.diag(DIFFERENCES)])
    error = (_simulate(shifted[windows.group], windows) - windows.qpos[:, None]) / spread[:, None, None]
    error = np.nan_to_num(error, nan=1e6, posinf=1e6, neginf=-1e6).clip(-1e6, 1e6)
    residual, size = error[:, 0], np.abs(error[:, 0])
    jacobian = (error[:, 1:] - error[:, :1]) / DIFFERENCES[:, None]
    weight = np.minimum(1.0, OUTLIER / np.maximum(size, 1e-12))
    huber = np.where(size < OUTLIER, size**2, OUTLIER * (2 * size - OUTLIER))
    member = (windows.group == np.arange(len(parameters))[:, None]).astype(float)
    member /= member.sum(axis=1, keepdims=True) * residual.shape[1]
    weighted = jacobian * weight[:, None]
    slope, curvature = np.einsum("wpt,wt->wp", weighted, residual), weighted @ jacobian.transpose(0, 2, 1)
    return member @ huber.sum(axis=1), member @ slope, np.einsum("gw,wpq->gpq", member, curvature)


def _simulate(
    parameters: Float[np.ndarray, "windows trials parameters"], windows: Windows
) -> Float[np.ndarray, "windows trials time"]:
    """Simulate the positions of the simple drive; dry friction can stop it within a step."""
    stiffness, damping, dry, limit = np.exp(np.moveaxis(parameters[..., :LOGARITHMIC], -1, 0))
    gravity, offset, delay = np.moveaxis(parameters[..., LOGARITHMIC:], -1, 0)
    start = round(BEFORE / STEP) - delay / STEP
    first_index = np.floor(start).astype(int)
    fraction, row, last = start - first_index, np.arange(len(start))[:, None], windows.ctrl.shape[1] - 1
    q, v = (np.broadcast_to(x[:, None], start.shape).copy() for x in (windows.qpos[:, 0], windows.qvel))
    positions = np.empty((windows.qpos.shape[1], *start.shape))
    index = np.minimum(first_index + np.arange(len(positions))[:, None, None], last)
    commands = windows.ctrl[row, index] * (1 - fraction) + windows.ctrl[row, np.minimum(index + 1, last)] * fraction
    damping_factor, dry_step = 1 / (1 + STEP * damping), STEP * dry
    lowest, least_step = -limit, -dry_step
    # Thousands of steps of small arrays: `np.clip` and indexing would take a third of their time.
    for i, command in enumerate(commands):
        positions[i] = q
        drive = np.minimum(np.maximum(command - q, lowest), limit)
        v = (v + STEP * (stiffness * drive - gravity * np.sin(q) + offset)) * damping_factor
        v -= np.minimum(np.maximum(v, least_step), dry_step)
        q = q + STEP * v
    return np.moveaxis(positions, 0, -1)
