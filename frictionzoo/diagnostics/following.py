"""Diagnostics of a position and its command: sign, order of joints, scale, zero and time shift."""

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Bool, Float

from frictionzoo.bench import Bench
from frictionzoo.core.log import Log
from frictionzoo.data.signals import Signal
from frictionzoo.diagnostics.commands import takes_energy
from frictionzoo.diagnostics.findings import Finding, say_sign, turn
from frictionzoo.diagnostics.lags import SHORTEST, WINDOWS, Likeness, compare, find_drift, find_shift, pick_lag

FOLLOWS = 0.9  # correlation above which a position follows its command
IGNORES = 0.5  # correlation below which it does not
LARGER = 3.0  # scale of position over command above which units are wrong
SMALLER = 8.0  # inverse scale above which units are likely wrong
FAR_SMALLER = 20.0  # inverse scale that no weak gain explains
APART = 0.5  # smallest distance of position and command, over their motion, that indicates different zeros
DEGREE = 0.1  # relative tolerance of a factor that is recognised as a unit, such as 57.3 for degrees
MUCH_BETTER, FAR_BETTER = 0.5, 0.1  # misfit over the misfit at usual lags, below which another lag is better, certain
POOR = 0.02  # misfit at usual lags below which a position follows, even if another lag is better
EARLY = 0.01  # s, smallest lead of a position that counts
LATE, GAINS = 0.2, 2.5  # s, and times damping over stiffness: their sum is the largest usual lag
QUARTER = 0.2  # s, largest lag at which an opposite sign is sought
COPIES, ABOUT = 0.98, 0.3  # correlation, and relative deviation of the scale from 1, of a followed command
LATEST_OTHER = 0.3  # s, largest lag behind another joint's command
OTHER = 0.3  # distance to another joint's command, relative to the joint's command, below which columns are swapped


class Followed(NamedTuple):
    """A joint's position compared with its command, both without outliers [rad or m].

    Attributes:
        on: Samples in which the drive should follow.
        settles: Damping over stiffness of the actuator law, which explains a lag of the position [s].
        work: Net work of the command, as a share of the energy that it exchanges.
    """

    qpos: Signal
    ctrl: Signal
    on: Bool[np.ndarray, "time"]
    likeness: Likeness
    settles: float
    work: float


def settling(log: Log, bench: Bench, joint: int, on: Bool[np.ndarray, "time"]) -> float:
    """Return damping over stiffness of the actuator law near its desired position [s]; 0 without stiffness."""
    values, law, zero = bench.initial_values(), bench.actuator, np.zeros_like(log.qpos)
    affine, small = law.affine(values), 1e-4

    def torque(qvel: Float[np.ndarray, "time nv"], ctrl: Float[np.ndarray, "time nv"]) -> np.ndarray:
        control = law.control(np, values, zero, qvel, ctrl, log.inputs)
        return np.asarray(affine.gain * control + affine.bias2 * qvel)[on, joint]

    stiffness = float(np.median(torque(zero, zero + small) - torque(zero, zero - small)))
    damping = float(np.median(torque(zero - small, zero) - torque(zero + small, zero)))
    return max(damping / stiffness, 0.0) if stiffness > 0 else 0.0


def check_following(
    log: Log, of: str, bench: Bench, joint: int, found: Followed, drifts: bool, swapped: int | None
) -> Iterator[Finding]:
    """Find faults of a position and its command; `of` names the joint in messages.

    If the lag `drifts` over the recording, a single lag has no meaning. `swapped` is the joint whose command this joint
    follows instead, if any.
    """
    least = max(2 * log.timestep, EARLY)
    usual = found.likeness.between(-least, max(LATE, found.settles))
    best, slide = found.likeness.best, bench.joint_type == "slide"
    opposed = found.likeness.between(0.0, QUARTER).correlation.min()
    if swapped is not None:
        text = f"qpos{of} follows ctrl of {bench.joints[swapped]}: columns are swapped; put data.columns.ctrl, or "
        text += "data.columns.qpos and data.columns.qvel, into the order of the bench's joints"
        yield Finding("bad", "swapped", text)
    elif opposed < -FOLLOWS and -opposed > usual.correlation.max():
        text = f"qpos{of} moves opposite to ctrl (correlation {opposed:.2f}), expected to follow it; set "
        text += f"data.sign.ctrl={say_sign(joint, bench.nv)}, or the sign of both qpos and qvel"
        yield Finding("bad", "opposed", text, repairs=turn(joint, "ctrl"))
    elif found.likeness.correlation[best] < IGNORES:
        text = f"qpos{of} does not follow ctrl at any time (correlation {found.likeness.correlation[best]:.2f}): check "
        text += "that ctrl is a desired position (bench.actuator, or another bench) of this joint (data.columns.ctrl)"
        yield Finding("bad" if takes_energy(bench, joint, found.work) else "caution", "ignored", text)
    elif found.likeness.correlation[best] > FOLLOWS:
        yield from () if drifts else _check_time(of, found, least)
        yield from _check_size(of, found, slide)


