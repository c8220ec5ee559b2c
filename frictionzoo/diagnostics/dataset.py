"""Diagnostics of a whole data set: declared units, excitation, and limits and contacts at the recorded positions."""

from collections import Counter
from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from frictionzoo.bench import Bench
from frictionzoo.bench.compiled import can_collide
from frictionzoo.core.log import Dataset, Log
from frictionzoo.core.telling import say_percent
from frictionzoo.diagnostics.findings import Finding, of_joint

UNITS = {
    **dict.fromkeys(("rad", "mrad", "deg", "rev"), "hinge"),
    **dict.fromkeys(("m", "mm", "um"), "slide"),
    **dict.fromkeys(("Nm", "mNm", "N", "A", "mA", "V", "mV"), "effort"),
}
"""Quantity of each unit; other units, such as the factor of a raw register, are not checked."""
MEANS = {"hinge": "angles", "slide": "lengths"}
MOVING = 0.05  # share of the top speed above which a joint moves
ONE_WAY = 0.01  # share of moving samples in the rarer direction below which a joint does not reverse
ONE_SPEED = 1.5  # smallest ratio of the 90 % to the 10 % quantile of the speed of moving samples
STATES = 2000  # recorded states in which contacts and limits are sought, about


def check_declared(dataset: Dataset, bench: Bench, to_position: bool) -> Iterator[Finding]:
    """Find lengths on a hinge, angles on a slide, and commands that the actuator law does not accept."""
    unit: dict[str, str] = {}
    for log in dataset.logs:
        unit |= log.units
    joints = ", ".join(bench.joints[:3]) + (", ..." if bench.nv > 3 else "")
    for signal in ("qpos", "ctrl"):
        kind = UNITS.get(unit.get(signal, "").replace(" ", ""))
        if kind in MEANS and (signal == "qpos" or to_position) and kind != bench.joint_type:
            text = f"{dataset.name}: {signal} is in {unit[signal]}, expected {MEANS[bench.joint_type]} for {joints} of "
            text += f"{bench.source}, a {bench.joint_type}; choose the bench of these recordings (bench=NAME, or "
            text += f"bench.mjcf and bench.joint), or set data.units.{signal}"
            yield Finding("bad", f"declared {signal}", text)
        elif signal == "ctrl" and kind is not None and (kind != "effort") != to_position:
            law = type(bench.actuator).__name__
            wanted = "a desired position" if to_position else "a torque, force or current"
            text = f"{dataset.name}: ctrl is in {unit[signal]}, expected {wanted} for {law} of {bench.source}; choose "
            text += "the bench of these recordings (bench=NAME) or its actuator (bench.actuator._target_), or set "
            text += "data.units.ctrl"
            yield Finding("bad", "declared ctrl", text)


def check_excitation(logs: Sequence[Log], bench: Bench) -> Iterator[Finding]:
    """Find joints that never reverse or that move at one speed."""
    for joint, name in enumerate(bench.joints):
        of = of_joint(bench.joints, joint)
        velocity = np.concatenate([log.qvel[:, joint] for log in logs])
        top = float(np.quantile(np.abs(velocity), 0.99))
        moving = velocity[np.abs(velocity) > MOVING * top]
        if not top > 0 or len(moving) < 2:
            continue
        back = min(float(np.mean(moving > 0)), float(np.mean(moving < 0)))
        slow, fast = np.quantile(np.abs(moving), [0.1, 0.9])
        if back < ONE_WAY:
            text = f"the motion{of} hardly reverses ({say_percent(back)} in the other direction): dry friction and a "
            text += "constant torque cannot be distinguished; record both directions and list them in data.train"
            yield Finding("caution", "one way", text, joint=name)
        if fast < ONE_SPEED * slow:
            text = f"the motion{of} has one speed, {slow:.3g} to {fast:.3g} in most samples: dry and viscous friction "
            text += "cannot be distinguished; record slower and faster motion and list it in data.train, or fix one "
            text += "of them (model=mujoco_default model.params.damping.identify=false)"
            yield Finding("caution", "one speed", text, joint=name)


def check_motion(dataset: Dataset, bench: Bench) -> Iterator[Finding]:
    """Find motion beyond limits that the bench ignores, and limits and contacts of the MuJoCo model in its course."""
    qpos = np.concatenate([log.qpos for log in dataset.logs])
    for joint, (low, high), positions in zip(bench.joints, bench.unlimited, qpos.T, strict=True):
        beyond = (positions < low) | (positions > high)
        if beyond.any():
            share = f"{say_percent(beyond.mean())} of the recorded positions"
            text = f"joint {joint} is beyond its limits in the file, {low:.4g} to {high:.4g}, in {share}, which span "
            text += f"{positions.min():.4g} to {positions.max():.4g}: the joint may have hit a stop, or its zero or "
            text += "sign differs from the file (data.sign, bench.limits=keep)"
            yield Finding("caution", "limits", text, joint=joint)
    model = bench.compile(constraint=False)
    limited = model.jnt_limited.any() or model.tendon_limited.any()
    if not (limited or model.npair or can_collide(model)):
        return
    data, counts = mujoco.MjData(model), Counter[str]()
    qpos = qpos[:: max(1, len(qpos) // STATES)]
    for position in qpos:
        data.qpos[:] = position
        mujoco.mj_fwdPosition(model, data)
        counts.update({*_list_forces(model, data)})
    for text, times in counts.items():
        share = say_percent(times / len(qpos))
        message = f"{text} in {share} of the recorded positions: MuJoCo applies a force there, "
        message += "which biases friction; check these positions, or remove the limit or contact from the MJCF"
        yield Finding("caution", text, message)


def _list_forces(model: mujoco.MjModel, data: mujoco.MjData) -> Iterator[str]:
    """Yield limits that are reached, and geoms that touch."""
    for kind, index in zip(data.efc_type, data.efc_id, strict=True):
        if kind == mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT:
            yield f"joint {model.joint(index).name} is at its limit"
        elif kind == mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON:
            yield f"tendon {model.tendon(index).name or index} is at its limit"
    for pair in data.contact.geom:
        yield "geoms {} and {} touch".format(*(model.geom(geom).name or f"number {geom}" for geom in pair))
