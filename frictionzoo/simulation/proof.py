"""Verification: steps of an engine against steps of MuJoCo C, for one bench and friction model."""

import copy
from collections.abc import Mapping, Sequence
from operator import itemgetter
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np
import torch
from jaxtyping import Float

from frictionzoo.bench import Bench
from frictionzoo.core.errors import BenchError, FrictionzooError
from frictionzoo.core.log import Log
from frictionzoo.core.records import Proof
from frictionzoo.core.state import DriveState, Signals
from frictionzoo.models import FrictionModel, TorchFriction
from frictionzoo.models.formula import as_numpy, torch_state, torch_values
from frictionzoo.simulation import Values
from frictionzoo.simulation.choose import naming_what_mjx_lacks
from frictionzoo.simulation.drive import Drive

TOLERANCE = 1e-9
"""Largest difference of a position or velocity that counts as rounding, relative for values above 1."""
_CASES, _STEPS = 16, 8
_BEYOND = 0.5  # reach of states beyond the recorded range, on each side, as a share of it
_MOVED = 0.05  # distance of values from the initial ones, as a share of the distance between the bounds
_OVERFLOW = 1e6  # of a position or velocity
_TRIALS = 40  # reduced MJCFs to try
# XLA options for functions that run once.
_ONCE = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}


class Recorded(NamedTuple):
    """Recorded samples of a bench, one row each; `load` is the payload's effect, from `Bench.load`."""

    qpos: Float[np.ndarray, "samples nv"]
    qvel: Float[np.ndarray, "samples nv"]
    signals: Signals
    load: Float[np.ndarray, "samples load"]

    @classmethod
    def of(cls, logs: Sequence[Log]) -> "Recorded":
        """Collect all samples of logs that a bench accepted."""
        rows = [cls(log.qpos, log.qvel, log.signals, np.tile(log.load, (log.samples, 1))) for log in logs]
        return jax.tree.map(lambda *of_logs: np.concatenate(of_logs), *rows)


class Cases(NamedTuple):
    """Short rollouts to compare: initial states, and signals each of shape (cases, steps, nv)."""

    qpos: Float[np.ndarray, "cases nv"]
    qvel: Float[np.ndarray, "cases nv"]
    signals: Signals
    load: Float[np.ndarray, "cases load"]


def initial_values(bench: Bench, model: FrictionModel) -> Values:
    """Return the initial values of an identification, by owner and name, as numpy arrays."""
    return {"bench": bench.initial_values(), "friction": as_numpy(torch_values(model))}


def prove(bench: Bench, model: FrictionModel, engine: str, values: Values, recorded: Recorded) -> Proof:
    """Verify that steps and short rollouts of a drive match MuJoCo C with the MJCF that would be exported.

    Half of the rollouts begin at recorded states, the others anywhere in the log's range and beyond. Each runs in
    float64 with the given values and with others near them. MuJoCo C is independent of the engine: torch computes the
    model's terms from `mujoco`'s state; they enter as joint damping, friction constraint limit, and applied force.

    Raises:
        BenchError: They differ by more than `TOLERANCE`; the message names the MJCF element whose removal alone
            resolves it, if there is one.
    """
    cases = _draw(recorded)
    compared = [values, _moved(bench, model, values)]
    step, rollout = _compare(bench, model, engine, compared, cases)
    if not rollout <= TOLERANCE:
        fault = _find_fault(bench, model, engine, compared, cases)
        part = "something in the MJCF" if fault is None else fault
        advice = "" if fault is None else "; leave it out of the MJCF, or fix what it acts on"
        raise BenchError(
            f"{bench.source}: engine={engine} does not simulate {part} as MuJoCo C does (position or velocity differ "
            f"by {step:.2g} after a step and {rollout:.2g} after {_STEPS}, expected at most {TOLERANCE:g}){advice}"
        )
    return Proof(float(step), float(rollout), 2 * _CASES, _STEPS)


