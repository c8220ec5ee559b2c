"""What a drive's torque does not exceed, for actuator laws that may have a limit."""

from collections.abc import Mapping
from typing import Any

LIMITS: Mapping[str, str] = {"torque_limit": "torque", "torque_saturation": "torque"}
"""Dimension of each parameter of a limit; a law that may have one has them among its `optional`."""

POSITIVE: Mapping[str, str] = dict.fromkeys(
    LIMITS, "leave it out where there is none, give a joint without one more than it ever needs"
)
"""Of each parameter of a limit, what to do where it is 0: the drive would have no torque."""


def saturate(xp: Any, values: Mapping[str, Any], torque: Any) -> Any:
    """A torque within the limits that there are; the very one where there are none.

        kappa tanh(torque / kappa), kappa = torque_saturation;  then clip(., -torque_limit, torque_limit)

    The hyperbolic tangent bends from the start, as a motor whose iron saturates does; the other cuts off.

    Source: arXiv 2505.14266, 2025, the smooth one.

    Args:
        xp: Array namespace.
        values: Of the actuator law's parameters, `torque_limit` and `torque_saturation` [N m or N] where it has them.
        torque: What the drive is to give [N m or N].
    """
    if "torque_saturation" in values:
        torque = values["torque_saturation"] * xp.tanh(torque / values["torque_saturation"])
    if "torque_limit" in values:
        torque = xp.minimum(xp.maximum(torque, -values["torque_limit"]), values["torque_limit"])
    return torque
