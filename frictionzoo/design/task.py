"""Simulation of a drive for experiment design: motion and information of a command."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Array, Float

from frictionzoo.bench import Bench
from frictionzoo.bench.limits import Motion
from frictionzoo.core.segments import Sampling
from frictionzoo.core.state import Signals
from frictionzoo.design.information import Information, SensorNoise, inform
from frictionzoo.fit import Space
from frictionzoo.fit.blocks import MOST_STRETCHES
from frictionzoo.fit.uncertainty import LEVEL
from frictionzoo.simulation.drive import Drive
from frictionzoo.simulation.proof import Cases, simulate_in_c
from frictionzoo.simulation.rollout import applied, make_observer


@dataclass(frozen=True)
class Task:
    """A drive and its planned fit, of segments from measured initial states as in `Objective`.

    Attributes:
        length: Sample intervals in a segment.
        weights: Weights of squared position and velocity errors in the loss.
        vector: Coordinates of the assumed parameters.
        constants: Constant inputs of the actuator model by name.
        load: Changes of the MuJoCo model by the payload.
    """

    bench: Bench
    drive: Drive
    space: Space
    sampling: Sampling
    length: int
    weights: tuple[float, float]
    noise: SensorNoise
    vector: Float[np.ndarray, "coordinates"]
    constants: Mapping[str, Float[np.ndarray, "nv"]]
    load: Float[np.ndarray, "load"]

    @property
    def values(self) -> dict[str, dict[str, Any]]:
        """Values of all parameters, by owner and name."""
        arrays = self.space.values(jnp.asarray(self.vector))
        return {owner: {name: np.asarray(value) for name, value in named.items()} for owner, named in arrays.items()}

    def segments(self, samples: int) -> int:
        """Return the number of segments in a recording of this many samples."""
        return (samples - 1) // self.length

    def half_widths(self, information: Information, segments: int) -> Float[np.ndarray, "batch coordinates"]:
        """Return half of each 95 % interval in coordinates, as in `estimate_uncertainty`; NaN without effect."""
        quantile = scipy.special.stdtrit(max(min(segments, MOST_STRETCHES) - 1, 1), (1 + LEVEL) / 2)
        variances = np.diagonal(np.asarray(information.covariance), axis1=1, axis2=2)
        effect = np.diagonal(np.asarray(information.hessian), axis1=1, axis2=2) > 0
        return np.where(effect, quantile * np.sqrt(np.maximum(variances, 0)), np.nan)

    def signals(self, xp: Any, ctrl: Any, speed: Any) -> Signals:
        """Return the signals from each sample but the last on, with the history before the first that a delay needs.

        `ctrl` is the commanded position [rad or m] and `speed` its derivative, both of shape (batch, samples, nv).
        """
        inputs = {"ctrl_velocity": speed, **self.constants}

        def lengthen(signal: Any) -> Any:
            signal = xp.broadcast_to(signal, ctrl.shape)[:, :-1]
            return xp.concatenate([signal[:, :1]] * self.sampling.history + [signal], axis=1)

        names = self.bench.actuator.inputs
        observed = {name: lengthen(xp.asarray(value)) for name, value in self.bench.observed.items()}
        return Signals(lengthen(ctrl), {name: lengthen(inputs[name]) for name in names}, observed)

    def see(
        self, ctrl: Array, speed: Array, home: Float[np.ndarray, "nv"], steady: int = 0
    ) -> tuple[Motion, Information]:
        """Simulate commands of shape (batch, samples, nv), with their information; differentiable, to be compiled.

        Segments that begin before the sample `steady` do not count for the information.
        """
        vector, signals = jnp.asarray(self.vector), self.signals(jnp, ctrl, speed)
        load = jnp.broadcast_to(jnp.asarray(self.load), (len(ctrl), len(self.load)))
        qpos, qvel, slopes = self._simulate(vector, home, signals, load)
        qpos, qvel = qpos[:, :-1], qvel[:, :-1]
        observe = make_observer(self.drive.engine, self.sampling)
        torque = observe(self.space.values(vector), qpos, qvel, signals, load).motor_torque
        slopes = slopes[-(-steady // self.length) :]
        return Motion(ctrl[:, :-1], speed[:, :-1], qpos, qvel, torque), inform(slopes, self.weights, self.noise)

    def _simulate(
        self, vector: Array, home: Float[np.ndarray, "nv"], signals: Signals, load: Array
    ) -> tuple[Array, Array, Array]:
        """Simulate recordings from rest at `home`.

        Returns:
            Positions and velocities at the samples, (batch, samples, nv), and their derivatives after the first sample
            of each complete segment, with respect to the coordinates and the segment's initial positions and
            velocities, (segments, tangents, batch, length, nv, 2).
        """
        samples = signals.ctrl.shape[1] - self.sampling.history
        count = self.segments(samples + 1)
        begins = self.length * np.arange(count)[:, None]
        window = begins + np.arange(self.sampling.history + self.length)
        cut = signals.map(lambda signal: jnp.moveaxis(signal[:, window], 1, 0))
        batch, nv = signals.ctrl.shape[0], signals.ctrl.shape[2]
        # Tangent directions: all coordinates, then all initial positions, then all initial velocities.
        coordinates = len(self.space.start)
        unit = np.eye(coordinates + 2 * nv)
        parts = np.split(unit, [coordinates, coordinates + nv], axis=1)
        vectors, *states = (jnp.asarray(part, vector.dtype) for part in parts)
        seeds = vectors, *(jnp.broadcast_to(part[:, None], (len(unit), batch, nv)) for part in states)
        rollout = self.drive.rollout

        def segment(state: tuple[Array, Array], driving: Signals) -> tuple[Any, Any]:
            def run(vector: Array, qpos: Array, qvel: Array) -> Array:
                return jnp.stack(rollout(self.space.values(vector), qpos, qvel, driving, load), axis=-1)

            slope = jax.vmap(lambda *along: jax.jvp(run, (vector, *state), along), out_axes=(None, 0))
            after, slopes = slope(*seeds)
            return (after[:, -1, :, 0], after[:, -1, :, 1]), (after, slopes)

        start = jnp.broadcast_to(jnp.asarray(home, vector.dtype), (batch, nv)), jnp.zeros((batch, nv), vector.dtype)
        # To save memory, the reverse sweep stores only states and simulates each segment again.
        end, (after, slopes) = jax.lax.scan(jax.checkpoint(segment), start, cut)
        parts = [jnp.stack(start, axis=-1)[:, None], jnp.moveaxis(after, 0, 1).reshape(batch, -1, nv, 2)]
        if samples > count * self.length:  # an incomplete segment adds no information, but must keep the limits
            last = signals.map(lambda signal: signal[:, count * self.length :])
            parts.append(jnp.stack(rollout(self.space.values(vector), *end, last, load), axis=-1))
        states = jnp.concatenate(parts, axis=1)
        return states[..., 0], states[..., 1], slopes

    def see_in_c(
        self, ctrl: Float[np.ndarray, "samples nv"], speed: Float[np.ndarray, "samples nv"], home: np.ndarray
    ) -> tuple[Motion, Motion]:
        """Simulate one command in MuJoCo C; return the motion at its samples and in all simulation steps."""
        sampling, values = self.sampling, self.values
        signals = self.signals(np, ctrl[None], speed[None])
        acting = applied(jax.tree.map(jnp.asarray, values), signals.map(jnp.asarray), sampling)
        steps = acting.map(lambda signal: np.asarray(signal, np.float64).reshape(1, -1, self.bench.nv))
        start = Cases(home[None], np.zeros((1, self.bench.nv)), steps, self.load[None])
        qpos, qvel, torque = simulate_in_c(self.bench, self.drive.model, values, start)[:, 0]
        ctrl_in_steps, speed_in_steps = (np.repeat(signal[:-1], sampling.substeps, axis=0) for signal in (ctrl, speed))
        sampled = [
            np.concatenate([initial, later])[:: sampling.substeps]
            for initial, later in ((start.qpos, qpos), (start.qvel, qvel))
        ]
        torques = torque[:: sampling.substeps]
        motion_in_steps = Motion(ctrl_in_steps, speed_in_steps, qpos, qvel, torque)
        return Motion(ctrl, speed, sampled[0], sampled[1], np.concatenate([torques, torques[-1:]])), motion_in_steps
