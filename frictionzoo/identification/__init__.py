"""Identification of a drive from recordings: the problem and its solution."""

from frictionzoo.identification.problem import Problem
from frictionzoo.identification.recipe import Parts
from frictionzoo.identification.solve import solve

__all__ = ["Parts", "Problem", "solve"]
