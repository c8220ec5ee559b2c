"""An identified drive in the joints of a robot's file, MJCF or URDF."""

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.parsers import expat

import mujoco
import numpy as np
from jaxtyping import Float

from frictionzoo.bench import Affine
from frictionzoo.bench.delay import stretch, write_delay
from frictionzoo.bench.robot_file.actuators import list_at, read_actuators, read_armature, read_damping, read_friction
from frictionzoo.bench.robot_file.source import Source, load
from frictionzoo.bench.template import in_full
from frictionzoo.core.errors import ConfigError, ExportError, closest
from frictionzoo.export.in_place import InPlace, Tag
from frictionzoo.export.nearest import Nearest, say_law
from frictionzoo.export.simulate import LATE
from frictionzoo.result.fitted_drive import FittedDrive
from frictionzoo.result.simulator import RK4

_JOINT = ("armature", "solreffriction", "frictionloss", "damping")
_PLAIN = {"dyntype": "none", "gaintype": "fixed", "gear": "1 0 0 0 0 0"}  # override the robot's defaults
_NAMED = 3  # largest number of joints that are listed by name
_SAME = 1e-12  # relative tolerance of a value read back
_UNLIMITED = np.array([np.nan, np.nan])
ACTUATORS = ("identified", "keep")


@dataclass(frozen=True)
class Equipped:
    """A robot's file with identified joints.

    Attributes:
        urdf: Whether the file is URDF, else MJCF.
        column: Column of each joint in the drive's values.
        model: The compiled file with all joints and actuators, without meshes, sensors and keyframes.
        remark: The changes, for a comment in the file.
        notes: Remarks for the user, a sentence each.
        unknown: Names of bodies that move with the joints and have no inertia in the model.
    """

    content: bytes
    urdf: bool
    joints: tuple[str, ...]
    column: tuple[int, ...]
    model: mujoco.MjModel
    remark: str
    notes: tuple[str, ...]
    unknown: tuple[str, ...]

    def commented(self, *sentences: str) -> "Equipped":
        """Return the robot with a comment at the top of the file: the changes, then these sentences."""
        file = InPlace.read(self.content)
        file.remark(" ".join([self.remark, *sentences]))
        return replace(self, content=file.write())


def _refuse_other_bench(path: Path, fitted: FittedDrive) -> None:
    """Refuse the recorded robot's file if the bench differs from it in what is not written."""
    if path != Path(fitted.bench.source):
        return
    if fitted.bench.inertia:
        links = ", ".join(list(fitted.bench.inertia)[:3])
        raise ExportError(
            f"into={path}: the inertias of {links} and others were identified too, expected those of the file; take "
            "the bench that was simulated, which has them"
        )
    if fitted.bench.gravity is not None:
        numbers = ", ".join(f"{number:.4g}" for number in fitted.bench.gravity)
        raise ExportError(
            f"into={path}: gravity was ({numbers}), expected that of the file; take the bench that was "
            "simulated, which has it"
        )


def put_into(
    path: Path, joints: Sequence[str], actuators: str, fitted: FittedDrive, nearest: Nearest, bench: str
) -> Equipped:
    """Put the drive into joints of a robot's MJCF or URDF, and leave all other bytes unchanged.

    A drive with one joint is put into each named joint; a drive with several joints needs as many names. `actuators` is
    `identified`, which replaces or adds the joints' actuators, or `keep`. For a drive from `at`, an MJCF also gets the
    time step and the integrator. Meshes may be missing. The result is read back and checked; it has no comment yet.

    Raises:
        ConfigError: The file or a joint does not exist.
        BenchError: MuJoCo cannot load the robot.
        ExportError: A joint has another type, the drive has other inertias or gravity than the file, or the file cannot
            hold the drive.
    """
    _refuse_other_bench(path, fitted)
    file, urdf = _read(path)
    tags = {name: tag for tag in file.tags if _is_joint(tag) and (name := tag.attributes.get("name"))}
    columns = _match(path, joints, list(tags), fitted)
    before, notes = load(str(path), file.content), list[str]()
    kind = fitted.bench.joint_type
    for name in joints:
        if before.model.joint(name).type[0] != getattr(mujoco.mjtJoint, f"mjJNT_{kind.upper()}"):
            raise ExportError(
                f"joint={name}: another type of joint in {path}, expected a {kind} as the drive's; name another"
            )
    timestep = float(before.model.opt.timestep)
    if fitted.origin is not None and not urdf:
        notes, timestep = _change_option(file, before.model.opt, fitted), fitted.timestep
    template = ET.fromstring(bench)
    for name, column in zip(joints, columns, strict=True):
        if urdf:
            _write_dynamics(file, tags[name], nearest, fitted.bench.own_damping, column)
            continue
        general = template.findall("./actuator/general")[column]
        template_joint = next(
            element for element in template.iter("joint") if element.get("name") == general.get("joint")
        )
        file.set(tags[name], {attribute: template_joint.get(attribute, "0") for attribute in _JOINT})
        if actuators == "identified":
            law = {key: value for key, value in general.attrib.items() if key not in ("name", "joint", *LATE)}
            law["biasprm"] = in_full([bias[column] for bias in meant(fitted, nearest)[1:]])
            if "delay" in nearest.bench and not fitted.bench.actuator.needs_state:
                law |= write_delay(float(write_late(fitted, nearest, timestep)["delay"][column]), timestep)
            notes += _write_actuator(file, name, law, before)
    changed = "armature, frictionloss, damping, solreffriction" + (" and actuator" if actuators == "identified" else "")
    remark = nearest.remark or say_law(fitted.model)
    comment = f"frictionzoo: {'dynamics' if urdf else changed} of {say_joints(joints)} identified. {remark}"
    after = load(str(path), file.write())
    _refuse_keys(file, path, before.model, after.model)
    changes = comment, tuple(dict.fromkeys(notes)), _list_unknown(after, joints)
    robot = Equipped(file.write(), urdf, tuple(joints), columns, after.model, *changes)
    _refuse_unlike(after, robot, fitted, nearest, actuators == "identified" and not urdf)
    return robot


