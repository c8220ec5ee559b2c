"""Errors of velocity as impulses: what joints lacked in each sample interval for a rollout to move as was measured."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from frictionzoo.bench import Bench
from frictionzoo.bench.compiled import rigid_inertia_at
from frictionzoo.core.segments import Segments


def impulses(
    errors: Float[Array, "segments intervals nv"],
    inertia: Float[Array, "segments nv nv"],
    armature: Float[Array, "nv"],
) -> Float[Array, "segments intervals nv"]:
    """What each sample interval adds to the momentum of a rollout's error [N m s or N s].

    A torque that the drive lacks shows in its own joint alone, where it acts, and once. An error of velocity shows it
    in all joints that it moves, divided by their inertia, and in all samples that follow.

    The inertia takes the armature that is tried, so that this is linear in it and has the measured acceleration for its
    derivative, as inverse dynamics has. Errors of velocity are the torque over the inertia: an armature that is found
    from these is too large by as much as the torque is noisy.

    Source: W. Fuller, "Measurement Error Models", 1987, for what noise of a regressor does.

    Args:
        errors: Of velocity, after each interval [rad/s or m/s].
        inertia: Joint-space inertia without armature where segments begin [kg m^2 or kg].
        armature: [kg m^2 or kg].
    """
    added = jnp.diff(errors, axis=1, prepend=jnp.zeros_like(errors[:, :1]))
    return jnp.einsum("sij,stj->sti", inertia, added, precision="highest") + armature * added


def rigid_inertia_of(bench: Bench, segments: Segments) -> Float[np.ndarray, "segments nv nv"]:
    """Joint-space inertia without armature where segments begin, with their payloads [kg m^2 or kg]."""
    model, found = bench.compile(constraint=False), np.zeros((segments.count, bench.nv, bench.nv))
    if "position_offset" in (known := bench.initial_values()):
        model.qpos0[:] = -known["position_offset"]
    loads, of_load = np.unique(segments.loads, axis=0, return_inverse=True)
    for number, load in enumerate(loads):
        own = of_load.ravel() == number
        bench.put_load(model, load)
        found[own] = rigid_inertia_at(model, segments.qpos[own, 0])
    return found


def is_moving(segments: Segments, slow: float) -> Bool[np.ndarray, "segments intervals nv"]:
    """Intervals in which a joint is faster than this share of its root mean square speed."""
    speed = np.abs(segments.qvel[:, 1:] + segments.qvel[:, :-1]) / 2
    return speed > slow * np.sqrt(np.mean(np.square(segments.qvel), axis=(0, 1)))
