"""Diagnostics of recordings before a fit, the most important findings first.

A recording's signals are compared with each other, and with the torques of actuators and links at its states.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from frictionzoo.bench import Bench
from frictionzoo.core.log import Dataset, Log
from frictionzoo.data.clean import TIMES_ROUNDED
from frictionzoo.diagnostics.balance import balance, explain
from frictionzoo.diagnostics.commands import check_command, check_work, work
from frictionzoo.diagnostics.dataset import check_declared, check_excitation, check_motion
from frictionzoo.diagnostics.findings import Doubt, Finding, settle
from frictionzoo.diagnostics.following import Followed, check_asked, check_drift, check_following, find_swaps, settling
from frictionzoo.diagnostics.lags import compare
from frictionzoo.diagnostics.readings import check_readings
from frictionzoo.diagnostics.samples import (
    SHORT,
    check_clock,
    check_position,
    check_stroke,
    check_turns,
    check_velocity,
    find_isolated,
    find_outlying,
    leave_out,
)
from frictionzoo.diagnostics.torque import KNOWN, agrees, check_torque

GAINS = ("kp", "kd")  # commands that move nothing by themselves
BRIEF = 2.5  # s; shorter recordings have too little motion to compare commands and torque
CLOSELY = 40  # evenly spread recordings with all checks; the others skip following and torque


def check_up(dataset: Dataset, bench: Bench, checkup: str) -> list[Doubt]:
    """Return likely faults of accepted recordings, or of their bench, with repairs; with `warn`, certain ones too.

    Raises:
        LogError: A fault is certain, and `checkup` is `strict`.
        ConfigError: `checkup` is unknown.
    """
    return settle(find_all(dataset, bench), checkup, len(dataset.logs))


def find_all(dataset: Dataset, bench: Bench) -> Iterator[Finding]:
    """Yield all findings of a data set on a bench, the most important first within each recording."""
    to_position = takes_position(bench)
    yield from check_declared(dataset, bench, to_position)
    logs = dataset.logs
    closely = {len(logs) * number // CLOSELY for number in range(CLOSELY)} if len(logs) > CLOSELY else None
    wrong = False
    for number, log in enumerate(logs):
        for finding in _check_log(log, bench, to_position, closely is None or number in closely):
            wrong |= finding.certain
            yield finding
    yield from () if wrong else check_readings(logs[0], bench)
    yield from check_excitation(dataset.train, bench)
    yield from check_motion(dataset, bench)


def takes_position(bench: Bench) -> bool:
    """Return whether a bench's commands are desired positions."""
    law = bench.actuator
    return bool({"stiffness", "1/position"} & set(law.dimensions.values())) or "kp" in law.inputs


def _check_log(log: Log, bench: Bench, to_position: bool, closely: bool) -> Iterator[Finding]:
    clock = list(check_clock(log))
    yield from clock
    for sentence in (note for note in log.repairs if note.startswith(TIMES_ROUNDED)):
        yield Finding("rounded", False, f"{sentence}; record them with more digits", log.name)
    if clock:
        return
    cleaned = {name: getattr(log, name).copy() for name in ("qpos", "qvel", "ctrl")}
    broken = False
    for joint, name in enumerate(bench.joints):
        for fault in _check_signals(log, _of(bench, joint), bench, joint, cleaned):
            broken |= fault.certain
            yield fault._replace(log=log.name, joint=name)
    if not broken:
        yield from _check_together(log, bench, to_position, closely, cleaned)


def _check_signals(
    log: Log, of: str, bench: Bench, joint: int, cleaned: dict[str, Float[np.ndarray, "time nv"]]
) -> Iterator[Finding]:
    """Check each signal of a joint, and replace outliers in `cleaned` for all later checks."""
    for name, values in cleaned.items():
        outliers = find_isolated(name, values[:, joint])
        if outliers.any():
            yield find_outlying(log, name, of, values[:, joint], outliers)
        values[:, joint] = leave_out(values[:, joint], outliers)
    qpos, qvel, ctrl = (cleaned[name][:, joint] for name in ("qpos", "qvel", "ctrl"))
    faults = list(check_position(of, qpos, ctrl, bench))
    yield from faults
    if not any(fault.certain for fault in faults):
        yield from check_velocity(log, of, joint, qpos, qvel)
        yield from check_stroke(of, qpos, qvel) if bench.joint_type == "slide" else ()


