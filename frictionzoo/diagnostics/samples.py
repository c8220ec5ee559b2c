"""Diagnostics of single signals, and of the measured velocity against the position."""

import math
from collections.abc import Iterator, Mapping

import numpy as np
from jaxtyping import Float

from frictionzoo.bench import Bench
from frictionzoo.core.log import Log
from frictionzoo.data.signals import (
    LONGEST_LAG,
    Signal,
    derive_velocity,
    find_outliers,
    find_quantum,
    find_velocity_lag,
    find_wrap,
    repair_spikes,
)
from frictionzoo.data.units import could_be_degrees
from frictionzoo.diagnostics.findings import Finding, Repair, of_joint
from frictionzoo.diagnostics.lags import compare

LAGGING = 0.004  # s, largest accepted lag of a measured velocity
UNITS = 0.1  # relative deviation of a measured velocity from the derivative above which it is reported
OTHER_UNITS = 3.0  # factor between them that no filter explains
UNLIKE = 0.5  # correlation below which a velocity does not belong to the position
STILL = 5  # encoder steps; a joint with less motion stands still
NOISE = 0.5  # ratio of steps between samples to spread, relative to white noise, above which a position is noise
SMOOTH = 0.01  # interpolation error, as a share of the spread, below which a position can judge a velocity
COARSE = 0.05  # interpolation error, as a share of the spread, above which sampling is too slow
FROZEN = 20  # repeated samples before a jump that indicate a frozen sensor
JUMP = 5.0  # factor on the largest usual step between samples that makes a jump
SPIKE = 0.05  # size of a spike, as a share of the motion
GAINS = ("kp", "kd")  # commands that move nothing by themselves
SHORT = 100  # samples; in shorter recordings, signals are not compared with each other
SLOWEST, FASTEST = 0.5, 2e-5  # s, plausible sample intervals
TURNS = 3.0  # a larger range of an angle may be in degrees
STROKE = 5.0  # m; a larger range of a slide may be in millimetres
FILLED = 0.1  # smallest share of a joint's limits that a motion in degrees covers
FAST = 50.0  # m/s, implausible for a slide
BITS = range(8, 25)  # of encoders, whose step is a turn over a power of two
EXACT = 0.002  # relative tolerance of such a step
FACTORS = {180 / math.pi: "deg", 60 / math.tau: "rpm", 1000.0: "mm"}


def check_clock(log: Log) -> Iterator[Finding]:
    """Find implausible sample intervals, which indicate another unit of time."""
    if not FASTEST <= log.timestep <= SLOWEST:
        unit = "ms" if log.timestep < 1e3 * SLOWEST else "us"
        text = f"{log.timestep:.3g} s between samples, expected {FASTEST:g} to {SLOWEST:g} s in a drive's recording; "
        text += f"set data.units.time{'=' + unit if log.timestep > SLOWEST else ''}, or, if the times are correct, "
        text += "record faster or set a shorter data.clean.step"
        yield Finding("bad", "clock", text, log=log.name)


def check_signals(
    log: Log, bench: Bench, joint: int, cleaned: Mapping[str, Float[np.ndarray, "time nv"]]
) -> Iterator[Finding]:
    """Check each signal of a joint, and replace outliers in `cleaned` by linear interpolation for all later checks."""
    of = of_joint(bench.joints, joint)
    for name, signals in cleaned.items():
        values = signals[:, joint]
        far = find_outliers(values)
        if name == "qpos":  # also spikes within the motion
            repaired = repair_spikes(values)
            far |= np.abs(values - repaired) > SPIKE * np.ptp(repaired)
        if far.any():
            index = int(np.argmax(np.where(far, np.abs(values - np.median(values)), -1.0)))
            text = f"{name}{of} has outliers ({far.sum()}), such as {values[index]:.4g} at {log.time[index]:.4g} s; "
            text += "set data.clean.spikes=repair"
            yield Finding("caution", f"outliers {name}", text, repairs=(Repair("data.clean.spikes", "repair"),))
            signals[:, joint] = np.interp(np.arange(len(values)), np.flatnonzero(~far), values[~far])
    qpos, qvel, ctrl = (cleaned[name][:, joint] for name in ("qpos", "qvel", "ctrl"))
    held = len(bench.joints) > 1 and np.ptp(ctrl) == 0 and not has_more(log, bench, joint)
    if held and _find_still(of, qpos, ctrl):
        return  # commanded to stand still while others move: the check of the command reports it
    fault = _find_still(of, qpos, ctrl) or _find_noise(of, qpos)
    if fault is None and bench.joint_type == "hinge":
        fault = _find_wrapping(of, qpos)
    if fault is not None:
        yield fault
        return
    if (apart := _apart(qpos)) > COARSE:
        text = f"qpos{of} differs from an interpolation of its neighbouring samples by {100 * apart:.0f} % of its "
        text += "spread: it is sampled too slowly and may be aliased; record faster, or set a shorter data.clean.step"
        yield Finding("caution", "coarse", text)
    yield from _find_frozen(of, qpos)
    yield from _check_velocity(log, of, joint, qpos, qvel)
    span, speed = float(np.ptp(qpos)), float(np.quantile(np.abs(qvel), 0.99))
    if bench.joint_type == "slide" and (span > STROKE or speed > FAST):
        text = f"qpos{of} moves by {span:.3g} m at up to {speed:.3g} m/s: it looks like millimetres; set "
        text += "data.units.qpos=mm (also for qvel and a desired position)"
        yield Finding("bad" if speed > FAST else "caution", "stroke", text)


