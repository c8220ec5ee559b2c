"""Spread from recording to recording and from unit to unit, of fits whose own uncertainty is known."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from conftest import changed

import frictionzoo as fz
from frictionzoo.core.errors import RunError
from frictionzoo.result.comparison.spread import separate


def test_both_spreads_are_found_again() -> None:
    rng, group = np.random.default_rng(0), np.repeat(np.arange(8), 6)
    found = []
    for _ in range(200):
        variance = np.square(rng.uniform(0.05, 0.3, len(group)))
        value = 1.0 + 0.3 * rng.normal(size=8)[group] + 0.2 * rng.normal(size=len(group))
        found.append(separate(value + np.sqrt(variance) * rng.normal(size=len(group)), variance, group))
    mean, run, unit, error = np.array(found).T
    assert mean.mean() == pytest.approx(1.0, abs=0.02)
    # Variances are unbiased but for those brought to 0, which are few; their mean is known to 3 %.
    assert np.square(run).mean() == pytest.approx(0.2**2, rel=0.1)
    assert np.square(unit).mean() == pytest.approx(0.3**2, rel=0.1)
    assert error.mean() == pytest.approx(mean.std(), rel=0.15)


def test_what_the_errors_explain_is_no_spread() -> None:
    rng, group = np.random.default_rng(1), np.repeat(np.arange(20), 20)
    _, run, unit, _ = separate(0.1 * rng.normal(size=400), np.full(400, 0.01), group)
    assert run < 0.03 and unit < 0.03
    _, alone, none, _ = separate(rng.normal(size=5), np.full(5, 0.01), np.zeros(5, int))
    assert alone > 0.3 and np.isnan(none)
    _, none, both, _ = separate(rng.normal(size=5), np.full(5, 0.01), np.arange(5))
    assert both > 0.3 and np.isnan(none)


def test_fits_are_told_apart_by_their_units(finished_run: Callable[[str], Any]) -> None:
    drive = fz.load(finished_run("mujoco_default")[0])
    row = drive.result["covariance"]
    assert row is not None

    def moved(by: float) -> fz.Identified:
        centre = [at + by for at in row["centre"]]
        return dataclasses.replace(drive, result=changed(drive.result, covariance={"centre": centre}))

    sure = [name for name, parameter in drive.parameters.items() if parameter.identifiable]
    found = fz.spread({"a": [moved(0.0), moved(4.0)], "b": [moved(20.0), moved(24.0)]})
    assert [*found] == sure
    for name, spread in found.items():
        at = row["labels"].index(name)
        variance, middle = row["matrix"][at][at], np.exp(row["centre"][at] + 12.0)
        assert spread.mean == pytest.approx(middle)
        assert spread.run == pytest.approx(middle * np.sqrt(8.0 - variance))
        assert spread.unit == pytest.approx(middle * np.sqrt(200.0 - 8.0 / 2), rel=1e-6)
    with pytest.raises(RunError, match="fits: 1, expected at least two"):
        fz.spread([drive])
    nothing = dataclasses.replace(drive, result=changed(drive.result, covariance=None, no_intervals="of a network"))
    with pytest.raises(RunError, match="of a network, expected intervals"):
        fz.spread([drive, nothing])
