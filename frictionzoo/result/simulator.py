"""Conversion of a drive to parameters with which a simulator with MuJoCo's steps reproduces its motion."""

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from frictionzoo.bench import Bench
from frictionzoo.core.build import build
from frictionzoo.core.described import remake
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.segments import Segments
from frictionzoo.models import FrictionModel
from frictionzoo.result.evaluate import Prediction
from frictionzoo.result.read_back import hold, thin
from frictionzoo.simulate import Values, friction_of
from frictionzoo.simulate.second_order import SecondOrder

if TYPE_CHECKING:
    from frictionzoo.result.identified import Identified

RK4 = "RK4"
"""MuJoCo's fourth-order integrator, which needs the parameters in continuous time."""
_LEAST = 0.1  # smallest share of an armature that compensation keeps
_MOST_SHARED = 20  # most samples tried that last a whole number of steps
_WHOLE = 0.01  # largest relative deviation from a whole number of steps, as for recordings


def put_into_simulator(drive: "Identified", timestep: float | None, integrator: str | None) -> "Identified":
    """Return the drive for a simulator, as `Identified.at` does."""
    drive = drive.origin if drive.origin is not None and stands_in(drive) else drive
    settings, values, continuous = drive.result["settings"]["bench"], drive.values, drive.bench.second_order
    if integrator is not None and integrator.casefold() == RK4.casefold():
        integrator = RK4
    if integrator == RK4 and not continuous:
        raise ConfigError(
            f"integrator={RK4}: the parameters hold for steps of {drive.timestep:g} s, expected a drive in "
            "continuous time; identify it with bench.second_order=true"
        )
    if timestep is None:
        home = remake(drive.bench, timestep=None).timestep if continuous else drive.timestep
        timestep = drive.timestep if _share_samples(drive.segments, home) is None else home
    every, interval = _share_samples(drive.segments, timestep), drive.segments.timestep
    if every is None:
        raise ConfigError(
            f"timestep={timestep:g}; expected steps that divide {interval:g} s, the recordings' interval, or up to "
            f"{_MOST_SHARED} of these"
        )
    step: dict[str, Any] = {"timestep": timestep}
    if integrator not in (None, RK4):
        step["integrator"] = integrator
    if integrator == RK4:
        bench = build({**settings, **step, **_soften(drive.bench, timestep)}, Bench)
    elif continuous:
        bench = build_simulated(drive.bench, settings, values, step)
        values = compensate(bench, drive.model, values, drive.segments)
    else:
        bench = build({**settings, **step}, Bench)
    bench = bench.observing(drive.bench.observed)
    sampling = bench.sampling(every * interval)
    thinned = thin(drive.segments, every, sampling.history)
    return replace(drive, bench=bench, values=values, segments=thinned, sampling=sampling, origin=drive)


def stands_in(drive: "Identified") -> bool:
    """Return whether the drive represents, in a simulator, a drive in continuous time."""
    return drive.origin is not None and drive.origin.bench.second_order


def read_integrator(drive: "Identified") -> str:
    """Return the integrator of the simulator for which the drive's parameters hold."""
    return RK4 if stands_in(drive) and drive.bench.second_order else drive.bench.integrator


def predict_origin(drive: "Identified") -> Prediction:
    """Predict the long test rollouts of the drive that this one represents in a simulator.

    The rollouts have this drive's samples and hold each command until the next sample.
    """
    if drive.origin is None:
        return Prediction(*drive.rollout())
    held = hold(drive.origin.recorded, _every(drive))
    return Prediction(*(_pick(drive, part) for part in drive.origin.rollout(held)))


def find_residual(drive: "Identified") -> Float[np.ndarray, "batch time nv"]:
    """Return measured minus simulated positions of the original drive, in its simulation steps [rad or m]."""
    origin = drive.origin or drive
    return _pick(drive, origin.recorded.qpos[:, 1:] - origin.rollout()[0])


def find_errors(drive: "Identified", qpos: Float[np.ndarray, "batch time nv"]) -> Float[np.ndarray, "batch time nv"]:
    """Return measured minus simulated positions of the long test rollouts in a simulator [rad or m].

    A simulator that keeps only every n-th sample holds commands longer than the recording did. The measured position
    then includes the resulting change of the drive's motion.
    """
    return find_residual(drive) + predict_origin(drive).qpos - qpos


def find_limited(drive: "Identified") -> list[int]:
    """Find the joints whose compensated armature was raised to the smallest allowed value."""
    if drive.origin is None or not stands_in(drive):
        return []
    armature, own = drive.values["bench"]["armature"], drive.origin.values["bench"]["armature"]
    return np.flatnonzero(armature == _LEAST * own).tolist()


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


def _every(drive: "Identified") -> int:
    """Return the number of recorded samples in one sample of the drive."""
    return max(1, round(drive.segments.timestep / (drive.origin or drive).segments.timestep))


def _pick(drive: "Identified", rows: Float[np.ndarray, "batch time nv"]) -> Float[np.ndarray, "batch samples nv"]:
    """Pick the rows at the drive's samples from rows at the recorded samples."""
    return rows[:, _every(drive) - 1 :: _every(drive)][:, : drive.segments.length]


def _delay(values: Values, timestep: float) -> Float[np.ndarray, "nv"]:
    return np.asarray(values["bench"].get("delay", np.zeros(len(values["bench"]["armature"])))) + timestep / 2
