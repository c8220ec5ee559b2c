"""Reading of a robot's file, MJCF or URDF, for a bench."""

import re
import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from frictionzoo.bench.compiled import can_collide
from frictionzoo.bench.robot_file.actuators import read_actuators, read_armature, read_damping, read_friction
from frictionzoo.bench.robot_file.controllers import ReadActuator, clip_range, range_of
from frictionzoo.bench.robot_file.couplings import add_contacts, add_equalities, add_tendons
from frictionzoo.bench.robot_file.options import acting, is_fluid, write_option
from frictionzoo.bench.robot_file.source import Source, listed, load
from frictionzoo.bench.robot_file.tree import Link, Tree
from frictionzoo.bench.template import (
    DEFAULT_SOLREFFRICTION,
    Joints,
    joint_type,
    read_joints,
    read_timestep,
    refuse_other_order,
)
from frictionzoo.core.errors import ConfigError, closest

_IMPLICIT = {mujoco.mjtIntegrator.mjINT_IMPLICIT, mujoco.mjtIntegrator.mjINT_IMPLICITFAST}


@dataclass(frozen=True)
class RobotFile:
    """Data of a robot's file for a bench.

    Attributes:
        root: Self-contained MJCF of the selected joints, in radians, with a fixed base, without friction, damping,
            armature and actuators at these joints, without meshes and sensors.
        values: `armature` [kg m^2 or kg], `frictionloss` [N m or N] and `damping` [N m s/rad or N s/m] of each joint,
            including its actuators'.
        bristles: Friction of the `<dcmotor>`s, by the parameter names of `lugre`; NaN for a joint without bristles.
        actuators: None for a joint without a supported actuator.
        ranges: Limits of each joint's position [rad or m]; NaN without a limit.
        forceranges: Torque limits of each joint [N m or N], from joint and actuator; NaN without a limit.
        ctrlranges: Limits of each joint's desired position [rad or m]; NaN without a limit.
        delays: Delay of each joint's commands [s]; 0 without an actuator.
        links: All moving bodies, and those kept by name.
        notes: Features that were left out or changed, one line each.
    """

    root: ET.Element
    joints: tuple[str, ...]
    values: Mapping[str, Float[np.ndarray, "nv"]]
    bristles: Mapping[str, Float[np.ndarray, "nv"]]
    actuators: tuple[ReadActuator | None, ...]
    ranges: Float[np.ndarray, "nv 2"]
    forceranges: Float[np.ndarray, "nv 2"]
    ctrlranges: Float[np.ndarray, "nv 2"]
    delays: Float[np.ndarray, "nv"]
    links: tuple[Link, ...]
    notes: tuple[str, ...]


def read_robot(
    source: str,
    joint: Joints = None,
    *,
    base: str = "fixed",
    contacts: str = "leave_out",
    limits: str = "leave_out",
    others: str = "fixed",
    keep: Collection[str] = (),
    timestep: float | str | None = None,
) -> RobotFile:
    """Read a robot's file; for the options, see `Robot`.

    With the file's values and actuators added, the result moves like the manufacturer's file with all other joints
    welded. Bodies without a selected joint between them are fused, except those named in `keep`. Meshes are opened only
    if a body's inertia depends on them.

    Raises:
        BenchError: The file cannot be read, lacks these joints or bodies, or has an unsupported feature that affects
            the motion.
        ConfigError: An option has an invalid value.
    """
    refuse_other("base", base, ("as_is", "fixed"))
    refuse_other("others", others, ("as_is", "fixed"))
    refuse_other("contacts", contacts, ("keep", "leave_out"))
    refuse_other("limits", limits, ("keep", "leave_out"))
    step = read_timestep(timestep)
    file = load(source)
    joints = _choose_joints(file, joint)
    bodies = [file.model.body(index).name for index in range(1, file.model.nbody)]
    for name in keep:
        if name not in bodies:
            file.fail(f"no body {name}; {closest(name, filter(None, bodies))}")
    _say_fixed(file, joints, base, others)
    apart = contacts == "keep" or is_fluid(file)
    tree = Tree(file, joints, keep, apart)
    _refuse_plugins(file, tree)
    values, bristles = _values(file, joints), read_friction(file, joints)
    actuators = read_actuators(file, joints)
    root = _write(file, tree, joints, contacts == "keep", limits == "keep", step)
    file.notes += _say_damped_limits(joints, actuators, file)
    return RobotFile(
        root,
        tuple(file.model.joint(joint).name for joint in joints),
        values,
        bristles,
        actuators,
        np.array([range_of(file.model.jnt_range[joint], file.model.jnt_limited[joint]) for joint in joints]),
        np.array([_force_limit(file, joint, read) for joint, read in zip(joints, actuators, strict=True)]),
        np.array([(np.nan, np.nan) if read is None else read.positions for read in actuators]),
        np.array([0.0 if read is None else read.delay for read in actuators]),
        tree.links,
        tuple(dict.fromkeys(file.notes)),
    )


