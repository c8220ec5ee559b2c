"""Engines: one simulation step of a bench, differentiable in its parameters."""

from frictionzoo.engine.base import Engine, Values, friction_of
from frictionzoo.engine.choose import make_engine
from frictionzoo.engine.mjx import MjxEngine
from frictionzoo.engine.specialised import SpecialisedEngine

__all__ = ["Engine", "MjxEngine", "SpecialisedEngine", "Values", "friction_of", "make_engine"]
