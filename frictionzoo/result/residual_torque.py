"""Residual torque of the training recordings, and of imitations: rollouts of the drive with encoder noise."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
import torch
from jaxtyping import Bool, Float, Int

from frictionzoo.core.described import remake
from frictionzoo.core.errors import FrictionzooError
from frictionzoo.core.log import Log
from frictionzoo.core.segments import cut_rollouts
from frictionzoo.core.state import DriveState
from frictionzoo.data.signals import find_noise, find_quantum
from frictionzoo.fit import Space
from frictionzoo.fit.motion import Decimation, Filtering, Recordings
from frictionzoo.fit.torque_equation import TorqueEquation
from frictionzoo.models import FrictionModel
from frictionzoo.models.base import sliding_torque
from frictionzoo.models.formula import torch_state
from frictionzoo.models.sees import observe
from frictionzoo.result.evaluate import rms
from frictionzoo.result.portrait import Rows
from frictionzoo.simulation.drive import Drive

LONGEST = 40_000  # most samples analysed, shared by the logs
SHORTEST = 1.0  # s; shorter logs consist mostly of filter transients
FEWEST = 100  # fewest rows in total, and of a joint
BANDWIDTHS = 10.0, 5.0  # Hz, tried if noise dominates at a higher bandwidth
DROWNED = 0.5  # largest share of noise in the residual variance
SOFTER = 1.1  # largest ratio of the imitation's residual torque to the recording's
MOST_STEPS = 1e6  # most simulation steps times joints
STIFFEST = 5e-4  # s, smallest time constant of the friction constraint
STOCK = 2  # most joints for plain MJX; more are too slow
ASTRAY = 0.5  # largest RMS error of the motion, as a share of its standard deviation
_log = logging.getLogger(__name__)

Friction = Callable[[Mapping[str, Any], DriveState], np.ndarray]
Torque = Float[np.ndarray, "rows nv"]
Coordinates = Float[np.ndarray, "coordinates"]


class Left(NamedTuple):
    """Residual torque of the training recordings.

    Attributes:
        torque: Residual torque [N m or N].
        friction: Model friction, filtered and decimated [N m or N].
        unfiltered: Model friction at the rows' instants, not filtered [N m or N].
        counts: Rows of each joint that count: those in motion.
        recordings: Bench, friction model and analysed logs.
        state: Inputs of the model in all samples.
        bandwidth: Bandwidth of the comparison [Hz].
        nothing: Reference without model error: the identified drive, simulated under the same commands and measured by
            the same encoders. If its motion differs too much from the recording: the effect of encoder noise.
    """

    equation: TorqueEquation
    torque: Torque
    friction: Torque
    unfiltered: Torque
    counts: Bool[np.ndarray, "rows nv"]
    recordings: Recordings
    state: DriveState
    bandwidth: float
    nothing: "Left | None" = None

    def of(self, joint: int) -> Float[np.ndarray, "counted"]:
        """Return the residual torque of a joint in the rows that count."""
        return self.torque[self.counts[:, joint], joint]

    def noise(self, joint: int) -> Float[np.ndarray, "counted"]:
        """Return the reference's residual torque of a joint."""
        return np.zeros(1) if self.nothing is None else self.nothing.of(joint)

    def law(self, joint: int) -> tuple[FrictionModel, set[str]]:
        """Return the friction model of a joint and the quantities on which it depends."""
        model = self.recordings.model
        law = model.of_joint(joint)[0]
        return law, {*law.sees} or observe(model, self.state)

    @property
    def time(self) -> Float[np.ndarray, "rows"]:
        """Time of each row, with the logs one after the other [s]."""
        return self.recordings.logs[0].timestep * self._places

    @property
    def rows(self) -> Rows:
        """Rows for friction curves, with the needed actuator torque, because the applied one correlates with errors."""
        state = self.state.map(lambda signal: signal[self._places])
        motor = state.motor_torque - self.torque
        return Rows(state._replace(motor_torque=motor), self.counts, self.unfiltered + self.torque)

    @property
    def _places(self) -> Int[np.ndarray, "rows"]:
        return list_samples(self.equation.decimate)


