"""Target `usd`: a USD layer over a robot's file, for Newton and Isaac Sim."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from frictionzoo.core.errors import ConfigError, ExportError, closest
from frictionzoo.export.base import Export, Target, measure, register_target
from frictionzoo.export.motor import (
    INPUTS,
    Joint,
    Motor,
    list_lacks,
    motors,
    read_inputs,
    run_joints,
    say_common,
    say_not_run,
)
from frictionzoo.export.nearest import find_nearest
from frictionzoo.result.fitted_drive import FittedDrive

FILE = "drive.usda"
_KINDS = {"hinge": ("PhysicsRevoluteJoint", "angular"), "slide": ("PhysicsPrismaticJoint", "linear")}
_STAGE = ("metersPerUnit", "kilogramsPerUnit")  # torque in N m needs 1 of each
_REMARKS = (
    "The layer refers to the robot's file by its present path: change subLayers after you move either of them.",
    "Newton reads newton:armature, newton:friction and newton:damping. PhysX reads physxJoint:armature and the gains; "
    "set its dry and viscous friction in Isaac Lab: target=isaaclab.",
)


@register_target("usd")
class Usd(Target):
    """USD layer over a robot's file, with armature, dry friction, damping and position gains of its joints.

    Source: Newton 1.8.0, `SchemaResolverNewton`; UsdPhysics, `DriveAPI`, whose angular gains are per degree.
    """

    options: ClassVar[Mapping[str, str]] = {
        **INPUTS,
        "into": "the robot's USD file, which stays as it is",
        "joint": "its joint, or several with commas between, by name or path; else those with the drive's names",
    }
    packages: ClassVar[tuple[str, ...]] = ("mujoco", "pxr")

    def write(self, fitted: FittedDrive, folder: Path, options: Mapping[str, str]) -> Export:
        """See `Target.write`."""
        if "into" not in options:
            raise ConfigError("target=usd without a robot's file; give into=ROBOT.usd")
        inputs, nearest = read_inputs(fitted, options), find_nearest(fitted)
        drives, damping = motors(fitted, inputs), nearest.damping + fitted.bench.own_damping
        rows = zip(drives, nearest.bench["armature"], nearest.frictionloss, damping, strict=True)
        joints = [Joint(motor, *map(float, values), lag=0) for motor, *values in rows]
        names = options["joint"].split(",") if "joint" in options else fitted.bench.joints
        if len(names) != fitted.bench.nv:
            raise ConfigError(
                f"joint={options['joint']}: {len(names)} joints, expected {fitted.bench.nv} as identified"
            )
        read = write_layer(folder / FILE, Path(options["into"]), names, joints, fitted.bench.joint_type)
        reasons = [*list_lacks(fitted, nearest), *_list_lacks(drives, fitted)]
        qpos = run_joints(fitted, nearest, read)
        difference = measure("qpos", fitted, qpos, fitted.rollout()[0], reason=", ".join(reasons))
        limits = (say_not_run("Newton"), *say_common(fitted, nearest, inputs, held=("delay",)), *_REMARKS)
        if reasons:
            limits = (*limits, f"The file differs from the drive: {', '.join(reasons)}.")
        return Export((FILE,), (difference,), limits)


def _list_lacks(drives: Sequence[Motor], fitted: FittedDrive) -> list[str]:
    """List in a few words each what a USD drive lacks."""
    lacks = ["no torque limit that falls with velocity"] if any(math.isfinite(d.velocity_limit) for d in drives) else []
    return lacks + (
        ["no command delay"] if fitted.values["bench"].get("delay", 0 * fitted.bench.own_damping).any() else []
    )


def write_layer(path: Path, robot: Path, names: Sequence[str], joints: Sequence[Joint], kind: str) -> list[Joint]:
    """Write the layer over a robot's file and return its joints, read back.

    Args:
        path: The layer.
        robot: The robot's USD file.
        names: Name or path of each joint's prim.
        joints: Values of each joint; command delays are left out.
        kind: `hinge` or `slide`.

    Raises:
        ExportError: The robot's file cannot be read, or is not in meters and kilograms.
        ConfigError: It lacks a joint, or a name is that of several.
    """
    from pxr import Sdf, Usd, UsdPhysics

    stage = _open(robot)
    paths = [_find_joint(stage, robot, name, kind) for name in names]
    layer = Sdf.Layer.CreateNew(str(path))
    layer.subLayerPaths = [str(robot.resolve())]
    over = Usd.Stage.Open(layer)
    for key in ("defaultPrim", "upAxis", *_STAGE):  # a stage takes these from its strongest layer alone
        if stage.HasAuthoredMetadata(key):
            over.SetMetadata(key, stage.GetMetadata(key))
    per_degree = math.pi / 180 if kind == "hinge" else 1.0
    number = Sdf.ValueTypeNames.Float
    for place, joint in zip(paths, joints, strict=True):
        prim = over.OverridePrim(place)
        values = {
            **{"newton:armature": joint.armature, "physxJoint:armature": joint.armature},
            **{"newton:friction": joint.frictionloss, "newton:damping": joint.damping * per_degree},
        }
        prim.AddAppliedSchema("PhysxJointAPI")
        for name, value in values.items():
            prim.CreateAttribute(name, number).Set(value)
        drive = UsdPhysics.DriveAPI.Apply(prim, _KINDS[kind][1])
        drive.CreateTypeAttr("force")
        drive.CreateStiffnessAttr(joint.motor.stiffness * per_degree)
        drive.CreateDampingAttr(joint.motor.damping * per_degree)
        drive.CreateMaxForceAttr(joint.motor.effort_limit)
    layer.Save()
    again = Usd.Stage.Open(str(path))
    return [_read_joint(again.GetPrimAtPath(place), kind, per_degree) for place in paths]


def _open(robot: Path) -> Any:
    from pxr import Tf, Usd

    if not robot.is_file():
        raise ExportError(f"{robot}: no such file, expected a robot's USD file; change into")
    try:
        stage = Usd.Stage.Open(str(robot))
    except Tf.ErrorException as error:
        raise ExportError(f"{robot}: USD cannot read it, expected .usd, .usda, .usdc or .usdz; change into") from error
    for key in _STAGE:
        default = 1.0 if key == "kilogramsPerUnit" else 0.01
        value = stage.GetMetadata(key) if stage.HasAuthoredMetadata(key) else default
        if value != 1.0:
            raise ExportError(f"{robot}: {key} is {value:g}, expected 1, so that torque is in N m; convert the file")
    return stage


def _find_joint(stage: Any, robot: Path, name: str, kind: str) -> Any:
    """Return the path of a joint's prim: of this path or name, or of this name as importers make it valid."""
    from pxr import Tf

    type_name = _KINDS[kind][0]
    joints = [prim for prim in stage.Traverse() if prim.GetTypeName() == type_name]
    matching = [prim for prim in joints if name in (str(prim.GetPath()), prim.GetName())] or [
        prim for prim in joints if prim.GetName() == Tf.MakeValidIdentifier(name)
    ]
    if len(matching) == 1:
        return matching[0].GetPath()
    if matching:
        listed = ", ".join(str(prim.GetPath()) for prim in matching[:3])
        raise ConfigError(f"joint={name}: {len(matching)} joints of {robot}, expected one; give its path: {listed}")
    known = closest(name, [prim.GetName() for prim in joints])
    raise ConfigError(f"joint={name}: {robot} has no {type_name} of this name; {known}")


def _read_joint(prim: Any, kind: str, per_degree: float) -> Joint:
    from pxr import UsdPhysics

    armature, loss, damping = (
        prim.GetAttribute(f"newton:{name}").Get() for name in ("armature", "friction", "damping")
    )
    drive = UsdPhysics.DriveAPI(prim, _KINDS[kind][1])
    stiffness, rate = drive.GetStiffnessAttr().Get() / per_degree, drive.GetDampingAttr().Get() / per_degree
    motor = Motor(stiffness, rate, effort_limit=drive.GetMaxForceAttr().Get())
    return Joint(motor, armature, loss, damping / per_degree, 0)
