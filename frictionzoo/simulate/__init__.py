"""Simulation: engines step a bench with a friction model, rollouts take many steps, and MuJoCo C verifies both."""

from frictionzoo.simulate.base import Engine, Friction, Values, friction_of, without_memory
from frictionzoo.simulate.choose import make_engine
from frictionzoo.simulate.mjx import MjxEngine
from frictionzoo.simulate.specialised import SpecialisedEngine

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
