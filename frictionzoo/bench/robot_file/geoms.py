"""Primitive geoms that can touch each other, written as MJCF."""

import xml.etree.ElementTree as ET
from collections.abc import Iterator

import mujoco
import numpy as np

from frictionzoo.bench.robot_file.source import Source
from frictionzoo.bench.robot_file.tree import numbers

_SIZES = {
    int(mujoco.mjtGeom.mjGEOM_PLANE): ("plane", 3),
    int(mujoco.mjtGeom.mjGEOM_SPHERE): ("sphere", 1),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): ("capsule", 2),
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): ("ellipsoid", 3),
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): ("cylinder", 2),
    int(mujoco.mjtGeom.mjGEOM_BOX): ("box", 3),
}
"""Name and number of size parameters of each primitive geom type."""
_SAID = ("condim", "contype", "conaffinity", "priority", "friction", "solmix", "solref", "solimp", "margin", "gap")


def add_contacts(source: Source, root: ET.Element) -> None:
    """Add the primitive geoms that can touch to a template without fused bodies, in place."""
    model = source.model
    bodies = [root.find("worldbody"), *root.iterfind("./worldbody//body")]
    paired = {*model.pair_geom1.tolist(), *model.pair_geom2.tolist()}
    for geom in range(model.ngeom):
        if int(model.geom_type[geom]) in _SIZES and (
            model.geom_contype[geom] | model.geom_conaffinity[geom] or geom in paired
        ):
            owner = bodies[int(model.geom_bodyid[geom])]
            assert owner is not None
            owner.append(_geom(model, geom))
    section = ET.SubElement(root, "contact")
    section.extend([*_pairs(model), *_excludes(model)])


def _geom(model: mujoco.MjModel, geom: int) -> ET.Element:
    kind, size = _SIZES[int(model.geom_type[geom])]
    values = {"size": model.geom_size[geom, :size], "pos": model.geom_pos[geom], "quat": model.geom_quat[geom]}
    attributes = {"name": model.geom(geom).name} if model.geom(geom).name else {}
    attributes |= {"type": kind} | {name: numbers(value) for name, value in values.items()}
    return ET.Element("geom", attributes | {name: _value(getattr(model, f"geom_{name}")[geom]) for name in _SAID})


def _pairs(model: mujoco.MjModel) -> Iterator[ET.Element]:
    fields = ("friction", "solref", "solreffriction", "solimp", "margin", "gap")
    for pair in range(model.npair):
        names = {f"geom{end}": model.geom(getattr(model, f"pair_geom{end}")[pair]).name for end in (1, 2)}
        attributes = {name: _value(getattr(model, f"pair_{name}")[pair]) for name in fields}
        yield ET.Element("pair", names | {"condim": _value(model.pair_dim[pair])} | attributes)


def _excludes(model: mujoco.MjModel) -> Iterator[ET.Element]:
    for signature in model.exclude_signature:
        first, second = int(signature) >> 16, int(signature) & 0xFFFF
        yield ET.Element("exclude", {"body1": model.body(first).name, "body2": model.body(second).name})


def _value(value: np.ndarray | np.number) -> str:
    is_integer = np.issubdtype(np.asarray(value).dtype, np.integer)
    return str(int(value)) if is_integer else numbers(np.asarray(value))
