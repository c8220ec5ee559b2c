"""MuJoCo C under the commands of recordings: how written models are compared with the fitted drive."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from operator import itemgetter

import mujoco
import numpy as np
from jaxtyping import Float, Int

from frictionzoo.core.state import Signals
from frictionzoo.result.identified import Identified

PAYLOADS = "Payloads of recordings are left out; for the difference above they were put into the model."
_WHOLE = 0.01  # share by which samples may differ from a whole number of steps, as for recordings
_ROUNDING = 1e-6  # of a step
_DIVERGED = [mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC]

Step = Callable[[mujoco.MjModel, mujoco.MjData, Signals], None]
"""Advances a model by one time step under one sample of the commands and both laws' other inputs."""


@dataclass(frozen=True)
class Place:
    """Where the identified joints are in a model.

    Attributes:
        qpos: Index of each joint's position.
        dof: Index of each joint's velocity.
        ctrl: Index of the command of each joint's actuator.
        actuator: Index of each joint's actuator.
        offset: The model's position less the recorded one [rad or m].
        put_load: Lets the body that carries payloads be what a row of `Segments.load` makes of it.
    """

    qpos: Int[np.ndarray, "nv"]
    dof: Int[np.ndarray, "nv"]
    ctrl: Int[np.ndarray, "nv"]
    actuator: Int[np.ndarray, "nv"]
    offset: Float[np.ndarray, "nv"]
    put_load: Callable[[mujoco.MjModel, Float[np.ndarray, "load"]], None]

    @classmethod
    def of_bench(cls, fitted: Identified) -> "Place":
        """The bench's own MJCF: its joints and actuators alone, and positions as they were recorded."""
        each = np.arange(fitted.bench.nv)
        return cls(each, each, each, each, np.zeros(fitted.bench.nv), fitted.bench.put_load)


def simulate(
    model: mujoco.MjModel,
    fitted: Identified,
    step: Step,
    prepare: Callable[[mujoco.MjModel, mujoco.MjData, int], None] = lambda *_: None,
    late: bool = True,
    place: Place | None = None,
) -> Float[np.ndarray, "batch time nv"]:
    """Positions after each sample of the long test rollouts, in the model's own time steps.

    Args:
        model: What was written, compiled; payloads are put into it.
        fitted: The drive whose rollouts these are.
        step: One time step.
        prepare: Called with a rollout's number before it begins, from its initial state.
        late: Whether the commands that `step` gets are late by the bench's delay.
        place: Where the joints are in the model; None for the bench's own.

    Returns:
        Recorded positions, without `Place.offset`; NaN in a rollout in which MuJoCo finds that it diverges.
    """
    segments, place = fitted.segments, Place.of_bench(fitted) if place is None else place
    timestep = float(model.opt.timestep)
    signals = _act(fitted, timestep, late)
    qpos = np.empty((segments.count, segments.length, fitted.bench.nv))
    for rollout in range(segments.count):
        if segments.load is not None:
            place.put_load(model, segments.load[rollout])
        data = mujoco.MjData(model)
        data.qpos[place.qpos], data.qvel[place.dof] = (
            segments.qpos[rollout, 0] + place.offset,
            segments.qvel[rollout, 0],
        )
        prepare(model, data, rollout)
        states = np.empty((signals.ctrl.shape[1] + 1, 2, fitted.bench.nv))
        states[0] = data.qpos[place.qpos], data.qvel[place.dof]
        with _without_log():
            for number in range(signals.ctrl.shape[1]):
                step(model, data, signals.map(itemgetter((rollout, number))))
                states[number + 1] = data.qpos[place.qpos], data.qvel[place.dof]
        qpos[rollout] = _at_samples(states, fitted, timestep) - place.offset
        if any(data.warning[kind].number for kind in _DIVERGED):
            qpos[rollout] = np.nan
    return qpos


@contextmanager
def _without_log() -> Iterator[None]:
    """Keep MuJoCo from writing a file into the working directory where a simulation diverges."""
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(None)


def _steps_a_sample(fitted: Identified, timestep: float) -> float:
    """Return how many steps of this length [s] a sample of the recordings lasts, rounded where it is nearly whole."""
    steps = fitted.segments.timestep / timestep
    whole = max(1.0, float(round(steps)))
    return whole if abs(steps / whole - 1) <= _WHOLE else steps


def _held(fitted: Identified, timestep: float, step: Int[np.ndarray, "..."]) -> Int[np.ndarray, "..."]:
    """Return the sample of `Segments.signals` that is held in a step; steps before the first state are negative."""
    segments = fitted.segments
    sample = segments.history + np.floor((step + _ROUNDING) / _steps_a_sample(fitted, timestep)).astype(int)
    return np.clip(sample, 0, segments.history + segments.length - 1)


