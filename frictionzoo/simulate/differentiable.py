"""Rollouts for PyTorch: torch tensors in, MuJoCo's dynamics between, torch tensors out, with autograd all the way."""

from collections.abc import Mapping
from functools import lru_cache

import jax
import torch
from jaxtyping import Float
from torch import Tensor

from frictionzoo.bench import Bench
from frictionzoo.bench.compiled import NO_PAYLOAD
from frictionzoo.core.errors import BenchError, ConfigError, closest
from frictionzoo.core.log import Payload
from frictionzoo.core.state import Signals
from frictionzoo.models import FrictionModel
from frictionzoo.simulate.bridge import as_torch_function
from frictionzoo.simulate.drive import Drive
from frictionzoo.simulate.torch_rollout import TorchRollout

_KEPT = 16  # compiled drives of this process


def rollout(
    bench: Bench,
    law: FrictionModel,
    qpos: Tensor,
    qvel: Tensor,
    ctrl: Tensor,
    *,
    parameters: Mapping[str, Tensor] | None = None,
    signals: Mapping[str, Tensor] | None = None,
    interval: float | None = None,
    payload: Payload | None = None,
    engine: str = "auto",
) -> tuple[Float[Tensor, "batch time nv"], Float[Tensor, "batch time nv"]]:
    """Open-loop rollouts of a drive, differentiable by torch.

    Autograd leads to the initial states, to the commands, to the law's parameters and to those of the bench that are
    given as tensors. All is computed in the type of `qpos`, float32 or float64, on JAX's device, and comes back to that
    of `qpos`. Second derivatives are not available. The drives used last stay compiled, each for the shapes it has met.

    Args:
        bench: The test stand.
        law: The friction law, a torch module; one with a memory begins as if the first state had lasted.
        qpos: Initial position [rad or m], of shape (batch, nv).
        qvel: Initial velocity [rad/s or m/s], of shape (batch, nv).
        ctrl: Command of each joint's actuator, of shape (batch, time, nv); sample i acts from state i to state i + 1.
        parameters: Values of the bench's parameters, of shape (nv,) or a single one, by name; the others are as the
            bench has them.
        signals: What the actuator law needs besides the command and what the friction law looks at (`bench.inputs`,
            `law.inputs`), by name, each of shape (batch, time, nv). What the friction law looks at may be left out, and
            what the actuator law can do without.
        interval: Of the samples [s], a whole number of simulation steps; None for one step.
        payload: What the bench carries; None for nothing.
        engine: `auto`, `specialised` or `mjx`.

    Returns:
        qpos and qvel after each sample interval. A rollout that diverges holds values that are not finite.

    Raises:
        BenchError: Shapes, joints, signals or the interval do not fit the bench, or MJX lacks something that it has.
        ConfigError: No such parameter or engine, or a gradient is asked of an engine that has none for this bench.
    """
    bench, function, reverse, history = _compile(bench, law, engine, interval)  # first: it may change the law's type
    values = _values(bench, law, parameters or {}, qpos)
    driven = _name(bench, law, qpos, qvel, ctrl, dict(signals or {}))
    if history:
        driven = driven.map(lambda signal: torch.cat([signal[:, :1].expand(-1, history, -1), signal], dim=1))
    load = torch.as_tensor(bench.load(payload or NO_PAYLOAD)).to(qpos).expand(len(qpos), -1)
    arguments = values, qpos, qvel, driven, load
    if not reverse and torch.is_grad_enabled() and any(leaf.requires_grad for leaf in jax.tree.leaves(arguments)):
        raise ConfigError(
            f"{bench.source}: engine={engine} has no gradient of this bench, whose solver iterates; expected a rollout "
            "under torch.no_grad(), or a bench without limits, contacts and equalities"
        )
    return function(*arguments)


@lru_cache(_KEPT)
def _compile(bench: Bench, law: FrictionModel, engine: str, interval: float | None) -> tuple:
    """The bench as the law sees it, the function, whether it has a gradient, and how many samples act before."""
    bench = bench.observing(law.inputs)
    interval = bench.timestep if interval is None else interval
    bench.check_interval(interval, "rollout")
    sampling = bench.sampling(interval)
    drive = Drive.assemble(bench, law, engine, sampling)
    found = drive.rollout
    if isinstance(found, TorchRollout):
        return bench, found.in_torch, found.reverse, sampling.history
    return bench, as_torch_function(found.function, found.compiler_options), found.reverse, sampling.history


def _values(
    bench: Bench, law: FrictionModel, given: Mapping[str, Tensor], like: Tensor
) -> dict[str, dict[str, Tensor]]:
    known = bench.initial_values()
    for name in given.keys() - known.keys():
        raise ConfigError(f"parameters.{name}: no such parameter of the bench; {closest(name, known)}")
    friction = law.state_dict(keep_vars=True).items()
    return {
        "bench": {name: _of_joints(bench, name, given.get(name, value), like) for name, value in known.items()},
        "friction": {name: v.to(like) if v.is_floating_point() else v.to(like.device) for name, v in friction},
    }


def _of_joints(bench: Bench, name: str, value: object, like: Tensor) -> Tensor:
    tensor = torch.as_tensor(value).to(like)
    if tensor.shape not in ((), (1,), (bench.nv,)):
        raise BenchError(f"parameters.{name}: shape {tuple(tensor.shape)}, expected ({bench.nv},), one a joint")
    return tensor.expand(bench.nv)


def _name(
    bench: Bench, law: FrictionModel, qpos: Tensor, qvel: Tensor, ctrl: Tensor, signals: dict[str, Tensor]
) -> Signals:
    """The command and the other signals, as a rollout takes them."""
    if qpos.ndim != 2 or ctrl.ndim != 3:
        raise BenchError(
            f"qpos of shape {tuple(qpos.shape)} and ctrl of {tuple(ctrl.shape)}, expected (batch, {bench.nv}) and "
            f"(batch, time, {bench.nv})"
        )
    batch, time = len(qpos), ctrl.shape[1]
    for name in signals.keys() - set(bench.inputs):
        raise BenchError(f"signals.{name}: neither law looks at it; {closest(name, bench.inputs)}")
    shapes = {"qpos": (batch, bench.nv), "qvel": (batch, bench.nv)}
    parts = {"ctrl": ctrl}
    without = {**bench.actuator.optional_inputs, **law.inputs}
    for name in bench.inputs:
        if name not in signals and name not in without:
            raise BenchError(f"signals.{name}: missing, and the bench's actuator needs it; give it in each sample")
        parts[name] = signals[name] if name in signals else torch.full_like(ctrl, without[name])
    shapes |= dict.fromkeys(parts, (batch, time, bench.nv))
    for name, tensor in {"qpos": qpos, "qvel": qvel, **parts}.items():
        if tuple(tensor.shape) != shapes[name]:
            raise BenchError(f"{name} has shape {tuple(tensor.shape)}, expected {shapes[name]}")
    whole = Signals(parts["ctrl"], {n: parts[n] for n in bench.actuator.inputs}, {n: parts[n] for n in bench.observed})
    return whole.map(lambda signal: signal.to(qpos))
