"""What in recordings cannot be right: looked at before a fit, and told with the option that mends it.

Everything here compares signals of one recording with each other and with what the bench's actuator does. What is
certain is refused; what is only likely is a warning of the run.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from frictionzoo.bench import Bench
from frictionzoo.bench.compiled import can_collide
from frictionzoo.core.errors import LogError
from frictionzoo.core.log import Dataset, Log
from frictionzoo.logs.signals import find_lag, find_outliers, find_quantum, find_velocity_lag, repair_spikes

ALIKE = 0.8  # correlation from which on a velocity with the other sign is the position's derivative
LAGGING = 0.004  # s, by which a measured velocity may lag the position
UNITS = 0.1  # relative difference of a measured velocity and the derivative from which on it is told
STILL = 5  # steps of the encoder; a joint that moves through less stands still
NOISE = 0.5  # of the largest ratio of the steps between samples to the spread, which is that of white noise
SATURATED = 0.2  # share of a command's samples at the ends of its range that is told, if it is no sequence of steps
PAST = 0.1  # share of a command's range by which the position passes it if the command is cut off
LEVELS, HELD = 10, 0.9  # values that hold this share of the samples: such a command is a sequence of steps
FROZEN = 20  # samples in which a sensor repeats itself before it jumps
JUMP = 5.0  # times the largest usual step between samples that is a jump
SPIKE = 0.05  # share of the motion that a spike within it leaves its neighbours by
SHORT = 100  # samples; in fewer, signals are not compared with each other
LARGER = 5.0  # times; a position moves no more, and while it follows no less, than it is told to
APART = 0.5  # times the motion that position and command are apart at the least
OPPOSED = 0.0  # share of the work that a command exchanges with the drive from which on it takes energy
CARRIED = -0.5  # the same of a joint that others move, from which on it is told: it may brake what they do
GAINS = ("kp", "kd")  # commands that move nothing by themselves
SLOWEST, FASTEST = 0.5, 2e-5  # s; no recording of a drive has longer or shorter sample intervals
STATES = 2000  # recorded states at which contacts and limits are looked for


def doubt_recordings(dataset: Dataset, bench: Bench) -> list[str]:
    """What is likely to be wrong with recordings, a sentence each with what mends it.

    Raises:
        LogError: Something is certainly wrong.
    """
    found: dict[str, tuple[str, list[str]]] = {}
    for log in dataset.logs:
        for kind, sentence in _doubt_log(log, bench):
            found.setdefault(kind, (f"{log.name}: {sentence}", []))[1].append(log.name)
    count = len(dataset.logs)
    return [f"{text} ({len(names)} of {count} logs)" if count > 1 else text for text, names in found.values()]


def doubt_motion(dataset: Dataset, bench: Bench) -> list[str]:
    """What the drive and the simulation may not have in common at the recorded positions: limits, contacts."""
    return [*_doubt_limits(dataset, bench), *_doubt_pushes(dataset, bench)]


def _doubt_limits(dataset: Dataset, bench: Bench) -> Iterator[str]:
    """Motion beyond limits that were left out."""
    qpos = np.concatenate([log.qpos for log in dataset.logs])
    for joint, (low, high), positions in zip(bench.joints, bench.unlimited, qpos.T, strict=True):
        beyond = (positions < low) | (positions > high)
        if beyond.any():
            share = f"{100 * beyond.mean():.2g} % of the recorded positions"
            yield (
                f"joint {joint} is beyond its limits in the file, {low:.4g} to {high:.4g}, in {share}, which span "
                f"{positions.min():.4g} to {positions.max():.4g}: a stop may have pushed there, or zero and sign of "
                "the joint are not the file's (data.sign, bench.limits=keep)"
            )


def _doubt_pushes(dataset: Dataset, bench: Bench) -> list[str]:
    """What MuJoCo C does at the recorded positions and the drive may not have done: touch a limit, make contact."""
    model = bench.compile(constraint=False)
    limited = model.jnt_limited.any() or model.tendon_limited.any()
    if not (limited or model.npair or can_collide(model)):
        return []
    data, found = mujoco.MjData(model), dict[str, int]()
    qpos = np.concatenate([log.qpos for log in dataset.logs])
    qpos = qpos[:: max(1, len(qpos) // STATES)]
    for position in qpos:
        data.qpos[:] = position
        mujoco.mj_fwdPosition(model, data)
        for what in {*_limits(model, data), *_contacts(model, data)}:
            found[what] = found.get(what, 0) + 1
    return [
        f"{what} in {100 * times / len(qpos):.2g} % of the recorded positions: MuJoCo pushes there, and friction is "
        "identified against that; look whether the drive was there, or leave it out of the MJCF"
        for what, times in found.items()
    ]


def _limits(model: mujoco.MjModel, data: mujoco.MjData) -> Iterator[str]:
    for row in range(data.nefc):
        kind, index = data.efc_type[row], data.efc_id[row]
        if kind == mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT:
            yield f"joint {model.joint(index).name} is at its limit"
        elif kind == mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON:
            yield f"tendon {model.tendon(index).name or index} is at its limit"


def _contacts(model: mujoco.MjModel, data: mujoco.MjData) -> Iterator[str]:
    for index in range(data.ncon):
        geoms = (model.geom(geom) for geom in data.contact[index].geom)
        yield "geoms {} and {} touch".format(*(geom.name or f"number {geom.id}" for geom in geoms))


def _doubt_log(log: Log, bench: Bench) -> Iterator[tuple[str, str]]:
    """Kind and sentence of each doubt; LogError for what is certain."""
    if not FASTEST <= log.timestep <= SLOWEST:
        raise LogError(
            f"{log.name}: {log.timestep:.3g} s between samples, expected {FASTEST:g} to {SLOWEST:g} s of a drive's "
            "recording; set data.units.time"
        )
    for joint in range(log.qpos.shape[1]):
        of = f" of {bench.joints[joint]}" if log.qpos.shape[1] > 1 else ""
        for kind, sentence in _doubt_joint(log, of, joint, bench):
            yield f"{kind}{of}", sentence


def _doubt_joint(log: Log, of: str, joint: int, bench: Bench) -> Iterator[tuple[str, str]]:
    signals = {name: getattr(log, name)[:, joint] for name in ("qpos", "qvel", "ctrl")}
    far = {name: _isolated(name, values) for name, values in signals.items()}
    for name, bad in far.items():
        if bad.any():
            yield f"outliers {name}", _say_outliers(log, f"{name}{of}", signals[name], bad)
    # All that follows is looked at without them.
    qpos, qvel, ctrl = (_without(values, far[name]) for name, values in signals.items())
    _refuse_still(log.name, of, qpos, ctrl)
    _refuse_noise(log.name, of, qpos)
    if bench.joint_type == "hinge":
        _refuse_wrapping(log.name, of, qpos)
    yield from _doubt_frozen(of, qpos)
    yield from _doubt_velocity(log, of, qpos, qvel)
    yield from _doubt_commands(log, of, joint, bench, {"qpos": qpos, "qvel": qvel, "ctrl": ctrl})


def _doubt_commands(
    log: Log, of: str, joint: int, bench: Bench, cleaned: Mapping[str, np.ndarray]
) -> Iterator[tuple[str, str]]:
    """What the command says, and others that a robot's drive gets beside it, each with the position."""
    qpos, ctrl, actuator = cleaned["qpos"], cleaned["ctrl"], bench.actuator
    on = np.ravel(log.extras.get("enable", np.ones(1))) > 0
    on = on if len(on) == len(qpos) else np.full(len(qpos), on.any())
    to_position = bool({"stiffness", "1/position"} & set(actuator.dimensions.values()))
    if "kp" in actuator.inputs:
        stiff = log.inputs["kp"][:, joint] > 0
        to_position, on = bool(stiff.any()), on & stiff
    told = np.ptp(ctrl) > 0
    beside = any(np.ptp(log.inputs[name][:, joint]) > 0 for name in actuator.commands if name not in GAINS)
    if told or not beside:
        yield from _doubt_command(of, ctrl, qpos[on] if to_position and on.any() else None)
    if len(qpos) > SHORT and (told or beside):
        if told and to_position:
            yield from _doubt_position_command(log, of, qpos, ctrl)
        yield from _doubt_opposed(log, of, bench, joint, cleaned)


