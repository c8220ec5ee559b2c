"""frictionzoo: a drive's armature and friction from its encoder log, through a differentiable MuJoCo."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from frictionzoo.bench.actuators.dc_motor_pd import DcMotorPD
    from frictionzoo.bench.actuators.force import Force
    from frictionzoo.bench.actuators.position_pd import PositionPD
    from frictionzoo.bench.actuators.voltage_servo import VoltageServo
    from frictionzoo.bench.base import Bench
    from frictionzoo.library import law, load
    from frictionzoo.result.identified import Identified
    from frictionzoo.simulate.differentiable import rollout

__all__ = ["Bench", "DcMotorPD", "Force", "Identified", "PositionPD", "VoltageServo", "law", "load", "rollout"]
__version__ = "0.1.0"

_HOMES = {
    **dict.fromkeys(("Bench", "DcMotorPD", "Force", "PositionPD", "VoltageServo"), "frictionzoo.bench"),
    **dict.fromkeys(("law", "load"), "frictionzoo.library"),
    "Identified": "frictionzoo.result.identified",
    "rollout": "frictionzoo.simulate.differentiable",
}


def __getattr__(name: str) -> Any:
    """The names of `__all__` where they are first used: MuJoCo, JAX and torch take seconds to import."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
