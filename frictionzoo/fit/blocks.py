"""Segments in blocks that fit into a processor's cache, spread over the devices."""

import operator
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int

from frictionzoo.core.segments import Segments
from frictionzoo.simulation.rollout import Rollout
from frictionzoo.simulation.torch_rollout import TorchRollout

BLOCK_STATES = 25_000
"""Joint states simulated at once; they fit into a processor's cache and bound the memory."""

KEPT_STATES, KEPT_BLOCKS = 100_000, 2
"""The same, with a least number of blocks for several threads, where rollouts store what tangents need: tangents are
then not simulated with the states, and more states fit."""

ON_ACCELERATOR = 40
"""Factor on `BLOCK_STATES` and `KEPT_STATES` on a GPU or TPU, which small blocks leave partly idle."""

SHARED_STATES = 10_000
"""Least number of states for two blocks and two threads; with fewer states, half of them take as long as all."""

MOST_STRETCHES = 50
"""Largest number of stretches into which the segments are divided, in order of time."""

ENOUGH_RECORDINGS = 10
"""Least number of recordings for stretches of whole recordings: with 9 degrees of freedom, Student's quantile is 15 %
above the normal one."""


class Blocks(NamedTuple):
    """Segments in blocks of equal size, each of shape (blocks, segments, ...).

    Attributes:
        qpos: Measured position [rad or m], (blocks, segments, states, nv).
        qvel: Measured velocity [rad/s or m/s], of the same shape.
        signals: Commands and other recorded signals, each (blocks, segments, samples, nv).
        load: Changes that payloads make to the bench's model, (blocks, segments, load).
        weight: 1; 0 for a segment that only fills the last block.
        stretch: Number of the segment's stretch of consecutive segments, from 0.
        linked: 1 where the next segment begins at the end of this one; 0 elsewhere.
        begun: Initial states at which their search begins, (blocks, segments, twice nv).
        counts: 1; 0 for an interval in which the joint is too slow, (blocks, segments, intervals, nv). None where all
            count.
        inertia: Joint-space inertia without armature at the start of each segment [kg m^2 or kg], (blocks, segments,
            nv, nv). None where errors are not impulses.
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
    """Return the measured initial states of segments, (blocks, segments, twice nv)."""
    xp = np if isinstance(qpos, np.ndarray) else jnp
    return xp.concatenate([qpos[:, :, 0], qvel[:, :, 0]], axis=2)


def without_motion(data: Blocks) -> Blocks:
    """Return the blocks without motion, signals, load, counts and inertia, in numpy."""
    return jax.tree.map(
        np.asarray, data._replace(qpos=None, qvel=None, signals=None, load=None, counts=None, inertia=None)
    )


def devices_of(rollout: Rollout) -> list[Any]:
    """Return the devices for the segments; torch uses one."""
    device = jax.config.jax_default_device
    devices = jax.local_devices(backend=device.platform if device is not None else None)
    return devices[:1] if isinstance(rollout, TorchRollout) else devices


def each(data: Blocks) -> Iterator[Blocks]:
    """Yield the blocks."""
    for index in range(len(data.weight)):
        # Compiled as one: JAX compiles every shape of an array by itself.
        yield (_take_block if isinstance(data.weight, Array) else _get_block)(data, index)


def _get_block(data: Blocks, index: Any) -> Blocks:
    return jax.tree.map(operator.itemgetter(index), data)


_take_block = jax.jit(_get_block)


def each_part(data: Blocks, states: tuple[Array, Array]) -> Iterator[tuple[Blocks, Array, Array]]:
    """Yield each block with the initial states of its segments and of the segments after them."""
    for index, block in enumerate(each(data)):
        yield block, states[0][index], states[1][index]


def to_numpy(parts: Iterable[Array]) -> list[np.ndarray]:
    """Convert arrays to float64, in which blocks are summed."""
    return [np.asarray(part, np.float64) for part in parts]


def divide(segments: Segments) -> Int[np.ndarray, "batch"]:
    """Return each segment's stretch, from 0: whole recordings if at least `ENOUGH_RECORDINGS`, else periods of time."""
    number = np.arange(segments.count)
    if segments.recording is not None:
        recordings = np.unique(segments.recording, return_inverse=True)[1]
        number = recordings if recordings[-1] + 1 >= ENOUGH_RECORDINGS else number
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
    """Cut segments into equal blocks; the last segment, with weight 0, fills up the last block.

    `stretch` comes from `divide`; `counts` and `inertia` are as in `Blocks`, by segment.
    """
    devices, kept = devices_of(rollout), rollout.keeps_slopes
    most = (KEPT_STATES if kept else BLOCK_STATES) * (1 if devices[0].platform == "cpu" else ON_ACCELERATOR)
    largest = max(1, most // (segments.length * segments.qpos.shape[2]))
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
