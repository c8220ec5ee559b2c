"""Partial evaluation: from a JAX function of a few numbers to an equivalent flat list of scalar operations.

MJX computes with arrays over bodies, joints and coordinates, and the model fixes most of their entries. The function is
traced once, and its operations are applied to arrays of expressions. Fixed entries become constants, equal expressions
become one, and the remaining operations run elementwise over any batch.
"""

from frictionzoo.simulation.fold.expression import CannotSpecialiseError
from frictionzoo.simulation.fold.specialise import Specialised, specialise

__all__ = ["CannotSpecialiseError", "Specialised", "specialise"]
