"""The fast engine: MJX's dynamics of one small bench as a flat function, and MuJoCo's friction constraint solved."""

import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, Int

from frictionzoo.bench import Bench
from frictionzoo.bench.branches import group_alike
from frictionzoo.bench.compiled import NO_FRICTION_CONSTRAINT, NO_PAYLOAD, can_collide, rigid_inertia
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
    friction constraint. Branches that do not move each other are simulated side by side, those of the same build by
    one function of the numbers in which they differ.

    Source: MuJoCo documentation, "Computation": "Numerical integration" and "Constraint model".

    Args:
        bench: What is simulated: hinges or slides, without contacts, limits, tendons and equalities.
        friction: The friction law's formula over `jax.numpy`.
        constraint: Whether the law answers with a `frictionloss`, or for which joints; it is 0 for the others.

    Raises:
        CannotSpecialiseError: The bench has something else.
    """

    name = "specialised"
    forward_limit = 3

    def __init__(self, bench: Bench, friction: Friction, constraint: bool | Sequence[bool]) -> None:
        model = bench.compile(constraint)
        _refuse_other_constraints(model)
        self._groups = _specialise_branches(bench, not model.opt.disableflags & NO_FRICTION_CONSTRAINT)
        self.branches = bench.branches
        self.note: str = _say(self._groups)
        self._order = np.argsort(np.concatenate([group.joints.ravel() for group in self._groups]))
        self._bench = bench
        self._friction = friction
        self._constraint = bool(np.any(constraint))
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
        state = self._drive_state(qpos, qvel, signals, here)
        terms, memory = self._friction.advance(values["friction"], state, memory, self._timestep)
        terms = FrictionTerms(*(term if term is None else jnp.broadcast_to(term, qvel.shape) for term in terms))
        accelerations = [
            group.each(self._accelerate, of, qvel[group.joints], jax.tree.map(operator.itemgetter(group.joints), terms))
            for group, of in zip(self._groups, here, strict=True)
        ]
        qvel = qvel + self._timestep * self._join(accelerations)
        return qpos + self._timestep * qvel, qvel, memory

    def drive_state(self, values: Values, qpos: Array, qvel: Array, signals: Signals, load: Array) -> DriveState:
        """See `Engine.drive_state`."""
        return self._drive_state(qpos, qvel, signals, self._at(values, qpos, qvel, signals, load))

    def _accelerate(self, here: Dynamics, qvel: Array, terms: FrictionTerms) -> Float[Array, "joints"]:
        """The accelerations of one branch that carry its velocities over the step."""
        force = here.motor_torque + here.external_torque
        implicit = here.inertia + here.implicit
        if terms.torque is not None:
            force = force - terms.torque
        if terms.damping is not None:
            if self._damper:
                force = force - terms.damping * qvel
            if self._damps_implicitly:
                implicit = implicit + jnp.diag(self._timestep * terms.damping)
        if self._constraint:
            row = here.constraint_inertia, here.constraint_reference, terms.frictionloss
            force = force + dry_friction(here.inertia, force, *row)
        return solve_spd(implicit, force)

    def _at(self, values: Values, qpos: Array, qvel: Array, signals: Signals, load: Array) -> list[Dynamics]:
        """The dynamics of each group of branches, with a first dimension of its branches."""
        ctrl = control(self._bench, values, qpos, qvel, signals)
        found = []
        for group in self._groups:
            own = {name: value[group.joints] for name, value in values["bench"].items()}
            loads = load[None] if group.load is None else jnp.asarray(group.load, load.dtype)
            found.append(group.each(group.dynamics, own, loads, *(part[group.joints] for part in (qpos, qvel, ctrl))))
        return found

    def _drive_state(self, qpos: Array, qvel: Array, signals: Signals, here: list[Dynamics]) -> DriveState:
        torques = (self._join([getattr(of, name) for of in here]) for name in ("motor_torque", "external_torque"))
        return DriveState(qpos, qvel, signals.ctrl, *torques, **signals.observed)

    def _join(self, parts: Sequence[Float[Array, "_ _"]]) -> Float[Array, "nv"]:
        """What groups say of their joints, in the order of the bench's."""
        whole = jnp.concatenate([part.ravel() for part in parts]) if len(parts) > 1 else parts[0].ravel()
        return whole if len(parts[0]) == len(parts) == 1 else whole[self._order]


