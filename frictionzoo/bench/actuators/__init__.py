"""Actuator laws, one a file; the files are looked through, not listed."""

from frictionzoo.bench.actuators.base import REGISTRY, Actuator, Affine, register_actuator

__all__ = ["Actuator", "Affine", "register_actuator"]


def __getattr__(name: str) -> type[Actuator]:
    """A law by the name of its class, as `_target_` has it; its own module has its type."""
    return REGISTRY.find_class(name)
