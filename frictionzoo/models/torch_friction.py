"""The plug-in interface of a torch-only friction model."""

from abc import abstractmethod
from typing import Any

import torch

from frictionzoo.core.errors import ModelError
from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models.base import FrictionModel, Values


class TorchFriction(FrictionModel):
    """Friction model without a formula over `xp`: any torch module, for example of `torch.nn` parts.

    Write `forward` in plain torch and register the class like any other model. `dimensions` declares physical
    parameters, which `forward` reads as attributes; any other parameter of the module is a weight. All parameters and
    buffers are float64, and float32 in a job that computes in float32: take every number from them, from the state, or
    from Python.

    Each step of a rollout leaves JAX for this model. This is exact, but slower than a formula: write a formula if you
    can.

    Cannot represent: a memory; a function of the whole batch, such as batch normalisation.
    """

    @abstractmethod
    def forward(self, state: DriveState) -> FrictionTerms:
        """Compute the friction terms; pure and deterministic, with this module's values.

        The state has tensors of shape (..., nv). The terms broadcast to it; `frictionloss` is above 0. Their gradient
        is finite, also at qvel = 0.
        """

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Return the terms of `forward` with these values in place of the module's; see `FrictionModel.terms`.

        Raises:
            ModelError: `xp` is not torch.
        """
        if xp is not torch:
            label = getattr(type(self), "name", type(self).__name__)
            raise ModelError(f"{label}: it exists only in torch, not in {xp.__name__}; derive it from FrictionModel")
        return torch.func.functional_call(self, dict(values), (state,))
