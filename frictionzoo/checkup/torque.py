"""What speaks against a recording, or against the bench, by the torque that its actuators give and its links need."""

from collections.abc import Iterator, Sequence

import numpy as np

from frictionzoo.bench import Bench
from frictionzoo.checkup.balance import Balance, Explained, delayed
from frictionzoo.checkup.findings import Finding, Repair, Said, identify_delay, say_sign, turn
from frictionzoo.checkup.lags import WINDOWS, find_drift, pick_lag, say_drift
from frictionzoo.core.log import Log

KNOWN = 0.1  # relative standard error up to which a share counts as known
TIMES = 3.0  # factor by which an actuator's torque differs from what links need and something else is wrong
MATTERS = 1.0  # times the unexplained variance of a torque, that links explain at the least where they are judged
FASTEST = {"hinge": 2e4, "slide": 2e3}  # rad/s^2 or m/s^2 at most of a drive under its largest torque
SLOWEST = {"hinge": 0.1, "slide": 0.01}  # and at least
PLAIN = 0.5  # share of a torque's variance that may be left where its inertia is to be told
MUCH_BETTER = 0.5  # times what is left of the torque as recorded, below which another time is the right one
EARLY, LATE = 0.01, 0.1  # s, between which a command acts, with the delay that a drive may have
OFFSETS = ("force_offset", "torque_offset")  # of actuator laws, beside what their commands ask for
LEFT = 0.3  # share of the variance that may be left of a joint whose command's time is looked at


def agrees(one: Explained | None) -> bool:
    """Whether a joint's torque is known to have the sign and the size that its links need."""
    return one is not None and one.error < KNOWN * one.share and 1 / TIMES < one.share < TIMES


def check_torque(
    log: Log, bench: Bench, found: Balance, explained: Sequence[Explained | None], to_position: bool
) -> Iterator[Finding]:
    """Signs, sizes, order and times of a recording, by its torque balance.

    Args:
        log: Accepted by the bench.
        bench: The test stand.
        found: The recording's torque balance.
        explained: How that explains the torque of each joint.
        to_position: Whether commands are positions, whose sign and time `check_following` looks at.
    """
    # Signs and sizes mean nothing of signals of different times.
    times = [] if to_position else list(_check_time(log, found, explained))
    yield from times
    for joint, one in enumerate(explained):
        if one is not None and not times:
            for said in _check_joint(bench, joint, one, to_position):
                yield Finding.of(said, log.name, bench.joints[joint])


def _check_joint(bench: Bench, joint: int, one: Explained, to_position: bool) -> Iterator[Said]:
    """Sign and size of a joint's torque against what its links need, or of its inertia."""
    of = f" of {bench.joints[joint]}" if bench.nv > 1 else ""
    if any(param.is_identified for name, param in bench.actuator.params.items() if name not in OFFSETS):
        return  # its size is not known yet
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
    """Return the parameters of an actuator to which its torque is proportional."""
    proportional = (("force_gain",), ("kp", "kd"), ("torque_gain",), ("kt_over_r", "kt2_over_r"))
    return next((names for names in proportional if {*names} <= bench.actuator.params.keys()), ())


def _torque_option(bench: Bench, factor: float) -> str:
    """Return what makes an actuator's torque so many times as large."""
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
    """The inertia of a joint without a load, which is its armature, by how fast the recorded torque makes it."""
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
    """A torque command that acts before it is given, or later than a drive's delay."""
    joints = [joint for joint, one in enumerate(explained) if one is not None]
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