def _draw(recorded: Recorded) -> Cases:
    rng = np.random.default_rng(0)
    row = rng.integers(len(recorded.qpos), size=_CASES)
    recorded_half = np.arange(_CASES)[:, None] % 2 == 0

    def states(signal: Float[np.ndarray, "samples nv"]) -> Float[np.ndarray, "cases nv"]:
        low, high = signal.min(axis=0), signal.max(axis=0)
        reach = _BEYOND * (high - low)
        anywhere = rng.uniform(low - reach, high + reach, (_CASES, signal.shape[1]))
        return np.where(recorded_half, signal[row], anywhere)

    others = rng.integers(len(recorded.qpos), size=(_CASES, _STEPS))
    driven = np.where(recorded_half, row[:, None], others)
    signals = recorded.signals.map(itemgetter(driven))
    return Cases(states(recorded.qpos), states(recorded.qvel), signals, recorded.load[row])


def _moved(bench: Bench, model: FrictionModel, values: Values) -> Values:
    """Return values near these, which also compares their effect in the exported model; weights stay."""
    rng = np.random.default_rng(1)
    moved = {owner: dict(section) for owner, section in values.items()}
    for owner, params in (("bench", bench.params), ("friction", model.params)):
        for name, param in params.items():
            if not param.is_identified:
                continue
            members, value = param.members(bench.nv), np.array(moved[owner][name])
            free = param.each("identify", bench.nv)[members]
            low, high = (param.to_coordinate(param.each(side, bench.nv)[members], np)[free] for side in ("low", "high"))
            coordinates = param.to_coordinate(value[free], np)
            shift = _MOVED * (high - low) * rng.uniform(-1, 1, np.shape(coordinates))
            value[free] = param.from_coordinate(np.clip(coordinates + shift, low, high), np)
            moved[owner][name] = value
    return moved


def _compare(
    bench: Bench, model: FrictionModel, engine: str, values: Sequence[Values], cases: Cases
) -> tuple[float, float]:
    """Return the largest difference after the first step and after any; infinite if the engine's is not finite."""
    ours = _in_engine(bench, model, engine, values, cases)
    theirs = np.stack([simulate_in_c(bench, model, trial, cases)[:2] for trial in values])
    # MuJoCo C restarts after an overflow, so later steps are not compared.
    sound = np.logical_and.accumulate((np.abs(theirs) < _OVERFLOW).all(axis=(1, 4)), axis=2)[:, None, ..., None]
    with np.errstate(invalid="ignore", over="ignore"):
        difference = np.abs(ours - theirs) / np.maximum(1.0, np.abs(theirs))
    difference = np.where(sound, np.where(np.isfinite(difference), difference, np.inf), 0.0)
    return float(difference[..., 0, :].max()), float(difference.max())


def _in_engine(
    bench: Bench, model: FrictionModel, engine: str, values: Sequence[Values], cases: Cases
) -> Float[np.ndarray, "values 2 cases steps nv"]:
    with jax.enable_x64(True), naming_what_mjx_lacks(bench):
        rollout = Drive.assemble(bench, copy.deepcopy(model), engine).rollout
        options = {**rollout.engine.forward_options, **_ONCE}
        in_torch = isinstance(model, TorchFriction)
        simulate = rollout if in_torch else jax.jit(rollout.function, compiler_options=options)
        trials = [jax.tree.map(lambda value: np.asarray(value, np.float64), _without_delay(trial)) for trial in values]
        return np.stack([[np.asarray(part) for part in simulate(trial, *cases)] for trial in trials])


