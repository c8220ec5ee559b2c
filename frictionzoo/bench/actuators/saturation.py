"""Optional limits of a drive's command and torque, shared by actuator laws."""

from collections.abc import Container, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

LIMITS: Mapping[str, str] = {"torque_limit": "torque", "torque_saturation": "torque", "torque_low": "torque"}
"""Dimension of each torque-limit parameter; laws list them in `optional`."""

POSITIVE: Mapping[str, str] = dict.fromkeys(
    ("torque_limit", "torque_saturation"),
    "leave it out where there is none, give a joint without one more than it ever needs",
)
"""Advice for a limit of 0, at which a joint would have no torque."""

POSITIONS: Mapping[str, str] = {"ctrl_low": "position", "ctrl_high": "position"}
"""Dimension of the limits of desired positions; laws with desired positions list them in `optional`."""

ENDS = ("torque_low", *POSITIONS)
"""Limits that remain in effect at 0."""


def saturate(xp: Any, values: Mapping[str, Any], torque: Any) -> Any:
    """Return a torque [N m or N] within the limits; without limits, the same object.

        kappa tanh(torque / kappa), kappa = torque_saturation;  then clip(., torque_low, torque_limit)

    The hyperbolic tangent represents magnetic saturation. All limits are optional; `torque_low` defaults to
    -`torque_limit`.

    Source: arXiv 2505.14266, 2025, for the hyperbolic tangent.
    """
    if "torque_saturation" in values:
        torque = values["torque_saturation"] * xp.tanh(torque / values["torque_saturation"])
    if "torque_low" in values:
        torque = xp.maximum(torque, values["torque_low"])
    elif "torque_limit" in values:
        torque = xp.maximum(torque, -values["torque_limit"])
    return xp.minimum(torque, values["torque_limit"]) if "torque_limit" in values else torque


def beyond_mujoco(params: Container[str]) -> bool:
    """Return whether a MuJoCo actuator cannot represent the limits: one limit alone, or a hyperbolic tangent."""
    return "torque_saturation" in params or ("torque_low" in params and "torque_limit" not in params)


def force_range(values: Mapping[str, Any], gain: Any = 1.0) -> Float[np.ndarray, "nv 2"] | None:
    """Return MuJoCo's torque range [N m or N], times `gain`, plus any `torque_offset`; None without `torque_limit`."""
    if "torque_limit" not in values:
        return None
    high = values["torque_limit"]
    ends = np.stack([gain * values.get("torque_low", -high), gain * high], axis=1)
    return ends + np.reshape(values.get("torque_offset", 0.0), (-1, 1))


def within_range(xp: Any, values: Mapping[str, Any], command: Any) -> Any:
    """Return a desired position [rad or m] within `ctrl_low` and `ctrl_high`; without limits, the same object."""
    if "ctrl_low" in values:
        command = xp.maximum(command, values["ctrl_low"])
    return xp.minimum(command, values["ctrl_high"]) if "ctrl_high" in values else command
