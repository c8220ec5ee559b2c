"""Differentiable rollouts for PyTorch: torch tensors in and out, with autograd through MuJoCo's dynamics."""

import math
import numbers
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import jax
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from frictionzoo.bench import Bench
from frictionzoo.bench.compiled import NO_PAYLOAD
from frictionzoo.core.errors import BenchError, ConfigError, ModelError, closest, refuse_unlike
from frictionzoo.core.log import Payload
from frictionzoo.core.state import DriveState, FrictionTerms, Signals
from frictionzoo.models import FrictionModel, TorchFriction
from frictionzoo.simulation.bridge import as_torch_function
from frictionzoo.simulation.context import refuse_late_fork
from frictionzoo.simulation.drive import Drive
from frictionzoo.simulation.torch_rollout import TorchRollout

Array = Tensor | np.ndarray
"""Tensor, NumPy array, or another object that NumPy reads as an array."""


class ModuleFriction(TorchFriction):
    """Friction of a torch module that maps positions and velocities, shape (..., 2 nv), to torques, shape (..., nv)."""

    def __init__(self, module: torch.nn.Module, nv: int) -> None:
        super().__init__(nv)
        self.name = type(module).__name__
        self.module: torch.nn.Module = module

    def forward(self, state: DriveState) -> FrictionTerms:
        """Compute the torque, which opposes motion if it has the sign of the velocity."""
        states = torch.cat([state.qpos, state.qvel], dim=-1)
        try:
            return FrictionTerms(torque=self.module(states))
        except (RuntimeError, TypeError) as error:  # another number of inputs
            shapes = f"{tuple(states.shape)}, expected torques of shape {tuple(state.qvel.shape)}"
            raise ModelError(f"{self.name}: {error}; called with positions and velocities of shape {shapes}") from error


def rollout(
    bench: Bench,
    law: torch.nn.Module,
    qpos: Array,
    qvel: Array,
    ctrl: Array,
    *,
    parameters: Mapping[str, Array | float] | None = None,
    signals: Mapping[str, Array] | None = None,
    interval: float | None = None,
    payload: Payload | None = None,
    engine: str = "auto",
) -> tuple[Float[Tensor, "batch time nv"], Float[Tensor, "batch time nv"]]:
    """Simulate open-loop rollouts of a drive, differentiable by torch.

    Gradients reach the initial states, the commands, the friction model's parameters and the bench's parameters given
    as tensors. Second derivatives are not available. Recently used drives stay compiled for each set of shapes.

    All is computed in float64 if a state, command or signal is float64, else in float32, also half precision and whole
    numbers. The computation runs on JAX's device; the results lie on the device of `qpos`.

    Args:
        bench: The test stand.
        law: The friction model; a memory begins as if the first state had lasted. Any other torch module is called with
            positions and velocities, of shape (batch, 2 nv), and returns the friction torques, of shape (batch, nv),
            positive against positive velocity.
        qpos: Initial position [rad or m], of shape (batch, nv).
        qvel: Initial velocity [rad/s or m/s], of shape (batch, nv).
        ctrl: Command of each joint's actuator, of shape (batch, time, nv); sample i acts from state i to state i + 1.
            Without samples the results have none either.
        parameters: Values of bench parameters by name, of shape (nv,) or a single one; the others keep the bench's
            values.
        signals: Further signals for the actuator law and the friction model (`bench.inputs`, `law.inputs`), by name,
            each of shape (batch, time, nv). The friction model's are optional, and some of the actuator law's.
        interval: Sample interval [s], a whole number of simulation steps; None for one step.
        payload: Payload of the bench; None for none.
        engine: `auto`, `specialised` or `mjx`.

    Returns:
        qpos and qvel after each sample interval. A rollout that diverges contains non-finite values.

    Raises:
        BenchError: Shapes, joints, signals or the interval do not fit the bench, or MJX does not support something in
            it.
        ConfigError: An unknown parameter or engine, an argument of another type, a process forked after JAX had begun
            to compute, or a gradient of an engine that has none for this bench.
        ModelError: The model does not return friction terms in torch.
    """
    refuse_late_fork()
    _refuse_others(bench, law, parameters, signals, payload, engine)
    law = law if isinstance(law, FrictionModel) else _wrap(law, bench.nv)
    interval = bench.timestep if interval is None else _to_interval(interval)
    arrays = {"qpos": qpos, "qvel": qvel, "ctrl": ctrl, **{f"signals.{name}": v for name, v in (signals or {}).items()}}
    tensors = _to_tensors(arrays)
    qpos, qvel, ctrl = (tensors.pop(name) for name in ("qpos", "qvel", "ctrl"))
    precision = qpos.dtype, bool(jax.config.read("jax_enable_x64"))
    drive, function, history = _compile(bench, law, engine, interval, precision)
    bench = drive.engine.bench
    values = _values(bench, law, parameters or {}, qpos)
    further = {name.removeprefix("signals."): tensor for name, tensor in tensors.items()}
    driving = _name(bench, law, qpos, qvel, ctrl, further)
    if not ctrl.numel():
        return qpos[:, None].expand(ctrl.shape).clone(), qvel[:, None].expand(ctrl.shape).clone()
    if history:
        driving = driving.map(lambda signal: torch.cat([signal[:, :1].expand(-1, history, -1), signal], dim=1))
    load = torch.as_tensor(bench.load(payload or NO_PAYLOAD)).to(qpos).expand(len(qpos), -1)
    arguments = values, qpos, qvel, driving, load
    differentiated = torch.is_grad_enabled() and any(leaf.requires_grad for leaf in jax.tree.leaves(arguments))
    if differentiated and not drive.engine.reverse:
        raise ConfigError(
            f"{bench.source}: engine={engine} has no gradient of this bench, whose solver iterates; expected a rollout "
            "under torch.no_grad(), or a bench without limits, contacts and equalities"
        )
    return function(*arguments)


