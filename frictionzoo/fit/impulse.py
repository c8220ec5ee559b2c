"""Velocity errors as impulses: what joints lacked in each sample interval for the rollout to match the recording."""

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
    """Return the momentum that each sample interval adds to a rollout's velocity errors [N m s or N s].

    A missing torque appears once, in the joint and interval where it acts. As a velocity error it would appear in all
    joints that it moves, divided by their inertia, and in all later samples.

    The armature is the one under trial. Impulses are therefore linear in it, with the measured acceleration as
    derivative, as in inverse dynamics. Velocity errors are torque over inertia, and torque noise would bias the
    armature upwards.

    `inertia` excludes the armature and holds at the start of each segment; both are in kg m^2 or kg.

    Source: W. Fuller, "Measurement Error Models", 1987, for the effect of noise in a regressor.
    """
    added = jnp.diff(errors, axis=1, prepend=jnp.zeros_like(errors[:, :1]))
    return jnp.einsum("sij,stj->sti", inertia, added, precision="highest") + armature * added


def rigid_inertia_of(bench: Bench, segments: Segments) -> Float[np.ndarray, "segments nv nv"]:
    """Return the joint-space inertia without armature at the start of segments, with payloads [kg m^2 or kg]."""
    model, inertia = bench.compile(constraint=False), np.zeros((segments.count, bench.nv, bench.nv))
    if "position_offset" in (values := bench.initial_values()):
        model.qpos0[:] = -values["position_offset"]
    loads, of_load = np.unique(segments.loads, axis=0, return_inverse=True)
    for number, load in enumerate(loads):
        members = of_load.ravel() == number
        bench.put_load(model, load)
        inertia[members] = rigid_inertia_at(model, segments.qpos[members, 0])
    return inertia


def is_moving(segments: Segments, slow: float) -> Bool[np.ndarray, "segments intervals nv"]:
    """Return in which intervals a joint is faster than this share of its root mean square speed."""
    speed = np.abs(segments.qvel[:, 1:] + segments.qvel[:, :-1]) / 2
    return speed > slow * np.sqrt(np.mean(np.square(segments.qvel), axis=(0, 1)))
