"""Shares of an error that functions of the drive's state explain, and their significance."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy.stats
from jaxtyping import Float, Int

STRETCHES = 50  # most stretches of time; their scores count as independent
ROWS = 20  # fewest in a stretch
LASTING = 4.0  # length of a stretch, in correlation lengths of the error
FOLDS = 5  # groups of stretches for cross-validation
LEVEL = 0.01  # chance of any finding with the right model, over all candidates tried
SHARE = 0.05  # of the variance beyond the known columns; smaller shares are not reported
MOST = 3  # most findings
ALIKE = 0.85  # share of the largest gain; the first candidate that reaches it is taken
_SPANNED = 1e-4  # relative size of the remainder below which other columns span a column

Column = Float[np.ndarray, "rows"]
Columns = Float[np.ndarray, "rows _"]
Factors = Float[np.ndarray, "_"] | float
Usual = Callable[[str, Sequence[str]], Factors]


class Candidate(NamedTuple):
    """Functions of the drive's state in each row that may explain an error, chosen from `tried` similar sets."""

    columns: Columns
    tried: int = 1


class Contribution(NamedTuple):
    """A candidate that explains a part of an error.

    Attributes:
        share: Share of the variance beyond known columns and earlier candidates that it explains in held-out rows.
        chance: Probability that an unrelated error scores as high, times the number of candidates.
    """

    name: str
    share: float
    chance: float


def attribute(
    error: Column,
    known: Columns,
    candidates: Mapping[str, Candidate],
    joints: int = 1,
    usual: Usual = lambda name, before: 0.0,
) -> list[Contribution]:
    """Find the candidates that explain an error, each beyond those found before it; return the largest share first.

    The error is first projected off the `known` columns, the effects of the model's parameters. Of similar candidates,
    the first is preferred. A candidate counts if Wald's test rejects that its coefficients equal the `usual` factors,
    which occur without model error, and if it lowers the error in held-out stretches. The significance holds for all
    candidates and `joints` together. The covariance comes from the differences between stretches of time, within which
    errors may be correlated.

    Source: A. C. Cameron, D. L. Miller, "A Practitioner's Guide to Cluster-Robust Inference", Journal of Human
    Resources 50(2), 2015, section VI, the jackknife CR3.
    """
    explained: list[Contribution] = []
    count = joints * sum(candidate.tried for candidate in candidates.values())
    remaining, basis = dict(candidates), _orthogonal(known)
    total = max(float(error @ error - np.square(basis.T @ error).sum()), 1e-300)  # not explained by known columns
    while remaining and len(explained) < MOST:
        before = [entry.name for entry in explained]
        trials = (_try(error, known, n, entry, count, total, usual(n, before)) for n, entry in remaining.items())
        significant = [entry for entry in trials if entry is not None]
        if not significant:
            break
        largest = max(entry.share for entry in significant)
        best = next(entry for entry in significant if entry.share >= ALIKE * largest)
        explained.append(best)
        known = np.column_stack([known, remaining.pop(best.name).columns])
    return sorted(explained, key=lambda entry: -entry.share)


def find_factors(error: Column, known: Columns, columns: Columns) -> Float[np.ndarray, "_"]:
    """Return the factors of columns in an error, beyond the known columns."""
    basis = _orthogonal(known)
    beyond = _beyond(columns, basis)
    factors = np.linalg.lstsq(beyond / _sizes(beyond), error - basis @ (basis.T @ error), rcond=_SPANNED)[0]
    return np.where(beyond.any(axis=0), factors / _sizes(beyond), 0.0)


def pick(error: Column, known: Columns, choices: Sequence[Columns]) -> int:
    """Return the index of the set of columns that explains most of an error beyond the known columns."""
    basis = _orthogonal(known)
    residual = error - basis @ (basis.T @ error)
    explained = []
    for columns in choices:
        directions = _orthogonal(columns - basis @ (basis.T @ columns))
        explained.append(float(np.square(directions.T @ residual).sum()))
    return int(np.argmax(explained))


