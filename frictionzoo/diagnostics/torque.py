"""Diagnostics of a recording and its bench by the torque balance of actuators and links."""

from collections.abc import Iterator, Sequence

import numpy as np

from frictionzoo.bench import Bench
from frictionzoo.core.log import Log
from frictionzoo.diagnostics.balance import Balance, Explained, delayed
from frictionzoo.diagnostics.findings import Finding, Repair, Said, identify_delay, say_sign, turn
from frictionzoo.diagnostics.lags import WINDOWS, find_drift, pick_lag, say_drift

KNOWN = 0.1  # relative standard error below which a share counts as known
TIMES = 3.0  # factor between actuator torque and links' torque above which gear ratio or unit is wrong
MATTERS = 1.0  # smallest ratio of the variance explained by links to the unexplained one, to judge the factor
FASTEST = {"hinge": 2e4, "slide": 2e3}  # rad/s^2 or m/s^2, largest plausible acceleration under the largest torque
SLOWEST = {"hinge": 0.1, "slide": 0.01}  # rad/s^2 or m/s^2, smallest plausible acceleration
PLAIN = 0.5  # largest unexplained variance share of a torque whose inertia is judged
MUCH_BETTER = 0.5  # factor on the misfit at usual lags that another lag has to reach
EARLY, LATE = 0.01, 0.1  # s, usual range of a command's lead and delay
OFFSETS = ("force_offset", "torque_offset")  # parameters of actuator laws that do not scale the command
LEFT = 0.3  # largest unexplained variance share at which time shifts are judged


def agrees(one: Explained | None) -> bool:
    """Return whether a joint's torque is known to have the sign and scale of the links' torque."""
    return one is not None and one.error < KNOWN * one.share and 1 / TIMES < one.share < TIMES