def _isolated(name: str, values: np.ndarray) -> Bool[np.ndarray, "time"]:
    """Samples that stand apart from those before and after them."""
    far = find_outliers(values)
    if name == "qpos":
        repaired = repair_spikes(values)
        far |= np.abs(values - repaired) > SPIKE * np.ptp(repaired)
    return far


def _say_outliers(log: Log, what: str, values: np.ndarray, far: np.ndarray) -> str:
    at = int(np.argmax(np.where(far, np.abs(values - np.median(values)), -1.0)))
    return (
        f"{what} has {far.sum()} samples far from those before and after, such as {values[at]:.4g} at "
        f"{log.time[at]:.4g} s; set data.clean.spikes=repair"
    )


def _without(values: np.ndarray, far: np.ndarray) -> np.ndarray:
    kept = np.flatnonzero(~far)
    return np.interp(np.arange(len(values)), kept, values[kept]) if far.any() else values


def _refuse_still(name: str, of: str, qpos: np.ndarray, ctrl: np.ndarray) -> None:
    moved, quantum = float(np.ptp(qpos)), find_quantum(qpos) or 0.0
    if moved <= STILL * quantum or moved <= 1e-9 * max(1.0, float(np.abs(qpos).max())):
        raise LogError(
            f"{name}: qpos{of} moves through {moved:.3g} in all, while ctrl spans {np.ptp(ctrl):.3g}; expected a drive "
            "that moves; look whether it was on, and at data.columns.qpos"
        )


