"""Diagnostics of a recording and its bench by the torque balance of actuators and links."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import mujoco
import numpy as np

from frictionzoo.bench import Bench
from frictionzoo.core.log import Log
from frictionzoo.diagnostics.balance import BalanceRows, TorqueRegression, balance, delayed, explain
from frictionzoo.diagnostics.findings import Finding, Repair, of_joint, say_sign, turn
from frictionzoo.diagnostics.lags import WINDOWS, find_drift, find_shift, pick_lag

KNOWN = 0.1  # relative standard error below which a share counts as known
TIMES = 3.0  # factor between actuator torque and links' torque above which gear ratio or unit is wrong
MATTERS = 1.0  # smallest ratio of the variance explained by links to the unexplained one, to judge the factor
FASTEST = {"hinge": 2e4, "slide": 2e3}  # rad/s^2 or m/s^2, largest plausible acceleration under the largest torque
SLOWEST = {"hinge": 0.1, "slide": 0.01}  # rad/s^2 or m/s^2, smallest plausible acceleration
PLAIN = 0.5  # largest unexplained variance share of a torque whose inertia is judged
MUCH_BETTER = 0.5  # factor on the misfit at usual lags that another lag has to reach
EARLY, LATE = 0.01, 0.1  # s, usual range of a command's lead and delay
SUITS = 0.3  # largest deviation from 1 of the ratio of recorded to needed torque, in the right unit
ANGLES = {"rev": math.tau, "deg": math.pi / 180}
"""Units of angles that are tried in place of radians, in rad."""
OFFSETS = ("force_offset", "torque_offset")  # parameters of actuator laws that do not scale the command
LEFT = 0.3  # largest unexplained variance share at which time shifts are judged


def agrees(one: TorqueRegression | None) -> bool:
    """Return whether a joint's torque is known to have the sign and scale of the links' torque."""
    return one is not None and one.error < KNOWN * one.share and 1 / TIMES < one.share < TIMES


def check_torque(
    log: Log, bench: Bench, found: BalanceRows, explained: Sequence[TorqueRegression | None], to_position: bool
) -> Iterator[Finding]:
    """Check signs, scales and times of an accepted log by its torque balance and each joint's regression.

    `to_position` is whether commands are desired positions, whose sign and time `check_following` checks.
    """
    # Signs and scales have no meaning if the signals are shifted in time.
    shifts = [] if to_position else list(_check_time(log, found, explained))
    yield from shifts
    for joint, regression in enumerate(explained):
        if regression is not None and not shifts:
            for fault in _check_joint(bench, joint, regression, to_position):
                yield replace(fault, log=log.name, joint=bench.joints[joint])


def check_recorded(log: Log, bench: Bench, model: mujoco.MjModel) -> Iterator[Finding]:
    """Find positions in another unit by the recorded torque, which must carry the links' weight and inertia."""
    torque = log.extras.get("torque")
    if torque is None or torque.shape != log.qpos.shape or bench.joint_type != "hinge":
        return
    in_radians = _explain_recorded(log, bench, model, torque, 1.0)
    doubtful = {joint: one for joint, one in enumerate(in_radians) if one is not None and not agrees(one)}
    others = {unit: _explain_recorded(log, bench, model, torque, factor) for unit, factor in ANGLES.items() if doubtful}
    for joint, one in doubtful.items():
        of = of_joint(bench.joints, joint)
        # But for friction, in the right unit the torque is the one that the links need.
        regressions = {unit: found[joint] for unit, found in others.items()}
        suits = [
            unit
            for unit, other in regressions.items()
            if other and agrees(other) and abs(other.share - 1) < SUITS and other.left < PLAIN and other.links > KNOWN
        ]
        if suits or one.error < KNOWN * abs(one.share):
            text = f"the recorded torque{of} is {one.share:.3g} times the torque that gravity "
            text += "and inertia need for the motion, expected about 1: their units differ; set "
            text += f"data.units.qpos={suits[0]} (also for qvel and a desired position)" if suits else "data.units.qpos"
            text += ", or data.units.torque and data.sign.torque, or check the links' masses"
            yield Finding(
                "bad" if suits else "caution", "recorded torque", text, log=log.name, joint=bench.joints[joint]
            )


def _explain_recorded(
    log: Log, bench: Bench, model: mujoco.MjModel, torque: np.ndarray, factor: float
) -> list[TorqueRegression | None]:
    """Return each joint's regression of the recorded torque, with positions and velocities times a factor."""
    found = balance(replace(log, qpos=factor * log.qpos, qvel=factor * log.qvel), bench, model, torque)
    return [None if found is None else explain(found, joint) for joint in range(bench.nv)]


