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
    """Functions of the drive's state that may explain an error.

    Attributes:
        columns: Their values in each row.
        tried: Number of similar candidates from which it was chosen.
    """

    columns: Columns
    tried: int = 1


class Explained(NamedTuple):
    """A candidate that explains a part of an error.

    Attributes:
        name: Its name.
        share: Share of the variance beyond the known columns that it explains in held-out rows, in addition to the
            candidates found before it.
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
) -> list[Explained]:
    """Find the candidates that explain an error, each in addition to those found before it.

    The error is first projected off the `known` columns. A candidate counts if Wald's test rejects that its
    coefficients equal the usual factors, and if it lowers the error in held-out stretches. The covariance comes from
    the differences between stretches of time, within which errors may be correlated.

    Source: A. C. Cameron, D. L. Miller, "A Practitioner's Guide to Cluster-Robust Inference", Journal of Human
    Resources 50(2), 2015, section VI, the jackknife CR3.

    Args:
        error: Error of each row.
        known: Effect of the model's parameters on the error.
        candidates: Candidates by name; of those that explain as much, the first is preferred.
        joints: Number of joints tested in this way.
        usual: Factors of a candidate's columns without model error, beyond those found before it.

    Returns:
        Significant candidates, largest share first.
    """
    found: list[Explained] = []
    count = joints * sum(candidate.tried for candidate in candidates.values())
    left, whole = dict(candidates), _left_by(known, error)
    while left and len(found) < MOST:
        before = [one.name for one in found]
        looks = [_try(error, known, name, one, count, whole, usual(name, before)) for name, one in left.items()]
        tried = [one for one in looks if one is not None]
        if not tried:
            break
        most = max(one.share for one in tried)
        best = next(one for one in tried if one.share >= ALIKE * most)
        found.append(best)
        known = np.column_stack([known, left.pop(best.name).columns])
    return sorted(found, key=lambda one: -one.share)


def find_factors(error: Column, known: Columns, columns: Columns) -> Float[np.ndarray, "_"]:
    """Return the factors of columns in an error, beyond the known columns."""
    basis = _orthogonal(known)
    beyond = _beyond(columns, basis)
    factors = np.linalg.lstsq(beyond / _sizes(beyond), error - basis @ (basis.T @ error), rcond=_SPANNED)[0]
    return np.where(beyond.any(axis=0), factors / _sizes(beyond), 0.0)


def pick(error: Column, known: Columns, choices: Sequence[Columns]) -> int:
    """Return the index of the set of columns that explains most of an error beyond the known columns."""
    basis = _orthogonal(known)
    rest = error - basis @ (basis.T @ error)
    explained = []
    for columns in choices:
        own = _orthogonal(columns - basis @ (basis.T @ columns))
        explained.append(float(np.square(own.T @ rest).sum()))
    return int(np.argmax(explained))


def correlation(error: Column) -> float:
    """Return the correlation of neighbouring rows; 0 for a constant."""
    rest = error - error.mean()
    return float(rest[1:] @ rest[:-1] / max(float(rest @ rest), 1e-300))


def excess(error: Column) -> float:
    """Return the excess kurtosis; 0 for normal noise."""
    return float(scipy.stats.kurtosis(error)) if np.ptp(error) > 0 else 0.0


def _left_by(known: Columns, error: Column) -> float:
    """Return the sum of squares that the known columns do not explain."""
    basis = _orthogonal(known)
    return max(float(error @ error - np.square(basis.T @ error).sum()), 1e-300)


def _try(
    error: Column, known: Columns, name: str, candidate: Candidate, count: int, whole: float, usual: Factors
) -> Explained | None:
    """Test a candidate beyond the known columns; None if it is insignificant or explains too little of `whole`."""
    basis = _orthogonal(known)
    columns = _orthogonal(_beyond(candidate.columns, basis))
    ordinary = (candidate.columns * usual).sum(axis=1)
    more = float(np.square(columns.T @ error).sum() - np.square(columns.T @ ordinary).sum()) / whole
    error = error - ordinary
    rest = error - basis @ (basis.T @ error)
    stretch = _stretches(rest - columns @ (columns.T @ rest))
    if not columns.shape[1] or stretch[-1] < 2 * columns.shape[1]:
        return None
    chance = min(1.0, count * _chance(rest, columns, stretch))
    share = (float(rest @ rest) - _held_out(rest, columns, stretch % FOLDS)) / whole
    # Only deviations from the usual factors that increase the error count.
    return Explained(name, share, chance) if chance <= LEVEL and min(share, more) >= SHARE else None


def _stretches(error: Column) -> Int[np.ndarray, "rows"]:
    """Return the stretch number of each row; stretches are long compared with the correlation time of the error."""
    alike = min(max(correlation(error), 0.0), 0.99)
    count = max(1, min(STRETCHES, int(len(error) / max(ROWS, LASTING * (1 + alike) / (1 - alike)))))
    return np.arange(len(error)) * count // len(error)


def _chance(error: Column, columns: Columns, stretch: Int[np.ndarray, "rows"]) -> float:
    """Return the probability of coefficients of orthonormal columns at least as far from 0 if they are 0.

    The jackknife over stretches gives their covariance; it is conservative where few stretches dominate.
    """
    count, size = int(stretch[-1]) + 1, columns.shape[1]
    parts = np.split(np.arange(len(error)), np.searchsorted(stretch, np.arange(1, count)))
    gram = np.stack([columns[part].T @ columns[part] for part in parts])
    score = np.stack([columns[part].T @ error[part] for part in parts])
    values = score.sum(axis=0)
    without = np.linalg.pinv(np.eye(size) - gram, hermitian=True) @ (values - score)[:, :, None]
    moved = without[:, :, 0] - values
    spread = (count - 1) / count * moved.T @ moved
    squared = values @ np.linalg.pinv(spread, hermitian=True) @ values
    return float(scipy.stats.f.sf(squared * (count - size) / (size * (count - 1)), size, count - size))


def _held_out(error: Column, columns: Columns, folds: Int[np.ndarray, "rows"]) -> float:
    """Return the cross-validated sum of squares that orthonormal columns do not explain."""
    left = 0.0
    for fold in range(FOLDS):
        out = folds == fold
        values = np.linalg.lstsq(columns[~out], error[~out], rcond=_SPANNED)[0]
        left += float(np.square(error[out] - columns[out] @ values).sum())
    return left


def _beyond(columns: Columns, basis: Columns) -> Columns:
    """Subtract from columns their projection on a basis; 0 where the basis spans a column."""
    rest = columns - basis @ (basis.T @ columns)
    return np.where(_sizes(rest) > _SPANNED * _sizes(columns), rest, 0.0)


def _orthogonal(columns: Columns) -> Columns:
    """Return an orthonormal basis of the space that columns span."""
    if not columns.shape[1] or not np.any(columns):
        return np.zeros((len(columns), 0))
    basis, sizes, _ = np.linalg.svd(columns / _sizes(columns), full_matrices=False)
    return basis[:, sizes > _SPANNED * sizes.max()]


def _sizes(columns: Columns) -> Float[np.ndarray, "n"]:
    return np.maximum(np.sqrt(np.square(columns).mean(axis=0)), 1e-300)
