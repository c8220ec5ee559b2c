"""From recordings to an identified drive: the problem, and its solution."""

from frictionzoo.identification.problem import Parts, Problem
from frictionzoo.identification.solve import solve

__all__ = ["Parts", "Problem", "solve"]