@lru_cache(16)  # the same wrapper for each call, so that its drive stays compiled
def _wrap(module: torch.nn.Module, nv: int) -> ModuleFriction:
    return ModuleFriction(module, nv)


@lru_cache(16)  # drives in this process
def _compile(
    bench: Bench, law: FrictionModel, engine: str, interval: float, precision: tuple[torch.dtype, bool]
) -> tuple:
    """Return the drive with the bench that observes the model's signals, the function, and its history samples."""
    # Each precision has a separate drive (it is a key of the cache), because engines keep their traces.
    bench = bench.observing(law.inputs)
    bench.check_interval(interval, "interval")
    sampling = bench.sampling(interval)
    drive = Drive.assemble(bench, law, engine, sampling)
    if isinstance(drive.rollout, TorchRollout):
        return drive, drive.rollout.in_torch, sampling.history
    return drive, as_torch_function(drive.rollout.function, drive.engine.compiler_options), sampling.history


def _refuse_others(bench: Any, law: Any, parameters: Any, signals: Any, payload: Any, engine: Any) -> None:
    refuse_unlike("bench", bench, Bench, "a Bench, as in Bench('stand.xml', actuator=PositionPD(kp=15, kd=0.5))")
    expected = "a FrictionModel, as fz.law('stribeck') is, or a torch module from states to torques"
    refuse_unlike("law", law, torch.nn.Module, expected)
    for name, value in {"parameters": parameters, "signals": signals}.items():
        refuse_unlike(name, value, (Mapping, type(None)), "a mapping from name to tensor, or None")
    refuse_unlike("payload", payload, (Payload, type(None)), "a Payload, or None")
    refuse_unlike("engine", engine, str, "auto, specialised or mjx")


def _to_interval(interval: Any) -> float:
    if isinstance(interval, numbers.Real) and not isinstance(interval, bool) and 0 < float(interval) < math.inf:
        return float(interval)
    raise BenchError(f"interval={interval}: expected a time in s, a whole number of simulation steps, or None for one")


