"""Automatic choice of the method by the model, for sweeps over models of all kinds."""

from frictionzoo.core.errors import refuse_outside
from frictionzoo.fit.adam import Adam
from frictionzoo.fit.base import Fit, register_method
from frictionzoo.fit.lm import MOST_COORDINATES, MOST_TRIES, LevenbergMarquardt
from frictionzoo.fit.objective import Objective


@register_method("auto")
class Auto(Adam):
    """Levenberg-Marquardt where it applies; Adam for networks and for models that exist only in torch.

    Args:
        tries: `iterations` of `LevenbergMarquardt`.
        tolerance: `tolerance` of `LevenbergMarquardt`.
        iterations: `iterations` of `Adam`.
        learning_rate: `learning_rate` of `Adam`.
        b2: `b2` of `Adam`.
        derivative: `derivative` of `Adam`.
        schedule: `schedule` of `Adam`.
        start: `start` of both.

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
        super().__init__(iterations, learning_rate, b2, derivative, schedule, start)

    def choose(self, objective: Objective) -> Fit:
        """See `Fit.choose`."""
        few = len(objective.space.start) <= MOST_COORDINATES
        return self._lm if few and not objective.torch_law else self._adam
