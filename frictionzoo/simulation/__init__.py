"""Simulation: engines step a bench with a friction model, rollouts take many steps, and MuJoCo C verifies both."""

from frictionzoo.simulation.base import Engine, Friction, Values, friction_of, without_memory
from frictionzoo.simulation.choose import make_engine
from frictionzoo.simulation.mjx import MjxEngine
from frictionzoo.simulation.specialised import SpecialisedEngine

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
