"""Identification of armature and friction of robot drives from encoder logs, with differentiable MuJoCo."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from frictionzoo.api.compared import Compared
    from frictionzoo.api.design import design_recording
    from frictionzoo.api.drift import drift
    from frictionzoo.api.identified import Identified
    from frictionzoo.api.inspected import inspect
    from frictionzoo.api.library import compare, free, identify, law, list_models, load, read, tied
    from frictionzoo.api.logs import Logs
    from frictionzoo.bench.actuators.dc_motor_pd import DcMotorPD
    from frictionzoo.bench.actuators.force import Force
    from frictionzoo.bench.actuators.joint_pd import JointPD
    from frictionzoo.bench.actuators.position_pd import PositionPD
    from frictionzoo.bench.actuators.recorded_pd import RecordedPD
    from frictionzoo.bench.actuators.voltage_servo import VoltageServo
    from frictionzoo.bench.base import Bench
    from frictionzoo.bench.robot import Robot
    from frictionzoo.core.log import Log
    from frictionzoo.core.params import Param, Parameter
    from frictionzoo.core.state import DriveState, FrictionTerms
    from frictionzoo.data.clean import Cleaning
    from frictionzoo.data.split import Split
    from frictionzoo.models.base import FrictionModel
    from frictionzoo.models.contract import check_model
    from frictionzoo.models.registry import register_model
    from frictionzoo.result.comparison.spread import spread
    from frictionzoo.simulation.differentiable import rollout

__all__ = [
    "Bench",
    "Cleaning",
    "Compared",
    "DcMotorPD",
    "DriveState",
    "Force",
    "FrictionModel",
    "FrictionTerms",
    "Identified",
    "JointPD",
    "Log",
    "Logs",
    "Param",
    "Parameter",
    "PositionPD",
    "RecordedPD",
    "Robot",
    "Split",
    "VoltageServo",
    "check_model",
    "compare",
    "design_recording",
    "drift",
    "free",
    "identify",
    "inspect",
    "law",
    "list_models",
    "load",
    "read",
    "register_model",
    "rollout",
    "spread",
    "tied",
]
__version__ = "0.1.0"

_LIBRARY = "frictionzoo.api.library"
_HOMES = {
    **dict.fromkeys(("Bench", "Robot", "DcMotorPD", "Force", "JointPD"), "frictionzoo.bench"),
    **dict.fromkeys(("PositionPD", "RecordedPD", "VoltageServo"), "frictionzoo.bench"),
    **dict.fromkeys(("compare", "free", "identify", "law", "list_models", "load", "read", "tied"), _LIBRARY),
    **dict.fromkeys(("DriveState", "FrictionTerms"), "frictionzoo.core.state"),
    **dict.fromkeys(("FrictionModel", "register_model"), "frictionzoo.models"),
    "Cleaning": "frictionzoo.data.clean",
    "Compared": "frictionzoo.api.compared",
    "Identified": "frictionzoo.api.identified",
    "Log": "frictionzoo.core.log",
    "Logs": "frictionzoo.api.logs",
    **dict.fromkeys(("Param", "Parameter"), "frictionzoo.core.params"),
    "Split": "frictionzoo.data.split",
    "design_recording": "frictionzoo.api.design",
    "drift": "frictionzoo.api.drift",
    "inspect": "frictionzoo.api.inspected",
    "check_model": "frictionzoo.models.contract",
    "rollout": "frictionzoo.simulation.differentiable",
    "spread": "frictionzoo.result.comparison.spread",
}


def __getattr__(name: str) -> Any:
    """Import a name of `__all__` on first use: MuJoCo, JAX and torch take seconds to import."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
