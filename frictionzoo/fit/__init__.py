"""Fits: from segments and a simulated drive to identified parameters; methods register themselves."""

from frictionzoo.fit.base import REGISTRY, Fit, register_method
from frictionzoo.fit.loggers import RunLogger
from frictionzoo.fit.loop import run_fit
from frictionzoo.fit.module import Outcome
from frictionzoo.fit.objective import Objective
from frictionzoo.fit.space import Space
from frictionzoo.fit.start import fit_reference
from frictionzoo.fit.uncertainty import estimate_uncertainty

__all__ = [
    "Fit",
    "Objective",
    "Outcome",
    "RunLogger",
    "Space",
    "estimate_uncertainty",
    "fit_reference",
    "register_method",
    "run_fit",
]


def __getattr__(name: str) -> type[Fit]:
    """Return a fit method by its class name, for `_target_`; type checkers see it in its module only."""
    return REGISTRY.find_class(name)
