"""Simulation of a drive for experiment design: motion, use of the limits, and information of a command."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from frictionzoo.bench import Bench
from frictionzoo.bench.limits import Motion
from frictionzoo.core.state import Signals
from frictionzoo.design.information import Information, Sensitivity, inform
from frictionzoo.simulation.drive import Drive
from frictionzoo.simulation.proof import Cases, simulate_in_c
from frictionzoo.simulation.rollout import applied, make_observer


class Seen(NamedTuple):
    """Motions of a batch of commands, and their information."""

    motion: Motion
    information: Information


@dataclass(frozen=True)
class Task:
    """A drive and its planned fit.

    Attributes:
        vector: Coordinates of the assumed parameters.
        constants: Constant inputs of the actuator model by name.
        load: Changes of the MuJoCo model by the payload.
    """

    bench: Bench
    drive: Drive
    sensitivity: Sensitivity
    vector: Float[np.ndarray, "coordinates"]
    constants: Mapping[str, Float[np.ndarray, "nv"]]
    load: Float[np.ndarray, "load"]

    @property
    def values(self) -> dict[str, dict[str, Any]]:
        """Values of all parameters, by owner and name."""
        arrays = self.sensitivity.space.values(jnp.asarray(self.vector))
        return {owner: {name: np.asarray(value) for name, value in named.items()} for owner, named in arrays.items()}

    def signals(self, xp: Any, ctrl: Any, speed: Any) -> Signals:
        """Return the signals from each sample but the last on, with the history before the first that a delay needs.

        `ctrl` is the commanded position [rad or m] and `speed` its derivative, both of shape (batch, samples, nv).
        """
        inputs = {"ctrl_velocity": speed, **self.constants}

        def lengthen(signal: Any) -> Any:
            signal = xp.broadcast_to(signal, ctrl.shape)[:, :-1]
            return xp.concatenate([signal[:, :1]] * self.sensitivity.sampling.history + [signal], axis=1)

        names = self.bench.actuator.inputs
        observed = {name: lengthen(xp.asarray(value)) for name, value in self.bench.observed.items()}
        return Signals(lengthen(ctrl), {name: lengthen(inputs[name]) for name in names}, observed)

    def see(self, ctrl: Array, speed: Array, home: Float[np.ndarray, "nv"], steady: int = 0) -> Seen:
        """Simulate commands of shape (batch, samples, nv), with their information; differentiable, to be compiled.

        Segments that begin before the sample `steady` do not count for the information.
        """
        vector, signals = jnp.asarray(self.vector), self.signals(jnp, ctrl, speed)
        load = jnp.broadcast_to(jnp.asarray(self.load), (len(ctrl), len(self.load)))
        sensed = self.sensitivity.look(vector, home, signals, load)
        qpos, qvel = sensed.qpos[:, :-1], sensed.qvel[:, :-1]
        observe = make_observer(self.drive.engine, self.sensitivity.sampling)
        torque = observe(self.sensitivity.space.values(vector), qpos, qvel, signals, load).motor_torque
        motion = Motion(ctrl[:, :-1], speed[:, :-1], qpos, qvel, torque)
        slopes = sensed.slopes[-(-steady // self.sensitivity.length) :]
        return Seen(motion, inform(slopes, self.sensitivity.weights, self.sensitivity.noise))

    def see_in_c(
        self, ctrl: Float[np.ndarray, "samples nv"], speed: Float[np.ndarray, "samples nv"], home: np.ndarray
    ) -> tuple[Motion, Motion]:
        """Simulate one command in MuJoCo C; return the motion at its samples and in all simulation steps."""
        sampling, values = self.sensitivity.sampling, self.values
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
