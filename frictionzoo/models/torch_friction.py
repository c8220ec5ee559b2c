"""The plug-in interface of a friction model that exists only in torch."""

from abc import abstractmethod
from typing import Any

import torch

from frictionzoo.core.errors import ModelError
from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models.base import FrictionModel, Values


class TorchFriction(FrictionModel):
    """A friction law of which there is no formula over `xp`: any torch module, of `torch.nn` parts say.

    Its author writes `forward` in plain torch and registers the class like any other law. Physical parameters are
    declared in `dimensions` and read as attributes; any other parameter of the module is a weight. All parameters and
    buffers are made float64, and float32 ones stand in for them where a job computes so: take every number from them,
    from the state, or from Python.

    Each step of a rollout leaves JAX for this law. That is exact and slower than a formula: write one where you can.

    Cannot represent: a memory; a law of the whole batch, such as batch normalisation.
    """

    @abstractmethod
    def forward(self, state: DriveState) -> FrictionTerms:
        """The law itself, pure and deterministic, with this module's own values.

        Args:
            state: Torch tensors of shape (..., nv).

        Returns:
            Terms of shape (..., nv), or that broadcast to it; `frictionloss` above 0. Their gradient is finite at
            qvel = 0 too.
        """

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """What `forward` answers with these values in place of the module's own; see `FrictionModel.terms`.

        Raises:
            ModelError: `xp` is another namespace than torch.
        """
        if xp is not torch:
            label = getattr(type(self), "name", type(self).__name__)
            raise ModelError(f"{label}: it exists only in torch, not in {xp.__name__}; derive it from FrictionModel")
        return torch.func.functional_call(self, dict(values), (state,))
