"""A drive that is to be excited: from a command to its motion, to what it uses of its limits, and to what it says."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from frictionzoo.bench import Bench
from frictionzoo.core.state import Signals
from frictionzoo.excite.information import Information, Sensitivity, inform
from frictionzoo.excite.limits import Limits
from frictionzoo.models import FrictionModel
from frictionzoo.simulate.drive import Drive
from frictionzoo.simulate.proof import Cases, simulate_in_c
from frictionzoo.simulate.rollout import applied, make_observer


class Motion(NamedTuple):
    """A command, and the motion that it makes; each of shape (..., samples, nv).

    Attributes:
        ctrl: Commanded position [rad or m].
        speed: Its derivative [rad/s or m/s].
        qpos: Position [rad or m].
        qvel: Velocity [rad/s or m/s].
        torque: The actuator's torque or force [N m or N], as it acts from each sample on.
    """

    ctrl: Any
    speed: Any
    qpos: Any
    qvel: Any
    torque: Any

    def shares(self, xp: Any, limits: Limits) -> Any:
        """Of the limits, as `Limits.shares` has them."""
        return limits.shares(xp, *self)


class Seen(NamedTuple):
    """What a batch of commands leads to: motions, and the information in them."""

    motion: Motion
    information: Information


@dataclass(frozen=True)
class Task:
    """What is excited.

    Attributes:
        bench: The test stand.
        model: The friction law.
        drive: Both, simulated.
        sensitivity: How recordings of it are fitted.
        vector: Coordinates of the parameters of which one starts.
        constants: What the actuator law needs besides the command, by name, each of shape (nv,).
        load: What the payload changes in the model.
    """

    bench: Bench
    model: FrictionModel
    drive: Drive
    sensitivity: Sensitivity
    vector: Float[np.ndarray, "coordinates"]
    constants: Mapping[str, Float[np.ndarray, "nv"]]
    load: Float[np.ndarray, "load"]

    @property
    def values(self) -> dict[str, dict[str, Any]]:
        """Values of all parameters, by owner and name."""
        found = self.sensitivity.space.values(jnp.asarray(self.vector))
        return {owner: {name: np.asarray(value) for name, value in own.items()} for owner, own in found.items()}

    def signals(self, xp: Any, ctrl: Any, speed: Any) -> Signals:
        """What drives a simulation from each sample but the last on, and before the first as long as commands are late.

        Args:
            xp: Array namespace.
            ctrl: Commanded position [rad or m], of shape (batch, samples, nv).
            speed: Its derivative [rad/s or m/s].
        """
        given = {"ctrl_velocity": speed, **self.constants}

        def lengthen(signal: Any) -> Any:
            signal = xp.broadcast_to(signal, ctrl.shape)[:, :-1]
            return xp.concatenate([signal[:, :1]] * self.sensitivity.sampling.history + [signal], axis=1)

        names = self.bench.actuator.inputs
        observed = {name: lengthen(xp.asarray(value)) for name, value in self.bench.observed.items()}
        return Signals(lengthen(ctrl), {name: lengthen(given[name]) for name in names}, observed)

    def see(self, ctrl: Array, speed: Array, home: Float[np.ndarray, "nv"], steady: int = 0) -> Seen:
        """Motion and information of commands of shape (batch, samples, nv); to be compiled, and differentiable.

        Segments that begin before the sample `steady` are no part of the information.
        """
        vector, signals = jnp.asarray(self.vector), self.signals(jnp, ctrl, speed)
        load = jnp.broadcast_to(jnp.asarray(self.load), (len(ctrl), len(self.load)))
        sensed = self.sensitivity.look(vector, home, signals, load)
        qpos, qvel = sensed.qpos[:, :-1], sensed.qvel[:, :-1]
        observe = make_observer(self.drive.engine, self.sensitivity.sampling)
        torque = observe(self.sensitivity.space.values(vector), qpos, qvel, signals, load).motor_torque
        motion = Motion(ctrl[:, :-1], speed[:, :-1], qpos, qvel, torque)
        return Seen(
            motion,
            inform(
                sensed.slopes[-(-steady // self.sensitivity.length) :], self.sensitivity.weights, self.sensitivity.noise
            ),
        )

    def expect(
        self, ctrl: Float[np.ndarray, "samples nv"], speed: Float[np.ndarray, "samples nv"], home: np.ndarray
    ) -> Float[np.ndarray, "coordinates"]:
        """Half of each interval that a recording of one command will lead to, in the optimiser's coordinates."""
        see = self.drive.rollout.compile(lambda ctrl, speed: self.see(ctrl, speed, home).information)
        segments = self.sensitivity.segments(len(ctrl))
        return self.sensitivity.half_widths(see(ctrl[None], speed[None]), segments)[0]

    def see_in_c(
        self, ctrl: Float[np.ndarray, "samples nv"], speed: Float[np.ndarray, "samples nv"], home: np.ndarray
    ) -> tuple[Motion, Motion]:
        """The motion of one command in MuJoCo C: at its samples, and in all simulation steps."""
        sampling, values = self.sensitivity.sampling, self.values
        signals = self.signals(np, ctrl[None], speed[None])
        acting = applied(jax.tree.map(jnp.asarray, values), signals.map(jnp.asarray), sampling)
        steps = acting.map(lambda signal: np.asarray(signal, np.float64).reshape(1, -1, self.bench.nv))
        start = Cases(home[None], np.zeros((1, self.bench.nv)), steps, self.load[None])
        qpos, qvel, torque = simulate_in_c(self.bench, self.model, values, start)[:, 0]
        held, rate = (np.repeat(signal[:-1], sampling.substeps, axis=0) for signal in (ctrl, speed))
        sampled = [
            np.concatenate([first, after])[:: sampling.substeps]
            for first, after in ((start.qpos, qpos), (start.qvel, qvel))
        ]
        torques = torque[:: sampling.substeps]
        whole = Motion(held, rate, qpos, qvel, torque)
        return Motion(ctrl, speed, sampled[0], sampled[1], np.concatenate([torques, torques[-1:]])), whole