def _check_joint(bench: Bench, joint: int, one: TorqueRegression, to_position: bool) -> Iterator[Finding]:
    """Check sign and scale of a joint's torque against its links' torque, or its inertia."""
    of = of_joint(bench.joints, joint)
    if any(param.is_identified for name, param in bench.actuator.params.items() if name not in OFFSETS):
        return  # its scale is unknown before the fit
    if one.error < KNOWN * abs(one.share):
        if one.share < 0:
            turned = ("qpos", "qvel", "ctrl") if to_position else ("ctrl",)
            signals = "data.sign.qpos, data.sign.qvel and data.sign.ctrl" if to_position else "data.sign.ctrl"
            text = f"ctrl{of} gives the opposite of the torque that gravity and inertia need ({one.share:.3g} times), "
            text += f"expected the same sign; set {signals}={say_sign(joint, bench.nv)}, or check gravity and the "
            text += "joint's axis in the MJCF"
            yield Finding("bad", "opposed", text, repairs=turn(joint, *turned))
        elif one.links > MATTERS * one.left and not 1 / TIMES < one.share < TIMES:
            option, repairs = _scale_torque(bench, joint, 1 / one.share)
            text = f"the actuator{of} gives {one.share:.3g} times the torque that gravity and inertia need: a gear "
            text += f"ratio is missing, or ctrl has another unit; set {option}"
            state = "caution" if 1 / TIMES**2 < one.share < TIMES**2 else "bad"
            yield Finding(state, "torque", text, repairs=repairs)
    elif np.isnan(one.share) and one.left < PLAIN and one.inertia_error < KNOWN * abs(one.inertia):
        yield from _check_inertia(bench, joint, of, one)


def _scale_torque(bench: Bench, joint: int, factor: float) -> tuple[str, tuple[Repair, ...]]:
    """Return the options that scale an actuator's torque, in words and as repairs."""
    proportional = (("force_gain",), ("kp", "kd"), ("torque_gain",), ("kt_over_r", "kt2_over_r"))
    names = next((names for names in proportional if {*names} <= bench.actuator.params.keys()), ())
    whose = "its value" if len(names) == 1 else "their values"
    option = f"bench.actuator.params.{' and '.join(names)}" if names else "the actuator's gains"
    units = "data.units"
    if names == ("force_gain",):
        option, units = f"{option}.init", f"data.units.ctrl={factor:.3g}"
    gains = (f"bench.actuator.params.{name}.init" for name in names)
    repairs = tuple(Repair(gain, float(f"{factor:.3g}"), joint, is_factor=True) for gain in gains)
    return f"{option} to {factor:.3g} times {whose}, or {units}", repairs


def _check_inertia(bench: Bench, joint: int, of: str, one: TorqueRegression) -> Iterator[Finding]:
    """Check the inertia of a joint without a load by the acceleration that the torque would give it."""
    slide = bench.joint_type == "slide"
    if one.inertia < 0:
        text = f"ctrl{of} gives a torque opposite to the acceleration, expected the same sign; set "
        text += f"data.sign.ctrl={say_sign(joint, bench.nv)}, or the sign of both qpos and qvel"
        yield Finding("bad", "opposed", text, repairs=turn(joint, "ctrl"))
    elif not SLOWEST[bench.joint_type] < one.acceleration < FASTEST[bench.joint_type]:
        unit, per = ("kg", "m/s^2") if slide else ("kg m^2", "rad/s^2")
        fast = one.acceleration > SLOWEST[bench.joint_type]
        text = f"the torque{of} accelerates an inertia of {one.inertia:.3g} {unit} by up to {one.acceleration:.3g} "
        text += f"{per}, expected {SLOWEST[bench.joint_type]:g} to {FASTEST[bench.joint_type]:g} {per}: qpos or ctrl "
        text += f"has another unit; set data.units.qpos{('=mm' if slide else '=deg') if fast else ''} or "
        text += "data.units.ctrl"
        yield Finding("caution", "inertia", text)


def _check_time(log: Log, found: BalanceRows, explained: Sequence[TorqueRegression | None]) -> Iterator[Finding]:
    """Find a torque command that acts before its time, or later than a drive's delay explains."""
    joints = [joint for joint, regression in enumerate(explained) if regression is not None]
    if not joints:
        return
    lags, misfit = delayed(found, joints, slice(None))
    if not len(lags):
        return
    lag, usual = float(lags[misfit.argmin()]), misfit[(lags >= -EARLY) & (lags <= LATE)]
    windows = np.array_split(np.arange(len(found.torque)), WINDOWS)

    def find_lag(rows: np.ndarray) -> tuple[float, float] | None:
        lags, misfit = delayed(found, joints, slice(rows[0], rows[-1] + 1))
        lag = pick_lag(lags, misfit) if len(lags) > 2 else None
        return None if lag is None else (float(found.when[rows].mean()), lag)

    if (drift := find_drift([find_lag(rows) for rows in windows])) is not None:
        yield replace(drift, log=log.name)
    elif misfit.min() <= LEFT and not -EARLY <= lag <= LATE and misfit.min() < MUCH_BETTER * usual.min():
        yield replace(find_shift("the motion", lag), log=log.name)
