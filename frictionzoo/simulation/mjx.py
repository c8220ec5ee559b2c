"""Reference engine: MuJoCo's step in JAX (MJX) with a friction model inside."""

import contextlib
import io
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from frictionzoo.bench import Bench
from frictionzoo.bench.compiled import INERTIAL, can_collide, rigid_inertia
from frictionzoo.core.state import DriveState, FrictionTerms, Signals
from frictionzoo.simulation.base import FORWARD, UNFUSED, Engine, Friction, Values, control
from frictionzoo.simulation.dry_friction import rigid_step
from frictionzoo.simulation.linear import rows_of, solve_spd

with contextlib.redirect_stdout(io.StringIO()):  # mujoco.mjx prints that its optional backend is missing
    from mujoco import mjx
    from mujoco.mjx._src import derivative

_FUSED_JOINTS = 4  # largest number of joints for which fusion was measured to save time
_TOLERANCE = 1e-12  # of MJX's solver; 1e-8 stops short of the minimum that MuJoCo C's exact line search reaches
_SLIDES_ONLY = 2  # body_simple of a body that only slides along its axes; its dof_invweight0 leaves the armature out


class ModelInputs(NamedTuple):
    """Fields of the MuJoCo model that depend on a bench's values.

    Attributes:
        armature: `dof_armature` [kg m^2 or kg].
        invweight0: `dof_invweight0`, inverse joint-space inertia at the reference position [1/(kg m^2) or 1/kg].
        body_invweight0: The same of each body, in translation and rotation; empty if no constraint acts on bodies.
        tendon_invweight0: The same of each tendon; empty without tendons.
        actuator: `gainprm[0]` and `biasprm[:3]` of each actuator, of shape (nv, 4).
        inertial: `body_mass`, `body_ipos`, `body_iquat` and `body_inertia` of the body that carries payloads, of shape
            (11,); empty without.
        reference: `qpos0` [rad or m]; empty if the bench has no `position_offset`.
        links: Link properties that differ between similar branches, as in `Alike`; empty for one branch.
    """

    armature: Any
    invweight0: Any
    body_invweight0: Any
    tendon_invweight0: Any
    actuator: Any
    inertial: Any
    reference: Any
    links: Any


class Acting(NamedTuple):
    """Torques and coefficients in one state, without friction and the links' inertia; names as in `Dynamics`.

    Attributes:
        displacement: Displacement of the joints from their reference position [rad or m].
        passive_torque: Torque of springs, dampers and everything else in the MJCF [N m or N].
        implicit: The integrator's addition to the inertia, without the friction model's damping, of shape (nv, nv).
    """

    armature: Any
    displacement: Any
    motor_torque: Any
    passive_torque: Any
    implicit: Any
    constraint_inertia: Any
    constraint_reference: Any


