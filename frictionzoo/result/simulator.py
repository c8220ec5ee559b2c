"""A drive for a simulator of first order: the parameters with which its steps move as the drive does."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from frictionzoo.bench import Bench
from frictionzoo.core.build import build
from frictionzoo.core.segments import Segments
from frictionzoo.models import FrictionModel
from frictionzoo.simulate import Values, friction_of
from frictionzoo.simulate.second_order import SecondOrder

_LEAST = 0.1  # of an armature that is left at least


def build_simulated(bench: Bench, settings: Mapping[str, Any], values: Values, step: Mapping[str, Any]) -> Bench:
    """Build the bench that a simulator of first order has in place of one of second order.

    Commands act half a step later, and dry friction is no stiffer than the simulator takes.

    Args:
        bench: Of second order.
        settings: Its section.
        values: The drive's.
        step: `timestep` [s], and `integrator` where it is another.
    """
    constant, ratio = bench.solreffriction
    softer = [max(constant, 2 * step["timestep"]), ratio] if constant > 0 else [constant, ratio]
    known = {"init": _delay(values, step["timestep"]).tolist(), "high": 1.0, "identify": False}
    params = {**(settings.get("params") or {}), "delay": known}
    section = {**settings, **step, "second_order": False, "solreffriction": softer, "params": params}
    return build(section, Bench).observing(bench.observed)


def compensate(
    bench: Bench, model: FrictionModel, values: Values, segments: Segments
) -> tuple[dict[str, dict[str, np.ndarray]], Float[np.ndarray, "nv"]]:
    """Return a drive's values for a simulator of first order, and what its armatures should lose besides and cannot.

    Such a step takes torques that go with the velocity at its begin or at its end, and not in its middle: for a torque
    -d v, an armature that is h/2 d larger, or smaller, has the same effect. Where d depends on the state, its median
    over the measured states counts.

    Args:
        bench: Of first order, as `build_simulated` makes it.
        model: The friction law.
        values: Of the drive in continuous time.
        segments: Measured states; without any, a velocity of 1 rad/s or m/s counts.
    """
    stepping = SecondOrder(bench, friction_of(model))
    with jax.enable_x64(True):
        states = segments.qpos[:, :-1], segments.qvel[:, :-1], segments.acting
        rows = jax.tree.map(lambda signal: jnp.asarray(signal, jnp.float64).reshape(-1, bench.nv), states)
        if not segments.count:  # of a card, which has no recordings: one state in motion
            rows = jax.tree.map(lambda signal: jnp.ones((1, bench.nv)), rows)
        known = jax.tree.map(lambda value: jnp.asarray(value, jnp.float64), values)
        more = np.asarray(stepping.surplus(known, *rows), np.float64)
    armature = np.asarray(values["bench"]["armature"])
    changed = np.maximum(armature + more, _LEAST * armature)
    own = {owner: dict(of) for owner, of in values.items()}
    own["bench"] |= {"armature": changed, "delay": _delay(values, bench.timestep)}
    return own, changed - (armature + more)


def _delay(values: Values, timestep: float) -> Float[np.ndarray, "nv"]:
    return np.asarray(values["bench"].get("delay", np.zeros(len(values["bench"]["armature"])))) + timestep / 2
