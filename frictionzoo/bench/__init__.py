"""Benches: the MJCF around a drive, and the actuator laws that turn commands into torque."""

from frictionzoo.bench.actuators.base import REGISTRY, Actuator, Affine, register_actuator
from frictionzoo.bench.base import Bench
from frictionzoo.bench.robot import Robot

__all__ = ["Actuator", "Affine", "Bench", "Robot", "register_actuator"]


def __getattr__(name: str) -> type[Actuator]:
    """An actuator law by the name of its class, as `_target_` has it; its own module has its type."""
    return REGISTRY.find_class(name)
