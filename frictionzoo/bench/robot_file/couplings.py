"""Equality constraints and tendons that couple joints, and geoms that can touch each other, written as MJCF."""

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from frictionzoo.bench.robot_file.source import Source
from frictionzoo.bench.robot_file.tree import Tree
from frictionzoo.bench.template import in_full

_EQ, _WRAP = mujoco.mjtEq, mujoco.mjtWrap
_SIZES = {"plane": 3, "sphere": 1, "capsule": 2, "ellipsoid": 3, "cylinder": 2, "box": 3}
"""Number of size parameters of each primitive geom type."""
_SAID = ("condim", "contype", "conaffinity", "priority", "friction", "solmix", "solref", "solimp", "margin", "gap")


def add_equalities(source: Source, tree: Tree, joints: Sequence[int], root: ET.Element) -> None:
    """Write the equality constraints between selected joints; note those that constrain no selected joint.

    Raises:
        BenchError: A constraint couples a selected joint to an unselected one, couples tendons, or closes a loop.
    """
    model, section, idle = source.model, ET.Element("equality"), []
    for index in range(model.neq):
        if model.eq_active0[index] and _ties(source, tree, joints, index):
            section.append(_joint_equality(source, joints, index))
        else:
            idle.append(source.name("equality", index))
    source.note("left out: {n} equality constraints that tie no chosen joint, {}", idle)
    if len(section):
        source.note(f"kept: {len(section)} equality constraints between chosen joints, which then move together")
        root.append(section)


def _ties(source: Source, tree: Tree, joints: Sequence[int], index: int) -> bool:
    """Return whether an equality constraint acts on a selected joint."""
    model = source.model
    kind, ends = _EQ(model.eq_type[index]), (int(model.eq_obj1id[index]), int(model.eq_obj2id[index]))
    if kind == _EQ.mjEQ_JOINT:
        return any(joint in joints for joint in ends)
    if kind == _EQ.mjEQ_TENDON:
        return any(tendon >= 0 and _spans(source, joints, tree, tendon) for tendon in ends)
    sites = model.eq_objtype[index] == mujoco.mjtObj.mjOBJ_SITE
    if kind in (_EQ.mjEQ_CONNECT, _EQ.mjEQ_WELD):
        first, second = (int(model.site_bodyid[end]) if sites else max(end, 0) for end in ends)
        return not tree.together(first, second)
    return False


def _joint_equality(source: Source, joints: Sequence[int], index: int) -> ET.Element:
    model, name = source.model, source.name("equality", index)
    ends = int(model.eq_obj1id[index]), int(model.eq_obj2id[index])
    if _EQ(model.eq_type[index]) != _EQ.mjEQ_JOINT:
        source.fail(
            f"equality constraint {name} ties tendons of chosen joints, closes a loop of bodies, or pulls at one from "
            "outside, which is not supported; choose joints outside of it"
        )
    if not all(joint in joints for joint in ends):
        names = [source.name("joint", joint) if joint >= 0 else "a constant" for joint in ends]
        source.fail(
            f"equality constraint {name} ties joint {names[0]} to {names[1]} (mimic in a URDF), of which only one is "
            "chosen; choose both or neither in bench.joint"
        )
    values = {"polycoef": model.eq_data[index, :5], "solref": model.eq_solref[index], "solimp": model.eq_solimp[index]}
    names = {f"joint{end + 1}": model.joint(joint).name for end, joint in enumerate(ends)}
    return ET.Element("joint", names | {key: in_full(value) for key, value in values.items()})


def add_tendons(source: Source, tree: Tree, joints: Sequence[int], root: ET.Element, limits: bool) -> None:
    """Write the fixed tendons that act on selected joints without an actuator; note the other tendons.

    Raises:
        BenchError: A spatial tendon acts on a selected joint.
    """
    model, section, idle = source.model, ET.Element("tendon"), []
    for tendon in range(model.ntendon):
        if not (_acts(model, tendon, limits) and _spans(source, joints, tree, tendon)):
            idle.append(source.name("tendon", tendon))
        elif _is_fixed(model, tendon):
            section.append(_fixed(model, joints, tendon, limits))
        else:
            name = source.name("tendon", tendon)
            source.fail(
                f"tendon {name} runs in space and pulls at a chosen joint, which is not supported; choose others"
            )
    source.note("left out: {n} tendons that pull at no chosen joint by themselves, {}", idle)
    if len(section):
        source.note(f"kept: {len(section)} tendons with springs, damping, friction or limits at chosen joints")
        root.append(section)


def _wraps(model: mujoco.MjModel, tendon: int) -> Iterator[tuple[int, int, float]]:
    """Yield type, object and parameter of each part of a tendon's path."""
    first = int(model.tendon_adr[tendon])
    for index in range(first, first + int(model.tendon_num[tendon])):
        yield int(model.wrap_type[index]), int(model.wrap_objid[index]), float(model.wrap_prm[index])


def _is_fixed(model: mujoco.MjModel, tendon: int) -> bool:
    return all(kind == _WRAP.mjWRAP_JOINT for kind, _, _ in _wraps(model, tendon))


