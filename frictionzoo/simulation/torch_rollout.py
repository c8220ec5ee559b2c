"""Rollouts with a torch-only friction model: a torch loop around the engine's compiled step."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from operator import itemgetter
from typing import Any

import jax
import jax.numpy as jnp
import torch
from jaxtyping import Array, Float

from frictionzoo.core.errors import ConfigError, ModelError
from frictionzoo.core.segments import Sampling
from frictionzoo.core.state import DriveState, FrictionTerms, Signals
from frictionzoo.models import TorchFriction
from frictionzoo.simulation import Engine, Friction, Values, without_memory
from frictionzoo.simulation.bridge import as_torch_function, to_arrays, to_tensors
from frictionzoo.simulation.rollout import Rollout, applied

AS_GIVEN: Friction = without_memory(lambda values, state: FrictionTerms(**values))
"""Friction for an engine whose model is evaluated outside: the values are the step's friction terms."""


@dataclass(frozen=True)
class TorchRollout(Rollout):
    """Many open-loop rollouts with a torch-only friction model.

    It takes and returns arrays like every `Rollout`, but JAX can neither compile nor differentiate it. `in_torch` is
    the same over torch tensors, with torch's gradient; `law` is the friction model's name, for messages.
    """

    in_torch: Callable[..., tuple[torch.Tensor, torch.Tensor]]
    law: str

    @property
    def compiled(self) -> Callable[..., tuple[Any, Any]]:
        """The rollout itself: only its steps are compiled."""
        return self.function


def make_torch_rollout(engine: Engine, model: TorchFriction, sampling: Sampling) -> TorchRollout:
    """Make the rollouts of an engine with a friction model in torch.

    A step of all segments is compiled once. The model's input, its terms and the next state cross between JAX and torch
    through DLPack; the gradient returns the same way, by the vector-Jacobian product of the engine's step.

    Raises:
        ConfigError: Rollouts are to be of second order.
        ModelError: The model has a memory.
    """
    label = getattr(model, "name", type(model).__name__)  # a model in a notebook need not be registered
    if model.memory:
        raise ModelError(
            f"{label}: a memory of {model.memory} in a law that exists only in torch, expected 0; derive it from "
            "FrictionModel"
        )
    if sampling.second_order:
        raise ConfigError(
            f"bench.second_order=true: {label} exists only in torch, in which rollouts are of first order; set "
            "bench.second_order=false, or derive the law from FrictionModel"
        )
    operation = partial(as_torch_function, compiler_options=engine.compiler_options)
    acting_of = operation(partial(_acting, sampling))
    observe = operation(jax.vmap(partial(_observe, engine), in_axes=(None, 0, 0, 0, 0)))
    step = operation(jax.vmap(partial(_step, engine), in_axes=(None, 0, 0, 0, 0, 0, 0)))

    def in_torch(
        values: Any, qpos: torch.Tensor, qvel: torch.Tensor, signals: Signals, load: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        bench_values = values["bench"]
        load = qpos.new_zeros((len(qpos), 0)) if load is None else load
        acting = acting_of(bench_values, signals).map(torch.unbind)  # one autograd node, not one a step
        steps = [acting.map(itemgetter(number)) for number in range(len(acting.ctrl))]
        torques = observe(bench_values, qpos, qvel, steps[0], load)
        states = []
        for now, following in zip(steps, [*steps[1:], steps[-1]], strict=True):
            state = DriveState(qpos, qvel, now.ctrl, *torques, **now.observed)
            terms = _whole(label, model.terms(torch, values["friction"], state), qvel)
            qpos, qvel, *torques = step(bench_values, terms, qpos, qvel, now, following, load)
            states.append((qpos, qvel))
        positions, velocities = zip(*states[sampling.substeps - 1 :: sampling.substeps], strict=True)
        return torch.stack(positions, dim=1), torch.stack(velocities, dim=1)

    def in_arrays(values: Values, qpos: Any, qvel: Any, signals: Signals, load: Any = None) -> tuple[Any, Any]:
        with torch.no_grad():
            return to_arrays(in_torch(*to_tensors((values, qpos, qvel, signals, load))))

    return TorchRollout(in_arrays, engine, engine.bench.branches, False, in_torch, label)


def _acting(sampling: Sampling, bench: Mapping[str, Any], signals: Signals) -> Signals:
    """Return the signals that act in each simulation step, each of shape (steps, batch, nv)."""
    acting = applied({"bench": bench}, signals, sampling)
    return acting.map(lambda signal: jnp.moveaxis(signal.reshape(len(signal), -1, signal.shape[3]), 0, 1))


def _observe(
    engine: Engine, bench: Mapping[str, Any], qpos: Array, qvel: Array, signals: Signals, load: Array
) -> tuple[Float[Array, "nv"], Float[Array, "nv"]]:
    """Return the torques in the model's input, which torch does not have yet."""
    state = engine.drive_state({"bench": bench}, qpos, qvel, signals, load)
    return state.motor_torque, state.external_torque


def _step(
    engine: Engine,
    bench: Mapping[str, Any],
    terms: Mapping[str, Float[Array, "nv"]],
    qpos: Float[Array, "nv"],
    qvel: Float[Array, "nv"],
    now: Signals,
    following: Signals,
    load: Float[Array, "load"],
) -> tuple[Float[Array, "nv"], ...]:
    """Return the state after a step with these friction terms, and the torques that the model reads there."""
    # One operation, because crossing between JAX and torch costs more than a small bench's physics.
    memory = jnp.zeros((*qvel.shape, 0), qvel.dtype)
    qpos, qvel, _ = engine.step({"bench": bench, "friction": terms}, qpos, qvel, now, load, memory)
    return qpos, qvel, *_observe(engine, bench, qpos, qvel, following, load)


def _whole(label: str, terms: Any, qvel: torch.Tensor) -> dict[str, torch.Tensor]:
    """Return the model's terms, one row a segment; ModelError if they are not friction terms."""
    if not isinstance(terms, FrictionTerms):
        expected = "expected FrictionTerms, as in FrictionTerms(torque=torque)"
        raise ModelError(f"{label}: forward returns a {type(terms).__name__}, {expected}")
    for name, term in terms.given().items():
        if not isinstance(term, torch.Tensor) or not _broadcasts(term.shape, qvel.shape):
            description = f"shape {tuple(term.shape)}" if isinstance(term, torch.Tensor) else type(term).__name__
            raise ModelError(f"{label}: {description} of its {name}, expected a tensor of shape {tuple(qvel.shape)}")
    return {name: term.to(qvel.dtype).broadcast_to(qvel.shape) for name, term in terms.given().items()}


def _broadcasts(shape: torch.Size, whole: torch.Size) -> bool:
    pairs = zip(reversed(shape), reversed(whole), strict=False)
    return len(shape) <= len(whole) and all(one in (1, other) for one, other in pairs)
