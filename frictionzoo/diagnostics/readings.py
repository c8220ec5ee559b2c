"""Alternative readings of a recording: joints reordered or reversed to match the links' torque better."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import mujoco
import numpy as np

from frictionzoo.bench import Bench
from frictionzoo.core.log import Log
from frictionzoo.diagnostics.balance import balance, mismatch
from frictionzoo.diagnostics.findings import Finding, Repair, turn

SHORT = 100  # samples; shorter recordings are not checked
WORTH = 0.08  # unexplained variance share of a joint's torque above which other readings are tried
MUCH_BETTER = 0.5  # factor on the recording's unexplained share that another reading has to reach
AS_GOOD = 1.5  # factor on the best reading's unexplained share up to which another is reported with it
GAINED = 0.1  # smallest reduction of the unexplained share, summed over joints


def check_readings(log: Log, bench: Bench, model: mujoco.MjModel) -> Iterator[Finding]:
    """Find reordered or reversed joints that explain the torque of a recording much better."""
    if bench.nv == 1 or log.samples <= SHORT:
        return
    unchanged = balance(log, bench, model)
    unexplained = np.zeros(1) if unchanged is None else mismatch(unchanged)
    if unexplained.max() < WORTH:
        return
    branches, better = np.array(bench.branches), list[tuple[float, float, str, tuple[Repair, ...]]]()
    for joint, sentence, change, repairs in _other_readings(bench):
        of_branch = branches == branches[joint]
        changed = balance(change(log), bench, model) if unexplained[of_branch].max() > WORTH else None
        if changed is not None:
            before, after = float(unexplained[of_branch].sum()), float(mismatch(changed)[of_branch].sum())
            if after < MUCH_BETTER * before and before - after > GAINED:
                better.append((after, before, sentence, repairs))
    if better:
        after, before, _, repairs = min(better)
        # A hanging leg moves like its mirror image: several readings may be equally good.
        sentences = [sentence for new, old, sentence, _ in sorted(better) if new < AS_GOOD * after and old == before]
        text = "the actuators' torque matches the torque that the links need much better (unexplained share "
        text += f"{after:.2g} instead of {before:.2g}, summed over coupled joints) if {'; or if '.join(sentences)}"
        yield Finding("caution", "reading", text, log=log.name, repairs=repairs)


def _other_readings(bench: Bench) -> Iterator[tuple[int, str, Callable[[Log], Log], tuple[Repair, ...]]]:
    """Yield alternative readings: joint, sentence with the repair, change of the recording, and options (if any)."""
    for joint, name in enumerate(bench.joints):
        sign = np.where(np.arange(bench.nv) == joint, -1, 1)
        text = f"{name} is reversed: set data.sign.qpos, data.sign.qvel and data.sign.ctrl="
        text += f"[{','.join(map(str, sign))}], or reverse its axis in the MJCF"
        yield joint, text, partial(_turn, sign), turn(joint, "qpos", "qvel", "ctrl")
        for other in range(joint):
            if bench.branches[joint] == bench.branches[other]:
                order = np.arange(bench.nv)
                order[[joint, other]] = other, joint
                pair = f"{bench.joints[other]} and {name} are swapped: exchange them in"
                yield joint, f"{pair} bench.joint or data.columns", partial(_order, order, True), ()
                yield joint, f"ctrl of {pair} data.columns.ctrl", partial(_order, order, False), ()


def _turn(sign: np.ndarray, log: Log) -> Log:
    inputs = {name: sign * v if name in ("ctrl_velocity", "ctrl_torque") else v for name, v in log.inputs.items()}
    return replace(log, qpos=sign * log.qpos, qvel=sign * log.qvel, ctrl=sign * log.ctrl, inputs=inputs)


def _order(order: np.ndarray, whole: bool, log: Log) -> Log:
    log = replace(log, ctrl=log.ctrl[:, order], inputs={name: v[:, order] for name, v in log.inputs.items()})
    return replace(log, qpos=log.qpos[:, order], qvel=log.qvel[:, order]) if whole else log