def refuse_other(option: str, value: str, choices: Sequence[str]) -> None:
    """Refuse a value of an option that is not one of the `choices`.

    Raises:
        ConfigError: The value is another.
    """
    if value not in choices:
        raise ConfigError(f"bench.{option}={value}: no such choice; {closest(str(value), choices)}")


def _choose_joints(source: Source, joint: Joints) -> list[int]:
    """Return the indices of the joints with these names or regular expressions of whole names, in MuJoCo's order."""
    kinds = {index: joint_type(kind) for index, kind in enumerate(source.model.jnt_type)}
    names = {source.model.joint(index).name: index for index, kind in kinds.items() if kind in ("hinge", "slide")}
    if joint is None:
        if "" in names:
            source.fail("it has joints without a name, expected a name for each; list the joints in bench.joint")
        wanted = [".*"]
    else:
        wanted = read_joints(joint)
    if not names or not wanted:
        source.fail(
            "no hinge and no slide is chosen, expected joints that move; set bench.joint, or another bench.mjcf"
        )
    for name in wanted:
        if name not in names and not _matching(name, names):
            indices = [index for index in kinds if source.model.joint(index).name == name]
            problem = (
                f"joint {name} is a {kinds[indices[0]]} joint, expected a hinge or a slide"
                if indices
                else f"no joint {name}"
            )
            source.fail(f"{problem}; {closest(name, filter(None, names))}; set bench.joint")
    refuse_other_order(source.path, [name for name in wanted if name in names], names)
    return sorted({index for name in wanted for index in ([names[name]] if name in names else _matching(name, names))})


def _matching(pattern: str, names: dict[str, int]) -> list[int]:
    try:
        return [index for name, index in names.items() if name and re.fullmatch(pattern, name)]
    except re.error:
        return []


def _say_fixed(source: Source, joints: Sequence[int], base: str, others: str) -> None:
    """Note the fixed joints, or refuse to fix them."""
    model, fixed = source.model, [index for index in range(source.model.njnt) if index not in joints]
    bases = [index for index in fixed if joint_type(model.jnt_type[index]) == "free"]
    unchosen = [index for index in fixed if index not in bases]
    if bases:
        bodies = listed([source.name(int(model.jnt_bodyid[index])) for index in bases])
        if base == "as_is":
            source.fail(
                f"bench.base=as_is: body {bodies} floats, and nothing holds it in rollouts; set bench.base=fixed"
            )
        source.notes.append(f"floating base: body {bodies} is fixed in its position and orientation from the file")
    if unchosen:
        names = listed([model.joint(index).name or f"number {index}" for index in unchosen])
        if others == "as_is":
            source.fail(
                f"bench.others=as_is: {len(unchosen)} joints are not chosen ({names}); choose them or set it to fixed"
            )
        balls = sum(joint_type(model.jnt_type[index]) == "ball" for index in unchosen)
        which = f", {balls} of them ball joints," if balls else ""
        source.notes.append(
            f"{len(unchosen)} joints are not chosen{which} and stand at their reference position: {names}"
        )


def _refuse_plugins(file: Source, tree: Tree) -> None:
    for body in range(file.model.nbody):
        if file.model.body_plugin[body] >= 0 and tree.moves(body):
            file.fail(
                f"body {file.name(body)} moves by a plugin, which is not supported; choose joints that do not move it"
            )


