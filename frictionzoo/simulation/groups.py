"""Dynamics of a bench as flat functions; similar branches share one function of the properties that differ."""

import operator
from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, Int

from frictionzoo.bench import Bench
from frictionzoo.bench.branches import group_alike
from frictionzoo.bench.compiled import INERTIAL, NO_PAYLOAD, rigid_inertia
from frictionzoo.core.state import FrictionTerms
from frictionzoo.simulation import tree
from frictionzoo.simulation.base import Values, without_memory
from frictionzoo.simulation.fold import Specialised, specialise
from frictionzoo.simulation.linear import FEW_JOINTS, Rows, add_diagonal
from frictionzoo.simulation.mjx import Acting, MjxEngine, ModelInputs, inertial_fields


class Dynamics(NamedTuple):
    """One branch in one state, before friction; torques as in `DriveState`.

    Attributes:
        inertia: Joint-space inertia with the armature, by rows.
        implicit: `inertia` with the integrator's addition, without the friction model's damping.
        constraint_inertia: `efc_D` of the friction constraint's rows [kg m^2 or kg]; empty without constraint.
        constraint_reference: `efc_aref` of these rows [rad/s^2 or m/s^2].
    """

    inertia: Rows
    implicit: Rows
    motor_torque: Any
    external_torque: Any
    constraint_inertia: Any
    constraint_reference: Any