def _find_still(of: str, qpos: Signal, ctrl: Signal) -> Finding | None:
    moved, quantum = float(np.ptp(qpos)), find_quantum(qpos) or 0.0
    if moved > STILL * quantum and moved > 1e-9 * max(1.0, float(np.abs(qpos).max())):
        return None
    text = f"qpos{of} spans only {moved:.3g}, while ctrl spans {np.ptp(ctrl):.3g}; expected a moving drive; check "
    text += "whether it was on, and data.columns.qpos"
    return Finding("bad", "still", text)


def _find_noise(of: str, qpos: Signal) -> Finding | None:
    # Steps between samples of white noise have twice its variance, of a motion that is sampled fast almost none.
    ratio = float(np.std(np.diff(qpos)) / (np.std(qpos) * np.sqrt(2)))
    if len(qpos) <= 20 or ratio <= NOISE:
        return None
    text = f"qpos{of} jumps between samples like noise ({100 * ratio:.0f} % of white noise), expected a motion; check "
    text += "data.columns.qpos and the sensor, or record faster, with a data.clean.step no longer than the sample "
    text += "interval"
    return Finding("bad", "noise", text)


def _find_wrapping(of: str, qpos: Signal) -> Finding | None:
    period = find_wrap(qpos)
    if period is None:
        return None
    jumps = np.abs(np.diff(qpos)) > 0.5 * period
    turn = "a whole turn" if period == math.tau else f"{period:.6g} rad"
    unit = {360.0: "deg", 1.0: "rev"}.get(period, "")
    unit = f"; if this is a whole turn, set data.units.qpos{'=' + unit if unit else ''} instead, and the period in rad"
    text = f"qpos{of} jumps by {turn} {jumps.sum()} times, first at sample {int(np.argmax(jumps)) + 1}, expected a "
    text += f"continuous angle; set data.clean.wrap={period:.16g}{'' if period == math.tau else unit}"
    repairs = (Repair("data.clean.wrap", period),) if period == math.tau else ()
    return Finding("bad", "wrapping", text, repairs=repairs)


def _apart(qpos: Signal) -> float:
    """Return the RMS error of a cubic interpolation from two samples on either side, as a share of the spread."""
    if len(qpos) <= 20:
        return 0.0
    interpolated = (9 * (qpos[2:-4] + qpos[4:-2]) - (qpos[:-6] + qpos[6:])) / 16
    return float(np.sqrt(np.mean((qpos[3:-3] - interpolated) ** 2)) / np.std(qpos))


def _find_frozen(of: str, qpos: Signal) -> Iterator[Finding]:
    """Find a position that stays constant and then jumps."""
    steps, quantum = np.abs(np.diff(qpos)), find_quantum(qpos) or 0.0
    edges = np.flatnonzero(np.diff(np.concatenate([[False], steps == 0, [False]]).astype(int)))
    usual = float(np.quantile(steps, 0.99))
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        if last - first >= FROZEN and last < len(steps) and steps[last] > max(JUMP * usual, 3 * quantum):
            text = f"qpos{of} is constant from sample {first} on and jumps by {steps[last]:.3g} at sample {last + 1}: "
            text += "the sensor seems frozen; remove this part of the recording"
            yield Finding("caution", "frozen", text)
            return