def offset_of(fitted: FittedDrive) -> Float[np.ndarray, "nv"]:
    """Return the offset of true from recorded positions [rad or m]."""
    return fitted.values["bench"].get("position_offset", np.zeros(fitted.bench.nv))


def say_whole(path: Path, robot: Equipped) -> tuple[str, ...]:
    """Compile the whole file with meshes in MuJoCo; return a sentence if neither it nor the original compiles.

    Raises:
        ExportError: MuJoCo compiles only the original.
    """
    failure = _compile(robot.content, path)
    if failure is None:
        return ()
    if _compile(path.read_bytes(), path) is None:
        raise ExportError(f"into={path}: with the drive in it, MuJoCo does not compile it ({failure}); fix it")
    return (f"MuJoCo does not compile it here, nor the original ({failure}): it was checked without meshes.",)


def _compile(content: bytes, path: Path) -> str | None:
    """Compile a file at this path; return MuJoCo's error, or None."""
    try:
        spec = mujoco.MjSpec.from_string(ET.tostring(ET.fromstring(content), encoding="unicode"))
        spec.modelfiledir = str(path.resolve().parent)
        spec.compile()
    except (ValueError, RuntimeError) as error:
        return " ".join(str(error).split())
    return None


def _read(path: Path) -> tuple[InPlace, bool]:
    try:
        file = InPlace.read(path.read_bytes())
    except (OSError, expat.ExpatError) as error:
        reason = error.strerror if isinstance(error, OSError) else f"not XML ({error})"
        raise ConfigError(f"into={path}: {reason}; expected an MJCF or URDF file; name one") from None
    root = file.tags[0].name
    if root not in ("mujoco", "robot"):
        raise ConfigError(f"into={path}: <{root}>, expected <mujoco> (MJCF) or <robot> (URDF); name such a file")
    if any(tag.name == "include" for tag in file.tags):
        raise ConfigError(f"into={path}: it has an <include>, expected one self-contained file; flatten it first")
    return file, root == "robot"


def _is_joint(tag: Tag) -> bool:
    """Return whether an element is a joint of the robot, not of its equalities, tendons, defaults or transmissions."""
    return tag.name == "joint" and (tag.path[:2] == ("mujoco", "worldbody") or tag.path == ("robot",))


def _match(path: Path, joints: Sequence[str], found: Sequence[str], fitted: FittedDrive) -> tuple[int, ...]:
    for name in joints:
        if name not in found:
            raise ConfigError(f"joint={name}: no such joint in {path}; {closest(name, found)}")
    if len(set(joints)) < len(joints):
        raise ConfigError(f"joint={','.join(joints)}: expected each joint once; change it")
    if fitted.bench.nv == 1:
        return (0,) * len(joints)
    if len(joints) != fitted.bench.nv:
        raise ConfigError(
            f"joint={','.join(joints)}: {len(joints)} joints, expected {fitted.bench.nv} in the order of "
            f"{', '.join(fitted.bench.joints)}; name as many"
        )
    return tuple(range(fitted.bench.nv))


def say_joints(joints: Sequence[str]) -> str:
    """Name joints for a sentence; more than a few are counted."""
    return f"{len(joints)} joints" if len(joints) > _NAMED else ", ".join(joints)


