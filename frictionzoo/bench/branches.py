"""Branches of a robot with a fixed base: independent subtrees of bodies, grouped by identical structure.

A suspended quadruped has four legs with independent equations of motion; each is a separate problem, and the legs
differ only in a few numbers of their links.
"""

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float, Int

from frictionzoo.bench.compiled import can_collide

_LINKS = ("body_pos", "body_quat", "body_mass", "body_subtreemass", "body_ipos", "body_iquat", "body_inertia")
_LINKS += ("jnt_pos", "jnt_axis", "jnt_stiffness", "qpos0", "qpos_spring", "dof_damping")
"""Fields of links and joints that may differ between branches of the same structure."""
_IDLE = ("invweight0", "M0", "acc0", "length0", "user", "range", "treeid", "name", "margin", "tree_", "nbuffer")
_IDLE += ("dof_armature", "actuator_gainprm", "actuator_biasprm")
"""Parts of the names of fields that have no effect on joints without limits, are derived, or are set in each step."""
_SIGHT = ("geom_", "mesh_", "mat_", "site_", "cam_", "light_", "bvh_", "tex_", "skin_", "vis", "stat", "oct_", "paths")


class Alike(NamedTuple):
    """Branches of the same structure, one row each in `joints` (indices) and `links` (values of `fields`).

    `fields` are the numbers of the compiled model that differ: field, and index in its flattened array.
    """

    joints: Int[np.ndarray, "branches joints"]
    fields: tuple[tuple[str, int], ...]
    links: Float[np.ndarray, "branches links"]


def number_branches(model: mujoco.MjModel) -> tuple[int, ...]:
    """Return each joint's branch number, from 0; 0 for all if contacts, equalities or tendons may couple branches."""
    if model.neq or model.ntendon or model.npair or can_collide(model):
        return (0,) * model.nv
    numbers: dict[int, int] = {}
    return tuple(numbers.setdefault(int(tree), len(numbers)) for tree in model.dof_treeid)


def group_alike(joints: Sequence[Int[np.ndarray, "_"]], models: Sequence[mujoco.MjModel]) -> list[Alike]:
    """Return the branches in groups of the same structure, from their joints' indices and compiled models."""
    groups: dict[bytes, list[int]] = {}
    for index, model in enumerate(models):
        groups.setdefault(_build(model), []).append(index)
    return [_compare([joints[i] for i in members], [models[i] for i in members]) for members in groups.values()]


def _compare(joints: Sequence[np.ndarray], models: Sequence[mujoco.MjModel]) -> Alike:
    fields, links = [], []
    for name in _LINKS:
        rows = np.array([np.ravel(getattr(model, name)) for model in models])
        for entry in np.flatnonzero((rows != rows[0]).any(axis=0)):
            fields.append((name, int(entry)))
            links.append(rows[:, entry])
    return Alike(np.array(joints), tuple(fields), np.array(links).T.reshape(len(models), len(fields)))


def _build(model: mujoco.MjModel) -> bytes:
    """Return the parts of a compiled model that must be identical: sizes, structure, actuators, options."""
    parts = []
    for name in dir(model):
        if name.startswith(("_", *_SIGHT)) or name in _LINKS or any(part in name for part in _IDLE):
            continue
        value = getattr(model, name)
        if isinstance(value, int | float | np.ndarray):
            parts.append(name.encode() + np.ascontiguousarray(value).tobytes())
    options = (model.opt.timestep, *model.opt.gravity, model.opt.integrator, model.opt.disableflags)
    shapes = "".join(f"{name}{np.shape(getattr(model, name))}" for name in _LINKS)
    return b" ".join(parts) + np.array(options, float).tobytes() + shapes.encode()
