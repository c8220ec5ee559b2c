"""What laws whose friction depends on the temperature share."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

from frictionzoo.core.errors import ConfigError
from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models.base import FrictionModel, Params, Values

ABSOLUTE_ZERO = -273.15  # degC


class TemperatureModel(FrictionModel):
    """Dry friction as MuJoCo's constraint and viscous friction, each a coefficient times a share of the temperature.

    A law says what the two shares are; they are positive, and 1 at the reference temperature.

    Attributes:
        reference: Temperature at which the coefficients hold [degC]; a drive whose recordings lack the temperature acts
            as there.

    Raises:
        ConfigError: The reference is not above absolute zero, and as `FrictionModel` has it.
    """

    constraint = True
    dissipative = True
    sees = ("speed", "temperature")

    def __init__(self, nv: int, reference: float = 25.0, params: Params | None = None) -> None:
        super().__init__(nv, params)
        if not ABSOLUTE_ZERO < reference < float("inf"):
            raise ConfigError(f"model.reference={reference}; expected a temperature above {ABSOLUTE_ZERO} degC")
        self.reference: float = float(reference)
        self.inputs: Mapping[str, float] = {"temperature": self.reference}

    @abstractmethod
    def shares(self, xp: Any, values: Values, temperature: Any) -> tuple[Any, Any]:
        """What frictionloss and damping are multiplied by at a temperature [degC], of shape (..., nv)."""

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """The constraint's limit and the damping at this temperature."""
        dry, viscous = self.shares(xp, values, state.temperature)
        return FrictionTerms(frictionloss=values["frictionloss"] * dry, damping=values["damping"] * viscous)
