"""Engines: one simulation step of a bench, differentiable in its parameters."""

from frictionzoo.engine.base import Engine, Friction, Values, friction_of, without_memory
from frictionzoo.engine.choose import make_engine
from frictionzoo.engine.mjx import MjxEngine
from frictionzoo.engine.specialised import SpecialisedEngine

__all__ = [
    "Engine",
    "Friction",
    "MjxEngine",
    "SpecialisedEngine",
    "Values",
    "friction_of",
    "make_engine",
    "without_memory",
]