def check_turns(of: str, log: Log, joint: int, limits: np.ndarray) -> Iterator[Finding]:
    """Find an angle that seems to be in degrees, by its range, the encoder step and the limits of the file."""
    qpos = log.qpos[:, joint]
    span, low, high = float(np.ptp(qpos)), *limits
    degrees = np.radians(qpos)
    if span <= TURNS * math.tau and not high - low < span:
        return
    beyond = float(np.mean((qpos < low) | (qpos > high)))
    inside = bool(((degrees >= low) & (degrees <= high)).all()) and beyond > 0.5
    inside = inside and float(np.ptp(degrees)) > FILLED * (high - low)
    quantum = find_quantum(qpos)
    counts = quantum is not None and _is_step(quantum, 360.0) and not _is_step(quantum, math.tau)
    if span <= TURNS * math.tau and not (inside and counts):
        return
    if not (inside or counts or could_be_degrees(qpos, log.time)):
        return
    why = ["its encoder step divides 360"] if counts else []
    why += ["it is within the joint's limits only if in degrees"] if inside else []
    text = f"qpos{of} spans {span / math.tau:.3g} turns{'; ' + ', '.join(why) if why else ''}: it looks like degrees; "
    text += "set data.units.qpos=deg (also for qvel and a desired position), or, if measured before a gear, the gear "
    text += "ratio, as in data.units.qpos=0.02"
    yield Finding("bad" if why else "caution", "degrees", text)


def _is_step(quantum: float, turn: float) -> bool:
    bits = math.log2(turn / quantum) if quantum > 0 else 0.0
    return round(bits) in BITS and abs(turn / 2 ** round(bits) / quantum - 1) < EXACT


def _check_velocity(log: Log, of: str, joint: int, qpos: Signal, qvel: Signal) -> Iterator[Finding]:
    """Compare the measured velocity of a joint that moves with the derivative of its position."""
    estimate, repairs = "set data.clean.velocity=estimated", (Repair("data.clean.velocity", "estimated"),)
    if joint in log.without_velocity:
        if not log.velocity_estimated:
            hint = "if another column has the velocity, set data.columns.qvel"
            text = f"the velocity{of} is estimated from qpos, not read from the recording; {hint}"
            yield Finding("caution", "velocity", text)
        return
    if not np.ptp(qvel) > 0:
        text = f"qvel{of} is constant, expected the velocity of a joint that moves; {estimate}"
        yield Finding("bad", "velocity", text, repairs=repairs)
        return
    lag_and_scale = find_velocity_lag(log.time, qpos, qvel)
    if lag_and_scale is None and find_velocity_lag(log.time, qpos, -qvel) is not None:
        text = f"qvel{of} and the position's derivative have opposite signs, expected the same; set data.sign.qvel=-1, "
        text += "or data.sign.qpos=-1 if this matches the command"
        yield Finding("bad", "velocity sign", text)
    elif lag_and_scale is None and len(qpos) > SHORT:
        derived = derive_velocity(log.time, qpos)
        length = min(len(derived), len(qvel))
        likeness = compare(qvel[:length], derived[:length], log.timestep, np.ones(length, bool))
        correlation = likeness.between(-LONGEST_LAG, LONGEST_LAG).correlation.max()
        # If a joint hardly moves, both are noise.
        text = f"qvel{of} does not match the position's derivative: check for swapped columns (data.columns.qvel), "
        text += f"or {estimate}"
        state = "bad" if correlation < UNLIKE and _apart(qpos) < SMOOTH else "caution"
        yield Finding(state, "velocity", text, repairs=repairs)
    elif lag_and_scale is not None:
        lag, scale = lag_and_scale
        if abs(lag) > max(LAGGING, 0.75 * log.timestep):
            late, other = ("qvel", "qpos") if lag > 0 else ("qpos", "qvel")
            text = f"{late}{of} lags {other} by {1e3 * abs(lag):.3g} ms; set data.clean.velocity_lag=auto or "
            text += f"data.clean.velocity=estimated{', and identify bench.params.delay' if late == 'qpos' else ''}"
            removal = (Repair("data.clean.velocity_lag", "auto"),) if lag > 0 else repairs
            yield Finding("caution", "lag", text, repairs=removal)
        if abs(scale - 1) > UNITS:
            unit = _suggest(scale)
            text = f"qvel{of} is {scale:.4g} times the position's derivative: check the units of time, qpos and qvel "
            text += f"(data.units{unit}), or set data.clean.velocity=estimated"
            state = "caution" if 1 / OTHER_UNITS < scale < OTHER_UNITS else "bad"
            yield Finding(state, "units", text, repairs=() if unit else repairs)


def _suggest(scale: float) -> str:
    """Return the unit option that explains a velocity of `scale` times the position's derivative; empty if none."""
    for factor, unit in FACTORS.items():
        if abs(scale / factor - 1) < UNITS:
            or_time = " or data.units.time=ms" if unit == "mm" else ""
            return f", such as data.units.qvel={unit}{'' if unit == 'rpm' else '/s'}{or_time}"
        if abs(scale * factor - 1) < UNITS and unit != "rpm":
            return f", such as data.units.qpos={unit}"
    return ""


def has_more(log: Log, bench: Bench, joint: int) -> bool:
    """Return whether a joint receives another varying command than `ctrl`."""
    return any(np.ptp(log.inputs[name][:, joint]) > 0 for name in bench.actuator.commands if name not in GAINS)
