"""Segments as a fit holds them: in blocks that fit into a processor's cache, spread over the devices."""

import operator
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int

from frictionzoo.core.segments import Segments
from frictionzoo.core.threads import usable_threads
from frictionzoo.simulate.rollout import Rollout
from frictionzoo.simulate.torch_rollout import TorchRollout

T = TypeVar("T")
BLOCK_STATES = 25_000
"""States of a joint that are simulated at once: they fit into a processor's cache, and memory does not grow."""

KEPT_STATES, KEPT_BLOCKS = 100_000, 2
"""The same where rollouts keep what tangents need: these are not simulated along, and more fit. At least so many blocks
are made then, for several threads."""

SHARED_STATES = 10_000
"""States from which on there are two blocks at least, for two threads; operations on fewer take as long as on half."""

MOST_STRETCHES = 50
"""Stretches into which the segments are divided at most, in their order in time."""

ENOUGH_RECORDINGS = 10
"""Recordings from which on none is divided: of 9 degrees of freedom, Student's quantile is 15 % above the normal's."""


class Blocks(NamedTuple):
    """Segments in blocks of equal size, each of shape (blocks, segments, ...).

    Attributes:
        qpos: Measured position [rad or m], (blocks, segments, states, nv).
        qvel: Measured velocity [rad/s or m/s], of the same shape.
        signals: What drives them, each (blocks, segments, samples, nv).
        load: What payloads change in the bench's model, (blocks, segments, load).
        weight: 1; 0 for a segment that only fills the last block.
        stretch: Number of the stretch of consecutive segments to which a segment belongs, from 0.
        linked: 1 where the next segment begins at the end of this one; 0 elsewhere.
        begun: Initial states at which the search for those that fit best begins, (blocks, segments, twice nv).
        counts: 1; 0 for a joint in an interval in which it is too slow, (blocks, segments, intervals, nv). None where
            all count.
        inertia: Joint-space inertia without armature where each begins [kg m^2 or kg], (blocks, segments, nv, nv). None
            where errors do not count by impulse.
    """

    qpos: Any
    qvel: Any
    signals: Any
    load: Any
    weight: Any
    stretch: Any
    linked: Any
    begun: Any
    counts: Any = None
    inertia: Any = None


def measured_states(qpos: Any, qvel: Any) -> Any:
    """Where segments start as measured, (blocks, segments, twice nv)."""
    xp = np if isinstance(qpos, np.ndarray) else jnp
    return xp.concatenate([qpos[:, :, 0], qvel[:, :, 0]], axis=2)


def without_motion(data: Blocks) -> Blocks:
    """Return which segments count and which belong together, in numpy, without recorded motion."""
    return jax.tree.map(
        np.asarray, data._replace(qpos=None, qvel=None, signals=None, load=None, counts=None, inertia=None)
    )


def devices_of(rollout: Rollout) -> list[Any]:
    """Over which the segments are spread; torch works on one."""
    device = jax.config.jax_default_device
    devices = jax.local_devices(backend=device.platform if device is not None else None)
    return devices[:1] if isinstance(rollout, TorchRollout) else devices


def each(data: Blocks) -> Iterator[Blocks]:
    """The blocks one after the other."""
    for index in range(len(data.weight)):
        yield jax.tree.map(operator.itemgetter(index), data)


def each_part(data: Blocks, states: tuple[Array, Array]) -> Iterator[tuple[Blocks, Array, Array]]:
    """The same, with where their segments and the next ones start."""
    for index, block in enumerate(each(data)):
        yield block, states[0][index], states[1][index]


def side_by_side(function: Callable[[Any], T], parts: Iterable[Any], devices: int) -> list[T]:
    """Of each part: operations are too small for several threads, blocks side by side are not.

    Devices have threads of their own.
    """
    with ThreadPoolExecutor(usable_threads() if devices == 1 else 1) as pool:
        return list(pool.map(function, parts))


def alone(block: Blocks) -> Blocks:
    """As data of one block."""
    return jax.tree.map(lambda part: part[None], block)


def to_numpy(parts: Iterable[Array]) -> list[np.ndarray]:
    """In float64, in which blocks are summed."""
    return [np.asarray(part, np.float64) for part in parts]


def divide(segments: Segments) -> Int[np.ndarray, "batch"]:
    """Number of the stretch to which each segment belongs, from 0.

    A stretch is one recording or several where there are enough of these, and otherwise a part of the time.
    """
    number = np.arange(segments.count)
    if segments.recording is not None:
        of = np.unique(segments.recording, return_inverse=True)[1]
        number = of if of[-1] + 1 >= ENOUGH_RECORDINGS else number
    units = int(number[-1]) + 1
    return number * min(units, MOST_STRETCHES) // units


def into_blocks(
    segments: Segments,
    stretch: Int[np.ndarray, "batch"],
    dtype: Any,
    rollout: Rollout,
    counts: np.ndarray | None = None,
    inertia: np.ndarray | None = None,
) -> Blocks:
    """Equal blocks; where the segments do not fill the last, its rest repeats the last segment with no weight.

    Args:
        segments: What to hold.
        stretch: To which stretch each of them belongs, as `divide` has it.
        dtype: Of numbers.
        rollout: What will simulate them.
        counts: As `Blocks` has it, by segment.
        inertia: Likewise.
    """
    devices, kept = devices_of(rollout), rollout.keeps_slopes
    largest = max(1, (KEPT_STATES if kept else BLOCK_STATES) // (segments.length * segments.qpos.shape[2]))
    states = segments.count * segments.length * segments.qpos.shape[2]
    fewest = KEPT_BLOCKS if kept else 1 + (states >= SHARED_STATES)
    blocks = max(-(-segments.count // largest), min(fewest, segments.count))
    size = -(-segments.count // blocks)
    size = -(-size // len(devices)) * len(devices)
    index = np.minimum(np.arange(blocks * size), segments.count - 1)

    def cut(signal: np.ndarray) -> np.ndarray:
        return signal[index].astype(dtype).reshape(blocks, size, *signal.shape[1:])

    weight = (np.arange(blocks * size) < segments.count).astype(dtype).reshape(blocks, size)
    numbers = stretch[index].astype(np.int32).reshape(blocks, size)
    measured = cut(segments.qpos), cut(segments.qvel), segments.signals.map(cut), cut(segments.loads)
    follows = np.zeros(blocks * size, dtype)
    if segments.follows is not None:
        follows[: segments.count] = segments.follows
    linked = np.append(follows[1:], np.zeros(1, dtype)).reshape(blocks, size)
    optional = (None if signal is None else cut(signal) for signal in (counts, inertia))
    host = Blocks(*measured, weight, numbers, linked, measured_states(*measured[:2]), *optional)
    if len(devices) == 1:
        return jax.tree.map(jnp.asarray, host)
    sharding = NamedSharding(Mesh(np.array(devices), ("segments",)), PartitionSpec(None, "segments"))
    return jax.tree.map(lambda signal: jax.device_put(signal, sharding), host)
