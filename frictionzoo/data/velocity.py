"""Checks of recorded velocities against positions: no motion, another unit, another joint, late or noisy."""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from frictionzoo.core.errors import LogError
from frictionzoo.data.signals import Signal, derive_velocity, find_noise, find_velocity_lag, repair_spikes

DEAD = 0.01  # share of the spread of the position's derivative, below which an unrelated velocity shows no motion
COMPARED = 200  # fewest samples for comparing a measured velocity with the position
SAME_UNIT = 3.0  # largest ratio of velocity and derivative in the same unit; a filter may lower the velocity

Columns = Float[np.ndarray, "time columns"]
"""Samples of one signal, one column a joint."""


def find_dead_velocities(time: Signal, qpos: Columns, qvel: Columns, gap: float) -> dict[int, str]:
    """Find joints whose recorded velocity is missing, constant or shows no motion, and return a sentence about each.

    `time` is in s, `qpos` [rad or m] and `qvel` [rad/s or m/s] are NaN where missing; `gap` as in `Cleaning`.
    """
    faults = (_find_fault(time, *pair, gap) for pair in zip(qpos.T, qvel.T, strict=True))
    return {joint: f"qvel{of_joints([joint], qvel)} {fault}" for joint, fault in enumerate(faults) if fault}


def _find_fault(time: Signal, position: Signal, velocity: Signal, gap: float) -> str:
    """Return why one joint's velocity shows no motion; empty if it shows it. Arguments as `find_dead_velocities`."""
    has_position = np.isfinite(position)
    has_both = has_position & np.isfinite(velocity)
    if has_both.sum() * gap < has_position.sum():
        return f"is missing in {100 * (1 - has_both.sum() / has_position.sum()):.3g} % of the samples"
    if not has_position.any() or not np.ptp(position[has_position]) > 0:  # a velocity of 0 is correct at rest
        return ""
    if not np.ptp(velocity[has_both]) > 0:
        return f"is constantly {velocity[has_both][0]:.3g} while qpos moves"
    repaired = repair_spikes(position)
    spread = float(np.std(derive_velocity(time, repaired)))
    if np.std(velocity[has_both]) < DEAD * spread and find_velocity_lag(time, repaired, velocity) is None:
        return f"varies by {np.std(velocity[has_both]):.2g} and the position's derivative by {spread:.2g}"
    return ""


def compare_velocities(
    name: str, time: Signal, qpos: Columns, qvel: Columns, joints: Iterable[int], estimates: Columns | None
) -> tuple[list[str], list[int]]:
    """Compare measured velocities [rad/s or m/s] with positions [rad or m] at uniform times [s].

    `estimates` are velocities derived from the positions; None keeps all measured ones. Return sentences on joints
    whose velocity is less accurate than the estimate, or unlike the position's derivative; and the numbers of the
    former.

    Raises:
        LogError: The units of a velocity and its position differ.
    """
    worse, unlike = dict[int, str](), list[int]()
    for joint in joints if len(time) >= COMPARED else ():
        match = find_velocity_lag(time, repair_spikes(qpos[:, joint]), qvel[:, joint])
        if match is None:
            unlike.append(joint)
        elif not 1 / SAME_UNIT < match[1] < SAME_UNIT:
            raise LogError(
                f"{name}: qvel{of_joints([joint], qvel)} is {match[1]:.4g} times the position's derivative, expected "
                "about 1 (57.3: degrees, 9.55: rpm); set data.units, or data.clean.velocity=measured to use it "
                "unchanged"
            )
        elif estimates is not None and (
            reason := _say_worse(qvel[:, joint], estimates[:, joint], match[0], float(time[1] - time[0]))
        ):
            worse[joint] = f"qvel{of_joints([joint], qvel)} {reason}"
    sentences = list(worse.values())
    if unlike:
        sentences.append(
            f"qvel{of_joints(unlike, qvel)} does not match the position's derivative: check for swapped columns, or "
            "set data.clean.velocity=estimated"
        )
    return sentences, list(worse)


def _say_worse(velocity: Signal, estimate: Signal, lag: float, timestep: float) -> str:
    """Return why an estimate from the position is more accurate than the measured velocity; empty if it is not.

    Their mean squared difference is the sum of measurement noise, lag and estimation error. Differences of the velocity
    show the noise; removing the lag [s] shows its part.
    """
    noise, samples = find_noise(velocity), round(lag / timestep)  # interpolation within samples would smooth the noise
    difference, aligned = (
        float(np.square(_later(velocity, shift) - _later(estimate, -shift)).mean()) for shift in (0, samples)
    )
    lag_variance = max(difference - aligned, 0.0)
    if not aligned - noise**2 < noise**2 + lag_variance:
        return ""
    if lag_variance > noise**2:
        return f"lags qpos by {1e3 * lag:.3g} ms"
    return f"has more noise ({noise:.2g} rad/s or m/s) than an estimate from qpos"


def _later(signal: Signal, samples: int) -> Float[np.ndarray, "kept"]:
    """Return a signal without its first samples; without its last ones if the number is negative."""
    return signal[max(samples, 0) : len(signal) + min(samples, 0)]


def of_joints(joints: Sequence[int], values: Columns) -> str:
    """Return ` of joint 2` or ` of joints 1, 3` for messages; empty for all joints."""
    numbers = ", ".join(str(joint + 1) for joint in joints)
    return "" if len(joints) == values.shape[1] else f" of joint{'s' if len(joints) > 1 else ''} {numbers}"
