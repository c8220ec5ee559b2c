"""Drive whose command is proportional to its force, with an offset and limits."""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from frictionzoo.bench.actuators.base import Actuator, Affine, Sections, Value, register_actuator
from frictionzoo.bench.actuators.saturation import ENDS, LIMITS, POSITIVE, beyond_mujoco, force_range, saturate


@register_actuator("force")
class Force(Actuator):
    """Force drive: force = sat(force_gain ctrl + force_offset), with ctrl in its recorded unit (volts, newtons).

    By default the command is the force or torque itself. For a recorded motor current, `force_gain` is the known torque
    constant. sat applies if the law has `torque_limit`, `torque_low` or `torque_saturation`, as in `JointPD`.
    """

    dimensions: ClassVar[Mapping[str, str]] = {"force_gain": "torque/command", "force_offset": "torque", **LIMITS}
    optional: ClassVar[tuple[str, ...]] = tuple(LIMITS)
    ends: ClassVar[tuple[str, ...]] = ENDS
    positive: ClassVar[Mapping[str, str]] = POSITIVE
    defaults: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "force_gain": {"init": 1.0, "low": 0.1, "high": 10.0, "scale": "log", "identify": False},
        "force_offset": {"init": 0.0, "low": -1.0, "high": 1.0, "scale": 1.0, "identify": False},
    }

    def __init__(
        self,
        params: Sections = None,
        *,
        force_gain: Value = None,
        force_offset: Value = None,
        torque_limit: Value = None,
        torque_saturation: Value = None,
        torque_low: Value = None,
    ) -> None:
        super().__init__(
            params,
            force_gain=force_gain,
            force_offset=force_offset,
            torque_limit=torque_limit,
            torque_saturation=torque_saturation,
            torque_low=torque_low,
        )

    @property
    def has_controller(self) -> bool:
        """See `Actuator.has_controller`; a limit counts as a controller."""
        return not LIMITS.keys().isdisjoint(self.params)

    @property
    def needs_state(self) -> bool:
        """See `Actuator.needs_state`."""
        return beyond_mujoco(self.params)

    def affine(self, values: Mapping[str, Any]) -> Affine:
        """See `Actuator.affine`."""
        zero = 0 * values["force_gain"]
        return Affine(values["force_gain"], values["force_offset"] + values.get("torque_offset", zero), zero, zero)

    def control(
        self, xp: Any, values: Mapping[str, Any], qpos: Any, qvel: Any, command: Any, inputs: Mapping[str, Any]
    ) -> Any:
        """See `Actuator.control`."""
        requested = values["force_gain"] * command + values["force_offset"]
        limited = saturate(xp, values, requested)
        return command if limited is requested else command + (limited - requested) / values["force_gain"]

    def force_range(self, values: Mapping[str, Any]) -> Float[np.ndarray, "nv 2"] | None:
        """See `Actuator.force_range`."""
        return force_range(values)
