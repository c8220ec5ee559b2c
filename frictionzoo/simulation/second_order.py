"""Rollouts of second order in the time step, from MuJoCo's first-order steps."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float

from frictionzoo.bench import Bench
from frictionzoo.core.state import DriveState, Signals
from frictionzoo.simulation.base import Friction, Values, control

_MOST = 0.5  # largest reduction of an armature, as a share of it: it stays positive


class SecondOrder:
    """Correction that turns MuJoCo's Euler or implicitfast steps into position Verlet with a velocity midpoint.

    A step is a kick at q, then a drift over the whole step. With q = Q + h/2 v it is position Verlet in Q: half a
    drift, a kick, half a drift. A rollout therefore begins at Q + h/2 v and reads Q = q - h/2 v. A torque -d v belongs
    at the mean of the velocities before and after the kick. If the integrator takes it before the kick, an armature
    larger by h/2 d has this effect; if after the kick, one smaller by h/2 d. The friction model's memory is not
    differentiated.

    Source: E. Hairer, C. Lubich, G. Wanner, "Geometric numerical integration illustrated by the Stoermer-Verlet
    method", Acta Numerica 12, 2003, section 1.
    """

    def __init__(self, bench: Bench, friction: Friction) -> None:
        options = bench.compile(constraint=False).opt
        damper = not options.disableflags & mujoco.mjtDisableBit.mjDSBL_DAMPER
        euler = options.integrator == mujoco.mjtIntegrator.mjINT_EULER
        implicit = not options.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP if euler else True
        self._half = float(options.timestep) / 2
        self._damping_sign = (-1.0 if implicit else 1.0) * damper
        self._actuator_sign = 1.0 if euler else -1.0
        self._bench, self._friction = bench, friction

    def begin(self, qpos: Any, qvel: Any) -> Any:
        """Return the position from which MuJoCo's steps begin."""
        return qpos + self._half * qvel

    def read(self, qpos: Any, qvel: Any) -> Any:
        """Return the drive's position for this state of MuJoCo's steps."""
        return qpos - self._half * qvel

    def adapt(self, values: Values, qpos: Array, qvel: Array, signals: Signals, memory: Array) -> Values:
        """Return the values with the armature that makes the step from this state a midpoint step."""
        bench_values = values["bench"]
        armature = bench_values["armature"]
        increase = self._half * self._slope(values, qpos, qvel, signals, memory)
        return {**values, "bench": {**bench_values, "armature": armature + jnp.maximum(increase, -_MOST * armature)}}

    def surplus(self, values: Values, qpos: Array, qvel: Array, signals: Signals) -> Float[Array, "nv"]:
        """Return the armature that `adapt` adds [kg m^2], its median over states of shape (samples, nv)."""

        def of_one(qpos: Array, qvel: Array, signals: Signals) -> Array:
            zero = jnp.zeros_like(qpos)
            state = DriveState(qpos, qvel, signals.ctrl, zero, zero, **signals.observed)
            memory = self._friction.settle(values["friction"], state)
            return self._half * self._slope(values, qpos, qvel, signals, memory)

        return jnp.median(jax.vmap(of_one)(qpos, qvel, signals), axis=0)

    def _slope(self, values: Values, qpos: Array, qvel: Array, signals: Signals, memory: Array) -> Float[Array, "nv"]:
        """Return the damping, the fall of torque over velocity [N m s/rad]; implicit torques count negatively."""
        bench_values, ones = values["bench"], jnp.ones_like(qvel)
        # An array of JAX: in scan it takes numpy's for float32 unless 64 bits are its default.
        own_damping = jnp.asarray(self._bench.own_damping, qvel.dtype)
        affine = self._bench.actuator.affine(bench_values)

        def brake(velocity: Array) -> tuple[Array, Array]:
            """Return the torques against the motion without the affine actuator's, and MuJoCo's damping."""
            ctrl = control(self._bench, values, qpos, velocity, signals)
            motor = affine.gain * ctrl + affine.bias0 + affine.bias1 * qpos + affine.bias2 * velocity
            state = DriveState(qpos, velocity, signals.ctrl, motor, jnp.zeros_like(qpos), **signals.observed)
            terms, _ = self._friction.advance(values["friction"], state, memory, 2 * self._half)
            explicit = -affine.gain * ctrl
            if terms.torque is not None and not memory.size:
                explicit = explicit + terms.torque
            if terms.frictionloss is not None:
                explicit = explicit + jnp.sign(qvel) * terms.frictionloss
            damping = jnp.zeros_like(qvel) if terms.damping is None else terms.damping
            return jnp.broadcast_to(explicit, qvel.shape), jnp.broadcast_to(damping, qvel.shape)

        (_, damping), (explicit, _) = jax.jvp(brake, (qvel,), (ones,))
        return explicit - self._actuator_sign * affine.bias2 + self._damping_sign * (damping + own_damping)
