"""Base class of models whose friction depends on the temperature."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

from frictionzoo.core.errors import ConfigError
from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models.base import FrictionModel, Params, Values

ABSOLUTE_ZERO = -273.15  # degC


class TemperatureModel(FrictionModel):
    """Dry friction as MuJoCo's constraint and viscous friction, each a coefficient times a factor of the temperature.

    A subclass defines the two factors. They are positive, and 1 at the reference temperature.

    Attributes:
        reference: Temperature to which the coefficients refer [degC]; also the temperature of drives whose recordings
            have none.

    Raises:
        ConfigError: The reference is not above absolute zero; see also `FrictionModel`.
    """

    constraint = True
    dissipative = True
    sees: ClassVar[tuple[str, ...]] = ("speed", "temperature")

    def __init__(self, nv: int, reference: float = 25.0, params: Params | None = None) -> None:
        super().__init__(nv, params)
        if not ABSOLUTE_ZERO < reference < float("inf"):
            raise ConfigError(f"model.reference={reference}; expected a temperature above {ABSOLUTE_ZERO} degC")
        self.reference: float = float(reference)
        self.inputs: Mapping[str, float] = {"temperature": self.reference}

    @abstractmethod
    def shares(self, xp: Any, values: Values, temperature: Any) -> tuple[Any, Any]:
        """Return the factors of frictionloss and damping at a temperature [degC], of shape (..., nv)."""

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Return the constraint's limit and the damping at this temperature."""
        dry, viscous = self.shares(xp, values, state.temperature)
        return FrictionTerms(frictionloss=values["frictionloss"] * dry, damping=values["damping"] * viscous)