class _Group(NamedTuple):
    """Branches that are alike, whose dynamics are one function of their numbers.

    Attributes:
        joints: Index of each joint, a row a branch.
        load: What makes a branch of the function, a row each, as `MjxEngine` takes it; None for the bench as a whole,
            whose load is the recording's.
        inputs: From values and load to MJX's inputs.
        reduced: MJX's dynamics.
    """

    joints: Int[np.ndarray, "branches joints"]
    load: Float[np.ndarray, "branches load"] | None
    inputs: Callable[[Values, Array], ModelInputs]
    reduced: Specialised

    def dynamics(self, values: Mapping[str, Any], load: Array, qpos: Array, qvel: Array, ctrl: Array) -> Dynamics:
        """Of one branch."""
        return self.reduced(self.inputs({"bench": values}, load), qpos, qvel, ctrl)

    def each(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """A function of every branch, of arguments with a first dimension of branches."""
        if len(self.joints) > 1:
            return jax.vmap(function)(*arguments)
        alone = function(*jax.tree.map(operator.itemgetter(0), arguments))
        return jax.tree.map(lambda part: part[None], alone)


def _specialise_branches(bench: Bench, constrainable: bool) -> list[_Group]:
    """The bench's dynamics, branch by branch where it has several and none carries payloads."""
    numbers = np.array(bench.branches)
    if bench.payload is not None or not numbers.any():
        return [_Group(np.arange(bench.nv)[None], None, *_specialised(bench, constrainable, ()))]
    joints = [np.flatnonzero(numbers == number) for number in range(numbers.max() + 1)]
    parts = [bench.only(own.tolist()) for own in joints]
    models = {own[0]: part.compile(constraint=False) for own, part in zip(joints, parts, strict=True)}
    groups = []
    for alike in group_alike(joints, list(models.values())):
        first = next(part for own, part in zip(joints, parts, strict=True) if own[0] == alike.joints[0, 0])
        rigid = np.array([rigid_inertia(models[own[0]]).ravel() for own in alike.joints])
        load = np.concatenate([alike.links, rigid], axis=1) if alike.fields else rigid[:, :0]
        groups.append(_Group(alike.joints, load, *_specialised(first, constrainable, alike.fields)))
    return groups


def _say(groups: Sequence[_Group]) -> str:
    operations = " + ".join(
        f"{len(group.joints)} x {group.reduced.operations}" if len(group.joints) > 1 else f"{group.reduced.operations}"
        for group in groups
    )
    return f"the dynamics come down to {operations} scalar operations"


_known: dict[str, tuple[Callable[[Values, Array], ModelInputs], Specialised]] = {}
"""What was specialised in this process: a job simulates its bench with several laws."""


def _specialised(
    bench: Bench, constrainable: bool, fields: Sequence[tuple[str, int]]
) -> tuple[Callable[[Values, Array], ModelInputs], Specialised]:
    """From values to MJX's inputs, and MJX's dynamics, of this bench and those that differ from it in these fields.

    The friction constraint's coefficients are among them, whether the law needs them or not: XLA leaves out what is not
    used, and one bench is specialised once. An MJCF whose flags leave no such constraint has none.
    """
    # Two benches that write the same MJCF with the same values differ in initial values and bounds only, and those
    # reach MJX's model by its inputs.
    ones = dict.fromkeys(bench.params, np.ones(bench.nv))
    key = f"{type(bench.actuator).__qualname__} {bench.payload} {fields} {bench.mjcf(ones)}"
    if key not in _known:
        with jax.enable_x64(True):
            law = without_memory(lambda values, state: FrictionTerms())
            reference = MjxEngine(bench, law, constrainable, fields)
            values = {"bench": bench.initial_values()}
            load = np.zeros(len(fields) + bench.nv**2) if fields else bench.load(NO_PAYLOAD)
            inputs = jax.eval_shape(reference.model_inputs, values, jnp.asarray(load))
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
