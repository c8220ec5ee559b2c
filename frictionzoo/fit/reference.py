"""The same bench without friction: what every result is compared with."""

import hashlib
from pathlib import Path

import jax
import numpy as np

from frictionzoo.fit.chunk import search
from frictionzoo.fit.lm import LevenbergMarquardt
from frictionzoo.fit.objective import Objective
from frictionzoo.logs.cache import cached, digest
from frictionzoo.simulate import Values

_ITERATIONS = 50  # a handful is usual


def fit_reference(objective: Objective, folder: Path | None = None) -> Values:
    """Minimise the objective from the initial values, to a relative change of 1e-6.

    Args:
        objective: That of a bench without friction.
        folder: Where the minimum is kept for other jobs with the same objective; None to keep nothing.

    Returns:
        Physical values of all parameters by owner and name.
    """

    def fit() -> dict[str, np.ndarray]:
        method = LevenbergMarquardt(_ITERATIONS, 1e-6)
        return {"best": np.asarray(search(method, objective)[0].best)}

    path = None if folder is None else folder / f"{_fingerprint(objective)}.npz"
    best = cached(path, ["best"], fit)["best"]
    return jax.tree.map(np.asarray, objective.space.values(jax.numpy.asarray(best)))


def _fingerprint(objective: Objective) -> str:
    """Of all that the minimum follows from: residuals as a program's text, the loss, its data, start and bounds."""
    space, data = objective.space, objective.data
    arrays = {"start": space.start, "low": space.low, "high": space.high, **data._asdict(), **data.signals.named()}
    del arrays["signals"]
    numbers = digest({name: np.asarray(array) for name, array in arrays.items()})
    return hashlib.sha256(f"{objective.describe()}{numbers}".encode()).hexdigest()
