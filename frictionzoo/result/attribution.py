"""What goes with an error: the share of it that functions of the drive's state explain, and whether chance does so."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy.stats
from jaxtyping import Float, Int

STRETCHES = 50  # of time, whose scores count as independent
ROWS = 20  # in a stretch at the least
LASTING = 4.0  # times the rows over which errors are alike that a stretch is long
FOLDS = 5  # by turns held out, of stretches
LEVEL = 0.01  # chance that a drive with the right law has any finding, over all that is tried
SHARE = 0.05  # of the variance that is left, below which nothing is told
MOST = 3  # findings
ALIKE = 0.85  # share of the largest gain from which on the candidate that was named first is taken
_SPANNED = 1e-4  # share of a column's size, of which less is left if others span it

Column = Float[np.ndarray, "rows"]
Columns = Float[np.ndarray, "rows _"]
Factors = Float[np.ndarray, "_"] | float
Usual = Callable[[str, Sequence[str]], Factors]


class Candidate(NamedTuple):
    """Functions of the drive's state that may explain an error.

    Attributes:
        columns: Their values in each row.
        tried: How many like it were looked through to choose it.
    """

    columns: Columns
    tried: int = 1


class Explained(NamedTuple):
    """A candidate that explains a part of an error.

    Attributes:
        name: Its name.
        share: Of the variance that the known columns leave, what it explains of held-out rows beyond those before it.
        chance: That an error which has nothing to do with it scores as high, times the number of candidates.
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
    """Candidates that explain an error, the largest share first, each beyond those found before it.

    The error is first freed of what `known` columns explain. A candidate counts if its coefficients are not 0 by Wald's
    test, with a covariance from the differences between stretches of time, within which errors may depend on each other
    as they like; and if it lowers the error in stretches that were held out. Where factors are usual, 0 is there.

    Source: A. C. Cameron, D. L. Miller, "A Practitioner's Guide to Cluster-Robust Inference", Journal of Human
    Resources 50(2), 2015, section VI, the jackknife CR3.

    Args:
        error: In each row.
        known: What the law's own parameters may still move.
        candidates: By name, in the order in which they are preferred where they explain as much.
        joints: Number of joints that are looked at so.
        usual: Factors of a candidate's columns, beyond those found before it, where nothing is wrong.
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
    """Return the factors of columns in an error beyond the known ones."""
    basis = _orthogonal(known)
    beyond = _beyond(columns, basis)
    factors = np.linalg.lstsq(beyond / _sizes(beyond), error - basis @ (basis.T @ error), rcond=_SPANNED)[0]
    return np.where(beyond.any(axis=0), factors / _sizes(beyond), 0.0)


def pick(error: Column, known: Columns, choices: Sequence[Columns]) -> int:
    """Which of many sets of columns explains most of an error beyond the known ones."""
    basis = _orthogonal(known)
    rest = error - basis @ (basis.T @ error)
    explained = []
    for columns in choices:
        own = _orthogonal(columns - basis @ (basis.T @ columns))
        explained.append(float(np.square(own.T @ rest).sum()))
    return int(np.argmax(explained))


def correlation(error: Column) -> float:
    """Correlation of neighbouring rows; 0 of a constant."""
    rest = error - error.mean()
    return float(rest[1:] @ rest[:-1] / max(float(rest @ rest), 1e-300))


def excess(error: Column) -> float:
    """Excess kurtosis; 0 of normal noise."""
    return float(scipy.stats.kurtosis(error)) if np.ptp(error) > 0 else 0.0


def _left_by(known: Columns, error: Column) -> float:
    """Sum of squares that known columns leave."""
    basis = _orthogonal(known)
    return max(float(error @ error - np.square(basis.T @ error).sum()), 1e-300)


def _try(
    error: Column, known: Columns, name: str, candidate: Candidate, count: int, whole: float, usual: Factors
) -> Explained | None:
    """What a candidate explains beyond known columns, of a whole sum of squares, if that is no chance and enough."""
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
    # What is unusual counts only where the error has more of it than usual, and not less.
    return Explained(name, share, chance) if chance <= LEVEL and min(share, more) >= SHARE else None


def _stretches(error: Column) -> Int[np.ndarray, "rows"]:
    """Number of the stretch of time of each row; stretches are long beside the time over which errors are alike."""
    alike = min(max(correlation(error), 0.0), 0.99)
    count = max(1, min(STRETCHES, int(len(error) / max(ROWS, LASTING * (1 + alike) / (1 - alike)))))
    return np.arange(len(error)) * count // len(error)


def _chance(error: Column, columns: Columns, stretch: Int[np.ndarray, "rows"]) -> float:
    """Probability of coefficients of orthonormal columns as far from 0 if they are 0.

    Their covariance is that of the jackknife over stretches, the more careful one where few stretches say most.
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
    """Sum of squares that orthonormal columns leave of rows that they were not fitted to."""
    left = 0.0
    for fold in range(FOLDS):
        out = folds == fold
        values = np.linalg.lstsq(columns[~out], error[~out], rcond=_SPANNED)[0]
        left += float(np.square(error[out] - columns[out] @ values).sum())
    return left


def _beyond(columns: Columns, basis: Columns) -> Columns:
    """Columns less what a basis spans of them; 0 where that is all."""
    rest = columns - basis @ (basis.T @ columns)
    return np.where(_sizes(rest) > _SPANNED * _sizes(columns), rest, 0.0)


def _orthogonal(columns: Columns) -> Columns:
    """An orthonormal basis of what columns span."""
    if not columns.shape[1] or not np.any(columns):
        return np.zeros((len(columns), 0))
    basis, sizes, _ = np.linalg.svd(columns / _sizes(columns), full_matrices=False)
    return basis[:, sizes > _SPANNED * sizes.max()]


def _sizes(columns: Columns) -> Float[np.ndarray, "n"]:
    return np.maximum(np.sqrt(np.square(columns).mean(axis=0)), 1e-300)