class MjxEngine(Engine):
    """Engine that steps a bench with MJX's functions.

    The step is `mjx.step`, split after positions, velocities and actuators, where the friction model needs access.
    Friction enters as MuJoCo's joint damping, as the limit of its friction constraint, and as a generalised force.

    Args:
        constraint: Whether the model returns a `frictionloss`, or for which joints; it is 0 for the others.
        fields: Field and place of each link property that differs between similar branches. The load holds their values
            in front of the joint-space inertia.
        note: As in `Engine`.
    """

    name = "mjx"
    forward_limit = 16

    def __init__(
        self,
        bench: Bench,
        friction: Friction,
        constraint: bool | Sequence[bool],
        fields: Sequence[tuple[str, int]] = (),
        note: str = "",
    ) -> None:
        model = bench.compile(constraint)
        # One Newton iteration is exact for one joint, and lets MJX avoid a while loop, which has no reverse mode.
        model.opt.iterations = 1 if bench.nv == 1 else model.opt.iterations
        model.opt.tolerance = min(model.opt.tolerance, _TOLERANCE)
        fused = bench.nv <= _FUSED_JOINTS
        self.compiler_options: Mapping[str, Any] = {} if fused else UNFUSED
        self.forward_options: Mapping[str, Any] = FORWARD if fused else UNFUSED
        self.bench = bench
        self._fields = fields
        self.note = note
        self.friction = friction
        self._timestep = float(model.opt.timestep)
        self._rigid_inertia = rigid_inertia(model)
        self._body_jacobian, self._tendon_jacobian = _jacobians(model)
        self._ignores_armature = model.body_simple[model.dof_bodyid] == _SLIDES_ONLY
        self._model = mjx.put_model(model)
        self._data = mjx.make_data(self._model)
        rows = self._data._impl.efc_J.shape[0]
        self._constraint = rows > 0
        # Whether the joints' dry friction is the only constraint.
        self._rubs_alone = self._constraint and rows == np.count_nonzero(model.dof_frictionloss)
        self.reverse: bool = not self._constraint or model.opt.iterations == 1

    def step(
        self, values: Values, qpos: Array, qvel: Array, signals: Signals, load: Array, memory: Array, midway: Any = None
    ) -> tuple[Array, Array, Array]:
        """See `Engine.step`."""
        ctrl = control(self.bench, values, qpos, qvel, signals)
        model, data = self._drive(self.model_inputs(values, load), qpos, qvel, ctrl)
        if midway is not None:
            data = data.replace(qfrc_bias=mjx.fwd_velocity(model, data.replace(qvel=midway)).qfrc_bias)
        state = _drive_state(data, signals)
        terms, memory = self.friction.advance(values["friction"], state, memory, self._timestep)
        model, data = self._apply(terms, model, data)
        data = mjx.fwd_acceleration(model, data)
        if midway is not None and self.bench.is_stiff and self._rubs_alone:
            inertia = rows_of(mjx.full_m(model, data) + self._implicit(model, data))
            limit = model.dof_frictionloss
            acceleration, shift = rigid_step(inertia, data.qfrc_smooth, qvel, self._timestep, limit)
            qvel = qvel + self._timestep * acceleration
            return qpos + self._timestep * qvel + shift, qvel, memory
        data = mjx.solve(model, data) if self._constraint else data.replace(qacc=data.qacc_smooth)
        euler = model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
        data = mjx.euler(model, data) if euler else mjx.implicit(model, data)
        return data.qpos, data.qvel, memory

    def drive_state(self, values: Values, qpos: Array, qvel: Array, signals: Signals, load: Array) -> DriveState:
        """See `Engine.drive_state`."""
        ctrl = control(self.bench, values, qpos, qvel, signals)
        return _drive_state(self._drive(self.model_inputs(values, load), qpos, qvel, ctrl)[1], signals)

    def model_inputs(self, values: Values, load: Float[Array, "load"]) -> ModelInputs:
        """Return the model fields that depend on these values and this load."""
        armature = jnp.asarray(values["bench"]["armature"], jnp.result_type(float))
        affine = self.bench.actuator.affine(values["bench"])
        # MuJoCo computes dof_invweight0 at compilation; it sets the friction constraint's softness. It must follow the
        # armature, else the exported model would have different friction.
        count = len(self._fields) or INERTIAL
        inertial, rigid = load[:count], load[count:].reshape(2 * [self.bench.nv] if len(load) else (0, 0))
        rigid = rigid if len(load) else jnp.asarray(self._rigid_inertia, armature.dtype)
        inverse = jnp.stack([solve_spd(rigid + jnp.diag(armature), unit) for unit in jnp.eye(len(rigid))])
        fixed = jnp.asarray(self._model.dof_invweight0, armature.dtype)
        ignored = jnp.asarray(self._ignores_armature)
        if self.bench.payload is not None:  # a payload moves the body's centre, so the body is no longer simple
            mass = jnp.asarray(self._model.body_mass[self.bench.payload], inertial.dtype)
            ignored = ignored & (inertial[0] == mass)
        invweight0 = jnp.where(ignored, fixed, jnp.diag(inverse))
        bodies, tendons = (
            jnp.einsum("...in,nm,...im->...", jacobian, inverse, jacobian) / jacobian.shape[-2]
            for jacobian in (jnp.asarray(j, armature.dtype) for j in (self._body_jacobian, self._tendon_jacobian))
        )
        bodies = jnp.where(bodies < mujoco.mjMINVAL, bodies[:, ::-1], bodies)  # as MuJoCo's compiler does
        reference = -jnp.asarray(values["bench"].get("position_offset", np.zeros(0)), armature.dtype)
        actuator = jnp.stack(list(affine), axis=-1)
        inertial, links = (inertial[:0], inertial) if self._fields else (inertial, inertial[:0])
        return ModelInputs(armature, invweight0, bodies, tendons, actuator, inertial, reference, links)

    def acting(
        self, inputs: ModelInputs, qpos: Float[Array, "nv"], qvel: Float[Array, "nv"], ctrl: Float[Array, "nu"]
    ) -> Acting:
        """Return everything except the links that a step needs; arguments as in `step`, but ctrl is MuJoCo's."""
        model, data = self._drive(inputs, qpos, qvel, ctrl)
        implicit = self._implicit(model, data)
        passive = data.qfrc_passive + data.qfrc_applied
        constraint = data._impl.efc_D, data._impl.efc_aref
        return Acting(model.dof_armature, qpos - model.qpos0, data.qfrc_actuator, passive, implicit, *constraint)

    def _implicit(self, model: mjx.Model, data: mjx.Data) -> Float[Array, "nv nv"]:
        """Return the integrator's addition to the joint-space inertia [kg m^2 or kg]."""
        if model.opt.integrator != mujoco.mjtIntegrator.mjINT_EULER:
            slope = derivative.deriv_smooth_vel(model, data)
            return jnp.zeros((model.nv, model.nv)) if slope is None else -model.opt.timestep * slope
        if model.opt.disableflags & mjx.DisableBit.EULERDAMP:
            return jnp.zeros((model.nv, model.nv))
        return jnp.diag(model.opt.timestep * model.dof_damping)

    def _drive(self, inputs: ModelInputs, qpos: Array, qvel: Array, ctrl: Array) -> tuple[mjx.Model, mjx.Data]:
        """Compute everything up to the actuator forces, without friction."""
        model = self._model.replace(
            dof_armature=inputs.armature,
            dof_invweight0=inputs.invweight0,
            actuator_gainprm=self._model.actuator_gainprm.at[:, 0].set(inputs.actuator[:, 0]),
            actuator_biasprm=self._model.actuator_biasprm.at[:, :3].set(inputs.actuator[:, 1:]),
        )
        fields = ("body_invweight0", inputs.body_invweight0), ("tendon_invweight0", inputs.tendon_invweight0)
        model = model.replace(**{name: value for name, value in (*fields, ("qpos0", inputs.reference)) if len(value)})
        if self.bench.payload is not None:
            changes = inertial_fields(inputs.inertial)
            body = self.bench.payload
            model = model.replace(**{name: getattr(model, name).at[body].set(v) for name, v in changes.items()})
        for name in dict.fromkeys(name for name, _ in self._fields):
            array = getattr(model, name)
            entries = list(array.ravel())
            for link, (field, place) in zip(inputs.links, self._fields, strict=True):
                if field == name:
                    entries[place] = link
            model = model.replace(**{name: jnp.stack(entries).reshape(array.shape)})
        data = self._data.replace(qpos=qpos, qvel=qvel, ctrl=ctrl)
        data = mjx.fwd_position(model, data)
        data = mjx.fwd_velocity(model, data)
        return model, mjx.fwd_actuation(model, data)

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


