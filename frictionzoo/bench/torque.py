"""Torque of a bench's actuators, at recorded states and the largest at standstill."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from frictionzoo.bench.base import Bench
from frictionzoo.core.log import Log

_FAR = 1e6  # command [rad, m or the command's unit] that saturates any actuator with a limit
_SAME = 1e-3  # largest relative change of a saturated torque when the command is doubled


def actuator_torque(
    bench: Bench, log: Log, values: Mapping[str, Any], qvel: Float[np.ndarray, "time nv"] | None = None
) -> Float[np.ndarray, "time nv"]:
    """Return the actuators' torque at the states of an accepted log [N m or N], times `enable` if recorded.

    `values` are the bench's parameters; `delay` [s] delays the commands. `qvel` replaces the recorded velocities.
    """
    qvel, delay = log.qvel if qvel is None else qvel, values.get("delay")
    log = log if delay is None else _late(log, bench.actuator.commands, np.broadcast_to(delay, bench.nv))
    ctrl = bench.actuator.control(np, values, log.qpos, qvel, log.ctrl, log.inputs)
    affine = bench.actuator.affine(values)
    torque = affine.gain * ctrl + affine.bias0 + affine.bias1 * log.qpos + affine.bias2 * qvel
    return np.asarray(log.inputs.get("enable", 1.0) * torque)


def stall_torque(
    bench: Bench, values: Mapping[str, Any], inputs: Mapping[str, Any], qpos: Float[np.ndarray, "nv"]
) -> Float[np.ndarray, "nv"]:
    """Return the largest torque of each actuator at standstill at `qpos` [N m or N]; infinite without a limit.

    The value is the smaller one of both directions. `inputs` are the actuator law's, each of shape (nv,).
    """
    zeros, affine = np.zeros(bench.nv), bench.actuator.affine(values)

    def torque(command: float) -> np.ndarray:
        ctrl = bench.actuator.control(np, values, qpos, zeros, qpos + command, inputs)
        return np.abs(affine.gain * ctrl + affine.bias0 + affine.bias1 * qpos)

    ends = [(torque(sign * _FAR), torque(2 * sign * _FAR)) for sign in (1, -1)]
    limited = [np.where(np.abs(twice - once) <= _SAME * once, once, np.inf) for once, twice in ends]
    return np.minimum(*limited)


def _late(log: Log, commands: tuple[str, ...], delay: Float[np.ndarray, "nv"]) -> Log:
    """Return the log with each command delayed by the delay of its joint [s], rounded up to whole samples."""
    samples = np.arange(log.samples)[:, None] - np.ceil(np.maximum(delay, 0) / log.timestep - 1e-9).astype(int)
    rows, columns = np.maximum(samples, 0), np.arange(len(delay))
    delayed = {name: log.inputs[name][rows, columns] for name in commands}
    return replace(log, ctrl=log.ctrl[rows, columns], inputs={**log.inputs, **delayed})