def _act(fitted: Identified, timestep: float, late: bool) -> Signals:
    """What drives each step of the long test rollouts, each of shape (batch, steps, nv).

    As `frictionzoo.simulate.rollout.applied`, in steps of any length [s].
    """
    per_sample, joint = _steps_a_sample(fitted, timestep), np.arange(fitted.bench.nv)
    step = np.arange(int(np.ceil(fitted.segments.length * per_sample - _ROUNDING)))[:, None]
    delay = fitted.values["bench"].get("delay", np.zeros(1)) if late else np.zeros(1)
    begins = step - delay / fitted.segments.timestep * per_sample
    whole = np.floor(begins).astype(int)
    later, (first, second) = begins - whole, (_held(fitted, timestep, whole + after) for after in (0, 1))

    def delayed(signal: Float[np.ndarray, "batch samples nv"]) -> Float[np.ndarray, "batch steps nv"]:
        return (1 - later) * signal[:, first, joint] + later * signal[:, second, joint]

    signals = fitted.recorded.signals.map(lambda signal: np.asarray(signal, np.float64))
    now = signals.map(lambda signal: signal[:, _held(fitted, timestep, step), joint])
    commands = {name: delayed(signals.inputs[name]) for name in fitted.sampling.commands}
    return now._replace(ctrl=delayed(signals.ctrl), inputs=now.inputs | commands)


def _at_samples(
    states: Float[np.ndarray, "instants 2 nv"], fitted: Identified, timestep: float
) -> Float[np.ndarray, "time nv"]:
    """Positions at the recordings' samples: between two steps, of the cubic through their positions and velocities."""
    at = _steps_a_sample(fitted, timestep) * np.arange(1, fitted.segments.length + 1)
    first = np.floor(at + _ROUNDING).astype(int)
    start, end = states[first], states[np.minimum(first + 1, len(states) - 1)]
    share = np.maximum(at - first, 0.0)[:, None]
    blend = share**2 * (3 - 2 * share)
    bend = share * (1 - share) * ((1 - share) * start[:, 1] - share * end[:, 1])
    return (1 - blend) * start[:, 0] + blend * end[:, 0] + timestep * bend


def step_with_control(fitted: Identified) -> Step:
    """A step in which the caller computes the actuator law's controller, and MuJoCo does the rest."""
    bench = fitted.bench

    def step(model: mujoco.MjModel, data: mujoco.MjData, signals: Signals) -> None:
        state = data.qpos, data.qvel
        data.ctrl[:] = bench.actuator.control(np, fitted.values["bench"], *state, signals.ctrl, signals.inputs)
        mujoco.mj_step(model, data)

    return step


def run_loaded(
    model: mujoco.MjModel,
    fitted: Identified,
    place: Place | None = None,
    begin: Callable[[mujoco.MjData, int], None] = lambda *_: None,
    late: bool | None = None,
) -> Float[np.ndarray, "batch time nv"]:
    """Positions of the long test rollouts in MuJoCo C, in a written model that is played as its users would.

    `ctrl` is the recorded command, or several of them combined, and the model's actuators delay it. For an actuator law
    that needs the state, the caller computes the controller in each step from late commands.

    Args:
        model: What was written, compiled.
        fitted: The drive whose rollouts these are.
        place: Where the joints are in the model; None for the bench's own.
        begin: Called with a rollout's number before it begins.
        late: Whether the caller delays the commands; None for a law that needs the state alone.
    """
    place = Place.of_bench(fitted) if place is None else place
    law, values = fitted.bench.actuator, fitted.values["bench"]

    def step(model: mujoco.MjModel, data: mujoco.MjData, signals: Signals) -> None:
        if law.needs_state:
            state = data.qpos[place.qpos] - place.offset, data.qvel[place.dof]
            data.ctrl[place.ctrl] = law.control(np, values, *state, signals.ctrl, signals.inputs)
        else:
            data.ctrl[place.ctrl] = law.combine(values, signals.ctrl, signals.inputs)
        mujoco.mj_step(model, data)

    def prepare(model: mujoco.MjModel, data: mujoco.MjData, rollout: int) -> None:
        """Put the commands before the first state where MuJoCo's late actuators look for them."""
        begin(data, rollout)
        signals = fitted.segments.signals.map(itemgetter(rollout))
        command = np.asarray(law.combine(values, signals.ctrl, signals.inputs), np.float64)
        for joint, actuator in enumerate(place.actuator):
            if model.actuator_actnum[actuator]:
                (before,) = _held(fitted, model.opt.timestep, np.array([-1]))
                data.act[model.actuator_actadr[actuator]] = command[before, joint]
            if count := int(model.actuator_history[actuator, 0]):
                steps = np.arange(-count, 0)
                known = command[_held(fitted, model.opt.timestep, steps), joint]
                mujoco.mj_initCtrlHistory(model, data, actuator, model.opt.timestep * steps, known)

    late = law.needs_state if late is None else late
    return simulate(model, fitted, step, prepare, late, place)


def commands_before(fitted: Identified, rollout: int) -> Signals:
    """The commands in the steps before the first state of a rollout of this number, the newest last; at least one.

    Each of shape (steps, nv); `inputs` has those that are commands alone.
    """
    segments = fitted.segments
    inputs = {name: segments.signals.inputs[name] for name in fitted.sampling.commands}
    known = Signals(segments.signals.ctrl, inputs).map(lambda signal: signal[rollout, : max(segments.history, 1)])
    return known.map(lambda signal: np.repeat(signal, fitted.sampling.substeps, axis=0))
