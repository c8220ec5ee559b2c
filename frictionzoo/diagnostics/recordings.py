"""Diagnostics of recordings before a fit, the most important findings first.

A recording's signals are compared with each other, and with the torques of actuators and links at its states.
"""

from collections.abc import Iterator
from dataclasses import replace

import mujoco
import numpy as np
from jaxtyping import Bool

from frictionzoo.bench import Bench
from frictionzoo.core.log import Dataset, Log
from frictionzoo.data.clean import TIMES_ROUNDED
from frictionzoo.diagnostics.balance import balance, explain
from frictionzoo.diagnostics.commands import check_command, check_work, work
from frictionzoo.diagnostics.dataset import check_declared, check_excitation, check_motion
from frictionzoo.diagnostics.findings import Finding, of_joint, settle
from frictionzoo.diagnostics.following import Followed, check_asked, check_drift, check_following, find_swaps, settling
from frictionzoo.diagnostics.lags import compare
from frictionzoo.diagnostics.readings import check_readings
from frictionzoo.diagnostics.samples import SHORT, check_clock, check_signals, check_turns, has_more
from frictionzoo.diagnostics.torque import KNOWN, agrees, check_recorded, check_torque

BRIEF = 2.5  # s; shorter recordings have too little motion to compare commands and torque
CLOSELY = 40  # evenly spread recordings with all checks; the others skip following and torque


def check_up(dataset: Dataset, bench: Bench, checkup: str) -> list[Finding]:
    """Return likely faults of accepted recordings, or of their bench, with repairs; with `warn`, certain ones too.

    Raises:
        LogError: A fault is certain, and `checkup` is `strict`.
        ConfigError: `checkup` is unknown.
    """
    return settle(find_all(dataset, bench), checkup, len(dataset.logs))