def _write_dynamics(file: InPlace, joint: Tag, nearest: Nearest, own_damping: np.ndarray, column: int) -> None:
    """Write friction and damping of a URDF joint, and the armature as a comment, since URDF has no armature."""
    attributes = {
        "damping": in_full(nearest.damping[column] + own_damping[column]),
        "friction": in_full(nearest.frictionloss[column]),
    }
    dynamics = next((tag for tag in file.tags if tag.owner is joint and tag.name == "dynamics"), None)
    if dynamics is None:
        file.append(joint, ET.Element("dynamics", attributes))
    else:
        file.set(dynamics, attributes)
    armature = in_full(nearest.bench["armature"][column])
    file.append(joint, ET.Comment(f" armature {armature}: URDF has no place for it "))


def meant(fitted: FittedDrive, nearest: Nearest) -> Affine:
    """Return the actuators' coefficients for true positions; the bench's are for encoder positions."""
    law = fitted.bench.actuator.affine(nearest.bench)
    return law._replace(bias0=law.bias0 - law.bias1 * offset_of(fitted))


def write_late(fitted: FittedDrive, nearest: Nearest, timestep: float) -> dict[str, Float[np.ndarray, "nv"]]:
    """Return the delays [s] of the actuators for this time step [s]; empty without a delay."""
    delays = {name: value for name, value in nearest.bench.items() if name == "delay"}
    return {name: stretch(value, timestep) for name, value in delays.items()} if fitted.integrator == RK4 else delays


def set_option(file: InPlace, fitted: FittedDrive) -> None:
    """Write time step and integrator of the drive into the `option` element of an MJCF."""
    attributes = {"timestep": in_full(fitted.timestep), "integrator": fitted.integrator}
    options = [tag for tag in file.tags if tag.path == ("mujoco",) and tag.name == "option"]
    for tag in options:
        file.set(tag, attributes)
    if not options:
        file.append(file.tags[0], ET.Element("option", attributes))


def _change_option(file: InPlace, option: mujoco.MjOption, fitted: FittedDrive) -> list[str]:
    """Write time step and integrator if the file has others; return a sentence on the change."""
    current, wanted = mujoco.mjtIntegrator(option.integrator).name.removeprefix("mjINT_"), fitted.integrator
    # Parameters for implicitfast also hold for implicit.
    if np.isclose(option.timestep, fitted.timestep, rtol=1e-6) and wanted.lower().startswith(current.lower()):
        return []
    set_option(file, fitted)
    return [
        f"Its <option> has timestep {fitted.timestep:g} and integrator {wanted}, for which the parameters are valid, "
        f"instead of {option.timestep:g} and {current}; the options timestep and integrator select others."
    ]


def _list_unknown(after: Source, joints: Sequence[str]) -> tuple[str, ...]:
    """Name the bodies moved by these joints whose inertia MuJoCo rejects, or whose mesh is missing."""
    model, ids, moved = after.model, {after.model.joint(name).id for name in joints}, np.zeros(after.model.nbody, bool)
    for body in range(1, model.nbody):
        start = model.body_jntadr[body]
        identified = ids & set(range(start, start + model.body_jntnum[body]))
        moved[body] = moved[model.body_parentid[body]] or bool(identified)
    return tuple(after.name("body", body) for body in np.flatnonzero(moved & ~after.compiled).tolist())


def _write_actuator(file: InPlace, joint: str, law: dict[str, str], before: Source) -> list[str]:
    """Write a joint's actuator with these attributes into an MJCF, within the limits of the robot's actuator."""
    sections = [tag for tag in file.tags if tag.path == ("mujoco",) and tag.name == "actuator"]
    elements = [tag for tag in file.tags if any(tag.owner is section for section in sections)]
    old = [tag for tag in elements if joint in (tag.attributes.get("joint"), tag.attributes.get("jointinparent"))]
    friction_motors = [tag for tag in old if tag.name == "dcmotor" and tag.attributes.get("input") == "none"]
    for tag in friction_motors:  # the identified friction includes its friction
        file.remove(tag)
    old = [tag for tag in old if tag not in friction_motors]
    if len(old) > 1:
        raise ConfigError(f"joint={joint}: {len(old)} actuators, expected one at most; set actuator=keep")
    name = old[0].attributes.get("name") if old else joint
    identity = {} if name is None else {"name": name}
    limits, notes = _list_limits(before, joint, law)
    if friction_motors:
        notes.append(
            f"The <dcmotor> of joint {joint} without a command is left out: the identified friction replaces it."
        )
    new = ET.Element("general", {**identity, "joint": joint, **limits, **_PLAIN, **law})
    if old:
        file.replace(old[0], new)
    elif sections:
        file.append(sections[-1], new)
    else:
        section = ET.Element("actuator")
        section.append(new)
        file.append(file.tags[0], section)
    return notes


