"""Fits: from segments and a simulated drive to identified parameters."""

from frictionzoo.fit.adam import Adam
from frictionzoo.fit.base import Fit
from frictionzoo.fit.grid import Grid
from frictionzoo.fit.loop import Outcome, run_fit
from frictionzoo.fit.objective import Objective, Space
from frictionzoo.fit.reference import fit_reference

__all__ = ["Adam", "Fit", "Grid", "Objective", "Outcome", "Space", "fit_reference", "run_fit"]