def find_all(dataset: Dataset, bench: Bench) -> Iterator[Finding]:
    """Yield all faults of a data set on a bench, the most important first within each recording."""
    yield from check_declared(dataset, bench, takes_position(bench))
    logs, model = dataset.logs, bench.compile(constraint=False)
    closely = {len(logs) * number // CLOSELY for number in range(CLOSELY)}  # all, if there are fewer
    wrong = False
    for number, log in enumerate(logs):
        for finding in _check_log(log, bench, model, number in closely):
            wrong |= finding.certain
            yield finding
    yield from () if wrong else check_readings(logs[0], bench, model)
    yield from check_excitation(dataset.train, bench)
    yield from check_motion(dataset, bench)


def takes_position(bench: Bench) -> bool:
    """Return whether a bench's commands are desired positions."""
    law = bench.actuator
    return bool({"stiffness", "1/position"} & set(law.dimensions.values())) or "kp" in law.inputs


def _check_log(log: Log, bench: Bench, model: mujoco.MjModel, closely: bool) -> Iterator[Finding]:
    """Check a recording; `model` is the bench compiled without a friction constraint."""
    clock = list(check_clock(log))
    yield from clock
    for sentence in (note for note in log.repairs if note.startswith(TIMES_ROUNDED)):
        yield Finding("caution", "rounded", f"{sentence}; record them with more digits", log=log.name)
    if clock:
        return
    cleaned = {name: getattr(log, name).copy() for name in ("qpos", "qvel", "ctrl")}
    broken = False
    for joint, name in enumerate(bench.joints):
        for fault in check_signals(log, bench, joint, cleaned):
            broken |= fault.certain
            yield replace(fault, log=log.name, joint=name)
    if not broken:
        yield from _check_together(replace(log, **cleaned), bench, model, closely)


def _check_together(log: Log, bench: Bench, model: mujoco.MjModel, closely: bool) -> Iterator[Finding]:
    """Check commands against motion, joint by joint, and against the torque of all joints."""
    closely = closely and log.samples > SHORT and float(log.time[-1] - log.time[0]) > BRIEF
    works, drift = work(log, bench), None
    followed = _follow(log, bench, works) if takes_position(bench) and closely else {}
    if followed and (drift := check_drift(log, max(followed.values(), key=lambda one: one.likeness.correlation.max()))):
        yield replace(drift, log=log.name)
    swaps, named, wrong = find_swaps(log, followed), {name for name in bench.joints if drift}, False
    for joint, name in enumerate(bench.joints):
        comparison = (followed.get(joint), drift is not None, swaps.get(joint))
        for fault in _check_commands(log, bench, joint, closely, *comparison):
            named, wrong = named | {name}, wrong or fault.certain
            yield replace(fault, log=log.name, joint=name)
    if log.samples > SHORT and not wrong:
        yield from _check_forces(log, bench, model, closely, works, named)


def _check_forces(
    log: Log, bench: Bench, model: mujoco.MjModel, closely: bool, works: np.ndarray, named: set[str]
) -> Iterator[Finding]:
    """Check torque and work of joints without findings so far; work counts if torque gives no verdict."""
    recorded = list(check_recorded(log, bench, model)) if closely else []
    yield from recorded
    named = named | {entry.joint for entry in recorded}
    balanced = balance(log, bench, model) if closely else None
    explained = [explain(balanced, joint) if balanced else None for joint in range(bench.nv)]
    torque = check_torque(log, bench, balanced, explained, takes_position(bench)) if balanced else ()
    findings = [entry for entry in torque if entry.joint not in named]
    opposed = sum(entry.title == "opposed" for entry in findings)
    if findings and opposed < sum(e is not None and e.error < KNOWN * abs(e.share) for e in explained):  # not all alike
        readings = list(check_readings(log, bench, model))
        certain = "bad" if any(entry.certain for entry in findings) else "caution"
        yield from (replace(reading, state=certain) for reading in readings)
        findings = [] if readings else findings
    yield from findings
    named = named | {entry.joint or name for entry in findings for name in bench.joints}
    for joint, name in enumerate(bench.joints):
        is_commanded = np.ptp(log.ctrl[:, joint]) > 0 or has_more(log, bench, joint)
        if name not in named and is_commanded and not agrees(explained[joint]):
            yield from (replace(fault, log=log.name, joint=name) for fault in check_work(bench, joint, works[joint]))


def _follow(log: Log, bench: Bench, works: np.ndarray) -> dict[int, Followed]:
    """Compare each joint that should follow a desired position with its command."""
    followed = {}
    for joint in range(bench.nv):
        on = _following(log, bench, joint)
        qpos, ctrl = log.qpos[:, joint], log.ctrl[:, joint]
        if on.sum() > SHORT / 2 and np.ptp(ctrl[on]) > 0:
            likeness, settles = compare(qpos, ctrl, log.timestep, on), settling(log, bench, joint, on)
            followed[joint] = Followed(qpos, ctrl, on, likeness, settles, float(works[joint]))
    return followed


def _check_commands(
    log: Log, bench: Bench, joint: int, closely: bool, followed: Followed | None, drifts: bool, swapped: int | None
) -> Iterator[Finding]:
    """Check the command of a joint, alone and against its position."""
    if bench.joints[joint] in bench.passive:
        return
    on, of, to_position = _following(log, bench, joint), of_joint(bench.joints, joint), takes_position(bench)
    if np.ptp(log.ctrl[:, joint]) > 0 or not has_more(log, bench, joint):
        follows = log.qpos[on, joint] if to_position and on.any() else None
        if faults := list(check_command(of, log.ctrl[:, joint], follows)):
            yield from faults
            return
    faults = [] if followed is None else list(check_following(log, of, bench, joint, followed, drifts, swapped))
    yield from faults
    if not faults and bench.joint_type == "hinge":
        yield from check_turns(of, log, joint, bench.unlimited[joint])
    if closely and not to_position:
        yield from check_asked(log, of, joint)


def _following(log: Log, bench: Bench, joint: int) -> Bool[np.ndarray, "time"]:
    """Return samples in which a joint should follow its command: it is on, and its gain kp is above 0."""
    if "kp" in bench.params and bench.initial_values()["kp"][joint] == 0:  # a velocity servo, or no actuator
        return np.zeros(log.samples, bool)
    on = np.ravel(log.extras.get("enable", np.ones(1))) > 0
    on = on if len(on) == log.samples else np.full(log.samples, on.any())
    return on & (log.inputs["kp"][:, joint] > 0) if "kp" in bench.actuator.inputs else on
