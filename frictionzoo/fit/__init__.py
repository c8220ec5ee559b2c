"""Fits: from segments and a simulated drive to identified parameters."""

from frictionzoo.fit.adam import Adam
from frictionzoo.fit.auto import Auto
from frictionzoo.fit.base import Fit
from frictionzoo.fit.grid import Grid
from frictionzoo.fit.known import Known
from frictionzoo.fit.lm import LevenbergMarquardt
from frictionzoo.fit.loggers import RunLogger
from frictionzoo.fit.loop import Outcome, run_fit
from frictionzoo.fit.objective import Objective
from frictionzoo.fit.reference import fit_reference
from frictionzoo.fit.space import Space
from frictionzoo.fit.uncertainty import estimate_uncertainty

__all__ = [
    "Adam",
    "Auto",
    "Fit",
    "Grid",
    "Known",
    "LevenbergMarquardt",
    "Objective",
    "Outcome",
    "RunLogger",
    "Space",
    "estimate_uncertainty",
    "fit_reference",
    "run_fit",
]