def _check_together(
    log: Log, bench: Bench, to_position: bool, closely: bool, cleaned: dict[str, Float[np.ndarray, "time nv"]]
) -> Iterator[Finding]:
    """Check commands against motion, joint by joint, and against the torque of all joints."""
    log = replace(log, **cleaned)
    closely = closely and log.samples > SHORT and float(log.time[-1] - log.time[0]) > BRIEF
    works = work(log, bench)
    followed = _follow(log, bench, works) if to_position and closely else {}
    drifts = False
    if followed:
        best = max(followed, key=lambda joint: followed[joint].likeness.correlation.max())
        if drift := check_drift(log, followed[best]):
            drifts = True
            yield drift._replace(log=log.name)
    swaps, named, wrong = find_swaps(log, followed), {name for name in bench.joints if drifts}, False
    for joint, name in enumerate(bench.joints):
        comparison = (followed.get(joint), drifts, swaps.get(joint))
        for fault in _check_commands(log, bench, joint, to_position, closely, *comparison):
            named, wrong = named | {name}, wrong or fault.certain
            yield fault._replace(log=log.name, joint=name)
    if log.samples > SHORT and not wrong:
        yield from _check_forces(log, bench, to_position, closely, works, named)


def _check_forces(
    log: Log, bench: Bench, to_position: bool, closely: bool, works: Float[np.ndarray, "nv"], named: set[str]
) -> Iterator[Finding]:
    """Check torque and work of joints without findings so far; work counts if torque gives no verdict."""
    balanced = balance(log, bench, bench.compile(constraint=False)) if closely else None
    explained = [explain(balanced, joint) if balanced else None for joint in range(bench.nv)]
    said = check_torque(log, bench, balanced, explained, to_position) if balanced else ()
    findings = [entry for entry in said if entry.joint not in named]
    opposed = [entry.joint for entry in findings if entry.kind == "opposed"]
    known_joints = [
        joint for joint, entry in enumerate(explained) if entry is not None and entry.error < KNOWN * abs(entry.share)
    ]
    if findings and len(opposed) < len(known_joints):  # not all joints alike
        readings = list(check_readings(log, bench))
        yield from (reading._replace(certain=any(entry.certain for entry in findings)) for reading in readings)
        findings = [] if readings else findings
    yield from findings
    named = named | {entry.joint or name for entry in findings for name in bench.joints}
    for joint, name in enumerate(bench.joints):
        is_commanded = np.ptp(log.ctrl[:, joint]) > 0 or _has_more(log, bench, joint)
        if name not in named and is_commanded and not agrees(explained[joint]):
            for said in check_work(_of(bench, joint), bench, joint, float(works[joint])):
                yield said._replace(log=log.name, joint=name)


def _follow(log: Log, bench: Bench, works: Float[np.ndarray, "nv"]) -> dict[int, Followed]:
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
    log: Log,
    bench: Bench,
    joint: int,
    to_position: bool,
    closely: bool,
    found: Followed | None,
    drifts: bool,
    swapped: int | None,
) -> Iterator[Finding]:
    """Check the command of a joint, alone and against its position."""
    on, of = _following(log, bench, joint), _of(bench, joint)
    if np.ptp(log.ctrl[:, joint]) > 0 or not _has_more(log, bench, joint):
        follows = log.qpos[on, joint] if to_position and on.any() else None
        command_faults = list(check_command(of, log.ctrl[:, joint], follows))
        yield from command_faults
        if command_faults:
            return
    following_faults = [] if found is None else list(check_following(log, of, bench, joint, found, drifts, swapped))
    yield from following_faults
    if not following_faults and bench.joint_type == "hinge":
        yield from check_turns(of, log.qpos[:, joint], bench.unlimited[joint])
    if closely and not to_position:
        yield from check_asked(log, of, joint)


def _of(bench: Bench, joint: int) -> str:
    """Return a joint's name for messages; empty on a bench with one joint."""
    return f" of {bench.joints[joint]}" if bench.nv > 1 else ""


def _following(log: Log, bench: Bench, joint: int) -> Bool[np.ndarray, "time"]:
    """Return samples in which a joint should follow its command: it is on, and a recorded gain is above 0."""
    on = np.ravel(log.extras.get("enable", np.ones(1))) > 0
    on = on if len(on) == log.samples else np.full(log.samples, on.any())
    return on & (log.inputs["kp"][:, joint] > 0) if "kp" in bench.actuator.inputs else on


def _has_more(log: Log, bench: Bench, joint: int) -> bool:
    """Return whether a joint receives another varying command than `ctrl`."""
    return any(np.ptp(log.inputs[name][:, joint]) > 0 for name in bench.actuator.commands if name not in GAINS)
