"""Actuator laws, one per file; the registry discovers them."""

from frictionzoo.bench.actuators.base import REGISTRY, Actuator, Affine, register_actuator

__all__ = ["Actuator", "Affine", "register_actuator"]


def __getattr__(name: str) -> type[Actuator]:
    """Return an actuator law by its class name, as written in `_target_`."""
    return REGISTRY.find_class(name)