def correlation(error: Column) -> float:
    """Return the correlation of neighbouring rows; 0 for a constant."""
    centred = error - error.mean()
    return float(centred[1:] @ centred[:-1] / max(float(centred @ centred), 1e-300))


def excess(error: Column) -> float:
    """Return the excess kurtosis; 0 for normal noise."""
    return float(scipy.stats.kurtosis(error)) if np.ptp(error) > 0 else 0.0


def _try(
    error: Column, known: Columns, name: str, candidate: Candidate, count: int, whole: float, usual: Factors
) -> Contribution | None:
    """Test a candidate beyond the known columns; None if it is insignificant or explains too little of `whole`."""
    basis = _orthogonal(known)
    columns = _orthogonal(_beyond(candidate.columns, basis))
    ordinary = (candidate.columns * usual).sum(axis=1)
    gain = float(np.square(columns.T @ error).sum() - np.square(columns.T @ ordinary).sum()) / whole
    error = error - ordinary
    residual = error - basis @ (basis.T @ error)
    stretch = _stretches(residual - columns @ (columns.T @ residual))
    if not columns.shape[1] or stretch[-1] < 2 * columns.shape[1]:
        return None
    chance = min(1.0, count * _chance(residual, columns, stretch))
    share = (float(residual @ residual) - _held_out(residual, columns, stretch % FOLDS)) / whole
    # Only deviations from the usual factors that increase the error count.
    return Contribution(name, share, chance) if chance <= LEVEL and min(share, gain) >= SHARE else None


def _stretches(error: Column) -> Int[np.ndarray, "rows"]:
    """Return each row's stretch; stretches are long compared with the correlation time of the error."""
    coefficient = min(max(correlation(error), 0.0), 0.99)
    count = max(1, min(STRETCHES, int(len(error) / max(ROWS, LASTING * (1 + coefficient) / (1 - coefficient)))))
    return np.arange(len(error)) * count // len(error)


def _chance(error: Column, columns: Columns, stretch: Int[np.ndarray, "rows"]) -> float:
    """Return the probability of coefficients of orthonormal columns at least as far from 0 if they are 0.

    Their covariance comes from the jackknife over stretches, conservative where few stretches dominate.
    """
    count, size = int(stretch[-1]) + 1, columns.shape[1]
    parts = np.split(np.arange(len(error)), np.searchsorted(stretch, np.arange(1, count)))
    gram = np.stack([columns[part].T @ columns[part] for part in parts])
    score = np.stack([columns[part].T @ error[part] for part in parts])
    values = score.sum(axis=0)
    without = np.linalg.pinv(np.eye(size) - gram, hermitian=True) @ (values - score)[:, :, None]
    deviation = without[:, :, 0] - values
    covariance = (count - 1) / count * deviation.T @ deviation
    squared = values @ np.linalg.pinv(covariance, hermitian=True) @ values
    return float(scipy.stats.f.sf(squared * (count - size) / (size * (count - 1)), size, count - size))


def _held_out(error: Column, columns: Columns, folds: Int[np.ndarray, "rows"]) -> float:
    squares = 0.0
    for fold in range(FOLDS):
        held_out = folds == fold
        values = np.linalg.lstsq(columns[~held_out], error[~held_out], rcond=_SPANNED)[0]
        squares += float(np.square(error[held_out] - columns[held_out] @ values).sum())
    return squares


def _beyond(columns: Columns, basis: Columns) -> Columns:
    """Subtract from columns their projection on a basis; 0 where the basis spans a column."""
    remainder = columns - basis @ (basis.T @ columns)
    return np.where(_sizes(remainder) > _SPANNED * _sizes(columns), remainder, 0.0)


def _orthogonal(columns: Columns) -> Columns:
    if not columns.shape[1] or not np.any(columns):
        return np.zeros((len(columns), 0))
    basis, sizes, _ = np.linalg.svd(columns / _sizes(columns), full_matrices=False)
    return basis[:, sizes > _SPANNED * sizes.max()]


def _sizes(columns: Columns) -> Float[np.ndarray, "n"]:
    return np.maximum(np.sqrt(np.square(columns).mean(axis=0)), 1e-300)