class Group(NamedTuple):
    """Similar branches, whose dynamics are one function of their properties.

    Attributes:
        joints: Indices of the joints, one row a branch.
        load: Load of each branch for `MjxEngine`, one row each; None for the bench as a whole, with the recording's
            load.
        links: Link properties that differ between branches, one row each; None if they come from the load.
        inputs: Function from values and load to MJX's inputs.
        acting: `MjxEngine.acting`, specialised.
        rigid: Inertia and bias torque of the links, from their properties, displacement and velocity.
    """

    joints: Int[np.ndarray, "branches joints"]
    load: Float[np.ndarray, "branches load"] | None
    links: Float[np.ndarray, "branches links"] | None
    inputs: Callable[[Values, Array], ModelInputs]
    acting: Specialised
    rigid: Specialised

    def dynamics(self, values: Values, load: Array, qpos: Array, qvel: Array, midway: Array, ctrl: Array) -> Dynamics:
        """Return the branches' dynamics, stacked, from `Engine.step`'s arguments and MuJoCo's ctrl, for all joints."""
        bench_values = {name: value[self.joints] for name, value in values["bench"].items()}
        loads = load[None] if self.load is None else jnp.asarray(self.load, load.dtype)
        links = load[None, :INERTIAL] if self.links is None else jnp.asarray(self.links, load.dtype)
        return self.each(
            self._of_branch, bench_values, loads, links, *(part[self.joints] for part in (qpos, qvel, midway, ctrl))
        )

    def each(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Apply a function to every branch, for arguments with a first dimension of branches."""
        if len(self.joints) > 1:
            return jax.vmap(function)(*arguments)
        result = function(*jax.tree.map(operator.itemgetter(0), arguments))
        return jax.tree.map(lambda part: part[None], result)

    def _of_branch(
        self, known: Mapping[str, Any], load: Array, links: Array, qpos: Array, qvel: Array, midway: Array, ctrl: Array
    ) -> Dynamics:
        acting: Acting = self.acting(self.inputs({"bench": known}, load), qpos, qvel, ctrl)
        # No parameter changes the links' properties, so they need no derivative.
        rows, bias = self.rigid(jax.lax.stop_gradient(links), acting.displacement, midway)
        inertia = add_diagonal(rows, acting.armature)
        additions = [acting.implicit[index] for index in range(len(rows))]
        implicit = tuple(
            tuple(map(operator.add, row, additions[index][: len(row)])) for index, row in enumerate(inertia)
        )
        constraint = acting.constraint_inertia, acting.constraint_reference
        return Dynamics(inertia, implicit, acting.motor_torque, acting.passive_torque - bias, *constraint)


def groups_of(bench: Bench, constrainable: bool) -> list[Group]:
    """Return the bench's dynamics, by branch if it has several and carries no payload.

    They include the friction constraint's coefficients unless the MJCF's flags disable it, so that each bench is
    specialised only once: XLA drops unused ones.
    """
    numbers = np.array(bench.branches)
    if bench.payload is not None or not numbers.any():
        links = None if bench.payload is not None else np.zeros((1, 0))
        return [Group(np.arange(bench.nv)[None], None, links, *_specialised(bench, [], constrainable, ()))]
    joints = [np.flatnonzero(numbers == number) for number in range(numbers.max() + 1)]
    parts = {members[0]: bench.only(members.tolist()) for members in joints}
    models = {first: part.compile(constraint=False) for first, part in parts.items()}
    groups = []
    for alike in group_alike(joints, list(models.values())):
        members = [models[members[0]] for members in alike.joints]
        rigid = np.array([rigid_inertia(model).ravel() for model in members])
        load = np.concatenate([alike.links, rigid], axis=1) if alike.fields else rigid[:, :0]
        rows = np.array([tree.flatten(_links(model)) for model in members])
        differ = np.flatnonzero((rows != rows[0]).any(axis=0))
        functions = _specialised(parts[alike.joints[0, 0]], differ.tolist(), constrainable, alike.fields)
        groups.append(Group(alike.joints, load, rows[:, differ], *functions))
    return groups


_known: dict[str, tuple[Callable[[Values, Array], ModelInputs], Specialised, Specialised]] = {}
"""Functions specialised in this process, for a job that simulates its bench with several models."""
_MOST_KNOWN = 64


def _specialised(
    bench: Bench, differ: Sequence[int], constrainable: bool, fields: Sequence[tuple[str, int]]
) -> tuple[Callable[[Values, Array], ModelInputs], Specialised, Specialised]:
    """Return the functions of a `Group`, for this bench and those that differ in these fields and link properties."""
    # Benches with equal MJCF at equal values differ only in initial values and bounds, inputs of MJX's model. A rollout
    # delays the commands before they reach the engine.
    ones = {name: np.full(bench.nv, float(name != "delay")) for name in bench.params}
    key = f"{type(bench.actuator).__qualname__} {bench.payload} {differ} {fields} {bench.mjcf(ones)}"
    if key not in _known:
        with jax.enable_x64(True):
            law = without_memory(lambda values, state: FrictionTerms())
            reference = MjxEngine(bench, law, constrainable, fields)
            values = {"bench": bench.initial_values()}
            load = np.zeros(len(fields) + bench.nv**2) if fields else bench.load(NO_PAYLOAD)
            inputs = jax.eval_shape(reference.model_inputs, values, jnp.asarray(load))
            acting = specialise(reference.acting, inputs, *[np.zeros(bench.nv)] * 3)
            if len(_known) >= _MOST_KNOWN:
                _known.pop(next(iter(_known)))  # the oldest
            _known[key] = reference.model_inputs, acting, _specialise_rigid(bench, differ)
    return _known[key]


def _specialise_rigid(bench: Bench, differ: Sequence[int]) -> Specialised:
    """Specialise the links' inertia and bias torque, for few joints with slopes in displacement and velocity."""
    model = bench.compile(constraint=False)
    has_gravity = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
    gravity = model.opt.gravity if has_gravity else np.zeros(3)
    links = _links(model)
    numbers = np.zeros(len(differ) if bench.payload is None else INERTIAL)

    def rigid(numbers: Array, displacement: Array, qvel: Array) -> tuple[Rows, Array]:
        if bench.payload is None:
            variable_links = tree.unflatten(links, dict(zip(differ, numbers, strict=True)))
        else:
            variable_links = tree.regroup(jnp, tree.links_of(jnp, _with_inertial(model, bench.payload, numbers)))
        link_poses = tree.poses(variable_links, displacement)
        return tree.joint_inertia(variable_links, link_poses), tree.bias_torque(
            variable_links, link_poses, qvel, gravity
        )

    moving = (1, 2) if bench.nv <= FEW_JOINTS else ()
    return specialise(rigid, numbers, *[np.zeros(bench.nv)] * 2, moving=moving)


def _links(model: mujoco.MjModel) -> list[tree.TreeLink]:
    return tree.without_rounding(tree.regroup(np, tree.links_of(np, model)))


def _with_inertial(model: mujoco.MjModel, body: int, inertial: Float[Array, "11"]) -> Any:
    """Return the model fields for `links_of`, with one body's values traced."""
    fields = {name: getattr(model, name) for name in tree.FIELDS}
    for name, value in inertial_fields(inertial).items():
        fields[name] = [value if index == body else entry for index, entry in enumerate(fields[name])]
    return SimpleNamespace(**fields)
