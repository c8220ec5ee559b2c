"""Simulation of written models in MuJoCo C under recorded commands, for comparison with the fitted drive."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from operator import itemgetter

import mujoco
import numpy as np
from jaxtyping import Float, Int

from frictionzoo.core.state import Signals
from frictionzoo.result.fitted_drive import FittedDrive

PAYLOADS = "Payloads of recordings are left out; for the difference above they were put into the model."
_WHOLE = 0.01  # relative deviation of a sample from whole steps that is rounded away, as for recordings
_ROUNDING = 1e-6  # rounding tolerance, as a share of a step
_ACTUATOR = ("gainprm", "biastype", "biasprm", "forcelimited", "forcerange")
LATE = ("delay", "nsample", "interp", "dyntype", "dynprm", "actearly")
"""Attributes of a delayed actuator."""
_DIVERGED = [mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC]

Step = Callable[[mujoco.MjData, Signals], None]
"""Advances a simulation by one step under one sample of the commands and of further inputs of actuator and friction."""


@dataclass(frozen=True)
class Indices:
    """Indices of the identified joints' positions, velocities, commands and actuators in a model.

    Attributes:
        offset: The model's position minus the recorded one [rad or m].
        put_load: Puts the payload of a row of `Segments.load` into the model.
    """

    qpos: Int[np.ndarray, "nv"]
    dof: Int[np.ndarray, "nv"]
    ctrl: Int[np.ndarray, "nv"]
    actuator: Int[np.ndarray, "nv"]
    offset: Float[np.ndarray, "nv"]
    put_load: Callable[[mujoco.MjModel, Float[np.ndarray, "load"]], None]

    @classmethod
    def of_bench(cls, fitted: FittedDrive) -> "Indices":
        """Return the indices for the bench's MJCF, which has only these joints, without offset."""
        joints = np.arange(fitted.bench.nv)
        return cls(joints, joints, joints, joints, np.zeros(fitted.bench.nv), fitted.bench.put_load)


def simulate(
    model: mujoco.MjModel,
    fitted: FittedDrive,
    step: Step,
    prepare: Callable[[mujoco.MjData, int], None] = lambda *_: None,
    late: bool = True,
    place: Indices | None = None,
) -> Float[np.ndarray, "batch time nv"]:
    """Simulate the long test rollouts with the model's time step.

    Payloads are put into `model`. `prepare` is called with a rollout's number at its initial state. If `late`, `step`
    gets commands delayed by the bench's delay. Without `place`, the model is the bench's MJCF.

    Returns:
        Positions after each sample, without `Place.offset`; NaN in rollouts that diverge according to MuJoCo.
    """
    segments, place = fitted.segments, Indices.of_bench(fitted) if place is None else place
    timestep = float(model.opt.timestep)
    signals = _act(fitted, timestep, late)
    qpos = np.empty((segments.count, segments.length, fitted.bench.nv))
    for rollout in range(segments.count):
        if segments.load is not None:
            place.put_load(model, segments.load[rollout])
        data = mujoco.MjData(model)
        data.qpos[place.qpos] = segments.qpos[rollout, 0] + place.offset
        data.qvel[place.dof] = segments.qvel[rollout, 0]
        prepare(data, rollout)
        states = np.empty((signals.ctrl.shape[1] + 1, 2, fitted.bench.nv))
        states[0] = data.qpos[place.qpos], data.qvel[place.dof]
        with _without_log():
            for number in range(signals.ctrl.shape[1]):
                step(data, signals.map(itemgetter((rollout, number))))
                states[number + 1] = data.qpos[place.qpos], data.qvel[place.dof]
        qpos[rollout] = _at_samples(states, fitted, timestep) - place.offset
        if any(data.warning[kind].number for kind in _DIVERGED):
            qpos[rollout] = np.nan
    return qpos


@contextmanager
def _without_log() -> Iterator[None]:
    """Keep MuJoCo from writing a log file into the working directory when a simulation diverges."""
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(None)


def _steps_a_sample(fitted: FittedDrive, timestep: float) -> float:
    """Return the number of time steps [s] in a recorded sample, rounded if it is nearly whole."""
    steps = fitted.segments.timestep / timestep
    rounded = max(1.0, float(round(steps)))
    return rounded if abs(steps / rounded - 1) <= _WHOLE else steps


def _held(fitted: FittedDrive, timestep: float, step: Int[np.ndarray, "..."]) -> Int[np.ndarray, "..."]:
    """Return the index in `Segments.signals` of a step's sample; steps before the first state are negative."""
    segments = fitted.segments
    sample = segments.history + np.floor((step + _ROUNDING) / _steps_a_sample(fitted, timestep)).astype(int)
    return np.clip(sample, 0, segments.history + segments.length - 1)