def simulate_in_c(
    bench: Bench, model: FrictionModel, values: Values, cases: Cases
) -> Float[np.ndarray, "3 cases steps nv"]:
    """Simulate rollouts in MuJoCo C without the engines; torch computes the friction terms, and delays are ignored.

    Returns:
        Position [rad or m] and velocity [rad/s or m/s] after each step, and the actuators' torque [N m or N] in it; NaN
        after an overflow.
    """
    values = _without_delay(values)
    text = bench.mjcf(values["bench"], np.array(model.constrained, float) if model.constraint else None)
    compiled = mujoco.MjModel.from_xml_string(text)
    damping, timestep, memory = compiled.dof_damping.copy(), float(compiled.opt.timestep), None
    friction = {name: torch.tensor(np.asarray(value, np.float64)) for name, value in values["friction"].items()}
    worlds = [_World(bench, compiled, *case) for case in zip(cases.qpos, cases.qvel, cases.load, strict=True)]
    results = np.empty((3, *cases.signals.ctrl.shape))
    for step in range(cases.signals.ctrl.shape[1]):
        qpos, qvel = (np.array([getattr(world.data, name) for world in worlds]) for name in ("qpos", "qvel"))
        signals = cases.signals.map(itemgetter((slice(None), step)))
        control = bench.actuator.control(np, values["bench"], qpos, qvel, signals.ctrl, signals.inputs)
        torques = zip(*(world.drive(ctrl, damping) for world, ctrl in zip(worlds, control, strict=True)), strict=True)
        motor, external = map(np.array, torques)
        state = torch_state(DriveState(qpos, qvel, signals.ctrl, motor, external, **signals.observed))
        with torch.no_grad():
            memory = model.settle(torch, friction, state) if memory is None else memory
            torch_terms, memory = model.advance(torch, friction, state, memory, timestep)
        terms = [None if term is None else np.broadcast_to(term.numpy(), qvel.shape) for term in torch_terms]
        for index, world in enumerate(worlds):
            world.step(damping, *(None if term is None else term[index] for term in terms))
            results[:, index, step] = world.data.qpos, world.data.qvel, motor[index]
    return results


def _without_delay(values: Values) -> dict[str, Mapping[str, Any]]:
    """Remove the delay: commands act at once here, and delays are verified elsewhere."""
    return {**values, "bench": {name: value for name, value in values["bench"].items() if name != "delay"}}


class _World:
    def __init__(self, bench: Bench, model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray, load: np.ndarray):
        self.model = copy.copy(model)
        bench.put_load(self.model, load)
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:], self.data.qvel[:] = qpos, qvel

    def drive(self, control: np.ndarray, damping: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the actuators' torque in this state, and the torque of everything except actuators and friction."""
        model, data = self.model, self.data
        data.ctrl[:], model.dof_damping[:], data.qfrc_applied[:] = control, damping, 0.0
        if not np.isfinite(data.qpos).all():
            return np.full(model.nv, np.nan), np.full(model.nv, np.nan)
        for stage in (mujoco.mj_fwdPosition, mujoco.mj_fwdVelocity, mujoco.mj_fwdActuation):
            stage(model, data)
        return data.qfrc_actuator.copy(), data.qfrc_passive - data.qfrc_bias

    def step(self, own: np.ndarray, torque: Any, frictionloss: Any, damping: Any) -> None:
        """Take one step with these friction terms; after an overflow the state stays NaN."""
        if not np.isfinite(self.data.qpos).all():
            return
        if torque is not None:
            self.data.qfrc_applied[:] = -torque
        if frictionloss is not None:
            self.model.dof_frictionloss[:] = frictionloss
        if damping is not None:
            self.model.dof_damping[:] = own + damping
        mujoco.mj_forward(self.model, self.data)
        # mj_step would write a warning file and restart.
        if np.abs(self.data.qacc).max() < _OVERFLOW / self.model.opt.timestep:
            mujoco.mj_step(self.model, self.data)
        else:
            self.data.qpos[:] = self.data.qvel[:] = np.nan


def _find_fault(bench: Bench, model: FrictionModel, engine: str, values: Sequence[Values], cases: Cases) -> str | None:
    """Return the MJCF part, in words, whose removal makes the engine agree with MuJoCo C; None if there is none."""
    reference, trials = simulate_in_c(bench, model, values[0], cases), []
    for part, simpler in bench.simpler():
        try:
            changes = not np.array_equal(simulate_in_c(simpler, model, values[0], cases), reference)
        except (FrictionzooError, ValueError):
            continue
        trials.append((not changes, part, simpler))
    # Parts that change MuJoCo C's result come first.
    for _, part, simpler in sorted(trials, key=lambda trial: trial[0])[:_TRIALS]:
        try:
            agrees = _compare(simpler, model, engine, values, cases)[1] <= TOLERANCE
        except FrictionzooError:
            continue
        if agrees:
            return part
    return None
