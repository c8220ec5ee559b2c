"""Residual torque of recordings, as a function of a fit's coordinates."""

import itertools
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from frictionzoo.bench import Bench
from frictionzoo.bench.regressor import inverse_torque
from frictionzoo.core.state import DriveState, Signals
from frictionzoo.fit.blocks import MOST_STRETCHES
from frictionzoo.fit.motion import Filtering, Motion, Recordings
from frictionzoo.fit.normal_equations import NormalEquations
from frictionzoo.fit.space import Space
from frictionzoo.fit.sparsity import Sparsity
from frictionzoo.models.base import sliding_torque
from frictionzoo.simulation import Values
from frictionzoo.simulation.drive import looks_at_one_joint

COUPLED = 0.5
"""Share of the residual torque explained by another joint's motion above which a gear may couple the two joints."""
LITTLE = 0.02  # residual torque as a share of the drives' torque below which it is not examined
_STEP = 1e-5  # rad or m, step of the finite difference in the position offset


class TorqueEquation:
    """Residual torque: drive torque minus the torque that armature, friction and links need for the recorded motion.

        lack = motor(q, v, ctrl) - friction(q, v, ...) - armature a - inverse dynamics(q, v, a)

    q are the smoothed recorded positions, v and a their derivatives. Commands are delayed as in a simulation. A model
    with memory contributes its friction at constant velocity.

    Attributes:
        motions: Motion of each log.
        motion: The same, concatenated.
        decimate: Filter and decimation for torques at all samples.
        moving: Which samples count, joint by joint.
        labels: Names of the coordinates.
        box: Initial coordinates and bounds.

    Args:
        filtering: Smoothing of positions and filtering of torques.
        held: Whether a recorded command acts until the next sample, as in a simulation; if not, only at its instant,
            like a measured torque or current.
        measured: Whether the recorded joint `torque` drives the joints, at its instant, in place of the actuator's
            response to the commands.
        substeps: Simulation steps in a sample interval if the drive is simulated, which make a held command act
            slightly earlier than in a real drive; 0 for a real drive.
    """

    def __init__(
        self,
        space: Space,
        recordings: Recordings,
        filtering: Filtering,
        held: bool,
        measured: bool = False,
        substeps: int = 0,
    ) -> None:
        bench, model, logs = recordings
        self._space, self.bench, self._model, self._logs = space, bench, model, logs
        self.joints, self.labels = bench.joints, tuple(space.labels)
        self.decimate = filtering.decimation(logs)
        self._measured = np.concatenate([log.extras["torque"] for log in logs]) if measured else None
        self.motions = [filtering.motion(log) for log in logs]
        self.motion = Motion(*(np.concatenate(parts) for parts in zip(*self.motions, strict=True)))
        # A simulated step uses the command at its beginning, on which the second difference of positions is centred.
        share = 1 - 1 / substeps if substeps else 1.0
        self._lateness = (share * logs[0].timestep / 2 if held else 0.0), logs[0].timestep
        self.moving = filtering.is_moving(self.decimate(self.motion.qvel))
        self.box = space.box
        is_local = looks_at_one_joint(model)
        self._sparsity = Sparsity.of(space, range(bench.nv) if is_local else [0] * bench.nv)
        steady = [motion._replace(qacc=np.zeros_like(motion.qacc)) for motion in self.motions]
        self._external = -self._inverse(bench, steady, None)
        self._compiled = jax.jit(self._torque), jax.jit(self._tangents), jax.jit(self._state)

    def lack(self, vector: Float[np.ndarray, "coordinates"]) -> Float[np.ndarray, "rows nv"]:
        """Return the residual torque, filtered and decimated [N m or N]."""
        coordinates = jnp.asarray(vector, self._space.start.dtype)
        torque = np.asarray(self._compiled[0](coordinates), np.float64)
        return self.decimate(torque) - self._rigid(self._space.values(coordinates)["bench"])

    def left(
        self, vector: Float[np.ndarray, "coordinates"], friction: Float[np.ndarray, "time nv"]
    ) -> Float[np.ndarray, "rows nv"]:
        """Return the residual torque with this friction torque in place of the model's [N m or N]."""
        values = self._space.values(jnp.asarray(vector, self._space.start.dtype))
        bench = values["bench"]
        torque = np.asarray(self._compiled[2](values).motor_torque, np.float64) - friction
        return self.decimate(torque - np.asarray(bench["armature"]) * self.motion.qacc) - self._rigid(bench)

    def state(self, vector: Float[np.ndarray, "coordinates"]) -> DriveState:
        """Return the inputs of the friction model at every sample, as numpy arrays of shape (time, nv)."""
        values = self._space.values(jnp.asarray(vector, self._space.start.dtype))
        shape = self.motion.qpos.shape
        return self._compiled[2](values).map(lambda signal: np.broadcast_to(np.asarray(signal, np.float64), shape))

    def slope(self, vector: Float[np.ndarray, "coordinates"]) -> Float[np.ndarray, "rows nv coordinates"]:
        """Return the derivative of the residual torque with respect to the coordinates."""
        coordinates = jnp.asarray(vector, self._space.start.dtype)
        tangents = self.decimate(np.moveaxis(np.asarray(self._compiled[1](coordinates), np.float64), 0, -1))
        slopes = np.zeros((*tangents.shape[:2], len(vector) + 1))  # the last collects tangents that move no coordinate
        for joints, place in zip(self._sparsity.joints, self._sparsity.place, strict=True):
            slopes[:, joints[:, None], place] = tangents[:, joints]
        slopes = slopes[:, :, :-1]
        return slopes - self._offset_slope(coordinates) if "bench.position_offset" in self._space.params else slopes

    def physical(self, vector: Float[np.ndarray, "coordinates"]) -> Float[np.ndarray, "coordinates"]:
        """Return the physical value of each coordinate, not clipped to its bounds."""
        split, params = self._space.split(vector), self._space.params
        return np.concatenate([np.zeros(0), *(params[name].from_coordinate(part, np) for name, part in split.items())])

    def scores(
        self, vector: Float[np.ndarray, "coordinates"]
    ) -> tuple[NormalEquations, Float[np.ndarray, "stretches coordinates"]]:
        """Return the normal equations of the residual torque, and the gradient of each stretch of time.

        Each joint's weight is the inverse variance of its residual torque.
        """
        residual, slopes = self.lack(vector), self.slope(vector)
        counts = np.maximum(self.moving.sum(axis=0), 1)
        variance = np.where(self.moving, np.square(residual), 0).sum(axis=0) / counts
        weight = np.where(self.moving, 1 / np.maximum(variance, np.finfo(float).tiny), 0) / self.moving.sum()
        by_row = np.einsum("rvc,rv->rc", slopes, weight * residual)
        scores = np.stack([part.sum(axis=0) for part in np.array_split(by_row, min(MOST_STRETCHES, len(by_row)))])
        hessian = np.einsum("rvc,rvd->cd", weight[:, :, None] * slopes, slopes, optimize=True)
        # With unknown noise variances, maximum likelihood minimises the geometric mean of the residual variances.
        mean = np.exp((counts * np.log(np.maximum(variance, np.finfo(float).tiny))).sum() / counts.sum())
        return NormalEquations(float(mean), mean * scores.sum(axis=0), mean * hessian), mean * scores

    def couplings(self, vector: Float[np.ndarray, "coordinates"]) -> dict[tuple[int, int], float]:
        """Return pairs of joints whose motions explain most of each other's residual torque, with the smaller share.

        This indicates a gear that couples two joints: one motor turns with both. Coupling by the links' inertia depends
        on the pose and does not show here. Joints with a residual torque below `LITTLE` are left out.
        """
        residual, driving = self.lack(vector), self.driving(vector)
        signals = self.decimate(np.stack([self.motion.qacc, self.motion.qvel, np.sign(self.motion.qvel)], axis=-1))
        nv = residual.shape[1]
        share = np.zeros((nv, nv))
        for joint in range(nv):
            moving = self.moving[:, joint]
            target, columns = residual[moving, joint], signals[moving, joint]
            unexplained = _unexplained(target, columns)
            if unexplained > LITTLE**2 * np.sum(np.square(driving[moving, joint])):
                others = [_unexplained(target, np.hstack([columns, signals[moving, other]])) for other in range(nv)]
                share[joint] = 1 - np.array(others) / unexplained
        mutual = np.minimum(share, share.T)
        return {(a, b): float(mutual[a, b]) for a, b in itertools.combinations(range(nv), 2) if mutual[a, b] > COUPLED}

    def driving(self, vector: Float[np.ndarray, "coordinates"]) -> Float[np.ndarray, "rows nv"]:
        """Return the torque of the drives, filtered and decimated [N m or N]."""
        values = self._space.values(jnp.asarray(vector, self._space.start.dtype))
        return self.decimate(np.asarray(self._compiled[2](values).motor_torque, np.float64))

    def _torque(self, vector: Array) -> Float[Array, "time nv"]:
        """Return the torque that drives the links, at all samples."""
        values = self._space.values(vector)
        state = self._state(values)
        friction = sliding_torque(jnp, self._model.terms(jnp, values["friction"], state), state.qvel)
        accelerated = values["bench"]["armature"] * jnp.asarray(self.motion.qacc, vector.dtype)
        return state.motor_torque - friction - accelerated

    def _tangents(self, vector: Array) -> Float[Array, "tangents time nv"]:
        seeds = jnp.asarray(self._sparsity.seeds, vector.dtype)
        return jax.vmap(lambda seed: jax.jvp(self._torque, (vector,), (seed,))[1])(seeds)

    def _state(self, values: Values) -> DriveState:
        dtype = self._space.start.dtype
        qpos, qvel, external = (jnp.asarray(x, dtype) for x in (*self.motion[:2], self._external))
        signals, bench = self._acting(values["bench"]), values["bench"]
        if self._measured is not None:
            motor = jnp.asarray(self._measured, dtype)
        else:
            ctrl = self.bench.actuator.control(jnp, bench, qpos, qvel, signals.ctrl, signals.inputs)
            gain, *bias = self.bench.actuator.affine(bench)
            motor = gain * ctrl + bias[0] + bias[1] * qpos + bias[2] * qvel
        return DriveState(qpos, qvel, signals.ctrl, motor, external, **signals.observed)

    def _acting(self, known: Mapping[str, Any]) -> Signals:
        """Return the recorded signals other than motion, with commands delayed to when they act."""
        dtype, commands = self._space.start.dtype, self.bench.actuator.commands
        recorded = [log.signals.named() for log in self._logs]
        named = {name: jnp.asarray(np.concatenate([part[name] for part in recorded]), dtype) for name in recorded[0]}
        first, last = self._ends
        half, interval = self._lateness
        shift = -(known.get("delay", jnp.zeros(self.bench.nv, dtype)) + half) / interval
        whole_samples = jax.lax.stop_gradient(jnp.floor(shift))
        samples = np.arange(len(first))[:, None] + whole_samples.astype(int)
        joint = jnp.arange(self.bench.nv)

        def late(command: Array) -> Array:
            before, after = (command[jnp.clip(samples + step, first, last), joint] for step in (0, 1))
            return before + (shift - whole_samples) * (after - before)

        acting = ("ctrl", *(f"inputs.{name}" for name in commands))
        return Signals.from_named({name: late(x) if name in acting else x for name, x in named.items()})

    @cached_property
    def _ends(self) -> tuple[Int[np.ndarray, "time 1"], Int[np.ndarray, "time 1"]]:
        """For each sample, the first and last sample of its log."""
        lengths = np.array([log.samples for log in self._logs])
        ends = np.cumsum(lengths)
        return np.repeat(ends - lengths, lengths)[:, None], np.repeat(ends - 1, lengths)[:, None]

    @cached_property
    def _fixed(self) -> Float[np.ndarray, "rows nv"]:
        return self.decimate(self._inverse(self.bench, self.motions, None))

    def _rigid(self, known: Mapping[str, Any]) -> Float[np.ndarray, "rows nv"]:
        offset = known.get("position_offset")
        if offset is None:
            return self._fixed
        return self.decimate(self._inverse(self.bench, self.motions, np.asarray(offset)))

    def _inverse(
        self, bench: Bench, motions: Sequence[Motion], offset: Float[np.ndarray, "nv"] | None
    ) -> Float[np.ndarray, "time nv"]:
        model, parts = bench.compile(constraint=False), []
        if offset is not None:
            model.qpos0[:] = -offset
        for log, motion in zip(self._logs, motions, strict=True):
            bench.put_load(model, log.load)
            parts.append(inverse_torque(model, *motion))
        return np.concatenate(parts)

    def _offset_slope(self, at: Array) -> Float[np.ndarray, "rows nv coordinates"]:
        """Return the derivative of the links' torque by the coordinates of the position offset."""
        offset = np.asarray(self._space.values(at)["bench"]["position_offset"], np.float64)
        reference, free = {"position_offset": offset}, self._space.places["bench.position_offset"].joints
        by_joint = np.zeros((*self.moving.shape, len(offset)))
        for joint in free:
            shifted = offset + _STEP * (np.arange(len(offset)) == joint)
            by_joint[..., joint] = (self._rigid({"position_offset": shifted}) - self._rigid(reference)) / _STEP
        offset_slope = jax.jacfwd(lambda vector: self._space.values(vector)["bench"]["position_offset"])(at)
        return by_joint @ np.asarray(offset_slope, np.float64)


def _unexplained(rest: Float[np.ndarray, "rows"], columns: Float[np.ndarray, "rows columns"]) -> float:
    """Return the sum of squares that no combination of columns explains."""
    return float(np.sum(np.square(rest - columns @ np.linalg.lstsq(columns, rest, rcond=None)[0])))
