"""Where measured motion will be: rollouts of drives that data allow, with what the fitted one left of others."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import scipy.special
from jaxtyping import Float

from frictionzoo.core.errors import RunError
from frictionzoo.fit.uncertainty import LEVEL
from frictionzoo.result.curves import Curves


class Band(NamedTuple):
    """A band of positions, from the first sample after the start of each rollout on.

    Attributes:
        low: Its lower end [rad or m].
        high: Its upper end.
    """

    low: Float[np.ndarray, "batch time nv"]
    high: Float[np.ndarray, "batch time nv"]


def predict_band(
    place: str,
    simulate: Callable[[Mapping[str, Float[np.ndarray, "nv"]]], Float[np.ndarray, "batch time nv"]],
    draws: Mapping[str, Float[np.ndarray, "count nv"]],
    curves: Curves,
) -> Band:
    """The band that holds each measured position with 95 %.

    q = q(theta) - e: a rollout q(theta) of a drive that is drawn from the joint distribution of its parameters, less
    the error e, at the same time after the start, of a training rollout of the fitted drive. The band's ends are the
    2.5 and 97.5 % quantiles over all pairs of a drawn drive and a training rollout. So it holds what parameters may be
    and what the law lacks, and what the noise of a measured initial state does. Of few training rollouts, n, errors are
    taken times t sqrt(1 + 1 / n) / z, as a prediction interval is wider with Student's quantile than with the normal's.

    It holds what is measured where that differs from the drive as training recordings did: a motion of another kind, or
    another load, need not be within.

    Source: R. Stine, "Bootstrap prediction intervals for regression", 1985, with errors of whole rollouts, which are
    correlated in time, as S. Lahiri, "Resampling Methods for Dependent Data", 2003, takes blocks.

    Args:
        place: Where the drive lies, for messages.
        simulate: Positions in the rollouts with these values in place of fitted ones.
        draws: Of parameters, by full name; empty where there are none to draw from.
        curves: With `train_errors`.

    Raises:
        RunError: There are errors of less than two training rollouts.
    """
    if len(curves.train_errors) < 2:
        raise RunError(
            f"{place}: {len(curves.train_errors)} training rollouts of the evaluation stayed finite, expected 2 at "
            "least, better 40; set evaluation.rollouts, and run it again"
        )
    errors = curves.train_errors * _widening(len(curves.train_errors))
    count = max((len(own) for own in draws.values()), default=1)
    length = errors.shape[1]
    drives = [simulate({name: own[number] for name, own in draws.items()})[:, :length] for number in range(count)]
    drives = [drive for drive in drives if np.isfinite(drive).all()] or drives
    share = (1 - LEVEL) / 2
    ends = [
        np.quantile(of[:, None] - errors[None, :, : of.shape[1]], [share, 1 - share], axis=(0, 1))
        for of in np.stack(drives, axis=1)
    ]
    low, high = np.stack(ends, axis=1)
    return Band(low, high)


def _widening(count: int) -> float:
    """Of a prediction interval by a standard deviation of so many numbers, over one whose deviation is known."""
    upper = (1 + LEVEL) / 2
    return float(scipy.special.stdtrit(count - 1, upper) / scipy.special.ndtri(upper) * np.sqrt(1 + 1 / count))
