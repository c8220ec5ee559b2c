"""What a drive's command and torque do not exceed, for actuator laws that may have limits."""

from collections.abc import Container, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

LIMITS: Mapping[str, str] = {"torque_limit": "torque", "torque_saturation": "torque", "torque_low": "torque"}
"""Dimension of each parameter of a limit; a law that may have one has them among its `optional`."""

POSITIVE: Mapping[str, str] = dict.fromkeys(
    ("torque_limit", "torque_saturation"),
    "leave it out where there is none, give a joint without one more than it ever needs",
)
"""Of each parameter of a limit, what to do where it is 0: the drive would have no torque."""

POSITIONS: Mapping[str, str] = {"ctrl_low": "position", "ctrl_high": "position"}
"""Dimension of the ends of the range of desired positions, among the `optional` of a law that has such."""

ENDS = ("torque_low", *POSITIONS)
"""Those that are there where they are 0."""


def saturate(xp: Any, values: Mapping[str, Any], torque: Any) -> Any:
    """A torque within the limits that there are; the very one where there are none.

        kappa tanh(torque / kappa), kappa = torque_saturation;  then clip(., torque_low, torque_limit)

    The hyperbolic tangent bends from the start, as a motor whose iron saturates does; the other cuts off.

    Source: arXiv 2505.14266, 2025, the smooth one.

    Args:
        xp: Array namespace.
        values: Of the actuator law's parameters, `torque_limit`, `torque_low` and `torque_saturation` [N m or N] where
            it has them; without `torque_low` the lower end is -`torque_limit`.
        torque: What the drive is to give [N m or N].
    """
    if "torque_saturation" in values:
        torque = values["torque_saturation"] * xp.tanh(torque / values["torque_saturation"])
    if "torque_low" in values:
        torque = xp.maximum(torque, values["torque_low"])
    elif "torque_limit" in values:
        torque = xp.maximum(torque, -values["torque_limit"])
    return xp.minimum(torque, values["torque_limit"]) if "torque_limit" in values else torque


def beyond_mujoco(params: Container[str]) -> bool:
    """Return whether a MuJoCo actuator cannot hold the limits: it has two ends, and no hyperbolic tangent."""
    return "torque_saturation" in params or ("torque_low" in params and "torque_limit" not in params)


def force_range(values: Mapping[str, Any], gain: Any = 1.0) -> Float[np.ndarray, "nv 2"] | None:
    """Return the ends of an actuator's torque [N m or N] where MuJoCo can hold them; None where there are none.

    Args:
        values: As in `saturate`, and the bench's `torque_offset` [N m or N] where it has one.
        gain: By which a torque within the limits is multiplied, of shape (nv,).
    """
    if "torque_limit" not in values:
        return None
    high = values["torque_limit"]
    ends = np.stack([gain * values.get("torque_low", -high), gain * high], axis=1)
    return ends + np.reshape(values.get("torque_offset", 0.0), (-1, 1))


def within_range(xp: Any, values: Mapping[str, Any], command: Any) -> Any:
    """A desired position [rad or m] within `ctrl_low` and `ctrl_high` where there are such; else the very one."""
    if "ctrl_low" in values:
        command = xp.maximum(command, values["ctrl_low"])
    return xp.minimum(command, values["ctrl_high"]) if "ctrl_high" in values else command