def find_swaps(log: Log, followed: Mapping[int, Followed]) -> dict[int, int]:
    """Map each joint to the joint whose command it follows instead, if exchanged commands suit them all."""
    suspects = [
        joint
        for joint, pair in followed.items()
        if pair.likeness.between(0.0, LATEST_OTHER).distance.min() > OTHER * np.std(pair.qpos[pair.on])
    ]
    cost = np.zeros((len(suspects), len(suspects)))
    for row, joint in enumerate(suspects):
        pair = followed[joint]
        for column, other in enumerate(suspects):
            likeness = compare(pair.qpos, followed[other].ctrl, log.timestep, pair.on).between(0.0, LATEST_OTHER)
            cost[row, column] = float(likeness.distance.min())
    assigned = zip(*scipy.optimize.linear_sum_assignment(cost**2), strict=True)
    swaps = [(row, column) for row, column in assigned if row != column]
    are_closer = all(cost[row, column] < OTHER * cost[row, row] for row, column in swaps)
    return {suspects[row]: suspects[column] for row, column in swaps} if are_closer else {}


def check_asked(log: Log, of: str, joint: int) -> Iterator[Finding]:
    """Find a torque command that the position follows like a desired position."""
    ctrl = log.ctrl[:, joint]
    if np.ptp(ctrl) > 0:
        likeness = compare(log.qpos[:, joint], ctrl, log.timestep, np.ones(log.samples, bool)).between(0.0, LATE)
        if likeness.correlation.max() > COPIES and abs(likeness.scale[likeness.best] - 1) < ABOUT:
            text = f"qpos{of} follows ctrl like a desired position (correlation {likeness.correlation.max():.3f}, "
            text += f"ratio {likeness.scale[likeness.best]:.2f}), expected a torque or force: choose the "
            text += "bench of these recordings (bench=NAME) or a position actuator (bench.actuator._target_)"
            yield Finding("caution", "asked", text)


def check_drift(log: Log, found: Followed) -> Finding | None:
    """Find a lag behind the command that changes over the recording."""
    lags = []
    for window in np.array_split(np.arange(log.samples), WINDOWS):
        around = slice(max(0, window[0] - len(window)), window[-1] + len(window))  # lags need commands on both sides
        inside = np.zeros(log.samples, bool)
        inside[window] = found.on[window]
        lag = None
        if inside.sum() >= SHORTEST:
            likeness = compare(found.qpos[around], found.ctrl[around], log.timestep, inside[around])
            follows = len(likeness.lags) > 2 and likeness.correlation.max() > FOLLOWS
            lag = pick_lag(likeness.lags, likeness.misfit) if follows else None
        lags.append(None if lag is None else (float(log.time[window].mean()), lag))
    return find_drift(lags)


def _check_time(of: str, found: Followed, least: float) -> Iterator[Finding]:
    """Find a position that is ahead of its command, or later than the drive explains."""
    likeness, lag = found.likeness, float(found.likeness.lags[found.likeness.best])
    late = LATE + GAINS * found.settles
    # A periodic command matches equally well a period later.
    usual = float(likeness.between(-least, late).misfit.min())
    ratio, is_poor = float(likeness.misfit.min()) / max(usual, 1e-12), usual > POOR
    is_early = lag < -least and (ratio < MUCH_BETTER if found.work < 0 else ratio < FAR_BETTER and is_poor)
    if is_early or (lag > late and ratio < MUCH_BETTER and is_poor):
        yield find_shift(f"qpos{of}", lag, found.settles)


def _check_size(of: str, found: Followed, slide: bool) -> Iterator[Finding]:
    scale = float(found.likeness.scale[found.likeness.best])
    qpos, ctrl = found.qpos[found.on], found.ctrl[found.on]
    moved, asked, apart = np.ptp(qpos), np.ptp(ctrl), float(np.abs(qpos - ctrl).min())
    if scale > LARGER or scale < 1 / SMALLER:
        text = f"qpos{of} spans {moved:.3g} and ctrl {asked:.3g}, ratio {scale:.4g}: "
        text += f"set {_mend(scale, slide)}"
        yield Finding("bad" if scale > LARGER or scale < 1 / FAR_SMALLER else "caution", "size", text)
    elif apart > APART * max(moved, asked):
        text = f"qpos{of} and ctrl differ by at least {apart:.3g}, for a motion of {max(moved, asked):.3g}: check that "
        text += "both have the same zero (bench.params.position_offset)"
        yield Finding("caution", "zero", text)


def _mend(scale: float, slide: bool) -> str:
    """Return the unit or gear ratio that gives a position the scale of its command."""
    signal, factor = ("qpos", scale) if scale > 1 else ("ctrl", 1 / scale)
    unit, size = ("mm", 1000.0) if slide else ("deg", 180 / math.pi)
    alike = " (and data.units.qvel)" if signal == "qpos" else ""
    if abs(factor / size - 1) < DEGREE:
        return f"data.units.{signal}={unit}{alike}"
    return (
        f"data.units.{signal}={unit} if it is in {unit} ({size:.3g} times), or, for a missing gear ratio, "
        f"data.units.{signal}={1 / factor:.3g}{alike}"
    )