def _refuse_noise(name: str, of: str, qpos: np.ndarray) -> None:
    # Steps between samples of white noise have a variance of two, of a motion that is sampled fast next to none.
    ratio = float(np.std(np.diff(qpos)) / (np.std(qpos) * np.sqrt(2)))
    if len(qpos) > 20 and ratio > NOISE:
        raise LogError(
            f"{name}: qpos{of} jumps between samples as noise does ({100 * ratio:.0f} % of white noise), expected a "
            "motion; look at data.columns.qpos and at the sensor, or record faster"
        )


def _refuse_wrapping(name: str, of: str, qpos: np.ndarray) -> None:
    steps = np.diff(qpos)
    turns = np.abs(np.abs(steps) - 2 * np.pi) < 0.1 * np.pi
    if turns.any() and np.median(np.abs(steps)) < 0.1:
        raise LogError(
            f"{name}: qpos{of} jumps by a whole turn {turns.sum()} times, first at sample {int(np.argmax(turns)) + 1}, "
            "expected an angle that goes on; set data.clean.wrap=6.283185307179586"
        )


def _doubt_frozen(of: str, qpos: np.ndarray) -> Iterator[tuple[str, str]]:
    """A position that repeats itself and then jumps to where the drive is by then."""
    steps, quantum = np.abs(np.diff(qpos)), find_quantum(qpos) or 0.0
    edges = np.flatnonzero(np.diff(np.concatenate([[False], steps == 0, [False]]).astype(int)))
    usual = float(np.quantile(steps, 0.99))
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        if last - first >= FROZEN and last < len(steps) and steps[last] > max(JUMP * usual, 3 * quantum):
            yield (
                "frozen",
                f"qpos{of} repeats itself from sample {first} on and jumps by {steps[last]:.3g} at sample {last + 1}: "
                "the sensor seems to freeze; cut that out of the recording",
            )
            return


def _doubt_velocity(log: Log, of: str, qpos: np.ndarray, qvel: np.ndarray) -> Iterator[tuple[str, str]]:
    if not np.ptp(qvel) > 0:
        yield "velocity", f"qvel{of} is constant; set data.clean.velocity=estimated"
        return
    found = find_velocity_lag(log.time, qpos, qvel)
    if found is None:
        if find_velocity_lag(log.time, qpos, -qvel) is not None:
            raise LogError(
                f"{log.name}: qvel{of} and the position's derivative have opposite signs, expected the same; set "
                "data.sign.qvel=-1, or data.sign.qpos=-1 if the command is right with that"
            )
        if len(qpos) > SHORT:
            yield (
                "velocity",
                f"qvel{of} is no copy of the position's derivative: look whether columns are swapped, or set "
                "data.clean.velocity=estimated",
            )
        return
    lag, scale = found
    if abs(lag) > max(LAGGING, 0.75 * log.timestep):
        late = "qvel" if lag > 0 else "qpos"
        yield (
            "lag",
            f"{late}{of} is late by {1e3 * abs(lag):.3g} ms against {'qpos' if late == 'qvel' else 'qvel'}; set "
            "data.clean.velocity_lag=auto or data.clean.velocity=estimated"
            + (", and let bench.params.delay be identified" if late == "qpos" else ""),
        )
    if abs(scale - 1) > UNITS:
        yield (
            "units",
            f"qvel{of} is {scale:.4g} times the position's derivative: look at the units of time, qpos and qvel "
            "(data.units), or set data.clean.velocity=estimated",
        )


