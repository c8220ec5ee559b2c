"""Benches: the MJCF around a drive, and the actuator laws that convert commands into torque."""

from frictionzoo.bench.actuators.base import REGISTRY, Actuator, Affine, register_actuator
from frictionzoo.bench.base import Bench
from frictionzoo.bench.robot import Robot

__all__ = ["Actuator", "Affine", "Bench", "Robot", "register_actuator"]


def __getattr__(name: str) -> type[Actuator]:
    """Return an actuator law by its class name, as written in `_target_`."""
    return REGISTRY.find_class(name)
