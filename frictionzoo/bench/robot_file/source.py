"""A robot's file compiled by MuJoCo: all joints and link inertias, without elements that do not affect motion."""

import contextlib
import re
import warnings
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from frictionzoo.bench.compiled import rotation
from frictionzoo.core.errors import BenchError

_LISTED = 6  # most names in a note
_MESH_TYPES = {mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_SDF, mujoco.mjtGeom.mjGEOM_HFIELD}
_MESH_FILES = {".stl", ".obj", ".msh"}  # supported by MuJoCo
_MASSLESS = {mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD}
_FROM_GEOM = mujoco.mjtInertiaFromGeom
_NO_NUMBERS = {"nan", "inf", "infinity"}
_NAMING = {"name", "class", "childclass", "joint", "joint1", "joint2", "body", "body1", "body2", "link", "user", "file"}
"""Attributes in which the words in `_NO_NUMBERS` may be names."""
_IDLE_SECTIONS = {"asset", "custom", "keyframe", "sensor", "statistic", "visual"}
_LEAST = 1e-13  # kg or kg m^2; MuJoCo's compiler refuses less
_ONCE = {"origin", "parent", "child", "axis", "limit", "dynamics", "mimic", "inertial", "mass", "inertia", "geometry"}
"""URDF elements that may occur once per parent; urdfdom reads the first of several, MuJoCo refuses the file."""
_READ = {"link", "joint", "material", "mujoco"}
_UNREAD_OF_JOINTS = {"safety_controller", "calibration"}


@dataclass
class Source:
    """Robot's file after compilation.

    Attributes:
        model: Compiled model with all joints and actuators, including a floating base.
        mass: Mass of each body [kg].
        centre: Centre of mass of each body in its frame [m].
        inertia: Inertia about the centre of mass, in the body's axes [kg m^2].
        compiled: Whether `model` has a body's mass and inertia; it has 1 instead of values that MuJoCo refuses.
        absent: Missing mesh file that determines a body's inertia, by the body's index.
        meshes: Number of geoms with a mesh that could touch something.
        notes: Features that were left out or changed, one line each.
    """

    path: str
    model: mujoco.MjModel
    mass: Float[np.ndarray, "nbody"]
    centre: Float[np.ndarray, "nbody 3"]
    inertia: Float[np.ndarray, "nbody 3 3"]
    compiled: Bool[np.ndarray, "nbody"]
    absent: dict[int, str]
    meshes: int
    notes: list[str]

    def fail(self, message: str) -> NoReturn:
        """Refuse the file in one line."""
        raise BenchError(f"{self.path}: {message}")

    def note(self, text: str, names: Sequence[str] | None = None) -> None:
        """Note a feature; with `names` only if there are any, with the names as `{}` and their number as `{n}`."""
        if names is None or names:
            listing = listed(names or ())
            self.notes.append(text.replace("{n}", str(len(names or ()))).replace("{}", listing))

    def name(self, kind: str, index: int) -> str:
        """Return the name of a `body`, `joint`, `actuator` or other element, or its number, for messages."""
        return getattr(self.model, kind)(index).name or f"number {index}"

    def dof(self, joint: int) -> int:
        """Return the index of a joint's degree of freedom."""
        return int(self.model.jnt_dofadr[joint])


def listed(names: Sequence[str]) -> str:
    """Return the first names and the number of the others, for messages."""
    others = len(names) - _LISTED
    return ", ".join(names[:_LISTED]) + (f" and {others} more" if others > 0 else "")


