"""Diagnostics of limits and contacts at the recorded positions, where drive and simulation may differ."""

from collections.abc import Iterator

import mujoco
import numpy as np

from frictionzoo.bench import Bench
from frictionzoo.bench.compiled import can_collide
from frictionzoo.core.log import Dataset
from frictionzoo.diagnostics.findings import Finding

STATES = 2000  # recorded states in which contacts and limits are sought, about


def check_motion(dataset: Dataset, bench: Bench) -> Iterator[Finding]:
    """Find limits and contacts of the MuJoCo model at the recorded positions."""
    yield from _find_limits(dataset, bench)
    yield from _find_pushes(dataset, bench)


def _find_limits(dataset: Dataset, bench: Bench) -> Iterator[Finding]:
    """Find motion beyond limits of the file that the bench ignores."""
    qpos = np.concatenate([log.qpos for log in dataset.logs])
    for joint, (low, high), positions in zip(bench.joints, bench.unlimited, qpos.T, strict=True):
        beyond = (positions < low) | (positions > high)
        if beyond.any():
            share = f"{100 * beyond.mean():.2g} % of the recorded positions"
            yield Finding(
                "limits",
                False,
                f"joint {joint} is beyond its limits in the file, {low:.4g} to {high:.4g}, in {share}, which span "
                f"{positions.min():.4g} to {positions.max():.4g}: a stop may have pushed there, or zero or sign of "
                "the joint differ from the file (data.sign, bench.limits=keep)",
                joint=joint,
            )


def _find_pushes(dataset: Dataset, bench: Bench) -> Iterator[Finding]:
    """Find active limits and contacts in MuJoCo C at the recorded positions."""
    model = bench.compile(constraint=False)
    limited = model.jnt_limited.any() or model.tendon_limited.any()
    if not (limited or model.npair or can_collide(model)):
        return
    data, counts = mujoco.MjData(model), dict[str, int]()
    qpos = np.concatenate([log.qpos for log in dataset.logs])
    qpos = qpos[:: max(1, len(qpos) // STATES)]
    for position in qpos:
        data.qpos[:] = position
        mujoco.mj_fwdPosition(model, data)
        for text in {*_limits(model, data), *_contacts(model, data)}:
            counts[text] = counts.get(text, 0) + 1
    for text, times in counts.items():
        yield Finding(
            text,
            False,
            f"{text} in {100 * times / len(qpos):.2g} % of the recorded positions: MuJoCo applies a force there, which "
            "biases friction; check these positions, or remove the limit or contact from the MJCF",
        )


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