def find_left(recordings: Recordings, space: Space, vector: Coordinates, filtering: Filtering) -> Left | None:
    """Compute the residual torque up to the highest bandwidth in which noise does not dominate.

    `recordings` holds the training logs and the fitted model, `vector` its values in the coordinates of `space`. None:
    fewer than `FEWEST` rows, or it cannot be computed and a log line gives the reason.
    """
    bench, model, logs = recordings
    logs = _shorten(logs)
    try:
        if sum(filtering.decimation(logs).rows) < FEWEST:
            return None
        residual = _narrow(Recordings(bench, model, logs), space, vector, filtering)
    except FrictionzooError as error:
        _log.info("no residual analysis: %s", error)
        return None
    if not np.isfinite(residual.torque).all():
        _log.info("no residual analysis: the residual torque is not finite with these values")
        return None
    return residual


def _shorten(logs: Sequence[Log]) -> tuple[Log, ...]:
    """Reduce the logs to about `LONGEST` samples: drop short logs, thin out many logs, and cut long ones."""
    chosen = [log for log in logs if log.samples * log.timestep > SHORTEST] or list(logs)
    samples = sum(log.samples for log in chosen)
    if samples > LONGEST:
        chosen = chosen[:: max(1, round(samples / LONGEST))]
    longest = max(LONGEST // len(chosen), round(SHORTEST / chosen[0].timestep))
    return tuple(log if log.samples <= longest else log.between(0, longest, "start") for log in chosen)


def _narrow(recordings: Recordings, space: Space, vector: Coordinates, filtering: Filtering) -> Left:
    imitations = _imitate(recordings, space, vector)
    white = (np.random.default_rng(0).normal(size=log.qpos.shape) for log in recordings.logs)
    pairs = zip(recordings.logs, white, strict=True)
    noisy_logs = tuple(replace(log, qpos=log.qpos + _encoder_noise(log) * noise) for log, noise in pairs)

    def leave(logs: Sequence[Log], filtering: Filtering) -> Left:
        return _leave(recordings._replace(logs=logs), space, vector, filtering)

    def compare(filtering: Filtering) -> tuple[Left, bool]:
        """Compute the residual torque with its reference, and whether encoder noise dominates."""
        residual, noisy = leave(recordings.logs, filtering), leave(noisy_logs, filtering)
        noise = noisy._replace(torque=noisy.torque - residual.torque, counts=residual.counts)
        dominated = (np.square(noise.torque).mean(axis=0) > DROWNED * np.square(residual.torque).mean(axis=0)).any()
        return residual._replace(nothing=noise if imitations is None else leave(imitations, filtering)), bool(dominated)

    residual, dominated = compare(filtering)
    # At reversals, a soft constraint gives the imitation more residual torque than a real drive has.
    joints = range(recordings.bench.nv)
    if imitations and any(rms(residual.noise(joint)) > SOFTER * rms(residual.of(joint)) for joint in joints):
        imitations = _imitate(recordings, space, vector, stiff=True) or imitations
        residual = residual._replace(nothing=leave(imitations, filtering))
    for bandwidth in BANDWIDTHS:
        if not dominated or bandwidth >= filtering.bandwidth:
            break
        try:
            narrower = replace(filtering, bandwidth=bandwidth)
            if sum(narrower.decimation(recordings.logs).rows) < FEWEST:
                break
            (residual, dominated), filtering = compare(narrower), narrower
        except FrictionzooError:  # too short for this bandwidth
            break
    return residual


def _leave(recordings: Recordings, space: Space, vector: Coordinates, filtering: Filtering) -> Left:
    bench, model, logs = recordings

    def velocity_noise(log: Log) -> Float[np.ndarray, "nv"]:
        """Return the standard deviation of velocity noise caused by encoder noise [rad/s or m/s]."""
        white = filtering.motion(replace(log, qpos=np.random.default_rng(0).normal(size=log.qpos.shape)))
        return _encoder_noise(log) * np.sqrt(np.mean(np.square(white.qvel), axis=0))

    substeps = bench.sampling(logs[0].timestep).substeps
    equation = TorqueEquation(space, recordings, filtering, held=True, substeps=substeps)
    values, state = space.values(jnp.asarray(vector, space.start.dtype))["friction"], equation.state(vector)
    friction = follow(model, logs)(values, state)
    speed = np.abs(equation.motion.qvel)
    noise = np.concatenate([np.broadcast_to(velocity_noise(log), log.qpos.shape) for log in logs])
    slow = speed < np.maximum(filtering.slow * np.sqrt(np.mean(np.square(speed), axis=0)), 3 * noise)
    near = max(1, round(0.5 / filtering.bandwidth / logs[0].timestep))
    decimate, places = equation.decimate, list_samples(equation.decimate)
    rows = decimate(friction), friction[places], ~_near_rest(slow, near, decimate)[places]
    return Left(equation, equation.left(vector, friction), *rows, recordings, state, filtering.bandwidth)


def _near_rest(slow: Bool[np.ndarray, "time nv"], near: int, decimate: Decimation) -> Bool[np.ndarray, "time nv"]:
    """Return the samples within `near` of a rest, where friction is whatever holds the joint; the filter spreads it."""
    parts = []
    for part in np.split(slow, np.cumsum(decimate.lengths)[:-1]):
        lasting = scipy.ndimage.binary_opening(part, np.ones((max(2, near // 2), 1)))
        parts.append(scipy.ndimage.binary_dilation(lasting, np.ones((2 * near + 1, 1))))
    return np.concatenate(parts)


def list_samples(decimate: Decimation) -> Int[np.ndarray, "rows"]:
    """Return the index of each row's sample."""
    starts = np.cumsum((0, *decimate.lengths[:-1]))
    ends = zip(starts, decimate.lengths, strict=True)
    return np.concatenate(
        [start + np.arange(decimate.edge, length - decimate.edge, decimate.factor) for start, length in ends]
    )


def follow(model: FrictionModel, logs: Sequence[Log]) -> Friction:
    """Return a function for the model torque over recorded motion [N m or N]; memory restarts with each log."""
    if model.memory:
        return _remember(model, logs)

    def friction(values: Mapping[str, Any], state: DriveState) -> Float[np.ndarray, "time nv"]:
        tensors = {name: torch.tensor(np.asarray(value, np.float64)) for name, value in values.items()}
        with torch.no_grad():
            inputs = torch_state(state)
            return sliding_torque(torch, model.terms(torch, tensors, inputs), inputs.qvel).numpy()

    return friction


def _remember(model: FrictionModel, logs: Sequence[Log]) -> Friction:
    begins = np.zeros(sum(log.samples for log in logs), bool)
    begins[np.cumsum([0, *(log.samples for log in logs[:-1])])] = True

    @jax.jit
    def follow(values: Mapping[str, Any], state: DriveState) -> Any:
        def step(memory: Any, now: tuple[DriveState, Any]) -> tuple[Any, Any]:
            inputs, begin = now
            memory = jnp.where(begin, model.settle(jnp, values, inputs), memory)
            terms, memory = model.advance(jnp, values, inputs, memory, logs[0].timestep)
            return memory, sliding_torque(jnp, terms, inputs.qvel)

        initial = model.settle(jnp, values, state.map(lambda signal: signal[0]))
        return jax.lax.scan(step, initial, (state, jnp.asarray(begins)))[1]

    return lambda values, state: np.asarray(follow(values, state.map(jnp.asarray)), np.float64)


def _imitate(recordings: Recordings, space: Space, vector: Coordinates, stiff: bool = False) -> tuple[Log, ...] | None:
    """Simulate an identified drive under recorded commands, and measure it like the recordings.

    The positions get the encoders' noise and quantisation. All logs are cut to the length of the shortest one, and
    `MOST_STEPS` limits their number. `stiff`: dry friction as stiff as the simulation step allows, not as in the bench.
    None: the simulation fails or takes too long, or the motion soon differs from the recording, as with torque
    commands.
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
    steps = np.array([find_quantum(column) or 0.0 for column in log.qpos.T])
    noisy = qpos + np.sqrt(np.maximum(_encoder_noise(log) ** 2 - steps**2 / 12, 0)) * random.normal(size=qpos.shape)
    return np.where(steps > 0, np.round(noisy / np.maximum(steps, 1e-300)) * steps, noisy)


def _encoder_noise(log: Log) -> Float[np.ndarray, "nv"]:
    return np.array([find_noise(column) for column in log.qpos.T])
