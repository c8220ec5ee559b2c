"""Drive of a bench and a friction model, ready for simulation."""

from dataclasses import dataclass

import numpy as np
import torch

from frictionzoo.bench import Bench
from frictionzoo.core.errors import BenchError
from frictionzoo.core.segments import Sampling
from frictionzoo.core.state import DriveState
from frictionzoo.models import FrictionModel, TorchFriction
from frictionzoo.models.formula import torch_values
from frictionzoo.simulation import Engine, friction_of, make_engine
from frictionzoo.simulation.rollout import EACH_STEP, Rollout, make_rollout
from frictionzoo.simulation.torch_rollout import AS_GIVEN, make_torch_rollout


@dataclass(frozen=True)
class Drive:
    """Bench with a friction model, ready for simulation.

    Attributes:
        engine: Engine of one step; for a torch-only model it takes friction terms in place of the model's values.
    """

    model: FrictionModel
    engine: Engine
    rollout: Rollout

    @classmethod
    def assemble(
        cls,
        bench: Bench,
        model: FrictionModel,
        engine: str,
        sampling: Sampling = EACH_STEP,
        midway: bool | None = None,
    ) -> "Drive":
        """Assemble the drive of this bench and model with the engine of this name.

        `midway` is whether steps take `advance_midway` of the model; None: those of second order do.

        Raises:
            BenchError: The model has another number of joints.
            ConfigError: There is no such engine, or it does not apply.
            ModelError: A torch-only model has a memory.
        """
        refuse_other_joints(model, bench)
        if isinstance(model, TorchFriction):
            simulated = make_engine(engine, bench, AS_GIVEN, model.constrained)
            return cls(model, simulated, make_torch_rollout(simulated, model, sampling))
        midway = sampling.second_order if midway is None else midway
        simulated = make_engine(engine, bench, friction_of(model, midway), model.constrained)
        coupled = any(bench.branches) and not looks_at_one_joint(model)
        return cls(model, simulated, make_rollout(simulated, sampling, coupled))


def refuse_other_joints(model: FrictionModel, bench: Bench) -> None:
    """Refuse a model with another number of joints than the bench: BenchError."""
    if model.nv != bench.nv:
        raise BenchError(f"a law of {model.nv} joints on {bench.source} with {bench.nv}, expected as many; set its nv")


def looks_at_one_joint(model: FrictionModel) -> bool:
    """Return whether a joint's friction depends on that joint alone, tested on states that differ in some joints."""
    rng, values = np.random.default_rng(0), torch_values(model)
    one, other = (torch.from_numpy(rng.normal(size=(len(DriveState._fields), 64, model.nv))) for _ in range(2))
    mask = torch.from_numpy(rng.random((64, model.nv)) < 0.5)

    def terms(signals: torch.Tensor) -> list[torch.Tensor]:
        state = DriveState(*signals)
        friction, _ = model.advance(torch, values, state, model.settle(torch, values, state), 1e-3)
        return [term.expand(mask.shape) for term in friction.given().values()]

    with torch.no_grad():
        parts = zip(terms(torch.where(mask, one, other)), terms(one), terms(other), strict=True)
        return all(torch.allclose(mixed, torch.where(mask, a, b), rtol=1e-9) for mixed, a, b in parts)
