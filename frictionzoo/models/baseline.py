"""No friction."""

from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Values, register_model


@register_model("baseline")
class Baseline(FrictionModel):
    """Drive without friction, the reference for all other models; only parameters of the bench are identified.

    Cannot represent: any loss. A drive with friction appears heavier or weaker than it is.

    torque = 0

    Source: V. Kovalev et al., Proc. MIPT 18(2), 2026, Table 1, "Baseline (no friction)".
    """

    dissipative = True
    export_target = "mjcf"

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Return no terms."""
        return FrictionTerms()
