"""Warm start of a fit at another method's result."""

import logging

import numpy as np

from frictionzoo.core.errors import FitError
from frictionzoo.fit.base import Fit
from frictionzoo.fit.chunk import search
from frictionzoo.fit.objective import Objective

_log = logging.getLogger(__name__)


def begin_where(start: Fit, objective: Objective) -> Objective:
    """Return the objective with a method's best vector as initial coordinates, clipped to the bounds.

    Raises:
        ConfigError: The method cannot search this space.
        FitError: The method diverges or finds no finite vector.
    """
    start = start.choose(objective)
    progress, _ = search(start, objective)
    if bool(progress.broken) or not np.isfinite(np.asarray(progress.best)).all():
        raise FitError(f"fit.start: {start.name} ends without a finite value, expected a finite start; set start=null")
    moved = objective.starting(np.asarray(progress.best))
    identified = moved.space.identified(moved.space.start).items()
    entries = (f"{name} {' '.join(f'{value:.3g}' for value in values)}" for name, values in identified)
    _log.info("the fit starts from the result of %s: %s", start.name, ", ".join(entries))
    return moved
