"""Partial evaluation: a JAX function of a few numbers to the flat list of scalar operations that it comes down to.

MJX computes with arrays over bodies, joints and coordinates, and most of their entries are fixed by the model. Here the
function is traced once, and its operations are carried out on arrays of expressions instead of numbers: what the model
fixes becomes a constant, equal expressions become one, and what is left runs elementwise over any batch.
"""

from frictionzoo.simulate.fold.expression import CannotSpecialiseError
from frictionzoo.simulate.fold.specialise import Specialised, specialise

__all__ = ["CannotSpecialiseError", "Specialised", "specialise"]