def inertial_fields(inertial: Float[Array, "11"]) -> dict[str, Array]:
    """Return the first entries of a load as fields of one body."""
    mass, position, orientation, inertia = jnp.split(inertial, [1, 4, 8])
    return {"body_mass": mass[0], "body_ipos": position, "body_iquat": orientation, "body_inertia": inertia}


def _jacobians(model: mujoco.MjModel) -> tuple[Float[np.ndarray, "bodies 2 3 nv"], Float[np.ndarray, "tendons 1 nv"]]:
    """Return the Jacobians of bodies' centres of mass and of tendons at the reference position."""
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    for stage in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_tendon):
        stage(model, data)
    # Only the softness of contacts and equalities needs the bodies' inverse inertia.
    bodies = np.zeros((model.nbody if model.neq or model.npair or can_collide(model) else 0, 2, 3, model.nv))
    for index, (along, around) in enumerate(bodies):
        if model.body_weldid[index]:
            mujoco.mj_jacBodyCom(model, data, along, around, index)
    tendons = np.zeros((model.ntendon, 1, model.nv))
    if model.ntendon:
        dense = np.zeros((model.ntendon, model.nv))
        mujoco.mju_sparse2dense(dense, data.ten_J, model.ten_J_rownnz, model.ten_J_rowadr, model.ten_J_colind)
        tendons[:, 0] = dense
    return bodies, tendons


def _drive_state(data: mjx.Data, signals: Signals) -> DriveState:
    external = data.qfrc_passive + data.qfrc_applied - data.qfrc_bias
    return DriveState(data.qpos, data.qvel, signals.ctrl, data.qfrc_actuator, external, **signals.observed)
