"""No fit at all: given values are judged as they are."""

import jax.numpy as jnp
from jaxtyping import Array

from frictionzoo.core.errors import ConfigError
from frictionzoo.fit.base import Chunk, Fit, Progress, Trace, begin, compile_chunk, keep_best, register_method
from frictionzoo.fit.objective import Blocks, Objective


@register_method("known")
class Known(Fit):
    """The initial values, published ones say, on the same segments and rollouts as identified ones."""

    def total(self, objective: Objective) -> int:
        """See `Fit.total`; raises ConfigError where something is to be identified."""
        if objective.space.names:
            raise ConfigError(
                f"fit=known: {objective.space.names[0]} is to be identified, expected known values only; set "
                "identify: false for it or choose another fit"
            )
        return 1

    def start(self, objective: Objective) -> Progress:
        """See `Fit.start`."""
        return begin(objective, objective.space.start, ())

    def chunk(self, objective: Objective, size: int) -> Chunk:
        """See `Fit.chunk`."""

        def run(progress: Progress, count: Array, data: Blocks) -> tuple[Progress, Trace]:
            loss = objective.loss(progress.vector, data)
            judged = keep_best(progress, loss)._replace(
                iteration=progress.iteration + count, broken=~jnp.isfinite(loss)
            )
            return judged, Trace(loss[None], jnp.zeros(1, loss.dtype), {})

        return compile_chunk(self, objective, run)
