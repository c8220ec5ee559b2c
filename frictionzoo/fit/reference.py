"""Reference fit of the bench without friction, with which every result is compared."""

import hashlib
from pathlib import Path

import jax
import numpy as np

from frictionzoo.data.cache import cached, digest
from frictionzoo.fit.chunk import search
from frictionzoo.fit.lm import LevenbergMarquardt
from frictionzoo.fit.objective import Objective
from frictionzoo.simulation import Values

_ITERATIONS = 50  # a handful is usual


def fit_reference(objective: Objective, folder: Path | None = None) -> Values:
    """Minimise the objective of a bench without friction; return physical values by owner and name.

    The fit starts at the initial values and ends at a relative change of 1e-6. `folder` caches the minimum for other
    jobs with the same objective.
    """

    def fit() -> dict[str, np.ndarray]:
        method = LevenbergMarquardt(_ITERATIONS, 1e-6)
        return {"best": np.asarray(search(method, objective)[0].best)}

    path = None if folder is None else folder / f"{_fingerprint(objective)}.npz"
    best = cached(path, ["best"], fit)["best"]
    return jax.tree.map(np.asarray, objective.space.values(jax.numpy.asarray(best)))


def _fingerprint(objective: Objective) -> str:
    """Return a hash of everything that determines the minimum: program of the residuals, loss, data, start, bounds."""
    space, data = objective.space, objective.data
    arrays = {"start": space.start, "low": space.low, "high": space.high, **data._asdict(), **data.signals.named()}
    del arrays["signals"]
    numbers = digest({name: np.asarray(array) for name, array in arrays.items()})
    return hashlib.sha256(f"{objective.describe()}{numbers}".encode()).hexdigest()