def load(path: str, content: bytes | None = None, equip: Callable[[mujoco.MjSpec], None] = lambda _: None) -> Source:
    """Read a robot's file, MJCF or URDF, or its `content` without includes; `equip` extends it before compilation.

    Textures are not opened, and meshes only if a body's inertia depends on them.

    Raises:
        BenchError: The file cannot be read, or MuJoCo refuses it.
    """
    notes: list[str] = []
    try:
        with _collecting_warnings(notes):
            spec, urdf = _parse(path, content, notes)
            notes += _leave_out(spec)
            meshes = sum(_needs_asset(geom) and bool(geom.contype or geom.conaffinity) for geom in spec.geoms)
            unlike, absent = _settle_inertia(spec, Path(path).parent)
            equip(spec)
            model = spec.compile()
    except (ValueError, RuntimeError) as error:  # MuJoCo raises both for invalid files
        reason = " ".join(str(error).split())
        raise BenchError(f"{path}: MuJoCo does not take it ({reason}); correct the file") from None
    axes = np.stack([rotation(quaternion) for quaternion in model.body_iquat])
    with np.errstate(invalid="ignore"):
        inertia = axes * model.body_inertia[:, None, :] @ axes.transpose(0, 2, 1)
        mass, compiled = model.body_mass.copy(), np.ones(model.nbody, bool)
        for body, (body_mass, body_inertia) in unlike.items():
            mass[body.id], inertia[body.id] = body_mass, axes[body.id] @ body_inertia @ axes[body.id].T
            compiled[body.id] = False
    absent_of = {body.id: file for body, file in absent.items()}
    source = Source(path, model, mass, model.body_ipos.copy(), inertia, compiled, absent_of, meshes, notes)
    _refuse_no_numbers(source)
    if urdf:
        bodies = [body for body in spec.bodies[1:] if not body.explicitinertial and model.body_weldid[body.id]]
        masses = [f"{body.name} ({mass[body.id]:.3g} kg)" for body in bodies if mass[body.id] > 0]
        source.note("links without <inertial>: MuJoCo takes mass from their collision shapes, {}", masses)
    return source


def look_at(path: str) -> mujoco.MjModel:
    """Return a robot's file compiled with its shapes and existing meshes, for pictures and not for simulation.

    Raises:
        BenchError: The file cannot be read, or MuJoCo refuses it.
    """
    notes: list[str] = []
    # A body may have no inertia without a missing mesh; the file is then read as for a simulation.
    with _collecting_warnings(notes), contextlib.suppress(ValueError, RuntimeError):
        spec, _ = _parse(path, None, notes)
        notes += _leave_out(spec)
        meshes = {mesh.name: mesh for mesh in spec.meshes}
        for geom in [geom for geom in spec.geoms if _needs_asset(geom)]:
            if not _is_there(spec, meshes.get(geom.meshname), Path(path).parent):
                spec.delete(geom)
        _delete_unused(spec)
        return spec.compile()
    return load(path).model


@contextlib.contextmanager
def _collecting_warnings(notes: list[str]) -> Iterator[None]:
    """Collect MuJoCo's warnings as notes; MuJoCo would print them and write a file in the working directory."""
    names_of: dict[str, list[str]] = {}  # groups warnings that differ only in a name

    def collect(text: str) -> None:
        match = re.search("'(.*?)'", text)
        kind = " ".join(re.sub("'.*?'", "{}", text, count=1).split())
        names_of.setdefault(kind, []).append(match[1] if match else "")

    mujoco.set_mju_user_warning(collect)
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            yield
    finally:
        mujoco.set_mju_user_warning(None)
        for warning in caught:
            collect(str(warning.message))
        notes += [f"MuJoCo warns: {kind.replace('{}', listed(names))}" for kind, names in names_of.items()]


def _parse(path: str, content: bytes | None, notes: list[str]) -> tuple[mujoco.MjSpec, bool]:
    """Return MuJoCo's specification, with includes, classes and frames resolved, and whether the file is a URDF."""
    try:
        root = ET.fromstring(Path(path).read_bytes() if content is None else content)
    except OSError as error:
        raise BenchError(f"{path}: cannot be read ({error.strerror}); set bench.mjcf to an MJCF or a URDF") from None
    except (ET.ParseError, UnicodeError, LookupError) as error:
        raise BenchError(f"{path}: not XML ({error}); set bench.mjcf to an MJCF or a URDF") from None
    for element in (element for section in root if section.tag not in _IDLE_SECTIONS for element in section.iter()):
        for name, text in element.attrib.items():
            if name not in _NAMING and not {*text.lower().replace("-", " ").split()}.isdisjoint(_NO_NUMBERS):
                raise BenchError(f'{path}: {name}="{text}" of <{element.tag}>, expected finite numbers; correct it')
    if root.tag == "mujoco" and content is None:
        return mujoco.MjSpec.from_file(path), False
    if root.tag not in ("mujoco", "robot"):
        raise BenchError(f"{path}: <{root.tag}>, expected <mujoco> of an MJCF or <robot> of a URDF")
    if urdf := root.tag == "robot":
        notes += _clean(path, root)
    spec = mujoco.MjSpec.from_string(ET.tostring(root, encoding="unicode"))
    spec.modelfiledir = str(Path(path).parent)
    if urdf:
        spec.compiler.fusestatic = False  # keeps the bodies' names; `Tree` fuses bodies
    return spec, urdf


