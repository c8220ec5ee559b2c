"""What one signal of one joint says by itself, and the measured velocity beside the position."""

import math
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool

from frictionzoo.bench import Bench
from frictionzoo.checkup.findings import Finding, Repair, Said
from frictionzoo.checkup.lags import compare
from frictionzoo.core.log import Log
from frictionzoo.logs.signals import (
    LONGEST_LAG,
    Signal,
    derive_velocity,
    find_outliers,
    find_quantum,
    find_velocity_lag,
    repair_spikes,
)

LAGGING = 0.004  # s, by which a measured velocity may lag the position
UNITS = 0.1  # relative difference of a measured velocity and the derivative from which on it is told
OTHER_UNITS = 3.0  # factor between them that no filter explains
UNLIKE = 0.5  # correlation below which a velocity has nothing to do with the position
STILL = 5  # steps of the encoder; a joint that moves through less stands still
NOISE = 0.5  # of the largest ratio of the steps between samples to the spread, which is that of white noise
SMOOTH = 0.01  # the same of a position that is known well enough to judge a velocity by
COARSE = 0.05  # share of the motion that its neighbours do not tell of a sample, from which on sampling is too slow
FROZEN = 20  # samples in which a sensor repeats itself before it jumps
JUMP = 5.0  # times the largest usual step between samples that is a jump
SPIKE = 0.05  # share of the motion that a spike within it leaves its neighbours by
SHORT = 100  # samples; in fewer, signals are not compared with each other
SLOWEST, FASTEST = 0.5, 2e-5  # s; no recording of a drive has longer or shorter sample intervals
TURNS = 3.0  # a joint that turns through more may be in degrees
STROKE = 5.0  # m; a slide that moves through more may be in millimetres
FILLED = 0.1  # share of the limits of a joint that a motion in degrees goes through at the least
FAST = 50.0  # m/s; no slide does
BITS = range(8, 25)  # of encoders, whose step is a turn over a power of two
EXACT = 0.002  # relative difference within which a step is such a one
FACTORS = {180 / math.pi: "deg", 60 / math.tau: "rpm", 1000.0: "mm"}


def check_clock(log: Log) -> Iterator[Finding]:
    """Times of another unit."""
    if not FASTEST <= log.timestep <= SLOWEST:
        unit = "ms" if log.timestep < 1e3 * SLOWEST else "us"
        yield Finding(
            "clock",
            True,
            f"{log.timestep:.3g} s between samples, expected {FASTEST:g} to {SLOWEST:g} s in a drive's recording; set "
            f"data.units.time{'=' + unit if log.timestep > SLOWEST else ''}, or, if the times are correct, record "
            "faster or set a shorter data.clean.step",
            log.name,
        )


def find_isolated(name: str, values: Signal) -> Bool[np.ndarray, "time"]:
    """Samples of a signal of this name that stand apart from those before and after them."""
    far = find_outliers(values)
    if name == "qpos":
        repaired = repair_spikes(values)
        far |= np.abs(values - repaired) > SPIKE * np.ptp(repaired)
    return far


def say_outliers(log: Log, what: str, values: Signal, far: Bool[np.ndarray, "time"]) -> str:
    """A sentence on the samples of a signal that stand apart."""
    at = int(np.argmax(np.where(far, np.abs(values - np.median(values)), -1.0)))
    return (
        f"{what} has outliers ({far.sum()}), such as {values[at]:.4g} at {log.time[at]:.4g} s; "
        "set data.clean.spikes=repair"
    )


def leave_out(values: Signal, far: Bool[np.ndarray, "time"]) -> Signal:
    """A signal with a straight line in place of some samples."""
    kept = np.flatnonzero(~far)
    return np.interp(np.arange(len(values)), kept, values[kept]) if far.any() else values


def check_position(of: str, qpos: Signal, ctrl: Signal, bench: Bench) -> Iterator[Said]:
    """What the position says alone: kind, whether it is certain, and a sentence. After what is certain, no more."""
    found: Said | None = _find_still(of, qpos, ctrl) or _find_noise(of, qpos)
    if found is None and bench.joint_type == "hinge":
        found = _find_wrapping(of, qpos)
    if found is not None:
        yield found
        return
    yield from _find_coarse(of, qpos)
    yield from _find_frozen(of, qpos)