def check_torque(
    log: Log, bench: Bench, found: Balance, explained: Sequence[Explained | None], to_position: bool
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
                yield Finding.of(fault, log.name, bench.joints[joint])


def _check_joint(bench: Bench, joint: int, one: Explained, to_position: bool) -> Iterator[Said]:
    """Check sign and scale of a joint's torque against its links' torque, or its inertia."""
    of = f" of {bench.joints[joint]}" if bench.nv > 1 else ""
    if any(param.is_identified for name, param in bench.actuator.params.items() if name not in OFFSETS):
        return  # its scale is unknown before the fit
    if one.error < KNOWN * abs(one.share):
        if one.share < 0:
            turned = ("qpos", "qvel", "ctrl") if to_position else ("ctrl",)
            signals = "data.sign.qpos, data.sign.qvel and data.sign.ctrl" if to_position else "data.sign.ctrl"
            yield (
                "opposed",
                True,
                f"ctrl{of} gives the opposite of the torque that gravity and inertia need ({one.share:.3g} times), "
                f"expected the same sign; set {signals}={say_sign(joint, bench.nv)}, or check gravity and the joint's "
                "axis in the MJCF",
                turn(joint, *turned),
            )
        elif one.links > MATTERS * one.left and not 1 / TIMES < one.share < TIMES:
            yield (
                "torque",
                not 1 / TIMES**2 < one.share < TIMES**2,
                f"the actuator{of} gives {one.share:.3g} times the torque that gravity and inertia need: a gear "
                f"ratio is missing, or ctrl has another unit; set {_torque_option(bench, 1 / one.share)}",
                _scale_torque(bench, joint, 1 / one.share),
            )
    elif np.isnan(one.share) and one.left < PLAIN and one.inertia_error < KNOWN * abs(one.inertia):
        yield from _check_inertia(bench, joint, of, one)


def _name_gains(bench: Bench) -> tuple[str, ...]:
    """Return the parameters that scale an actuator's torque."""
    proportional = (("force_gain",), ("kp", "kd"), ("torque_gain",), ("kt_over_r", "kt2_over_r"))
    return next((names for names in proportional if {*names} <= bench.actuator.params.keys()), ())


def _torque_option(bench: Bench, factor: float) -> str:
    names = _name_gains(bench)
    if names == ("force_gain",):
        return f"bench.actuator.params.force_gain.init to {factor:.3g} times its value, or data.units.ctrl={factor:.3g}"
    if not names:
        return f"the actuator's gains to {factor:.3g} times their values, or data.units"
    whose = "their values" if len(names) > 1 else "its value"
    return f"bench.actuator.params.{' and '.join(names)} to {factor:.3g} times {whose}, or data.units"


def _scale_torque(bench: Bench, joint: int, factor: float) -> tuple[Repair, ...]:
    rounded = float(f"{factor:.3g}")
    return tuple(Repair(f"bench.actuator.params.{n}.init", rounded, joint, is_factor=True) for n in _name_gains(bench))


def _check_inertia(bench: Bench, joint: int, of: str, one: Explained) -> Iterator[Said]:
    """Check the inertia of a joint without a load by the acceleration that the torque would give it."""
    slide = bench.joint_type == "slide"
    if one.inertia < 0:
        yield (
            "opposed",
            True,
            f"ctrl{of} gives a torque opposite to the acceleration, expected the same sign; set data.sign.ctrl="
            f"{say_sign(joint, bench.nv)}, or the sign of both qpos and qvel",
            turn(joint, "ctrl"),
        )
    elif not SLOWEST[bench.joint_type] < one.acceleration < FASTEST[bench.joint_type]:
        unit, per = ("kg", "m/s^2") if slide else ("kg m^2", "rad/s^2")
        fast = one.acceleration > SLOWEST[bench.joint_type]
        yield (
            "inertia",
            False,
            f"the torque{of} accelerates an inertia of {one.inertia:.3g} {unit} by up to {one.acceleration:.3g} {per}, "
            f"expected {SLOWEST[bench.joint_type]:g} to {FASTEST[bench.joint_type]:g} {per}: qpos or ctrl has another "
            f"unit; set data.units.qpos{('=mm' if slide else '=deg') if fast else ''} or data.units.ctrl",
        )


def _check_time(log: Log, found: Balance, explained: Sequence[Explained | None]) -> Iterator[Finding]:
    """Find a torque command that acts before its time, or later than a drive's delay explains."""
    joints = [joint for joint, regression in enumerate(explained) if regression is not None]
    if not joints:
        return
    lags, misfit = delayed(found, joints, slice(None))
    if not len(lags):
        return
    lag, usual = float(lags[misfit.argmin()]), misfit[(lags >= -EARLY) & (lags <= LATE)]
    drift = find_drift(
        [_window_lag(log, found, joints, rows) for rows in np.array_split(np.arange(len(found.torque)), WINDOWS)]
    )
    if drift is not None:
        yield Finding("drift", False, say_drift(drift), log.name)
    elif misfit.min() > LEFT:
        return
    elif lag < -EARLY and misfit.min() < MUCH_BETTER * usual.min():
        yield Finding(
            "early",
            True,
            f"the motion is ahead of ctrl by {-1e3 * lag:.3g} ms, expected to follow it: ctrl was recorded late; set "
            f"data.clean.command_lag={-lag:.2g} (s)",
            log.name,
            repairs=(Repair("data.clean.command_lag", float(f"{-lag:.2g}")),),
        )
    elif lag > LATE and misfit.min() < MUCH_BETTER * usual.min():
        yield Finding(
            "late",
            False,
            f"the motion lags ctrl by {1e3 * lag:.3g} ms: identify bench.params.delay "
            f"(bench.params.delay.identify=true and bench.params.delay.high={1.5 * lag:.2g}), or check that the "
            "columns have the same times",
            log.name,
            repairs=identify_delay(lag),
        )


def _window_lag(log: Log, found: Balance, joints: list[int], rows: np.ndarray) -> tuple[float, float] | None:
    lags, misfit = delayed(found, joints, slice(rows[0], rows[-1] + 1))
    lag = pick_lag(lags, misfit) if len(lags) > 2 else None
    return None if lag is None else (float(found.when[rows].mean()), lag)
