"""Draws of drives from the distribution of identified parameters."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from frictionzoo.bench.base import Bench
from frictionzoo.core.errors import ConfigError, RunError, closest
from frictionzoo.core.params import Param
from frictionzoo.fit.covariance import Covariance
from frictionzoo.fit.posterior import Chains, Fitted, draw_posterior
from frictionzoo.fit.space import Space
from frictionzoo.models.base import FrictionModel
from frictionzoo.result.types import Result
from frictionzoo.result.values import Parameter, read_parameters
from frictionzoo.simulation.context import computing


class Posterior(dict[str, Float[np.ndarray, "count nv"]]):
    """Draws of each parameter by full name, in its unit, with convergence diagnostics of the chains.

    Attributes:
        rhat: Rank-normalised split R-hat of each sampled value, by its label, `bench.armature`, or
            `bench.armature/knee` with several joints; 1: the chains agree.
        effective: Effective sample size of all samples, by the same labels.
        divergences: Number of samples whose sampler step diverged.
    """

    def __init__(self, draws: Mapping[str, Float[np.ndarray, "count nv"]], chains: Chains) -> None:
        super().__init__(draws)
        self.rhat: dict[str, float] = chains.rhat
        self.effective: dict[str, float] = chains.effective
        self.divergences: int = chains.divergences


def draw_parameters(
    place: str, result: Result, bench: Bench, model: FrictionModel, count: int, seed: int
) -> dict[str, Float[np.ndarray, "count nv"]]:
    """Draw joint values, within the bounds, of the parameters that the data determine, by full name.

    Args:
        place: Name of the drive for messages.
        result: Result of the run.
        bench: Its test stand.
        model: Its friction model.
        count: Number of drives.
        seed: Random seed.

    Raises:
        ConfigError: `count` is below 1.
        RunError: No parameter has an interval.
    """
    drawn, found = _draw(_read_covariance(place, result, count), bench, model, count, seed), {}
    for name, parameter in read_parameters(result, bench.nv).items():
        moved = _determined(parameter, bench)
        if moved.any():
            found[name] = np.where(moved, drawn[name], parameter.value)
    return found


def draw_with_chains(
    place: str, result: Result, bench: Bench, fitted: Fitted | None, count: int, seed: int
) -> Posterior:
    """Draw values of all parameters with an interval from the posterior.

    Args:
        place: Name of the drive for messages.
        result: Result of the run.
        bench: Its test stand.
        fitted: Minimised loss with the training data; None: not available.
        count: Number of drives.
        seed: Random seed.

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
    settings = result["settings"]
    with computing(*(settings[name] for name in ("dtype", "device", "compilation_cache"))):
        chains = draw_posterior(fitted, covariance, count, seed)
    drawn, found = fitted.objective.space.physical(chains.vectors.T), {}
    sampled = {label.partition("/")[0] for label in chains.rhat}
    for name, parameter in read_parameters(result, bench.nv).items():
        if name in sampled:
            found[name] = np.where(np.isnan(drawn[name].T), parameter.value, drawn[name].T)
    return Posterior(found, chains)


def _read_covariance(place: str, result: Result, count: int) -> Covariance:
    """Return the covariance; raise if `count` is below 1 or no parameter has an interval."""
    if count < 1:
        raise ConfigError(f"count={count}: expected 1 or more drives to draw")
    if (row := result["covariance"]) is None:
        why = result["no_intervals"] or "the data determine none of its parameters"
        raise RunError(f"{place}: {why}, expected intervals to draw from; check what was identified, and fit again")
    return Covariance(tuple(row["labels"]), np.array(row["centre"]), np.array(row["matrix"]), row["freedom"])


def _draw(
    covariance: Covariance, bench: Bench, model: FrictionModel, count: int, seed: int
) -> dict[str, Float[np.ndarray, "count nv"]]:
    """Draw all identified parameters; those without an interval get their initial values."""
    with jax.enable_x64(True):
        space = Space(bench, model, "float64")
    vectors = np.repeat(np.asarray(space.start, np.float64)[:, None], count, axis=1)
    own = [space.labels.index(label) for label in covariance.labels]
    vectors[own] = covariance.draw(count, np.random.default_rng(seed)).T
    with np.errstate(over="ignore"):  # after a diverged fit; the values are clipped to the bounds
        return {name: values.T for name, values in space.physical(vectors).items()}


def _determined(parameter: Parameter, bench: Bench) -> Bool[np.ndarray, "nv"]:
    """Return the joints in which the data determine a parameter."""
    found = [joint for row in parameter.by_joint if row["identifiable"] for joint in row["joints"]]
    return np.isin(bench.joints, found)


def put_values(
    values: Mapping[str, Mapping[str, Any]],
    drawn: Mapping[str, Float[np.ndarray, "nv"] | float],
    params: Mapping[str, Mapping[str, Param]],
    nv: int,
) -> dict[str, dict[str, Any]]:
    """Replace some of a drive's values, by full name.

    Args:
        values: Values of the drive, by owner and name.
        drawn: New values, one per joint or one for all; ignored for joints that lack the parameter.
        params: Physical parameters, by owner and name.
        nv: Number of joints.

    Raises:
        ConfigError: A parameter is unknown; or a value has the wrong shape, is not finite, or is negative where the
            lower bound is not.
    """
    known = {f"{owner}.{name}": param for owner, named in params.items() for name, param in named.items()}
    found = {owner: dict(named) for owner, named in values.items()}
    for full, own in drawn.items():
        if full not in known:
            raise ConfigError(f"{full}: no such parameter of the drive; {closest(str(full), known)}")
        owner, _, name = full.partition(".")
        found[owner][name] = _of_joints(full, own, known[full], nv)
    return found


def _of_joints(full: str, own: Any, param: Param, nv: int) -> Float[np.ndarray, "members"]:
    """Return the checked values of the joints that have the parameter."""
    array = np.asarray(own)
    if array.dtype.kind not in "iuf" or array.shape not in ((), (nv,)):
        raise ConfigError(
            f"{full}: {array.dtype} of shape {array.shape}, expected numbers of shape ({nv},), one a joint"
        )
    members = param.members(nv)
    taken = np.broadcast_to(array.astype(np.float64), nv)[members]
    least = np.where(param.each("low", nv)[members] >= 0, 0.0, -np.inf)
    wrong = ~(np.isfinite(taken) & (taken >= least))
    if wrong.any():
        at = int(np.argmax(wrong))
        number = "a number from 0 on" if np.isfinite(least[at]) else "a finite number"
        raise ConfigError(f"{full}: {taken[at]:g} of joint {members[at] + 1}, expected {number}")
    return taken
