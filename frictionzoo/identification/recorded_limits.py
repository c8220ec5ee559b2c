"""Limits of position, velocity and torque derived from recordings."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from frictionzoo.bench import Bench
from frictionzoo.bench.torque import actuator_torque, stall_torque
from frictionzoo.core.log import Log

_USUAL = 0.999  # quantile of the samples within a limit: samples beyond may be outliers
_DIGITS = 3  # digits of a limit


def usual_inputs(bench: Bench, logs: Sequence[Log]) -> dict[str, Float[np.ndarray, "nv"]]:
    """Return the actuator model's median inputs in accepted logs, without feed-forward commands."""
    actuator = bench.actuator
    feed_forward = set(actuator.commands) & set(actuator.optional_inputs)
    names = [name for name in actuator.inputs if name not in feed_forward]
    return {name: np.median(np.concatenate([log.inputs[name] for log in logs]), axis=0) for name in names}


def recorded_limits(bench: Bench, values: Mapping[str, Any], logs: Sequence[Log]) -> dict[str, Any]:
    """Return the limits `position`, `velocity` and `torque` of each joint as options of `frictionzoo.design`.

    No limit exceeds the recorded motion. The torque is the identified actuator's at the recorded states, at most its
    torque at standstill. All limits are rounded down in magnitude. `values` are the bench's identified parameters, each
    of shape (nv,); `logs` are training logs that the bench has accepted.
    """
    qpos = np.concatenate([log.qpos for log in logs])
    low, high = (np.quantile(qpos, share, axis=0) for share in (1 - _USUAL, _USUAL))
    velocity = np.quantile(np.abs(np.concatenate([log.qvel for log in logs])), _USUAL, axis=0)
    used_torque = np.quantile(
        np.abs(np.concatenate([actuator_torque(bench, log, values) for log in logs])), _USUAL, axis=0
    )
    inputs = {name: np.zeros(bench.nv) for name in bench.actuator.inputs} | usual_inputs(bench, logs)
    torque = np.minimum(used_torque, stall_torque(bench, values, inputs, (low + high) / 2))
    pairs = [[-round_down(-a), round_down(b)] for a, b in zip(low, high, strict=True)]
    limits = {"position": pairs, "velocity": list(map(round_down, velocity)), "torque": list(map(round_down, torque))}
    return limits if bench.nv > 1 else {name: limit[0] for name, limit in limits.items()}


def round_down(value: float) -> float:
    """Round down to three significant digits."""
    if not np.isfinite(value) or value == 0:
        return float(value)
    decimals = _DIGITS - 1 - int(np.floor(np.log10(abs(value))))
    nearest = round(float(value), decimals)
    return nearest if nearest <= value else round(nearest - 10.0**-decimals, decimals)