def _clean(path: str, root: ET.Element) -> Iterator[str]:
    """Remove from a URDF, in place, elements that MuJoCo refuses or ignores; yield a note for each ignored kind."""
    if any("xacro" in element.tag for element in root.iter() if isinstance(element.tag, str)):
        raise BenchError(
            f"{path}: it has xacro macros, expected a plain URDF; expand it first (xacro FILE > robot.urdf)"
        )
    yield from _take_first(root)
    unread = [element for element in root if element.tag not in _READ]
    if unread:
        counts = Counter(element.tag for element in unread)
        listing = ", ".join(f"{number} <{tag}>" for tag, number in counts.items())
        yield f"left out, because MuJoCo does not read them in a URDF: {listing}"
    for element in unread:
        root.remove(element)
    joints = root.findall("joint")
    speeds = [joint for joint in joints for limit in joint.findall("limit") if limit.get("velocity")]
    if speeds:
        yield f"velocity limits of {len(speeds)} joints: MuJoCo has none"
    others = Counter(child.tag for joint in joints for child in joint if child.tag in _UNREAD_OF_JOINTS)
    for tag, number in others.items():
        yield f"left out, because MuJoCo does not read them in a URDF: {number} <{tag}> of joints"


def _take_first(root: ET.Element) -> Iterator[str]:
    """Keep the first of several elements that may occur once, as URDF's reference reader (urdfdom) does."""
    for owner in root.iter():
        once = _ONCE & {"inertial"} if owner.tag == "link" else _ONCE  # a link may have several shapes
        tags = set()
        for child in list(owner):
            if child.tag in tags and child.tag in once:
                owner.remove(child)
                yield f"a second <{child.tag}> of <{owner.tag} {owner.get('name', '')}> is left out"
            tags.add(child.tag)


def _leave_out(spec: mujoco.MjSpec) -> Iterator[str]:
    """Delete elements that do not affect motion, and flexible bodies; yield a note for each kind."""
    for element in (*spec.geoms, *spec.sites, *spec.tendons, *spec.meshes):
        element.material = ""
    kinds = ("sensors", "keys", "cameras", "lights", "skins", "textures", "materials", "tuples")
    removed = {kind: list(getattr(spec, kind)) for kind in kinds}
    for elements in removed.values():
        for element in elements:
            spec.delete(element)
    counts = [f"{len(elements)} {kind}" for kind, elements in removed.items() if elements]
    if counts:
        yield f"left out, because they move no joint: {', '.join(counts)}"
    if spec.flexes:
        yield f"left out: {len(spec.flexes)} flexible bodies (flex) and forces on them"
        for flex in list(spec.flexes):
            spec.delete(flex)
        flexible = {mujoco.mjtEq.mjEQ_FLEX, mujoco.mjtEq.mjEQ_FLEXVERT, mujoco.mjtEq.mjEQ_FLEXSTRAIN}
        for equality in [equality for equality in spec.equalities if equality.type in flexible]:
            spec.delete(equality)


def _needs_asset(geom: mujoco.MjsGeom) -> bool:
    return geom.type in _MESH_TYPES or bool(geom.meshname)


def _settle_inertia(
    spec: mujoco.MjSpec, folder: Path
) -> tuple[dict[mujoco.MjsBody, tuple[float, Float[np.ndarray, "3 3"]]], dict[mujoco.MjsBody, str]]:
    """Replace inertias that MuJoCo refuses, and delete meshes on which no body's inertia depends.

    Returns:
        The mass and inertia of each body that MuJoCo refuses, in the file's axes, and each body's missing mesh that
        would give its inertia.
    """
    compiler, unlike, absent = spec.compiler, {}, {}
    meshes = {mesh.name: mesh for mesh in spec.meshes}
    for geom in [geom for geom in spec.worldbody.geoms if _needs_asset(geom)]:
        spec.delete(geom)
    for body in spec.bodies[1:]:
        giving = [geom for geom in body.geoms if _gives_inertia(geom, body, compiler)]
        missing = [
            geom for geom in giving if _needs_asset(geom) and not _is_there(spec, meshes.get(geom.meshname), folder)
        ]
        if missing:
            mesh = meshes.get(missing[0].meshname)
            absent[body] = missing[0].name if mesh is None else mesh.file
            unlike[body] = 0.0, np.zeros((3, 3))
        elif giving:
            _put_ones(body)
            body.mass, body.explicitinertial, body.ipos = 0.0, False, [np.nan, 0.0, 0.0]
        elif not (compiler.boundmass > 0 and compiler.boundinertia > 0):
            mass, inertia = _explicit(body)
            if not _is_taken(mass, inertia, bool(body.joints), compiler.balanceinertia):
                unlike[body] = mass, inertia
        for geom in [geom for geom in body.geoms if _needs_asset(geom) and (missing or geom not in giving)]:
            spec.delete(geom)
    if compiler.settotalmass > 0 and unlike:
        raise ValueError(f"settotalmass, but without a usable inertia of {listed([b.name for b in unlike])}")
    if compiler.inertiafromgeom == _FROM_GEOM.mjINERTIAFROMGEOM_TRUE:  # each body now states its source
        compiler.inertiafromgeom = _FROM_GEOM.mjINERTIAFROMGEOM_AUTO
    for body in unlike:
        _put_ones(body)
    _delete_unused(spec)
    return unlike, absent