def _find_still(of: str, qpos: Signal, ctrl: Signal) -> tuple[str, bool, str] | None:
    moved, quantum = float(np.ptp(qpos)), find_quantum(qpos) or 0.0
    if moved > STILL * quantum and moved > 1e-9 * max(1.0, float(np.abs(qpos).max())):
        return None
    return (
        "still",
        True,
        f"qpos{of} moves by {moved:.3g} in all, while ctrl spans {np.ptp(ctrl):.3g}; expected a moving drive; "
        "check whether it was on, and data.columns.qpos",
    )


def _find_noise(of: str, qpos: Signal) -> tuple[str, bool, str] | None:
    # Steps between samples of white noise have a variance of two, of a motion that is sampled fast next to none.
    ratio = float(np.std(np.diff(qpos)) / (np.std(qpos) * np.sqrt(2)))
    if len(qpos) <= 20 or ratio <= NOISE:
        return None
    return (
        "noise",
        True,
        f"qpos{of} jumps between samples like noise ({100 * ratio:.0f} % of white noise), expected a motion; check "
        "data.columns.qpos and the sensor, or record faster, with a data.clean.step no longer than the sample interval",
    )


def _find_wrapping(of: str, qpos: Signal) -> Said | None:
    steps = np.diff(qpos)
    turns = np.abs(np.abs(steps) - 2 * np.pi) < 0.1 * np.pi
    if not turns.any() or np.median(np.abs(steps)) >= 0.1:
        return None
    return (
        "wrapping",
        True,
        f"qpos{of} jumps by a whole turn {turns.sum()} times, first at sample {int(np.argmax(turns)) + 1}, "
        "expected a continuous angle; set data.clean.wrap=6.283185307179586",
        (Repair("data.clean.wrap", math.tau),),
    )


def _find_coarse(of: str, qpos: Signal) -> Iterator[tuple[str, bool, str]]:
    """A motion of which the samples on either side of one do not tell where it is: its frequencies may be folded."""
    apart = _apart(qpos)
    if apart > COARSE:
        yield (
            "coarse",
            False,
            f"qpos{of} differs from an interpolation of its neighbouring samples by {100 * apart:.0f} % of its spread: "
            "it is sampled too slowly and may be aliased; record faster, or set a shorter data.clean.step",
        )


def _apart(qpos: Signal) -> float:
    """Root mean square of what a cubic through the two samples on either side misses, as a share of the spread."""
    if len(qpos) <= 20:
        return 0.0
    between = (9 * (qpos[2:-4] + qpos[4:-2]) - (qpos[:-6] + qpos[6:])) / 16
    return float(np.sqrt(np.mean((qpos[3:-3] - between) ** 2)) / np.std(qpos))


def _find_frozen(of: str, qpos: Signal) -> Iterator[tuple[str, bool, str]]:
    """A position that repeats itself and then jumps to where the drive is by then."""
    steps, quantum = np.abs(np.diff(qpos)), find_quantum(qpos) or 0.0
    edges = np.flatnonzero(np.diff(np.concatenate([[False], steps == 0, [False]]).astype(int)))
    usual = float(np.quantile(steps, 0.99))
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        if last - first >= FROZEN and last < len(steps) and steps[last] > max(JUMP * usual, 3 * quantum):
            yield (
                "frozen",
                False,
                f"qpos{of} is constant from sample {first} on and jumps by {steps[last]:.3g} at sample {last + 1}: "
                "the sensor seems to freeze; cut this part out of the recording",
            )
            return


def check_turns(of: str, qpos: Signal, limits: np.ndarray) -> Iterator[tuple[str, bool, str]]:
    """An angle that can be degrees and no radians, by its range, the encoder's step and the limits of the file."""
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
    why = (["its encoder step divides 360"] if counts else []) + (
        ["only as degrees it is within the joint's limits"] if inside else []
    )
    yield (
        "degrees",
        bool(why),
        f"qpos{of} spans {span / math.tau:.3g} turns{'; ' + ', '.join(why) if why else ''}: it looks like degrees; set "
        "data.units.qpos=deg (also for qvel and a desired position), or, if measured before a gear, the gear ratio, as "
        "in data.units.qpos=0.02",
    )


