"""Evaluation of known values without a fit."""

from typing import Any

import jax.numpy as jnp

from frictionzoo.core.errors import ConfigError
from frictionzoo.fit.base import Evaluation, Fit, register_method
from frictionzoo.fit.blocks import Blocks
from frictionzoo.fit.objective import Objective


@register_method("known")
class Known(Fit):
    """Method that keeps the initial values, such as published ones, and evaluates them like identified ones."""

    def total(self, objective: Objective) -> int:
        """See `Fit.total`; raises ConfigError if there is a parameter to identify."""
        if objective.space.names:
            raise ConfigError(
                f"fit=known: {objective.space.names[0]} is to be identified, expected known values only; set "
                "identify: false for it or choose another fit"
            )
        return 1

    def step(self, objective: Objective, vector: Any, state: Any, data: Blocks) -> tuple[Evaluation, Any, Any]:
        """See `Fit.step`."""
        loss = objective.loss(vector, data)
        return Evaluation(loss, jnp.zeros_like(vector), ~jnp.isfinite(loss)), vector, state
