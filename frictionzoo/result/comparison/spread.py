"""Spread of parameters between recordings and between units, beyond the uncertainty of the fits."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from frictionzoo.core.errors import RunError
from frictionzoo.result.fitted_drive import FittedDrive

Numbers = Float[np.ndarray, "_"]


class Spread(NamedTuple):
    """Spread of one parameter of one joint, or of joints that share a value, in the parameter's unit.

    Attributes:
        mean: Mean over the units; geometric for `scale: log`.
        run: Standard deviation between recordings of a unit; NaN if no unit was recorded twice.
        unit: Standard deviation between units; NaN for one unit. With one recording per unit, it includes `run`.
        error: Standard error of the mean.
    """

    mean: float
    run: float
    unit: float
    error: float


def spread(fits: Sequence[FittedDrive] | Mapping[str, Sequence[FittedDrive]]) -> dict[str, Spread]:
    """Estimate run-to-run and unit-to-unit spread of parameters, separately from the uncertainty of the fits.

    y_ij = mean + u_i + r_ij + e_ij,   Var u = unit^2,  Var r = run^2,  Var e_ij = s_ij^2

    with y_ij the estimate of unit i from its recording j, in the optimiser's coordinate, and s_ij^2 from `covariance`.
    The method of moments estimates both variances, limited to at least 0: first between the recordings of each unit,
    then between the units. For `scale: log`, the mean converts them into the parameter's unit.

    Each drive is identified from one recording, with the same bench and model. A sequence holds the drives of one unit,
    a mapping those of several units by name.

    Source: R. DerSimonian, N. Laird, "Meta-analysis in clinical trials", 1986; S. Konstantopoulos, "Fixed effects and
    variance components estimation in three-level meta-analysis", 2011, for two levels of spread.

    Returns:
        Spread of each parameter that is identifiable in all fits, by full name; with several joints `NAME/JOINT`.

    Raises:
        RunError: There are fewer than two fits, or a fit has no intervals.
    """
    units = fits if isinstance(fits, Mapping) else {"unit": fits}
    drives = [drive for members in units.values() for drive in members]
    if len(drives) < 2:
        raise RunError(f"fits: {len(drives)}, expected at least two, each from a different recording; give more")
    rows = [_read(drive) for drive in drives]
    labels = [label for label in rows[0] if all(label in row for row in rows)]
    group = np.repeat(np.arange(len(units)), [len(members) for members in units.values()])
    spreads = {}
    for label in labels:
        value, variance = (np.array([row[label][index] for row in rows]) for index in (0, 1))
        mean, run, unit, error = separate(value, variance, group)
        scale = rows[0][label][2]
        middle, factor = (np.exp(mean), np.exp(mean)) if isinstance(scale, str) else (mean * scale, scale)
        spreads[label] = Spread(float(middle), *(float(factor * deviation) for deviation in (run, unit, error)))
    return spreads


def separate(value: Numbers, variance: Numbers, group: Int[np.ndarray, "_"]) -> tuple[float, float, float, float]:
    """Return mean, `run`, `unit`, `error` of `Spread` from estimates, their error variances and unit numbers."""
    masks = [group == number for number in np.unique(group)]
    sums = np.sum([_moments(value[mask], variance[mask]) for mask in masks], axis=0)
    run = np.sqrt(max(0.0, sums[0] / sums[1])) if sums[1] > 0 else np.nan
    weights = 1 / (variance + np.nan_to_num(run) ** 2)
    totals = np.array([weights[mask].sum() for mask in masks])
    means = np.array([np.average(value[mask], weights=weights[mask]) for mask in masks])
    excess, share = _moments(means, 1 / totals)
    unit = np.sqrt(max(0.0, excess / share)) if share > 0 else np.nan
    final = 1 / (1 / totals + np.nan_to_num(unit) ** 2)
    return float(np.average(means, weights=final)), float(run), float(unit), float(1 / np.sqrt(final.sum()))


def _moments(value: Numbers, variance: Numbers) -> tuple[float, float]:
    """Return the weighted squares in excess of the known variances, and the excess expected from a spread of 1."""
    weight = 1 / variance
    squares = (weight * np.square(value - np.average(value, weights=weight))).sum()
    return float(squares - (len(value) - 1)), float(weight.sum() - np.square(weight).sum() / weight.sum())


def _read(drive: FittedDrive) -> dict[str, tuple[float, float, str | float]]:
    row = drive.result.covariance
    if row is None:
        raise RunError(
            f"{drive.place}: {drive.result.no_intervals or 'data determine none of its parameters'}, expected "
            "intervals to separate spread from uncertainty; leave it out"
        )
    centre, variance = row.centre, np.diag(np.array(row.matrix))
    identifiable = {name for name, parameter in drive.parameters.items() if parameter.identifiable}
    return {
        label: (centre[index], float(variance[index]), row.scale[index])
        for index, label in enumerate(row.labels)
        if label.partition("/")[0] in identifiable
    }
