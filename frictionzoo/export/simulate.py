"""MuJoCo C under the commands of recordings: how written models are compared with the fitted drive."""

from collections.abc import Callable
from operator import itemgetter

import mujoco
import numpy as np
from jaxtyping import Float

from frictionzoo.core.state import Signals
from frictionzoo.result.identified import Identified

PAYLOADS = "Payloads of recordings are left out; for the difference above they were put into the model."

Step = Callable[[mujoco.MjModel, mujoco.MjData, Signals], None]
"""Advances a model by one time step under one sample of the commands and both laws' other inputs."""


def simulate(
    model: mujoco.MjModel,
    fitted: Identified,
    step: Step,
    prepare: Callable[[mujoco.MjModel, mujoco.MjData, int], None] = lambda *_: None,
    late: bool = True,
) -> Float[np.ndarray, "batch time nv"]:
    """Positions after each sample of the long test rollouts.

    Args:
        model: What was written, compiled; payloads are put into it.
        fitted: The drive whose rollouts these are.
        step: One time step.
        prepare: Called with a rollout's number before it begins, from its initial state.
        late: Whether the commands that `step` gets are late by the bench's delay.
    """
    segments = fitted.segments
    signals = fitted.acting(late=late)
    qpos = np.empty((segments.count, segments.length, fitted.bench.nv))
    for rollout in range(segments.count):
        if segments.load is not None:
            fitted.bench.put_load(model, segments.load[rollout])
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = segments.qpos[rollout, 0], segments.qvel[rollout, 0]
        prepare(model, data, rollout)
        for sample in range(segments.length):
            for substep in range(fitted.sampling.substeps):
                step(model, data, signals.map(itemgetter((rollout, sample, substep))))
            qpos[rollout, sample] = data.qpos
    return qpos


def step_with_control(fitted: Identified) -> Step:
    """A step in which the caller computes the actuator law's controller, and MuJoCo does the rest."""
    bench = fitted.bench

    def step(model: mujoco.MjModel, data: mujoco.MjData, signals: Signals) -> None:
        state = data.qpos, data.qvel
        data.ctrl[:] = bench.actuator.control(np, fitted.values["bench"], *state, signals.ctrl, signals.inputs)
        mujoco.mj_step(model, data)

    return step


def commands_before(fitted: Identified, rollout: int) -> Signals:
    """The commands in the steps before the first state of a rollout of this number, the newest last; at least one.

    Each of shape (steps, nv); `inputs` has those that are commands alone.
    """
    segments = fitted.segments
    inputs = {name: segments.signals.inputs[name] for name in fitted.sampling.commands}
    known = Signals(segments.signals.ctrl, inputs).map(lambda signal: signal[rollout, : max(segments.history, 1)])
    return known.map(lambda signal: np.repeat(signal, fitted.sampling.substeps, axis=0))