def _gives_inertia(geom: mujoco.MjsGeom, body: mujoco.MjsBody, compiler: mujoco.MjsCompiler) -> bool:
    """Return whether MuJoCo's compiler computes a body's inertia from this geom, among others."""
    never = compiler.inertiafromgeom == _FROM_GEOM.mjINERTIAFROMGEOM_FALSE
    explicit = body.explicitinertial and compiler.inertiafromgeom == _FROM_GEOM.mjINERTIAFROMGEOM_AUTO
    low, high = compiler.inertiagrouprange
    weighs = geom.density > 0 if np.isnan(geom.mass) else geom.mass > 0
    return bool(weighs and low <= geom.group <= high and not (never or explicit or geom.type in _MASSLESS))


def _is_there(spec: mujoco.MjSpec, mesh: mujoco.MjsMesh | None, folder: Path) -> bool:
    if mesh is None or not mesh.file:
        return mesh is not None
    name = Path(mesh.file).name if spec.strippath else mesh.file
    return (
        Path(mesh.file).suffix.lower() in _MESH_FILES
        and (folder / (mesh.compiler.meshdir or spec.meshdir) / name).is_file()
    )


def _explicit(body: mujoco.MjsBody) -> tuple[float, Float[np.ndarray, "3 3"]]:
    """Return mass and inertia from the file, in axes that only compilation resolves."""
    full = np.array(body.fullinertia)
    if np.isnan(full[0]):
        return float(body.mass), np.diag(body.inertia)
    xx, yy, zz, xy, xz, yz = full
    return float(body.mass), np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _is_taken(mass: float, inertia: Float[np.ndarray, "3 3"], moves: bool, balanced: bool) -> bool:
    """Return whether MuJoCo's compiler accepts this mass and inertia of a body."""
    principal = np.linalg.eigvalsh(inertia)
    if mass == 0 and not principal.any():
        return not moves
    least, middle, most = map(float, principal)
    return mass > _LEAST and least > _LEAST and (balanced or least + middle >= most)


def _put_ones(body: mujoco.MjsBody) -> None:
    """Set mass and inertia to 1 but keep the file's axes, which the compiler then resolves."""
    body.mass, body.inertia, body.fullinertia, body.explicitinertial = 1.0, np.ones(3), [np.nan, *np.zeros(5)], True
    if np.isnan(body.ipos[0]):
        body.ipos = np.zeros(3)


def _delete_unused(spec: mujoco.MjSpec) -> None:
    used, geoms = {geom.meshname for geom in spec.geoms}, {geom.name for geom in spec.geoms}
    unused = [mesh for mesh in spec.meshes if mesh.name not in used]
    pairs = [pair for pair in spec.pairs if not {pair.geomname1, pair.geomname2} <= geoms]
    for element in (*unused, *pairs, *spec.hfields):
        spec.delete(element)


def _refuse_no_numbers(source: Source) -> None:
    model = source.model
    fields = {name: getattr(model, name) for name in dir(model) if name.startswith(("body_", "jnt_", "actuator_"))}
    others = ("qpos0", "qpos_spring", "dof_armature", "dof_damping", "dof_frictionloss", "tendon_stiffness", "eq_data")
    fields |= {name: getattr(model, name) for name in others} | {"body_mass": source.mass, "body_ipos": source.centre}
    fields |= {"body_inertia": source.inertia, "timestep": model.opt.timestep, "gravity": model.opt.gravity}
    for name, field in fields.items():
        if not np.isfinite(field).all():
            source.fail(f"{name} has a number that is not finite (nan, inf); correct it")
