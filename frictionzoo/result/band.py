"""Prediction intervals of the measured position, from rollouts of drawn drives and errors in training rollouts."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import scipy.special
from jaxtyping import Float

from frictionzoo.core.errors import RunError
from frictionzoo.fit.uncertainty import LEVEL
from frictionzoo.result.curves import Curves


class Band(NamedTuple):
    """Ends of the position's prediction interval [rad or m], from the first sample after each rollout's start."""

    low: Float[np.ndarray, "batch time nv"]
    high: Float[np.ndarray, "batch time nv"]


def predict_band(
    place: str,
    simulate: Callable[[Mapping[str, Float[np.ndarray, "nv"]]], Float[np.ndarray, "batch time nv"]],
    draws: Mapping[str, Float[np.ndarray, "count nv"]],
    curves: Curves,
) -> Band:
    """Predict the 95 % interval of each measured position.

    q = q(theta) - e: q(theta) is a rollout of a drive drawn from the joint distribution of its parameters. e is the
    fitted drive's error in a training rollout at the same time after the start. The ends are the 2.5 and 97.5 %
    quantiles over all pairs of a drawn drive and a training rollout. The interval thus contains parameter uncertainty,
    model error, and noise of the measured initial state. With n training rollouts, errors are multiplied by
    t sqrt(1 + 1 / n) / z, the ratio of Student's to the normal prediction interval.

    The interval holds for motion like that of the training recordings, not for other kinds of motion or other loads.

    `place` names the drive in messages. `simulate` returns the positions in the rollouts, with some fitted values
    replaced by drawn ones, by full name; empty `draws`: fitted values only.

    Source: R. Stine, "Bootstrap prediction intervals for regression", 1985, with errors of whole rollouts, which are
    correlated in time, like the blocks of S. Lahiri, "Resampling Methods for Dependent Data", 2003.

    Raises:
        RunError: Fewer than two training rollouts have errors.
    """
    if len(curves.train_errors) < 2:
        raise RunError(
            f"{place}: {len(curves.train_errors)} training rollouts of the evaluation stayed finite, expected 2 at "
            "least, better 40; set evaluation.rollouts, and run it again"
        )
    errors = curves.train_errors * _widening(len(curves.train_errors))
    count = max((len(values) for values in draws.values()), default=1)
    length = errors.shape[1]
    drives = [simulate({name: values[number] for name, values in draws.items()})[:, :length] for number in range(count)]
    drives = [drive for drive in drives if np.isfinite(drive).all()] or drives
    share = (1 - LEVEL) / 2
    ends = [
        np.quantile(positions[:, None] - errors[None, :, : positions.shape[1]], [share, 1 - share], axis=(0, 1))
        for positions in np.stack(drives, axis=1)
    ]
    low, high = np.stack(ends, axis=1)
    return Band(low, high)


def _widening(count: int) -> float:
    """Return the ratio of prediction interval widths: standard deviation estimated from `count` numbers, or known."""
    upper = (1 + LEVEL) / 2
    return float(scipy.special.stdtrit(count - 1, upper) / scipy.special.ndtri(upper) * np.sqrt(1 + 1 / count))
