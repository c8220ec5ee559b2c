"""The reference engine: MuJoCo's own step in JAX (MJX), with a friction law inside."""

import contextlib
import io
from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from frictionzoo.bench import Bench
from frictionzoo.types import DriveState, FrictionTerms

with contextlib.redirect_stdout(io.StringIO()):  # it prints that its optional backend is not installed
    from mujoco import mjx

Values = Mapping[str, Mapping[str, Any]]
"""Physical values by owner (`bench`, `friction`) and name."""

Friction = Callable[[Mapping[str, Any], DriveState], FrictionTerms]
"""A friction law's formula: its values and what the drive is doing to friction terms."""


_SLIDES_ONLY = 2
"""MuJoCo's body_simple of a body that only slides along its own axes: its dof_invweight0 leaves the armature out."""


class MjxEngine:
    """Advances one bench by MJX's own functions.

    The step is `mjx.step` taken apart where a friction law needs to look in: after positions, velocities and actuators
    are known and before accelerations are. Friction enters as MuJoCo's joint damping, as the limit of MuJoCo's
    friction constraint, and as a generalised force.

    Args:
        bench: What is simulated.
        friction: The friction law's formula over `jax.numpy`.
        constraint: Whether the law answers with a `frictionloss`.
    """

    def __init__(self, bench: Bench, friction: Friction, constraint: bool) -> None:
        model = bench.compile(constraint)
        # For one joint a single Newton iteration is exact, and only then does MJX avoid a while loop, which reverse
        # mode cannot pass.
        model.opt.iterations = 1 if bench.nv == 1 else model.opt.iterations
        self._bench = bench
        self._friction = friction
        self._constraint = constraint
        self._rigid_inertia = _rigid_inertia(model)
        self._ignores_armature = model.body_simple[model.dof_bodyid] == _SLIDES_ONLY
        self._model = mjx.put_model(model)
        self._data = mjx.make_data(self._model)

    def step(
        self, values: Values, qpos: Float[Array, "nv"], qvel: Float[Array, "nv"], ctrl: Float[Array, "nu"]
    ) -> tuple[Float[Array, "nv"], Float[Array, "nv"]]:
        """Position and velocity one time step later.

        Args:
            values: Bench and friction parameters.
            qpos: Position [rad or m].
            qvel: Velocity [rad/s or m/s].
            ctrl: Command.
        """
        model, data = self._drive(values, qpos, qvel, ctrl)
        terms = self._friction(values["friction"], _drive_state(data))
        model, data = self._apply(terms, model, data)
        data = mjx.fwd_acceleration(model, data)
        data = mjx.solve(model, data) if self._constraint else data.replace(qacc=data.qacc_smooth)
        euler = model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
        data = mjx.euler(model, data) if euler else mjx.implicit(model, data)
        return data.qpos, data.qvel

    def drive_state(
        self, values: Values, qpos: Float[Array, "nv"], qvel: Float[Array, "nv"], ctrl: Float[Array, "nu"]
    ) -> DriveState:
        """What a friction law would see in this state; arguments as in `step`."""
        return _drive_state(self._drive(values, qpos, qvel, ctrl)[1])

    def _drive(self, values: Values, qpos: Array, qvel: Array, ctrl: Array) -> tuple[mjx.Model, mjx.Data]:
        """Everything up to the actuator forces, without friction."""
        model = self._set_bench(values["bench"])
        data = self._data.replace(qpos=qpos, qvel=qvel, ctrl=ctrl)
        data = mjx.fwd_position(model, data)
        data = mjx.fwd_velocity(model, data)
        return model, mjx.fwd_actuation(model, data)

    def _set_bench(self, values: Mapping[str, Any]) -> mjx.Model:
        armature = jnp.asarray(values["armature"], self._model.dof_armature.dtype)
        affine = self._bench.actuator.affine(values)
        gainprm = self._model.actuator_gainprm.at[:, 0].set(affine.gain)
        bias = jnp.stack([affine.bias0, affine.bias1, affine.bias2], axis=-1)
        # MuJoCo computes dof_invweight0 when it compiles, and the friction constraint's softness depends on it: it has
        # to follow the armature, else the exported model would have another friction.
        inverse = jnp.linalg.inv(jnp.asarray(self._rigid_inertia, armature.dtype) + jnp.diag(armature))
        invweight0 = jnp.where(self._ignores_armature, self._model.dof_invweight0, jnp.diagonal(inverse))
        return self._model.replace(
            dof_armature=armature,
            dof_invweight0=invweight0,
            actuator_gainprm=gainprm,
            actuator_biasprm=self._model.actuator_biasprm.at[:, :3].set(bias),
        )

    def _apply(self, terms: FrictionTerms, model: mjx.Model, data: mjx.Data) -> tuple[mjx.Model, mjx.Data]:
        if terms.damping is not None:
            model = model.replace(dof_damping=model.dof_damping + terms.damping)
            data = mjx.passive(model, data)
        if terms.frictionloss is not None:
            model = model.replace(dof_frictionloss=terms.frictionloss)
            data = mjx.make_constraint(model, data)
        if terms.torque is not None:
            data = data.replace(qfrc_applied=data.qfrc_applied - terms.torque)
        return model, data


def friction_of(module: Any) -> Friction:
    """A friction module's formula over `jax.numpy`."""

    def friction(values: Mapping[str, Any], state: DriveState) -> FrictionTerms:
        return module.terms(jnp, values, state)

    return friction


def _drive_state(data: mjx.Data) -> DriveState:
    external = data.qfrc_passive + data.qfrc_applied - data.qfrc_bias
    return DriveState(data.qpos, data.qvel, data.ctrl, data.qfrc_actuator, external)


def _rigid_inertia(model: mujoco.MjModel) -> Float[np.ndarray, "nv nv"]:
    """Joint-space inertia at the reference position without the armature [kg m^2 or kg]."""
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    return inertia - np.diag(model.dof_armature)
