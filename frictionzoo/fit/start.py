"""Fits before the fit: a warm start, and the reference without friction, with which every result is compared."""

import hashlib
import logging
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from frictionzoo.core.errors import FitError
from frictionzoo.data.cache import cached, digest
from frictionzoo.fit.base import Fit
from frictionzoo.fit.chunk import search
from frictionzoo.fit.lm import LevenbergMarquardt
from frictionzoo.fit.objective import Objective
from frictionzoo.simulation import Values

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


def fit_reference(objective: Objective, folder: Path | None = None) -> Values:
    """Minimise the objective of a bench without friction; return physical values by owner and name.

    The fit starts at the initial values and ends at a relative change of 1e-6, or of 1e-3 where it estimates initial
    states: those at corners of the motion make the last per cent slow. `folder` caches the minimum for other jobs with
    the same objective.
    """

    def fit() -> dict[str, np.ndarray]:
        method = LevenbergMarquardt(50, 1e-3 if objective.negligible else 1e-6)  # a handful of iterations is usual
        return {"best": np.asarray(search(method, objective)[0].best)}

    path = None if folder is None else folder / f"{_fingerprint(objective)}.npz"
    best = cached(path, ["best"], fit)["best"]
    return jax.tree.map(np.asarray, objective.space.values(jnp.asarray(best)))


def _fingerprint(objective: Objective) -> str:
    """Return a hash of everything that determines the minimum: program of the residuals, loss, data, start, bounds."""
    space, data = objective.space, objective.data
    arrays = {"start": space.start, "low": space.low, "high": space.high, **data._asdict(), **data.signals.named()}
    del arrays["signals"]
    numbers = digest({name: np.asarray(array) for name, array in arrays.items()})
    return hashlib.sha256(f"{objective.describe()}{numbers}".encode()).hexdigest()
