"""Fast engine: one small bench as a flat function, with a solver for MuJoCo's friction constraint."""

import operator
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from frictionzoo.bench import Bench
from frictionzoo.bench.compiled import NO_FRICTION_CONSTRAINT, can_collide
from frictionzoo.core.state import DriveState, FrictionTerms, Signals
from frictionzoo.simulation.base import FORWARD, UNFUSED, Engine, Friction, Values, control
from frictionzoo.simulation.dry_friction import dry_friction, rigid_step
from frictionzoo.simulation.fold import CannotSpecialiseError
from frictionzoo.simulation.groups import Dynamics, groups_of
from frictionzoo.simulation.linear import FEW_JOINTS, add_diagonal, solve_rows

# Largest number of joints in a branch for which fusion was measured to save time: rollouts and tangents run two to five
# times as fast with it, reverse sweeps up to twice.
_FUSED_FORWARD, _FUSED_REVERSE = 6, 4


class SpecialisedEngine(Engine):
    """Engine that steps a bench with its dynamics specialised for its MJCF.

    `specialise` partially evaluates the links' dynamics in link frames, and MJX's actuators, passive torques and
    coefficients of the friction constraint. The rest is written here: MuJoCo's semi-implicit Euler and implicitfast
    integrators, and its friction constraint. Branches that do not move each other are simulated in parallel, similar
    ones by one function of the properties that differ.

    Source: MuJoCo documentation, "Computation": "Numerical integration" and "Constraint model".

    Args:
        bench: The bench to simulate: hinges or slides, without contacts, limits, tendons and equalities.
        constraint: Whether the model returns a `frictionloss`, or for which joints; it is 0 for the others.

    Raises:
        CannotSpecialiseError: The bench has something else.
    """

    name = "specialised"
    forward_limit = 3

    def __init__(self, bench: Bench, friction: Friction, constraint: bool | Sequence[bool]) -> None:
        model = bench.compile(constraint)
        _refuse_other_constraints(model)
        self._groups = groups_of(bench, not model.opt.disableflags & NO_FRICTION_CONSTRAINT)
        operations = (
            f"{len(part.joints)} x {part.acting.operations + part.rigid.operations}".removeprefix("1 x ")
            for part in self._groups
        )
        self.note: str = f"the dynamics reduce to {' + '.join(operations)} scalar operations"
        self._order = np.argsort(np.concatenate([group.joints.ravel() for group in self._groups]))
        self.bench = bench
        self.friction = friction
        self._constraint = bool(np.any(constraint))
        self._timestep = float(model.opt.timestep)
        flags = model.opt.disableflags
        self._damper = not flags & mujoco.mjtDisableBit.mjDSBL_DAMPER
        euler = model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
        self._damps_implicitly = not flags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP if euler else self._damper
        joints = max(group.joints.shape[1] for group in self._groups)
        self.compiler_options: Mapping[str, Any] = {} if joints <= _FUSED_REVERSE else UNFUSED
        self.forward_options: Mapping[str, Any] = FORWARD if joints <= _FUSED_FORWARD else UNFUSED
        self.keeps_slopes: bool = bench.nv > 1 and joints <= FEW_JOINTS  # for one joint, one program compiles faster

    def step(
        self, values: Values, qpos: Array, qvel: Array, signals: Signals, load: Array, memory: Array, midway: Any = None
    ) -> tuple[Array, Array, Array]:
        """See `Engine.step`."""
        dynamics = self._at(values, qpos, qvel, signals, load, midway)
        state = self._drive_state(qpos, qvel, signals, dynamics)
        terms, memory = self.friction.advance(values["friction"], state, memory, self._timestep)
        terms = FrictionTerms(*(term if term is None else jnp.broadcast_to(term, qvel.shape) for term in terms))
        accelerate = partial(self._accelerate, midway is not None and self.bench.is_stiff)
        steps = [
            group.each(accelerate, branches, qvel[group.joints], jax.tree.map(operator.itemgetter(group.joints), terms))
            for group, branches in zip(self._groups, dynamics, strict=True)
        ]
        accelerations, shifts = (self._join(parts) for parts in zip(*steps, strict=True))
        qvel = qvel + self._timestep * accelerations
        return qpos + self._timestep * qvel + shifts, qvel, memory

    def drive_state(self, values: Values, qpos: Array, qvel: Array, signals: Signals, load: Array) -> DriveState:
        """See `Engine.drive_state`."""
        return self._drive_state(qpos, qvel, signals, self._at(values, qpos, qvel, signals, load))

    def _accelerate(self, rigid: bool, here: Dynamics, qvel: Array, terms: FrictionTerms) -> tuple[Array, Array]:
        """Return one branch's accelerations for the velocity update, and its additional displacements."""
        force = here.motor_torque + here.external_torque
        implicit = here.implicit
        if terms.torque is not None:
            force = force - terms.torque
        if terms.damping is not None:
            if self._damper:
                force = force - terms.damping * qvel
            if self._damps_implicitly:
                implicit = add_diagonal(implicit, self._timestep * terms.damping)
        if self._constraint and rigid:
            return rigid_step(implicit, force, qvel, self._timestep, terms.frictionloss)
        if self._constraint:
            row = here.constraint_inertia, here.constraint_reference, terms.frictionloss
            force = force + dry_friction(here.inertia, force, *row)
        return solve_rows(implicit, force), jnp.zeros_like(qvel)

    def _at(
        self, values: Values, qpos: Array, qvel: Array, signals: Signals, load: Array, midway: Array | None = None
    ) -> list[Dynamics]:
        """Return the dynamics of each group, with a first dimension of branches."""
        ctrl = control(self.bench, values, qpos, qvel, signals)
        midway = qvel if midway is None else midway
        return [group.dynamics(values, load, qpos, qvel, midway, ctrl) for group in self._groups]

    def _drive_state(self, qpos: Array, qvel: Array, signals: Signals, here: list[Dynamics]) -> DriveState:
        torques = (
            self._join([getattr(dynamics, name) for dynamics in here]) for name in ("motor_torque", "external_torque")
        )
        return DriveState(qpos, qvel, signals.ctrl, *torques, **signals.observed)

    def _join(self, parts: Sequence[Float[Array, "_ _"]]) -> Float[Array, "nv"]:
        """Join values by group into the order of the bench's joints."""
        joined = jnp.concatenate([part.ravel() for part in parts]) if len(parts) > 1 else parts[0].ravel()
        return joined if len(parts[0]) == len(parts) == 1 else joined[self._order]


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
