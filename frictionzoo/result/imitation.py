"""Imitations of recordings: rollouts of the identified drive, with encoder noise and no model error."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from frictionzoo.core.described import remake
from frictionzoo.core.errors import FrictionzooError
from frictionzoo.core.log import Log
from frictionzoo.core.segments import cut_rollouts
from frictionzoo.data.signals import find_noise, find_quantum
from frictionzoo.fit import Space
from frictionzoo.fit.motion import Recordings
from frictionzoo.simulation.drive import Drive

MOST_STEPS = 1e6  # most simulation steps times joints
STIFFEST = 5e-4  # s, smallest time constant of the friction constraint
STOCK = 2  # most joints for plain MJX; more are too slow
ASTRAY = 0.5  # largest RMS error of the motion, as a share of its standard deviation


def imitate(
    recordings: Recordings, space: Space, vector: Float[np.ndarray, "coordinates"], stiff: bool = False
) -> tuple[Log, ...] | None:
    """Simulate an identified drive under recorded commands, and measure it like the recordings.

    The positions get the encoders' noise and quantisation, estimated from the recordings. All logs are cut to the
    length of the shortest one, and `MOST_STEPS` limits their number. With `stiff`, dry friction is as stiff as the
    simulation step allows, instead of as in the bench.

    Returns:
        Imitated logs. None: the simulation fails or takes too long, or the motion differs too much from the recording,
        as it soon does with pure torque commands.
    """
    bench, model, logs = recordings
    if stiff:
        bench = remake(bench, solreffriction=[max(2 * bench.timestep, STIFFEST), 1.0]).observing(bench.observed)
    sampling = bench.sampling(logs[0].timestep)
    length = min(log.samples for log in logs) - 1
    count = min(len(logs), int(MOST_STEPS / (length * sampling.substeps * bench.nv)))
    try:
        drive = Drive.assemble(bench, model, "auto", sampling)
        if not count or (drive.engine.name == "mjx" and bench.nv > STOCK):
            return None
        chosen = [log.between(0, length + 1, "imitation") for log in logs[:count]]
        windows = cut_rollouts(chosen, length * logs[0].timestep, None, "consecutive", 0, sampling.history)
        values = space.values(jnp.asarray(vector, space.start.dtype))
        states = windows.qpos[:, 0], windows.qvel[:, 0], windows.signals, windows.loads
        qpos, qvel = (np.asarray(part, np.float64) for part in drive.rollout.compiled(values, *states))
    except FrictionzooError:
        return None
    with np.errstate(over="ignore", invalid="ignore"):  # diverged rollouts
        difference = np.sqrt(np.mean(np.square(qpos - windows.qpos[:, 1:]), axis=(0, 1)))
    if not (difference < ASTRAY * windows.qpos.std(axis=(0, 1))).all():  # False with NaN
        return None
    random = np.random.default_rng(0)
    cut = [log.between(1, length + 1, log.name) for log in chosen]
    return tuple(replace(log, qpos=_measure(log, q, random), qvel=v) for log, q, v in zip(cut, qpos, qvel, strict=True))


def _measure(log: Log, qpos: Float[np.ndarray, "time nv"], random: np.random.Generator) -> Float[np.ndarray, "time nv"]:
    """Return positions with the noise and quantisation of a log's encoders."""
    steps = np.array([find_quantum(column) or 0.0 for column in log.qpos.T])
    noise = np.array([find_noise(column) for column in log.qpos.T])
    noisy = qpos + np.sqrt(np.maximum(noise**2 - steps**2 / 12, 0)) * random.normal(size=qpos.shape)
    return np.where(steps > 0, np.round(noisy / np.maximum(steps, 1e-300)) * steps, noisy)


def add_noise(log: Log) -> Log:
    """Return a log with additional position noise as large as the noise of its encoders."""
    noise = np.array([find_noise(column) for column in log.qpos.T])
    return replace(log, qpos=log.qpos + noise * np.random.default_rng(0).normal(size=log.qpos.shape))
