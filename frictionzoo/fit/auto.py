"""The method that suits the law: what one sweep over laws of all kinds takes."""

from typing import Any

from frictionzoo.core.errors import refuse_outside
from frictionzoo.fit.adam import Adam
from frictionzoo.fit.base import Fit, Seen, register_method
from frictionzoo.fit.blocks import Blocks
from frictionzoo.fit.lm import MOST_COORDINATES, MOST_TRIES, LevenbergMarquardt
from frictionzoo.fit.objective import Objective


@register_method("auto")
class Auto(Fit):
    """Levenberg-Marquardt where it can be had; Adam for networks and for laws that exist only in torch.

    Args:
        tries: `iterations` of `LevenbergMarquardt`.
        tolerance: Of `LevenbergMarquardt`.
        iterations: Of `Adam`.
        learning_rate: Of `Adam`.
        b2: Of `Adam`.
        derivative: Of `Adam`.
        schedule: Of `Adam`.
        start: Of either.

    Raises:
        ConfigError: An argument is out of range.
    """

    def __init__(
        self,
        tries: int = 100,
        tolerance: float = 1e-8,
        iterations: int = 700,
        learning_rate: float = 0.01,
        b2: float = 0.9,
        derivative: str = "auto",
        schedule: str = "constant",
        start: Fit | None = None,
    ) -> None:
        refuse_outside("fit.tries", tries, 1, MOST_TRIES)
        self._lm = LevenbergMarquardt(tries, tolerance, start)
        self._adam = Adam(iterations, learning_rate, b2, derivative, schedule, start)
        self.start = start

    def choose(self, objective: Objective) -> Fit:
        """See `Fit.choose`."""
        few = len(objective.space.start) <= MOST_COORDINATES
        return self._lm if few and not objective.torch_law else self._adam

    def total(self, objective: Objective) -> int:
        """See `Fit.total`; raises ConfigError where nothing is to be identified."""
        return self.choose(objective).total(objective)

    def step(self, objective: Objective, vector: Any, state: Any, data: Blocks) -> tuple[Seen, Any, Any]:
        """Not its own: `choose` names the method that does the work."""
        return self.choose(objective).step(objective, vector, state, data)
