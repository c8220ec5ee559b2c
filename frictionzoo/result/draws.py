"""Draws of drives from the distribution of identified parameters, and prediction intervals from them."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy.special
from jaxtyping import Float

from frictionzoo.bench.base import Bench
from frictionzoo.core.errors import ConfigError, RunError, closest
from frictionzoo.core.params import Param
from frictionzoo.fit.posterior import Chains, Fitted, draw_posterior
from frictionzoo.fit.space import Space
from frictionzoo.fit.uncertainty import LEVEL, Covariance
from frictionzoo.models.base import FrictionModel
from frictionzoo.result.curves import Curves
from frictionzoo.result.types import Result
from frictionzoo.result.values import read_parameters
from frictionzoo.simulation.context import computing

Draws = Float[np.ndarray, "count nv"]
Positions = Float[np.ndarray, "batch time nv"]


class Posterior(dict[str, Draws]):
    """Draws of each parameter by full name, in its unit, with convergence diagnostics of the chains.

    Attributes:
        rhat: Rank-normalised split R-hat of each sampled value, by label (`bench.armature`, or `bench.armature/knee`
            with several joints); 1: the chains agree.
        effective: Effective sample size of all samples, by label.
        divergences: Number of samples whose sampler step diverged.
    """

    def __init__(self, draws: Mapping[str, Draws], chains: Chains) -> None:
        super().__init__(draws)
        self.rhat: dict[str, float] = chains.rhat
        self.effective: dict[str, float] = chains.effective
        self.divergences: int = chains.divergences


def draw_parameters(
    place: str, result: Result, bench: Bench, model: FrictionModel, count: int, seed: int
) -> dict[str, Draws]:
    """Draw joint values, within the bounds, of the parameters that the data determine, by full name.

    `place` names the drive in messages.

    Raises:
        ConfigError: `count` is below 1.
        RunError: No parameter has an interval.
    """
    covariance = _read_covariance(place, result, count)
    with jax.enable_x64(True):
        space = Space(bench, model, "float64")
    vectors = np.repeat(np.asarray(space.start, np.float64)[:, None], count, axis=1)
    indices = [space.labels.index(label) for label in covariance.labels]
    vectors[indices] = covariance.draw(count, np.random.default_rng(seed)).T
    with np.errstate(over="ignore"):  # after a diverged fit; the values are clipped to the bounds
        drawn, draws = space.physical(vectors), {}
    for name, parameter in read_parameters(result, bench.nv).items():
        joints = [joint for row in parameter.by_joint if row.identifiable for joint in row.joints]
        if joints:
            draws[name] = np.where(np.isin(bench.joints, joints), drawn[name].T, parameter.value)
    return draws


def draw_with_chains(
    place: str, result: Result, bench: Bench, fitted: Fitted | None, count: int, seed: int
) -> Posterior:
    """Draw values of all parameters with an interval from the posterior.

    `place` names the drive in messages; `fitted` is the minimised loss with the training data, if available.

    Raises:
        ConfigError: `count` is below 1, or `draw_posterior` raises it.
        FitError: `draw_posterior` raises it.
        RunError: No parameter has an interval, or the loss is not available.
    """
    covariance = _read_covariance(place, result, count)
    if fitted is None:
        raise RunError(
            f"{place}: no training data, expected a drive that identify returned; identify again, or draw with sample"
        )
    settings = result.settings
    with computing(*(settings[name] for name in ("dtype", "device", "compilation_cache"))):
        chains = draw_posterior(fitted, covariance, count, seed)
    drawn, draws = fitted.objective.space.physical(chains.vectors.T), {}
    sampled = {label.partition("/")[0] for label in chains.rhat}
    for name, parameter in read_parameters(result, bench.nv).items():
        if name in sampled:
            draws[name] = np.where(np.isnan(drawn[name].T), parameter.value, drawn[name].T)
    return Posterior(draws, chains)


def _read_covariance(place: str, result: Result, count: int) -> Covariance:
    """Return the covariance; raise if `count` is below 1 or no parameter has an interval."""
    if count < 1:
        raise ConfigError(f"count={count}: expected 1 or more drives to draw")
    if (row := result.covariance) is None:
        why = result.no_intervals or "the data determine none of its parameters"
        raise RunError(f"{place}: {why}, expected intervals to draw from; check what was identified, and fit again")
    return Covariance(tuple(row.labels), np.array(row.centre), np.array(row.matrix), row.freedom)


def put_values(
    values: Mapping[str, Mapping[str, Any]],
    drawn: Mapping[str, Float[np.ndarray, "nv"] | float],
    params: Mapping[str, Mapping[str, Param]],
    nv: int,
) -> dict[str, dict[str, Any]]:
    """Replace some of a drive's values by `drawn` ones, by full name; joints without the parameter are skipped.

    Raises:
        ConfigError: A parameter is unknown; or a value has the wrong shape, is not finite, or is negative where the
            lower bound is not.
    """
    parameters = {f"{owner}.{name}": param for owner, named in params.items() for name, param in named.items()}
    replaced = {owner: dict(named) for owner, named in values.items()}
    for full, value in drawn.items():
        if full not in parameters:
            raise ConfigError(f"{full}: no such parameter of the drive; {closest(str(full), parameters)}")
        owner, _, name = full.partition(".")
        replaced[owner][name] = _of_joints(full, value, parameters[full], nv)
    return replaced


def _of_joints(full: str, own: Any, param: Param, nv: int) -> Float[np.ndarray, "members"]:
    array = np.asarray(own)
    if array.dtype.kind not in "iuf" or array.shape not in ((), (nv,)):
        raise ConfigError(
            f"{full}: {array.dtype} of shape {array.shape}, expected numbers of shape ({nv},), one a joint"
        )
    members = param.members(nv)
    selected = np.broadcast_to(array.astype(np.float64), nv)[members]
    lowest = np.where(param.each("low", nv)[members] >= 0, 0.0, -np.inf)
    wrong = ~(np.isfinite(selected) & (selected >= lowest))
    if wrong.any():
        index = int(np.argmax(wrong))
        number = "a number from 0 on" if np.isfinite(lowest[index]) else "a finite number"
        raise ConfigError(f"{full}: {selected[index]:g} of joint {members[index] + 1}, expected {number}")
    return selected


class PredictionInterval(NamedTuple):
    """Ends of the position's prediction interval [rad or m], from the first sample after each rollout's start."""

    low: Positions
    high: Positions


def predict_band(
    place: str,
    simulate: Callable[[Mapping[str, Float[np.ndarray, "nv"]]], Positions],
    draws: Mapping[str, Draws],
    curves: Curves,
) -> PredictionInterval:
    """Predict the 95 % interval of each measured position.

    q = q(theta) - e: q(theta) is a rollout of a drive drawn from the joint distribution of its parameters. e is the
    fitted drive's error in a training rollout at the same time after the start. The ends are the 2.5 and 97.5 %
    quantiles over all pairs of a drawn drive and a training rollout. The interval thus contains parameter uncertainty,
    model error, and noise of the measured initial state. With n training rollouts, errors are multiplied by
    t sqrt(1 + 1 / n) / z, the ratio of Student's to the normal prediction interval.

    The interval holds for motion like the training recordings, not for other kinds of motion or other loads.

    `place` names the drive in messages. `simulate` returns the positions in the rollouts, with some fitted values
    replaced by drawn ones, by full name; empty `draws`: fitted values only.

    Source: R. Stine, "Bootstrap prediction intervals for regression", 1985, with errors of whole rollouts, which are
    correlated in time, like the blocks of S. Lahiri, "Resampling Methods for Dependent Data", 2003.

    Raises:
        RunError: Fewer than two training rollouts have errors.
    """
    kept, length = curves.train_errors.shape[:2]
    if kept < 2:
        raise RunError(
            f"{place}: {kept} training rollouts of the evaluation stayed finite, expected 2 at "
            "least, better 40; set evaluation.rollouts, and run it again"
        )
    upper = (1 + LEVEL) / 2
    student_to_normal = scipy.special.stdtrit(kept - 1, upper) / scipy.special.ndtri(upper)
    errors = curves.train_errors * float(student_to_normal * np.sqrt(1 + 1 / kept))
    count = max((len(values) for values in draws.values()), default=1)
    drives = [simulate({name: values[number] for name, values in draws.items()})[:, :length] for number in range(count)]
    drives = [drive for drive in drives if np.isfinite(drive).all()] or drives
    share = (1 - LEVEL) / 2
    ends = [
        np.quantile(positions[:, None] - errors[None, :, : positions.shape[1]], [share, 1 - share], axis=(0, 1))
        for positions in np.stack(drives, axis=1)
    ]
    return PredictionInterval(*np.stack(ends, axis=1))
