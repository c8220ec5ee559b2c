"""Limits that recordings show: a drive was seen to move so far, so fast and with so much torque."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from frictionzoo.bench import Bench
from frictionzoo.bench.torque import actuator_torque, stall_torque
from frictionzoo.core.log import Log

_USUAL = 0.999  # quantile of the samples that a limit holds: what lies beyond may be an outlier
_DIGITS = 3  # of a limit


def usual_inputs(bench: Bench, logs: Sequence[Log]) -> dict[str, Float[np.ndarray, "nv"]]:
    """Return what the actuator law usually gets besides the command, without feed-forward commands.

    Args:
        bench: The test stand.
        logs: Accepted by the bench.
    """
    law = bench.actuator
    fed = set(law.commands) & set(law.optional_inputs)
    names = [name for name in law.inputs if name not in fed]
    return {name: np.median(np.concatenate([log.inputs[name] for log in logs]), axis=0) for name in names}


def recorded_limits(bench: Bench, values: Mapping[str, Any], logs: Sequence[Log]) -> dict[str, Any]:
    """Return `position`, `velocity` and `torque` of each joint, as options of `frictionzoo.excite` have them.

    None exceeds the recorded motion. The torque is that of the identified actuator at the recorded states, and never
    above what the actuator gives at standstill. All are rounded towards less.

    Args:
        bench: The test stand.
        values: Identified values of the bench's parameters, each of shape (nv,).
        logs: Training recordings, accepted by the bench.
    """
    qpos = np.concatenate([log.qpos for log in logs])
    low, high = (np.quantile(qpos, share, axis=0) for share in (1 - _USUAL, _USUAL))
    velocity = np.quantile(np.abs(np.concatenate([log.qvel for log in logs])), _USUAL, axis=0)
    used = np.quantile(np.abs(np.concatenate([actuator_torque(bench, log, values) for log in logs])), _USUAL, axis=0)
    inputs = {name: np.zeros(bench.nv) for name in bench.actuator.inputs} | usual_inputs(bench, logs)
    torque = np.minimum(used, stall_torque(bench, values, inputs, (low + high) / 2))
    pairs = [[-round_down(-a), round_down(b)] for a, b in zip(low, high, strict=True)]
    found = {"position": pairs, "velocity": list(map(round_down, velocity)), "torque": list(map(round_down, torque))}
    return found if bench.nv > 1 else {name: each[0] for name, each in found.items()}


def round_down(value: float) -> float:
    """Return the largest number of three digits that is not above a value."""
    if not np.isfinite(value) or value == 0:
        return float(value)
    decimals = _DIGITS - 1 - int(np.floor(np.log10(abs(value))))
    nearest = round(float(value), decimals)
    return nearest if nearest <= value else round(nearest - 10.0**-decimals, decimals)
