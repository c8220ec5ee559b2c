"""The fast engine: MJX's dynamics of one small bench as a flat function, and MuJoCo's friction constraint solved."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array

from frictionzoo.bench import Bench
from frictionzoo.bench.compiled import NO_FRICTION_CONSTRAINT, NO_PAYLOAD, can_collide
from frictionzoo.core.state import DriveState, FrictionTerms, Signals
from frictionzoo.simulate.base import UNFUSED, Engine, Friction, Values, control, without_memory
from frictionzoo.simulate.dry_friction import dry_friction
from frictionzoo.simulate.fold import CannotSpecialiseError, Specialised, specialise
from frictionzoo.simulate.linear import solve_spd
from frictionzoo.simulate.mjx import Dynamics, MjxEngine, ModelInputs


class SpecialisedEngine(Engine):
    """Advances one bench by what MJX's functions come down to for this very model.

    Inertia, bias, actuator torque and the friction constraint's coefficients are MJX's, partially evaluated once by
    `specialise`. What remains is written here: MuJoCo's semi-implicit Euler and implicitfast integrators, and its
    friction constraint.

    Source: MuJoCo documentation, "Computation": "Numerical integration" and "Constraint model".

    Args:
        bench: What is simulated: hinges or slides, without contacts, limits, tendons and equalities.
        friction: The friction law's formula over `jax.numpy`.
        constraint: Whether the law answers with a `frictionloss`.

    Raises:
        CannotSpecialiseError: The bench has something else.
    """

    name = "specialised"
    forward_limit = 3

    def __init__(self, bench: Bench, friction: Friction, constraint: bool) -> None:
        model = bench.compile(constraint)
        _refuse_other_constraints(model)
        self._model_inputs, self._dynamics = _specialised(bench, not model.opt.disableflags & NO_FRICTION_CONSTRAINT)
        self.note: str = f"the dynamics come down to {self._dynamics.operations} scalar operations"
        self._bench = bench
        self._friction = friction
        self._constraint = constraint
        self._timestep = float(model.opt.timestep)
        flags = model.opt.disableflags
        self._damper = not flags & mujoco.mjtDisableBit.mjDSBL_DAMPER
        euler = model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
        self._damps_implicitly = not flags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP if euler else self._damper
        self.compiler_options: Mapping[str, Any] = {} if bench.nv == 1 else UNFUSED

    def step(
        self, values: Values, qpos: Array, qvel: Array, signals: Signals, load: Array, memory: Array
    ) -> tuple[Array, Array, Array]:
        """See `Engine.step`."""
        here = self._at(values, qpos, qvel, signals, load)
        state = _drive_state(qpos, qvel, signals, here)
        terms, memory = self._friction.advance(values["friction"], state, memory, self._timestep)
        force = here.motor_torque + here.external_torque
        implicit = here.inertia + here.implicit
        if terms.torque is not None:
            force = force - terms.torque
        if terms.damping is not None:
            damping = jnp.broadcast_to(terms.damping, qvel.shape)
            if self._damper:
                force = force - damping * qvel
            if self._damps_implicitly:
                implicit = implicit + jnp.diag(self._timestep * damping)
        if self._constraint:
            limit = jnp.broadcast_to(terms.frictionloss, qvel.shape)
            force = force + dry_friction(here.inertia, force, here.constraint_inertia, here.constraint_reference, limit)
        qvel = qvel + self._timestep * solve_spd(implicit, force)
        return qpos + self._timestep * qvel, qvel, memory

    def drive_state(self, values: Values, qpos: Array, qvel: Array, signals: Signals, load: Array) -> DriveState:
        """See `Engine.drive_state`."""
        return _drive_state(qpos, qvel, signals, self._at(values, qpos, qvel, signals, load))

    def _at(self, values: Values, qpos: Array, qvel: Array, signals: Signals, load: Array) -> Dynamics:
        ctrl = control(self._bench, values, qpos, qvel, signals)
        return self._dynamics(self._model_inputs(values, load), qpos, qvel, ctrl)


def _drive_state(qpos: Array, qvel: Array, signals: Signals, here: Dynamics) -> DriveState:
    return DriveState(qpos, qvel, signals.ctrl, here.motor_torque, here.external_torque, **signals.observed)


_known: dict[str, tuple[Callable[[Values, Array], ModelInputs], Specialised]] = {}
"""What was specialised in this process: a job simulates its bench with several laws."""


def _specialised(bench: Bench, constrainable: bool) -> tuple[Callable[[Values, Array], ModelInputs], Specialised]:
    """From values to MJX's inputs, and MJX's dynamics, of this bench.

    The friction constraint's coefficients are among them, whether the law needs them or not: XLA leaves out what is not
    used, and one bench is specialised once. An MJCF whose flags leave no such constraint has none.
    """
    # Two benches that write the same MJCF with the same values differ in initial values and bounds only, and those
    # reach MJX's model by its inputs.
    ones = dict.fromkeys(bench.params, np.ones(bench.nv))
    key = f"{type(bench.actuator).__qualname__} {bench.payload} {bench.mjcf(ones)}"
    if key not in _known:
        with jax.enable_x64(True):
            reference = MjxEngine(bench, without_memory(lambda values, state: FrictionTerms()), constrainable)
            values = {"bench": bench.initial_values()}
            inputs = jax.eval_shape(reference.model_inputs, values, jnp.asarray(bench.load(NO_PAYLOAD)))
            _known[key] = reference.model_inputs, specialise(reference.dynamics, inputs, *[np.zeros(bench.nv)] * 3)
    return _known[key]


def _refuse_other_constraints(model: mujoco.MjModel) -> None:
    flags = model.opt.disableflags
    can_touch = not flags & mujoco.mjtDisableBit.mjDSBL_CONTACT and bool(model.npair or can_collide(model))
    limits = not flags & mujoco.mjtDisableBit.mjDSBL_LIMIT and bool(model.jnt_limited.any())
    reasons = {
        "geoms that can touch": can_touch,
        "joint limits": limits,
        "equality constraints": model.neq > 0,
        "tendons": model.ntendon > 0,
        "an activation": model.na > 0,
    }
    for reason, present in reasons.items():
        if present:
            raise CannotSpecialiseError(reason)
