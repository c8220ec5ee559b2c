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
    """What replaces the parts of a drive in a simulator; see `FittedDrive`."""

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
    """Return the parts of a drive for a simulator, as `FittedDrive.at` describes.

    Args:
        bench: Bench of the drive.
        model: Friction model.
        values: Values of the drive.
        segments: Long test rollouts.
        settings: Section `bench` of the settings.
        timestep: Simulation step [s], or None.
        integrator: Name of the integrator, or None.
    """
    continuous = bench.second_order
    if integrator is not None and integrator.casefold() == RK4.casefold():
        integrator = RK4
    if integrator == RK4 and not continuous:
        raise ConfigError(
            f"integrator={RK4}: the parameters hold for steps of {bench.timestep:g} s, expected a drive in "
            "continuous time; identify it with bench.second_order=true"
        )
    if timestep is None:
        home = remake(bench, timestep=None).timestep if continuous else bench.timestep
        timestep = bench.timestep if _share_samples(segments, home) is None else home
    every, interval = _share_samples(segments, timestep), segments.timestep
    if every is None:
        raise ConfigError(
            f"timestep={timestep:g}; expected steps that divide {interval:g} s, the recordings' interval, or up to "
            f"{_MOST_SHARED} of these"
        )
    step: dict[str, Any] = {"timestep": timestep}
    if integrator not in (None, RK4):
        step["integrator"] = integrator
    if integrator == RK4:
        moved = build({**settings, **step, **_soften(bench, timestep)}, Bench)
    elif continuous:
        moved = build_simulated(bench, settings, values, step)
        values = compensate(moved, model, values, segments)
    else:
        moved = build({**settings, **step}, Bench)
    moved = moved.observing(bench.observed)
    sampling = moved.sampling(every * interval)
    return Simulated(moved, values, thin(segments, every, sampling.history), sampling)


def find_limited(values: Values, continuous: Values) -> list[int]:
    """Find the joints whose compensated armature was raised to the smallest allowed value.

    Args:
        values: Values for the simulator, from `compensate`.
        continuous: Values of the drive in continuous time.
    """
    return np.flatnonzero(values["bench"]["armature"] == _LEAST * continuous["bench"]["armature"]).tolist()


def build_simulated(bench: Bench, settings: Mapping[str, Any], values: Values, step: Mapping[str, Any]) -> Bench:
    """Build the bench for a first-order simulator from one of second order.

    Commands act half a step later, and dry friction is no stiffer than the simulator allows.

    Args:
        bench: Bench of second order.
        settings: Section `bench` of the settings.
        values: Values of the drive.
        step: `timestep` [s], and `integrator` if it differs.
    """
    known = {"init": _delay(values, step["timestep"]).tolist(), "high": 1.0, "identify": False}
    params = {**(settings.get("params") or {}), "delay": known}
    softer = _soften(bench, step["timestep"])
    return build({**settings, **step, **softer, "second_order": False, "params": params}, Bench)


def compensate(
    bench: Bench, model: FrictionModel, values: Values, segments: Segments
) -> dict[str, dict[str, np.ndarray]]:
    """Return a drive's values for a first-order simulator.

    Its step evaluates velocity-dependent torques at the beginning or end of the step instead of the middle. For a
    torque -d v, an armature larger or smaller by h/2 d compensates this. If d depends on the state, its median over the
    measured states is used. An armature keeps at least a tenth of its value.

    Args:
        bench: First-order bench from `build_simulated`.
        model: Friction model.
        values: Values of the drive in continuous time.
        segments: Measured states; empty: one state with all inputs equal to 1.
    """
    stepping = SecondOrder(bench, friction_of(model))
    with jax.enable_x64(True):
        states = segments.qpos[:, :-1], segments.qvel[:, :-1], segments.acting
        rows = jax.tree.map(lambda signal: jnp.asarray(signal, jnp.float64).reshape(-1, bench.nv), states)
        if not segments.count:  # a card has no recordings: one state in motion
            rows = jax.tree.map(lambda signal: jnp.ones((1, bench.nv)), rows)
        known = jax.tree.map(lambda value: jnp.asarray(value, jnp.float64), values)
        more = np.asarray(stepping.surplus(known, *rows), np.float64)
    armature = np.asarray(values["bench"]["armature"])
    changed = {"armature": np.maximum(armature + more, _LEAST * armature), "delay": _delay(values, bench.timestep)}
    return {owner: {**of, **changed} if owner == "bench" else dict(of) for owner, of in values.items()}


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
