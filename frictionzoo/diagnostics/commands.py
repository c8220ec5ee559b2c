"""Diagnostics of a command: its values, and the work that it does."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from frictionzoo.bench import Bench
from frictionzoo.core.log import Log
from frictionzoo.data.signals import Signal
from frictionzoo.diagnostics.balance import commanded_torque
from frictionzoo.diagnostics.findings import Finding, of_joint, turn

SATURATED = 0.2  # share of samples at the ends of the range above which a command may be clipped
PAST = 0.1  # overshoot of the position beyond a clipped command's range, as a share of that range
FAR_PAST = 0.5  # the same for a sequence of steps, after which a position may swing
LEVELS, HELD = 10, 0.9  # a command is a sequence of steps if this many values make up this share of the samples
OPPOSED = 0.0  # net work share below which a command takes energy from the drive
CARRIED = -0.5  # the same for a joint that other joints move, and that its actuator may brake


def check_command(of: str, ctrl: Signal, follows: Float[np.ndarray, "on"] | None) -> Iterator[Finding]:
    """Find a constant or clipped command; `follows` is the position that should follow it, if any."""
    low, high = float(ctrl.min()), float(ctrl.max())
    if low == high:
        text = f"ctrl{of} is constant, {low:.4g}: the motion contains little information; check data.columns.ctrl"
        yield Finding("caution", "constant", text)
        return
    # Resampling rounds levels and adds values between them.
    share = np.round((ctrl - low) / (high - low), 6)
    ends = float(np.mean((share == 0) | (share == 1)))
    _, counts = np.unique(share, return_counts=True)
    is_stepped = np.sort(counts)[-LEVELS:].sum() > HELD * len(ctrl)
    # A position commanded to rest at two ends does not go far beyond them.
    overshoot = 1.0 if follows is None else max(low - follows.min(), follows.max() - high) / (high - low)
    if ends > SATURATED and overshoot > PAST and (not is_stepped or (follows is not None and overshoot > FAR_PAST)):
        text = f"ctrl{of} is at an end of its range, {low:.4g} or {high:.4g}, in {100 * ends:.0f} % of the samples: it "
        text += "seems to be clipped; record the command that the drive received (data.columns.ctrl), or a smaller "
        text += "motion"
        yield Finding("caution", "saturated", text)


def check_work(bench: Bench, joint: int, share: float) -> Iterator[Finding]:
    """Find a command that takes energy from the drive; uncertain if other joints move this one."""
    if not takes_energy(bench, joint, share):
        return
    of = of_joint(bench.joints, joint)
    text = f"ctrl{of} takes energy from the drive ({100 * share:.0f} % of the energy that they exchange)"
    if _is_alone(bench, joint):
        message = f"{text}, expected to supply it; set data.sign.ctrl=-1, or the sign of both qpos and qvel, or check "
        message += "qpos and ctrl for swapped columns, units, zero and time shift (data.columns, data.units, "
        message += "data.clean.command_lag)"
        yield Finding("bad", "work", message, repairs=turn(joint, "ctrl"))
    else:
        message = f"{text}: correct if gravity or other joints move it; otherwise check data.sign.ctrl"
        yield Finding("caution", "work", message)


def takes_energy(bench: Bench, joint: int, share: float) -> bool:
    """Return whether a command takes more energy than plausible: none if no other joint moves its joint."""
    return bool(share < (OPPOSED if _is_alone(bench, joint) else CARRIED))


def _is_alone(bench: Bench, joint: int) -> bool:
    """Return whether no other joint moves this one."""
    return bench.branches.count(bench.branches[joint]) == 1


def work(log: Log, bench: Bench) -> Float[np.ndarray, "nv"]:
    """Return the net work of the commands on each joint, as a share of the energy that they exchange.

    The actuator's torque is taken at initial values and zero velocity, without its damping. Friction and damping
    dissipate the work, except for the energy stored between first and last state. Net work is therefore not negative,
    however late the drive follows, up to half a period.
    """
    power = commanded_torque(log, bench, np.zeros_like(log.qvel)) * log.qvel
    return power.sum(axis=0) / np.maximum(np.abs(power).sum(axis=0), 1e-300)