def _is_step(quantum: float, turn: float) -> bool:
    bits = math.log2(turn / quantum) if quantum > 0 else 0.0
    return round(bits) in BITS and abs(turn / 2 ** round(bits) / quantum - 1) < EXACT


def check_stroke(of: str, qpos: Signal, qvel: Signal) -> Iterator[tuple[str, bool, str]]:
    """A slide that moves as far or as fast as none does."""
    span, speed = float(np.ptp(qpos)), float(np.quantile(np.abs(qvel), 0.99))
    if span > STROKE or speed > FAST:
        yield (
            "stroke",
            speed > FAST,
            f"qpos{of} moves by {span:.3g} m at up to {speed:.3g} m/s: it looks like millimetres; set "
            "data.units.qpos=mm (also for qvel and a desired position)",
        )


def check_velocity(log: Log, of: str, joint: int, qpos: Signal, qvel: Signal) -> Iterator[Said]:
    """Compare the measured velocity of a joint that moves with the derivative of its position."""
    estimate, repairs = "set data.clean.velocity=estimated", (Repair("data.clean.velocity", "estimated"),)
    if joint in log.without_velocity:
        if not log.velocity_estimated:
            other = "if another column has it, set data.columns.qvel"
            yield "velocity", False, f"the recorded velocity{of} shows no motion: it is estimated from qpos; {other}"
        return
    if not np.ptp(qvel) > 0:
        yield (
            "velocity",
            True,
            f"qvel{of} is constant, expected the velocity of a joint that moves; {estimate}",
            repairs,
        )
        return
    found = find_velocity_lag(log.time, qpos, qvel)
    if found is None and find_velocity_lag(log.time, qpos, -qvel) is not None:
        yield (
            "velocity sign",
            True,
            f"qvel{of} and the position's derivative have opposite signs, expected the same; set data.sign.qvel=-1, or "
            "data.sign.qpos=-1 if that suits the command",
        )
    elif found is None and len(qpos) > SHORT:
        derived = derive_velocity(log.time, qpos)
        length = min(len(derived), len(qvel))
        beside = compare(qvel[:length], derived[:length], log.timestep, np.ones(length, bool))
        alike = beside.between(-LONGEST_LAG, LONGEST_LAG).correlation.max()
        # Of a joint that hardly moves, both are noise.
        yield (
            "velocity",
            bool(alike < UNLIKE and _apart(qpos) < SMOOTH),
            f"qvel{of} does not match the position's derivative: check for swapped columns (data.columns.qvel), "
            f"or {estimate}",
            repairs,
        )
    elif found is not None:
        yield from _find_late_velocity(log, of, found[0])
        yield from _find_velocity_unit(of, found[1])


def _find_late_velocity(log: Log, of: str, lag: float) -> Iterator[Said]:
    if abs(lag) > max(LAGGING, 0.75 * log.timestep):
        late, other = ("qvel", "qpos") if lag > 0 else ("qpos", "qvel")
        yield (
            "lag",
            False,
            f"{late}{of} lags {other} by {1e3 * abs(lag):.3g} ms; set data.clean.velocity_lag=auto or "
            f"data.clean.velocity=estimated{', and identify bench.params.delay' if late == 'qpos' else ''}",
            (Repair("data.clean.velocity_lag", "auto") if lag > 0 else Repair("data.clean.velocity", "estimated"),),
        )


def _find_velocity_unit(of: str, scale: float) -> Iterator[Said]:
    if abs(scale - 1) > UNITS:
        other = _suggest(scale)
        yield (
            "units",
            not 1 / OTHER_UNITS < scale < OTHER_UNITS,
            f"qvel{of} is {scale:.4g} times the position's derivative: check the units of time, qpos and qvel "
            f"(data.units{other}), or set data.clean.velocity=estimated",
            () if other else (Repair("data.clean.velocity", "estimated"),),
        )


def _suggest(scale: float) -> str:
    """What unit explains a velocity that is so many times the position's derivative."""
    for factor, unit in FACTORS.items():
        if abs(scale / factor - 1) < UNITS:
            return f", such as data.units.qvel={unit}{'' if unit == 'rpm' else '/s'}" + (
                " or data.units.time=ms" if unit == "mm" else ""
            )
        if abs(scale * factor - 1) < UNITS and unit != "rpm":
            return f", such as data.units.qpos={unit}"
    return ""
