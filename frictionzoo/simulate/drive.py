"""A bench with a friction law: what an identification simulates."""

from dataclasses import dataclass

from frictionzoo.bench import Bench
from frictionzoo.core.errors import BenchError
from frictionzoo.core.segments import Sampling
from frictionzoo.models import FrictionModel, TorchFriction
from frictionzoo.simulate import Engine, friction_of, make_engine
from frictionzoo.simulate.rollout import Rollout, make_rollout
from frictionzoo.simulate.torch_rollout import AS_GIVEN, make_torch_rollout


@dataclass(frozen=True)
class Drive:
    """A bench with a friction law, ready to be simulated.

    Attributes:
        model: The friction law.
        engine: One step; of a law that exists only in torch, with friction terms in place of the law's values.
        rollout: Many open-loop rollouts.
    """

    model: FrictionModel
    engine: Engine
    rollout: Rollout

    @classmethod
    def assemble(cls, bench: Bench, model: FrictionModel, engine: str, sampling: Sampling | None = None) -> "Drive":
        """The drive of this bench and this law, simulated by the engine of this name.

        Raises:
            BenchError: The law has another number of joints.
            ConfigError: No such engine, or it does not apply.
            ModelError: The law exists only in torch and has a memory.
        """
        if model.nv != bench.nv:
            raise BenchError(
                f"a law of {model.nv} joints on {bench.source} with {bench.nv}, expected as many; set its nv"
            )
        if isinstance(model, TorchFriction):
            simulated = make_engine(engine, bench, AS_GIVEN, model.constraint)
            return cls(model, simulated, make_torch_rollout(simulated, model, sampling))
        simulated = make_engine(engine, bench, friction_of(model), model.constraint)
        return cls(model, simulated, make_rollout(simulated, sampling))
