"""Conversion of a drive to parameters with which a simulator with MuJoCo's steps reproduces its motion."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from frictionzoo.bench import Bench
from frictionzoo.core.build import build
from frictionzoo.core.described import remake
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.segments import Sampling, Segments
from frictionzoo.models import FrictionModel
from frictionzoo.result.read_back import thin
from frictionzoo.simulation import Values, friction_of
from frictionzoo.simulation.second_order import SecondOrder

RK4 = "RK4"
"""MuJoCo's fourth-order integrator, which needs the parameters in continuous time."""
_LEAST = 0.1  # smallest share of an armature that compensation keeps
_MOST_SHARED = 20  # most samples tried that last a whole number of steps
_WHOLE = 0.01  # largest relative deviation from a whole number of steps, as for recordings


class Simulated(NamedTuple):
    """Parts that replace those of a drive in a simulator; see `FittedDrive`."""

    bench: Bench
    values: Values
    segments: Segments
    sampling: Sampling


def put_into_simulator(
    bench: Bench,
    model: FrictionModel,
    values: Values,
    segments: Segments,
    settings: Mapping[str, Any],
    timestep: float | None,
    integrator: str | None,
) -> Simulated:
    """Return the parts of a drive for a simulator with `timestep` [s]; `settings` is the section `bench`.

    Raises:
        ConfigError: As `FittedDrive.at`.
    """
    continuous = bench.second_order
    if integrator is not None and integrator.casefold() == RK4.casefold():
        integrator = RK4
    if integrator == RK4 and not continuous:
        raise ConfigError(
            f"integrator={RK4}: the parameters are valid for steps of {bench.timestep:g} s, expected parameters in "
            "continuous time; identify the drive with bench.second_order=true"
        )
    if timestep is None:
        default_step = remake(bench, timestep=None).timestep if continuous else bench.timestep
        timestep = bench.timestep if _share_samples(segments, default_step) is None else default_step
    every, interval = _share_samples(segments, timestep), segments.timestep
    if every is None:
        raise ConfigError(
            f"timestep={timestep:g}; expected a step that divides the recordings' interval, {interval:g} s, or a "
            f"multiple of it up to {_MOST_SHARED}"
        )
    step: dict[str, Any] = {"timestep": timestep}
    if integrator not in (None, RK4):
        step["integrator"] = integrator
    if integrator == RK4:
        simulated = build({**settings, **step, **_soften(bench, timestep)}, Bench)
    elif continuous:
        simulated = build_simulated(bench, settings, values, step)
        values = compensate(simulated, model, values, segments)
    else:
        simulated = build({**settings, **step}, Bench)
    simulated = simulated.observing(bench.observed)
    sampling = simulated.sampling(every * interval)
    return Simulated(simulated, values, thin(segments, every, sampling.history), sampling)


def find_limited(values: Values, continuous: Values) -> list[int]:
    """Find the joints whose armature `compensate` raised to the smallest allowed value."""
    return np.flatnonzero(values["bench"]["armature"] == _LEAST * continuous["bench"]["armature"]).tolist()


def build_simulated(bench: Bench, settings: Mapping[str, Any], values: Values, step: Mapping[str, Any]) -> Bench:
    """Build the bench for a first-order simulator from one of second order.

    Commands act half a step later, and dry friction is no stiffer than the simulator allows. `step` holds `timestep`
    [s], and `integrator` if it differs.
    """
    delay = {"init": _delay(values, step["timestep"]).tolist(), "high": 1.0, "identify": False}
    params = {**(settings.get("params") or {}), "delay": delay}
    softer = _soften(bench, step["timestep"])
    return build({**settings, **step, **softer, "second_order": False, "params": params}, Bench)


def compensate(
    bench: Bench, model: FrictionModel, values: Values, segments: Segments
) -> dict[str, dict[str, np.ndarray]]:
    """Return a drive's values for a first-order simulator with this bench, from values in continuous time.

    The simulator evaluates velocity-dependent torques at the beginning or end of the step instead of the middle. For a
    torque -d v, an armature larger or smaller by h/2 d compensates this. If d depends on the state, its median over the
    measured states is used; without states, over one state with all inputs equal to 1. An armature keeps at least a
    tenth of its value.
    """
    stepping = SecondOrder(bench, friction_of(model, midway=True))
    with jax.enable_x64(True):
        states = segments.qpos[:, :-1], segments.qvel[:, :-1], segments.acting
        rows = jax.tree.map(lambda signal: jnp.asarray(signal, jnp.float64).reshape(-1, bench.nv), states)
        if not segments.count:  # a card has no recordings: one state in motion
            rows = jax.tree.map(lambda signal: jnp.ones((1, bench.nv)), rows)
        arrays = jax.tree.map(lambda value: jnp.asarray(value, jnp.float64), values)
        surplus = np.asarray(jax.jit(stepping.surplus)(arrays, *rows), np.float64)
    armature = np.asarray(values["bench"]["armature"])
    changed = {"armature": np.maximum(armature + surplus, _LEAST * armature), "delay": _delay(values, bench.timestep)}
    return {owner: {**named, **changed} if owner == "bench" else dict(named) for owner, named in values.items()}


def _soften(bench: Bench, timestep: float) -> dict[str, list[float]]:
    """Return the stiffest friction constraint that MuJoCo allows with this step [s]."""
    constant, ratio = bench.solreffriction
    return {"solreffriction": [max(constant, 2 * timestep), ratio] if constant > 0 else [constant, ratio]}


def _share_samples(segments: Segments, timestep: float) -> int | None:
    """Return the smallest number of recorded samples that last a whole number of steps [s]; None if none does."""
    for every in range(1, min(_MOST_SHARED, segments.length) + 1 if timestep > 0 else 0):
        steps = every * segments.timestep / timestep
        if round(steps) and abs(steps / round(steps) - 1) <= _WHOLE / every**2:
            return every
    return None


def _delay(values: Values, timestep: float) -> Float[np.ndarray, "nv"]:
    return np.asarray(values["bench"].get("delay", np.zeros(len(values["bench"]["armature"])))) + timestep / 2