def _spans(source: Source, joints: Sequence[int], tree: Tree, tendon: int) -> bool:
    """Return whether a tendon's length depends on a selected joint."""
    model = source.model
    if _is_fixed(model, tendon):
        return any(joint in joints and factor for _, joint, factor in _wraps(model, tendon))
    geoms = {_WRAP.mjWRAP_SPHERE, _WRAP.mjWRAP_CYLINDER}
    bodies = [int(model.site_bodyid[index]) for kind, index, _ in _wraps(model, tendon) if kind == _WRAP.mjWRAP_SITE]
    bodies += [int(model.geom_bodyid[index]) for kind, index, _ in _wraps(model, tendon) if kind in geoms]
    return any(not tree.together(body, bodies[0]) for body in bodies)


def _acts(model: mujoco.MjModel, tendon: int, limits: bool) -> bool:
    """Return whether a tendon exerts a force without an actuator."""
    fields = ("stiffness", "damping", "frictionloss", "armature", "stiffnesspoly", "dampingpoly")
    limited = limits and model.tendon_limited[tendon]
    return bool(limited or any(np.any(getattr(model, f"tendon_{name}")[tendon]) for name in fields))


def _fixed(model: mujoco.MjModel, joints: Sequence[int], tendon: int, limits: bool) -> ET.Element:
    """Return a fixed tendon; unselected joints contribute a constant to its length."""
    path = [(joint, factor) for _, joint, factor in _wraps(model, tendon)]
    constant = sum(factor * model.qpos0[model.jnt_qposadr[joint]] for joint, factor in path if joint not in joints)
    values = {
        name: getattr(model, f"tendon_{name}")[tendon] for name in ("stiffness", "damping", "frictionloss", "armature")
    }
    values["springlength"] = model.tendon_lengthspring[tendon] - constant
    values |= {"solreffriction": model.tendon_solref_fri[tendon], "solimpfriction": model.tendon_solimp_fri[tendon]}
    attributes = {"name": model.tendon(tendon).name} if model.tendon(tendon).name else {}
    if limits and model.tendon_limited[tendon]:
        values |= {"range": model.tendon_range[tendon] - constant, "margin": model.tendon_margin[tendon]}
        values |= {"solreflimit": model.tendon_solref_lim[tendon], "solimplimit": model.tendon_solimp_lim[tendon]}
        attributes["limited"] = "true"
    element = ET.Element("fixed", attributes | {name: in_full(value) for name, value in values.items()})
    for joint, factor in path:
        if joint in joints:
            ET.SubElement(element, "joint", {"joint": model.joint(joint).name, "coef": in_full(factor)})
    return element


def add_contacts(source: Source, root: ET.Element) -> None:
    """Add the primitive geoms that can touch to a template without fused bodies, in place."""
    model = source.model
    bodies = [root.find("worldbody"), *root.iterfind("./worldbody//body")]
    paired = {*model.pair_geom1.tolist(), *model.pair_geom2.tolist()}
    for geom in range(model.ngeom):
        touches = model.geom_contype[geom] | model.geom_conaffinity[geom] or geom in paired
        if touches and _kind(model, geom) in _SIZES:
            owner = bodies[int(model.geom_bodyid[geom])]
            assert owner is not None
            owner.append(_geom(model, geom))
    contact, fields = (
        ET.SubElement(root, "contact"),
        ("friction", "solref", "solreffriction", "solimp", "margin", "gap"),
    )
    for pair in range(model.npair):
        names = {f"geom{end}": model.geom(getattr(model, f"pair_geom{end}")[pair]).name for end in (1, 2)}
        attributes = {name: _value(getattr(model, f"pair_{name}")[pair]) for name in fields}
        ET.SubElement(contact, "pair", names | {"condim": _value(model.pair_dim[pair])} | attributes)
    for signature in map(int, model.exclude_signature):
        bodies = {"body1": signature >> 16, "body2": signature & 0xFFFF}
        ET.SubElement(contact, "exclude", {end: model.body(body).name for end, body in bodies.items()})


def _kind(model: mujoco.MjModel, geom: int) -> str:
    return mujoco.mjtGeom(int(model.geom_type[geom])).name.removeprefix("mjGEOM_").lower()


def _geom(model: mujoco.MjModel, geom: int) -> ET.Element:
    kind = _kind(model, geom)
    values = {"size": model.geom_size[geom, : _SIZES[kind]], "pos": model.geom_pos[geom], "quat": model.geom_quat[geom]}
    attributes = {"name": model.geom(geom).name} if model.geom(geom).name else {}
    attributes |= {"type": kind} | {name: in_full(value) for name, value in values.items()}
    return ET.Element("geom", attributes | {name: _value(getattr(model, f"geom_{name}")[geom]) for name in _SAID})


def _value(value: np.ndarray | np.number) -> str:
    is_integer = np.issubdtype(np.asarray(value).dtype, np.integer)
    return str(int(value)) if is_integer else in_full(np.asarray(value))