def _list_limits(before: Source, joint: str, law: Mapping[str, str]) -> tuple[dict[str, str], list[str]]:
    """Return group and ranges of a joint's actuator as attributes of an actuator without class and gear, and remarks.

    The command range stays, in the unit of the new actuator, if both actuators take positions, velocities or torques.
    If a position controller replaces a motor, the motor's command range limits the force. `law` has the new `gainprm`
    and `biasprm`.
    """
    index = before.model.joint(joint).id
    actuators = list_at(before.model, index)
    if not actuators:
        return _as_attributes(_UNLIMITED, _UNLIMITED, 0), []
    group = int(before.model.actuator_group[actuators[0]])
    (read,) = read_actuators(before, [index])
    if read is None:
        limits = _as_attributes(_UNLIMITED, _UNLIMITED, group)
        return limits, [f"The limits of joint {joint}'s previous actuator are left out."]
    gain, (_, bias1, bias2) = float(law["gainprm"]), map(float, law["biasprm"].split())
    ctrl, force, notes = np.array(read.ctrlrange), np.array(read.forcerange), []
    if read.bias1 and bias1:
        ctrl = _ordered(ctrl * (read.gain / read.bias1) * (bias1 / gain))
    elif read.kind == "velocity" and bias2 == -gain and not bias1:
        ctrl = _ordered(ctrl * (read.gain / read.bias2) * (bias2 / gain))
    elif read.kind == "motor" and not (bias1 or bias2):
        ctrl = _ordered(ctrl * (read.gain / gain))
    elif read.kind == "motor" and np.isfinite(ctrl).all():
        low, high = _ordered(ctrl * read.gain)
        force, ctrl = np.array([np.fmax(force[0], low), np.fmin(force[1], high)]), _UNLIMITED
        notes = ["The motors' command ranges limit the force: a command is no longer a torque."]
    elif np.isfinite(ctrl).all():
        notes = ["Command ranges are left out: the identified actuators have other commands."]
        ctrl = _UNLIMITED
    return _as_attributes(ctrl, force, group), notes


def _ordered(ends: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
    return np.sort(ends) if np.isfinite(ends).all() else ends


def _as_attributes(ctrl: Float[np.ndarray, "2"], force: Float[np.ndarray, "2"], group: int) -> dict[str, str]:
    """Write all limits explicitly, to override the robot's defaults."""
    attributes = {"group": str(group)} if group else {}
    for name, ends in (("ctrl", ctrl), ("force", force)):
        limited = bool(np.isfinite(ends).all())
        attributes[f"{name}limited"] = str(limited).lower()
        if limited:
            attributes[f"{name}range"] = in_full(ends)
    return attributes


def _refuse_keys(file: InPlace, path: Path, before: mujoco.MjModel, after: mujoco.MjModel) -> None:
    # MuJoCo rejects keyframes with another number of commands or activations.
    for attribute, number, now in (("ctrl", before.nu, after.nu), ("act", before.na, after.na)):
        keys = [tag for tag in file.tags if tag.name == "key" and attribute in tag.attributes]
        if keys and number != now:
            raise ExportError(
                f"into={path}: its keyframes have {attribute} of {number} actuators, expected {now} with the drive; "
                f"remove {attribute} from them, or set actuator=keep"
            )


def _refuse_unlike(after: Source, robot: Equipped, fitted: FittedDrive, nearest: Nearest, actuators: bool) -> None:
    """Read the written file back, and refuse values changed by the file's defaults or other actuators."""
    ids = [after.model.joint(name).id for name in robot.joints]
    if not np.isnan(read_friction(after, ids)["stiffness"]).all():
        raise ExportError(
            f"into={after.path}: a <dcmotor> keeps its bristles, which would add to the friction that was identified; "
            "remove its lugre, or leave actuator out"
        )
    loss = after.model.dof_frictionloss[[after.dof(joint) for joint in ids]]
    pairs = {
        "frictionloss": (nearest.frictionloss, loss),
        "damping": (nearest.damping + fitted.bench.own_damping, read_damping(after, ids)),
    }
    if not robot.urdf:
        pairs["armature"] = nearest.bench["armature"], read_armature(after, ids)
    if actuators:
        law, read = meant(fitted, nearest), read_actuators(after, ids)
        for name in Affine._fields:
            actual = np.array([getattr(actuator, name, np.nan) for actuator in read])
            pairs[f"{name} of the actuator"] = getattr(law, name), actual
    for quantity, (expected, actual) in pairs.items():
        for name, value, wanted in zip(robot.joints, actual, expected[list(robot.column)], strict=True):
            if not np.isclose(value, wanted, rtol=_SAME, atol=0):
                raise ExportError(
                    f"into={after.path}: {quantity} of joint {name} comes out as {value:.6g}, expected {wanted:.6g}: "
                    "defaults or actuators of the file add to it; remove that from there"
                )