def _values(file: Source, joints: Sequence[int]) -> dict[str, Float[np.ndarray, "nv"]]:
    model, dofs = file.model, [file.dof(joint) for joint in joints]
    nonlinear = [model.joint(joint).name for joint in joints if model.jnt_stiffnesspoly[joint].any()]
    if nonlinear:
        file.notes.append(f"nonlinear springs of joint {listed(nonlinear)}: only the coefficient of qpos is kept")
    pairs = zip(joints, dofs, strict=True)
    soft = [model.joint(joint).name for joint, dof in pairs if tuple(model.dof_solref[dof]) != DEFAULT_SOLREFFRICTION]
    if soft:
        stated = " ".join(f"{number:g}" for number in model.dof_solref[dofs[0]])
        file.notes.append(
            f"solreffriction of joint {listed(soft)} ({stated}) left out: bench.solreffriction sets it for all joints"
        )
    stated = {
        "armature": read_armature(file, joints),
        "frictionloss": model.dof_frictionloss[dofs].copy(),
        "damping": read_damping(file, joints),
    }
    return {name: _at_least_zero(file, joints, name, values) for name, values in stated.items()}


def _at_least_zero(
    file: Source, joints: Sequence[int], name: str, values: Float[np.ndarray, "nv"]
) -> Float[np.ndarray, "nv"]:
    """Return the values with negative ones, possible after an unbounded fit, set to 0 and noted."""
    pairs = zip(joints, values, strict=True)
    negative = [f"{file.model.joint(joint).name} ({value:.3g})" for joint, value in pairs if value < 0]
    if negative:
        file.notes.append(f"{name} below 0 in the file is taken as 0: of joint {listed(negative)}")
    return np.maximum(values, 0.0)


def _write(
    file: Source, tree: Tree, joints: Sequence[int], contacts: bool, limits: bool, timestep: float | None
) -> ET.Element:
    acts = acting(file, "contact")
    touching = acts and bool(file.model.npair or can_collide(file.model))
    if acts and contacts and file.meshes:
        file.notes.append(f"contacts of {file.meshes} geoms that are meshes, or fitted to one, are left out")
    file.notes += _say_left_out(file, joints, acts and bool(touching or file.meshes) and not contacts, not limits)
    root = ET.Element("mujoco", {"model": "robot"})
    compiler = {"angle": "radian", "inertiafromgeom": "false", "autolimits": "false"}
    ET.SubElement(root, "compiler", compiler)
    root.append(write_option(file, timestep, contacts))
    limits = limits and acting(file, "limit")
    root.append(tree.write(limits))
    if contacts and touching:
        add_contacts(file, root)
    add_tendons(file, tree, joints, root, limits)
    if acting(file, "equality"):
        add_equalities(file, tree, joints, root)
    return root


def _say_left_out(file: Source, joints: Sequence[int], contacts: bool, limits: bool) -> Iterator[str]:
    """Yield a note for omitted contacts and limits, with the condition under which omission is correct."""
    limited = [joint for joint in joints if file.model.jnt_limited[joint]]
    if contacts:
        yield (
            "contacts are left out: correct if the robot touched nothing, including itself; "
            "bench.contacts=keep keeps them"
        )
    if limits and limited and acting(file, "limit"):
        yield (
            f"limits of {len(limited)} joints are left out: correct if the recorded motion is within them; "
            "bench.limits=keep keeps them"
        )


def _force_limit(file: Source, joint: int, actuator: ReadActuator | None) -> tuple[float, float]:
    """Return the torque range of a joint: the actuator's range, clipped to the joint's `actuatorfrcrange`."""
    model, no_limit = file.model, (np.nan, np.nan)
    limit = range_of(model.jnt_actfrcrange[joint], model.jnt_actfrclimited[joint])
    if not np.isnan(limit[0]) and model.jnt_actgravcomp[joint]:
        file.notes.append(
            f"actuatorfrcrange of joint {model.joint(joint).name}: ends the torque of the controller alone, without "
            "that of gravity compensation"
        )
    return clip_range(no_limit if actuator is None else actuator.torques, limit)


def _say_damped_limits(joints: Sequence[int], actuators: Sequence[ReadActuator | None], file: Source) -> Iterator[str]:
    """Yield a note on joints whose damping at the torque limit MuJoCo's implicit integrators omit."""
    if file.model.opt.integrator not in _IMPLICIT:
        return
    names = [
        file.model.joint(joint).name
        for joint, read in zip(joints, actuators, strict=True)
        if read is not None and read.bias2 and not np.isnan(read.forcerange).all()
    ]
    if names:
        yield (
            f"forcerange of joint {listed(names)}: while the torque is at its limit, kd damps the step as if it were "
            "not, which MuJoCo's implicit integrators leave out there"
        )