def _to_tensors(arrays: Mapping[str, Any]) -> dict[str, Tensor]:
    """Convert arrays to tensors of one precision on the first one's device."""
    tensors = {name: _to_tensor(name, array) for name, array in arrays.items()}
    double = any(tensor.dtype == torch.float64 for tensor in tensors.values())
    device = next(iter(tensors.values())).device
    return {name: tensor.to(device, torch.float64 if double else torch.float32) for name, tensor in tensors.items()}


def _to_tensor(name: str, value: Any) -> Tensor:
    """Return a tensor, or a copy of an array as one; ConfigError for anything but real numbers."""
    if not isinstance(value, Tensor):
        if not hasattr(value, "__array__"):
            raise ConfigError(f"{name}: {type(value).__name__}, expected a torch tensor or a NumPy array")
        array = np.asarray(value)
        kinds = {"f": np.float64 if array.dtype.itemsize > 4 else np.float32, "i": np.int64, "u": np.int64}
        if array.dtype.kind not in kinds:
            raise ConfigError(f"{name}: an array of {array.dtype}, expected floating-point or whole numbers")
        return torch.from_numpy(np.array(array, kinds[array.dtype.kind], order="C"))
    if value.dtype.is_complex or value.dtype == torch.bool or value.is_quantized or value.layout != torch.strided:
        description = f"{value.dtype} in the layout {value.layout}"
        raise ConfigError(f"{name}: a tensor of {description}, expected floating-point or whole numbers, strided")
    return value


def _values(bench: Bench, law: FrictionModel, given: Mapping[str, Any], like: Tensor) -> dict[str, dict[str, Tensor]]:
    initial = bench.initial_values()
    for name in given.keys() - initial.keys():
        raise ConfigError(f"parameters.{name}: no such parameter of the bench; {closest(str(name), initial)}")
    friction = law.state_dict(keep_vars=True).items()
    return {
        "bench": {name: _of_joints(bench, name, given.get(name, value), like) for name, value in initial.items()},
        "friction": {name: v.to(like) if v.is_floating_point() else v.to(like.device) for name, v in friction},
    }


def _of_joints(bench: Bench, name: str, value: Any, like: Tensor) -> Tensor:
    is_number = isinstance(value, numbers.Real) and not isinstance(value, bool)
    tensor = _to_tensor(f"parameters.{name}", np.asarray(value) if is_number else value).to(like)
    if tensor.shape not in ((), (1,), (bench.nv,)):
        raise BenchError(f"parameters.{name}: shape {tuple(tensor.shape)}, expected ({bench.nv},), one a joint")
    return tensor.expand(bench.nv)


def _name(
    bench: Bench, law: FrictionModel, qpos: Tensor, qvel: Tensor, ctrl: Tensor, signals: dict[str, Tensor]
) -> Signals:
    """Collect the command and the other signals for a rollout, with their defaults."""
    if qpos.ndim != 2 or ctrl.ndim != 3:
        raise BenchError(
            f"qpos of shape {tuple(qpos.shape)} and ctrl of {tuple(ctrl.shape)}, expected (batch, {bench.nv}) and "
            f"(batch, time, {bench.nv})"
        )
    batch, time = len(qpos), ctrl.shape[1]
    for name in signals.keys() - set(bench.inputs):
        raise BenchError(f"signals.{name}: no model uses it; {closest(str(name), bench.inputs)}")
    parts = {"ctrl": ctrl}
    defaults = {**bench.actuator.optional_inputs, **law.inputs}
    for name in bench.inputs:
        if name not in signals and name not in defaults:
            raise BenchError(f"signals.{name}: missing, and the bench's actuator needs it; give it in each sample")
        parts[name] = signals[name] if name in signals else torch.full_like(ctrl, defaults[name])
    for name, tensor in {"qpos": qpos, "qvel": qvel, **parts}.items():
        shape = (batch, time, bench.nv) if name in parts else (batch, bench.nv)
        if tuple(tensor.shape) != shape:
            raise BenchError(f"{name} has shape {tuple(tensor.shape)}, expected {shape}")
    collected = Signals(
        parts["ctrl"], {n: parts[n] for n in bench.actuator.inputs}, {n: parts[n] for n in bench.observed}
    )
    return collected.map(lambda signal: signal.to(qpos))