def _act(fitted: FittedDrive, timestep: float, late: bool) -> Signals:
    """Return the signals (batch, steps, nv) of each step, like `simulation.rollout.applied` for any time step [s]."""
    per_sample, joint = _steps_a_sample(fitted, timestep), np.arange(fitted.bench.nv)
    step = np.arange(int(np.ceil(fitted.segments.length * per_sample - _ROUNDING)))[:, None]
    delay = fitted.values["bench"].get("delay", np.zeros(1)) if late else np.zeros(1)
    begins = step - delay / fitted.segments.timestep * per_sample
    earlier = np.floor(begins).astype(int)
    share, (first, second) = begins - earlier, (_held(fitted, timestep, earlier + after) for after in (0, 1))

    def delayed(signal: Float[np.ndarray, "batch samples nv"]) -> Float[np.ndarray, "batch steps nv"]:
        return (1 - share) * signal[:, first, joint] + share * signal[:, second, joint]

    signals = fitted.recorded.signals.map(lambda signal: np.asarray(signal, np.float64))
    now = signals.map(lambda signal: signal[:, _held(fitted, timestep, step), joint])
    commands = {name: delayed(signals.inputs[name]) for name in fitted.sampling.commands}
    return now._replace(ctrl=delayed(signals.ctrl), inputs=now.inputs | commands)


def _at_samples(
    states: Float[np.ndarray, "instants 2 nv"], fitted: FittedDrive, timestep: float
) -> Float[np.ndarray, "time nv"]:
    """Interpolate positions at the recorded samples, by cubics through positions and velocities of the steps."""
    instants = _steps_a_sample(fitted, timestep) * np.arange(1, fitted.segments.length + 1)
    before = np.floor(instants + _ROUNDING).astype(int)
    start, end = states[before], states[np.minimum(before + 1, len(states) - 1)]
    share = np.maximum(instants - before, 0.0)[:, None]
    blend = share**2 * (3 - 2 * share)
    bend = share * (1 - share) * ((1 - share) * start[:, 1] - share * end[:, 1])
    return (1 - blend) * start[:, 0] + blend * end[:, 0] + timestep * bend


def run_loaded(
    model: mujoco.MjModel,
    fitted: FittedDrive,
    place: Indices | None = None,
    begin: Callable[[mujoco.MjData, int], None] = lambda *_: None,
    late: bool | None = None,
) -> Float[np.ndarray, "batch time nv"]:
    """Simulate the long test rollouts in MuJoCo C with a written model, as its user would; return positions.

    `ctrl` is the recorded command, or several commands combined, and the model's actuators delay it. If the actuator
    model needs the state, the caller computes the controller in each step from delayed commands.

    `begin` is called with a rollout's number before it begins. `late` states whether the caller delays the commands;
    None: only if the actuator model needs the state. Without `place`, the model is the bench's MJCF.
    """
    place = Indices.of_bench(fitted) if place is None else place
    law, values = fitted.bench.actuator, fitted.values["bench"]

    def step(data: mujoco.MjData, signals: Signals) -> None:
        if law.needs_state:
            state = data.qpos[place.qpos] - place.offset, data.qvel[place.dof]
            data.ctrl[place.ctrl] = law.control(np, values, *state, signals.ctrl, signals.inputs)
        else:
            data.ctrl[place.ctrl] = law.combine(values, signals.ctrl, signals.inputs)
        mujoco.mj_step(model, data)

    def prepare(data: mujoco.MjData, rollout: int) -> None:
        begin(data, rollout)
        signals = fitted.segments.signals.map(itemgetter(rollout))
        command = np.asarray(law.combine(values, signals.ctrl, signals.inputs), np.float64)
        for joint, actuator in enumerate(place.actuator):
            if model.actuator_actnum[actuator]:
                (before,) = _held(fitted, model.opt.timestep, np.array([-1]))
                data.act[model.actuator_actadr[actuator]] = command[before, joint]
            if count := int(model.actuator_history[actuator, 0]):
                steps = np.arange(-count, 0)
                # MuJoCo's delayed actuators start with the commands before the first state.
                history = command[_held(fitted, model.opt.timestep, steps), joint]
                mujoco.mj_initCtrlHistory(model, data, actuator, model.opt.timestep * steps, history)

    late = law.needs_state if late is None else late
    return simulate(model, fitted, step, prepare, late, place)


def equip(
    spec: mujoco.MjSpec, bench: str, armature: Sequence[float], bias0: Sequence[float] | None = None, late: bool = False
) -> mujoco.MjModel:
    """Give links what their format lacks, from the bench's MJCF: options, `solreffriction` and actuators.

    `armature` has a value for each joint [kg m^2 or kg]; `bias0` replaces that coefficient of the actuators [N m or N];
    `late` also copies their delays.

    Returns:
        The compiled bench.
    """
    source, model = mujoco.MjSpec.from_string(bench), mujoco.MjModel.from_xml_string(bench)
    spec.option = source.option
    for index, own in enumerate(source.actuators):
        joint = spec.joint(own.target)
        joint.armature, joint.solref_friction = armature[index], model.dof_solref[index]
        actuator = spec.add_actuator(name=own.name, target=own.target, trntype=own.trntype)
        for name in (*_ACTUATOR, *(LATE if late else ())):
            setattr(actuator, name, getattr(own, name))
        if bias0 is not None:
            actuator.biasprm[0] = bias0[index]
    return model


def commands_before(fitted: FittedDrive, rollout: int) -> Signals:
    """Return commands (steps, nv) before a rollout's first state, the newest last; at least one step."""
    segments = fitted.segments
    inputs = {name: segments.signals.inputs[name] for name in fitted.sampling.commands}
    commands = Signals(segments.signals.ctrl, inputs).map(lambda signal: signal[rollout, : max(segments.history, 1)])
    return commands.map(lambda signal: np.repeat(signal, fitted.sampling.substeps, axis=0))