def _doubt_command(of: str, ctrl: np.ndarray, follows: np.ndarray | None) -> Iterator[tuple[str, str]]:
    """What the command alone says, and beside the position where that is to follow it."""
    low, high = float(ctrl.min()), float(ctrl.max())
    if low == high:
        yield (
            "constant",
            f"ctrl{of} is constant, {low:.4g}: the motion tells little of the drive; look at data.columns.ctrl",
        )
        return
    # Resampling rounds levels, and puts a few values between them.
    share = np.round((ctrl - low) / (high - low), 6)
    ends = float(np.mean((share == 0) | (share == 1)))
    _, counts = np.unique(share, return_counts=True)
    steps = np.sort(counts)[-LEVELS:].sum() > HELD * len(ctrl)
    # A position that is told to rest at two ends does not go far beyond them.
    passed = 1.0 if follows is None else max(low - follows.min(), follows.max() - high) / (high - low)
    if ends > SATURATED and not steps and passed > PAST:
        yield (
            "saturated",
            f"ctrl{of} is at an end of its range, {low:.4g} or {high:.4g}, in {100 * ends:.0f} % of the samples: it "
            "seems to be cut off there; record what the drive got, or a smaller motion",
        )


def _doubt_position_command(log: Log, of: str, qpos: np.ndarray, ctrl: np.ndarray) -> Iterator[tuple[str, str]]:
    """A position follows what it is told to be: it is of its size, and comes near it at times."""
    follows = find_lag(qpos - qpos.mean(), ctrl - ctrl.mean(), log.timestep) is not None
    moved, asked, apart = np.ptp(qpos), np.ptp(ctrl), float(np.abs(qpos - ctrl).min())
    if moved > LARGER * asked or (follows and moved * LARGER < asked):
        yield (
            "size",
            f"qpos{of} moves through {moved:.3g} where ctrl asks for {asked:.3g}: look at their units (data.units; "
            "57.3 is a degree), and whether the position drifts",
        )
    elif apart > APART * max(moved, asked):
        yield (
            "zero",
            f"qpos{of} and ctrl are never less than {apart:.3g} apart over a motion of {max(moved, asked):.3g}: look "
            "whether both count from the same zero (bench.params.position_offset)",
        )


def _doubt_opposed(
    log: Log, of: str, bench: Bench, joint: int, cleaned: Mapping[str, np.ndarray]
) -> Iterator[tuple[str, str]]:
    """A command that takes energy; of a joint that others move and that gravity may drive, that is only doubtful."""
    signals = {name: getattr(log, name).copy() for name in cleaned}
    for name, values in cleaned.items():
        signals[name][:, joint] = values
    share = float(_work(replace(log, **signals), bench)[joint])
    took = f"ctrl{of} takes energy from the drive all along ({100 * share:.0f} % of what it exchanges)"
    alone = bench.branches.count(bench.branches[joint]) == 1
    if alone and share < OPPOSED:
        raise LogError(
            f"{log.name}: {took}, expected to give it; set data.sign.ctrl=-1, or the sign of both qpos and qvel, or "
            "look whether qpos and ctrl are swapped, have other units or another zero, or belong to other times "
            "(data.columns, data.units)"
        )
    if not alone and share < CARRIED:
        yield "opposed", f"{took}: right where gravity or other joints move it, else look at its sign (data.sign.ctrl)"


def _work(log: Log, bench: Bench) -> Float[np.ndarray, "nv"]:
    """Net work that the commands did on each joint, as a share of what they exchanged.

    The actuator's torque with initial values, its damping left out, as if the joint stood still. Over a recording,
    friction and damping take what the commands give, but for what the drive stores between its first and its last
    state; so the net work is not negative, however late the drive follows, up to half a period.
    """
    values = bench.initial_values()
    still = np.zeros_like(log.qvel)
    ctrl = bench.actuator.control(np, values, log.qpos, still, log.ctrl, log.inputs)
    affine = bench.actuator.affine(values)
    torque = affine.gain * ctrl + affine.bias0 + affine.bias1 * log.qpos
    enabled = log.inputs.get("enable", 1.0)
    power = enabled * torque * log.qvel
    return power.sum(axis=0) / np.maximum(np.abs(power).sum(axis=0), 1e-300)
