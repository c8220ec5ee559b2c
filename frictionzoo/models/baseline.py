"""No friction at all."""

from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Values, register_model


@register_model("baseline")
class Baseline(FrictionModel):
    """A drive without friction, what every other law is measured against; only the bench's quantities are identified.

    torque = 0

    Cannot represent: any loss. A drive that rubs looks heavier or weaker than it is.

    Source: V. Kovalev et al., Proc. MIPT 18(2), 2026, Table 1, "Baseline (no friction)".
    """

    dissipative = True

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """No term."""
        return FrictionTerms()
