"""Reading of a robot's file, MJCF or URDF, for a bench."""

import xml.etree.ElementTree as ET
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from frictionzoo.bench.compiled import can_collide
from frictionzoo.bench.robot_file.actuators import (
    list_movers,
    read_actuators,
    read_armature,
    read_damping,
    read_friction,
)
from frictionzoo.bench.robot_file.controllers import ReadActuator, clip_range, range_of
from frictionzoo.bench.robot_file.couplings import add_contacts, add_equalities, add_tendons
from frictionzoo.bench.robot_file.options import acting, is_fluid, write_option
from frictionzoo.bench.robot_file.source import Source, listed, load
from frictionzoo.bench.robot_file.tree import Tree
from frictionzoo.bench.template import DEFAULT_SOLREFFRICTION, Joints, choose_joints, joint_type
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
        movers: Names of the actuators with a command that move each joint, also those that are not supported.
        ranges: Limits of each joint's position [rad or m]; NaN without a limit.
        forceranges: Torque limits of each joint [N m or N], from joint and actuator; NaN without a limit.
        ctrlranges: Limits of each joint's desired position [rad or m] or velocity [rad/s or m/s]; NaN without a limit.
        delays: Delay of each joint's commands [s]; 0 without an actuator.
        notes: Features that were left out or changed, one line each.
    """

    root: ET.Element
    joints: tuple[str, ...]
    values: Mapping[str, Float[np.ndarray, "nv"]]
    bristles: Mapping[str, Float[np.ndarray, "nv"]]
    actuators: tuple[ReadActuator | None, ...]
    movers: tuple[tuple[str, ...], ...]
    ranges: Float[np.ndarray, "nv 2"]
    forceranges: Float[np.ndarray, "nv 2"]
    ctrlranges: Float[np.ndarray, "nv 2"]
    delays: Float[np.ndarray, "nv"]
    notes: tuple[str, ...]

    @property
    def passive(self) -> tuple[str, ...]:
        """Joints that no actuator moves, in a file whose actuators move other joints."""
        without = tuple(joint for joint, movers in zip(self.joints, self.movers, strict=True) if not movers)
        return without if len(without) < len(self.joints) else ()


def read_robot(
    source: str,
    joint: Joints = None,
    *,
    base: str = "fixed",
    contacts: str = "leave_out",
    limits: str = "leave_out",
    others: str = "fixed",
    keep: Collection[str] = (),
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
    for option, value in {"base": base, "others": others}.items():
        refuse_other(option, value, ("as_is", "fixed"))
    for option, value in {"contacts": contacts, "limits": limits}.items():
        refuse_other(option, value, ("keep", "leave_out"))
    file = load(source)
    model, joints = file.model, _choose_joints(file, joint)
    bodies = [model.body(index).name for index in range(1, model.nbody)]
    for name in keep:
        if name not in bodies:
            file.fail(f"no body {name}; {closest(name, filter(None, bodies))}")
    _say_fixed(file, joints, base, others)
    tree = Tree(file, joints, keep, apart=contacts == "keep" or is_fluid(file))
    for body in range(model.nbody):
        if model.body_plugin[body] >= 0 and tree.moves(body):
            name = file.name("body", body)
            file.fail(f"body {name} moves by a plugin, which is not supported; choose joints that do not move it")
    values, bristles = _values(file, joints), read_friction(file, joints)
    actuators = read_actuators(file, joints)
    root = _write(file, tree, joints, contacts == "keep", limits == "keep")
    if model.opt.integrator in _IMPLICIT:
        damped = [
            file.name("joint", joint)
            for joint, read in zip(joints, actuators, strict=True)
            if read is not None and read.bias2 and not np.isnan(read.forcerange).all()
        ]
        file.note(
            "forcerange of joint {}: while the torque is at its limit, kd damps the step as if it were not, which "
            "MuJoCo's implicit integrators leave out there",
            damped,
        )
    return RobotFile(
        root,
        tuple(model.joint(joint).name for joint in joints),
        values,
        bristles,
        actuators,
        list_movers(file, joints),
        np.array([range_of(model.jnt_range[joint], model.jnt_limited[joint]) for joint in joints]),
        np.array([_force_limit(file, joint, read) for joint, read in zip(joints, actuators, strict=True)]),
        np.array([(np.nan, np.nan) if read is None else read.targets for read in actuators]),
        np.array([0.0 if read is None else read.delay for read in actuators]),
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
    """Return the indices of the joints with these names or regular expressions of whole names; None for all."""
    kinds = map(joint_type, source.model.jnt_type)
    names = {source.model.joint(index).name: index for index, kind in enumerate(kinds) if kind in ("hinge", "slide")}
    if joint is None and "" in names:
        source.fail("it has joints without a name, expected a name for each; list the joints in bench.joint")
    chosen = choose_joints(source.path, ".*" if joint is None else joint, list(names)) if names else []
    if not chosen:
        source.fail(
            "no hinge and no slide is chosen, expected joints that move; set bench.joint, or another bench.mjcf"
        )
    return [names[name] for name in chosen]


def _say_fixed(source: Source, joints: Sequence[int], base: str, others: str) -> None:
    """Note the fixed joints, or refuse to fix them."""
    model, fixed = source.model, [index for index in range(source.model.njnt) if index not in joints]
    bases = [index for index in fixed if joint_type(model.jnt_type[index]) == "free"]
    unchosen = [source.name("joint", index) for index in fixed if index not in bases]
    bodies = [source.name("body", int(model.jnt_bodyid[index])) for index in bases]
    if bodies and base == "as_is":
        source.fail(
            f"bench.base=as_is: body {listed(bodies)} floats, and nothing holds it in rollouts; set bench.base=fixed"
        )
    if unchosen and others == "as_is":
        source.fail(
            f"bench.others=as_is: {len(unchosen)} joints are not chosen ({listed(unchosen)}); choose them or set it to "
            "fixed"
        )
    source.note("floating base: body {} is fixed in its position and orientation from the file", bodies)
    source.note("{n} joints are not chosen and stand at their reference position: {}", unchosen)


def _values(file: Source, joints: Sequence[int]) -> dict[str, Float[np.ndarray, "nv"]]:
    model, dofs = file.model, [file.dof(joint) for joint in joints]
    names = [file.name("joint", joint) for joint in joints]
    bent = [name for name, joint in zip(names, joints, strict=True) if model.jnt_stiffnesspoly[joint].any()]
    file.note("nonlinear springs of joint {}: only the coefficient of qpos is kept", bent)
    pairs = zip(names, dofs, strict=True)
    soft = [name for name, dof in pairs if tuple(model.dof_solref[dof]) != DEFAULT_SOLREFFRICTION]
    solref = " ".join(f"{number:g}" for number in model.dof_solref[dofs[0]])
    file.note(f"solreffriction of joint {{}} ({solref}) left out: bench.solreffriction sets it for all joints", soft)
    values = {
        "armature": read_armature(file, joints),
        "frictionloss": model.dof_frictionloss[dofs].copy(),
        "damping": read_damping(file, joints),
    }
    for quantity, stated in values.items():  # negative after an unbounded fit
        negative = [f"{name} ({value:.3g})" for name, value in zip(names, stated, strict=True) if value < 0]
        file.note(f"{quantity} below 0 in the file is taken as 0: of joint {{}}", negative)
    return {quantity: np.maximum(stated, 0.0) for quantity, stated in values.items()}


def _write(file: Source, tree: Tree, joints: Sequence[int], contacts: bool, limits: bool) -> ET.Element:
    acts = acting(file, "contact")
    touching = acts and bool(file.model.npair or can_collide(file.model))
    if acts and contacts and file.meshes:
        file.note(f"contacts of {file.meshes} geoms that are meshes, or fitted to one, are left out")
    if not contacts and (touching or (acts and file.meshes)):
        correct = "correct if the robot touched nothing, including itself; bench.contacts=keep keeps them"
        file.note(f"contacts are left out: {correct}")
    limited = [file.name("joint", joint) for joint in joints if file.model.jnt_limited[joint]]
    if acting(file, "limit") and not limits:
        correct = "correct if the recorded motion is within them; bench.limits=keep keeps them"
        file.note(f"limits of {{n}} joints are left out: {correct}", limited)
    root = ET.Element("mujoco", {"model": "robot"})
    compiler = {"angle": "radian", "inertiafromgeom": "false", "autolimits": "false"}
    ET.SubElement(root, "compiler", compiler)
    root.append(write_option(file, contacts))
    limits = limits and acting(file, "limit")
    root.append(tree.write(limits))
    if contacts and touching:
        add_contacts(file, root)
    add_tendons(file, tree, joints, root, limits)
    if acting(file, "equality"):
        add_equalities(file, tree, joints, root)
    return root


def _force_limit(file: Source, joint: int, actuator: ReadActuator | None) -> tuple[float, float]:
    """Return the torque range of a joint: the actuator's range, clipped to the joint's `actuatorfrcrange`."""
    model, no_limit = file.model, (np.nan, np.nan)
    limit = range_of(model.jnt_actfrcrange[joint], model.jnt_actfrclimited[joint])
    if not np.isnan(limit[0]) and model.jnt_actgravcomp[joint]:
        alone = "ends the torque of the controller alone, without that of gravity compensation"
        file.note(f"actuatorfrcrange of joint {file.name('joint', joint)}: {alone}")
    return clip_range(no_limit if actuator is None else actuator.torques, limit)
