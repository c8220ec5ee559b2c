"""Unmodified robot files as benches, checked against MuJoCo C: `python benchmarks/robot_files.py FILE_OR_FOLDER...`.

Each MJCF or URDF given, directly or in a folder, is read as a bench with all its joints of one degree of freedom. At
random states and commands, one MuJoCo C step of the bench is compared with a step of the maker's file. The maker's file
omits only the parts listed in `notes`: the floating base, contacts, limits.
"""

import argparse
import contextlib
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from measure import make_parser, report

from frictionzoo.bench.robot_file import RobotFile, read_robot
from frictionzoo.core.errors import FrictionzooError

COLUMNS = {"file": "file", "joints": "joints", "lines": "lines", "difference": "difference", "answer": "answer"}
STATES = 200
_ASSETS = {mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_SDF, mujoco.mjtGeom.mjGEOM_HFIELD}
_JOINT_TRANSMISSIONS = {mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT}
_LEFT_OUT = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT


def main() -> None:
    """Read and compare all files, print and write the results."""
    options = parse()
    rows = [describe(path, options.joint, options.notes) for path in find(options.files)]
    report(options.out, rows, COLUMNS, joint=options.joint, states=STATES)


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser("robot_files", __doc__)
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="MJCF, URDF, or a folder of them")
    parser.add_argument("--joint", nargs="*", metavar="NAME", help="names or patterns, all joints by default")
    parser.add_argument("--notes", action="store_true", help="print what was left out or changed")
    return parser.parse_args()


def find(places: Sequence[Path]) -> Iterator[Path]:
    """Yield the files among these places, and all model files in the folders."""
    for place in places:
        yield from sorted([*place.rglob("*.urdf"), *place.rglob("*.xml")]) if place.is_dir() else [place]


def describe(path: Path, joint: Sequence[str] | None, notes: bool = False) -> dict[str, Any]:
    """Read one file and return its row."""
    row: dict[str, Any] = {"file": "/".join(path.parts[-2:]), "joints": None, "lines": None, "difference": None}
    try:
        robot = read_robot(str(path), joint)
    except FrictionzooError as error:
        return row | {"answer": str(error).removeprefix(f"{path}: ")}
    if notes:
        print(f"{path}\n  " + "\n  ".join(robot.notes))
    row |= {"joints": len(robot.joints), "lines": len(robot.notes)}
    try:
        makers = reference(path, robot)
    except (ValueError, RuntimeError) as error:
        return row | {"answer": f"taken; MuJoCo alone does not: {' '.join(str(error).split())}"}
    return row | {"difference": difference(makers, written(robot, makers)), "answer": "taken"}


def reference(path: Path, robot: RobotFile) -> mujoco.MjModel:
    """Compile the maker's file in MuJoCo, without the parts that a bench omits.

    Deletes joints that were not chosen, with their equalities, actuators and tendons that were not read, and meshes of
    bodies that have an inertia or cannot move. Also deletes contact pairs, sensors, keyframes and visual elements, and
    disables contacts and limits.

    Raises:
        ValueError: MuJoCo does not compile it.
    """
    mujoco.set_mju_user_warning(lambda text: None)  # the notes contain its warnings
    spec = _parse(path)
    for element in (*spec.geoms, *spec.sites, *spec.tendons, *spec.meshes):
        element.material = ""
    for kind in ("sensors", "keys", "skins", "textures", "materials", "tuples", "pairs", "excludes"):
        for element in list(getattr(spec, kind)):
            spec.delete(element)
    _delete_unchosen(spec, robot)
    _delete_meshes(spec)
    model = spec.compile()
    model.opt.disableflags |= _LEFT_OUT
    return model


def _parse(path: Path) -> mujoco.MjSpec:
    with contextlib.suppress(ValueError):
        return mujoco.MjSpec.from_file(str(path))
    root = ET.parse(path).getroot()  # a URDF with a duplicate element
    for owner in root.iter("joint"):
        for second in owner.findall("origin")[1:]:
            owner.remove(second)
    return mujoco.MjSpec.from_string(ET.tostring(root, encoding="unicode"))


def _delete_unchosen(spec: mujoco.MjSpec, robot: RobotFile) -> None:
    read = {(name, actuator.name) for name, actuator in zip(robot.joints, robot.actuators, strict=True) if actuator}
    for actuator in list(spec.actuators):
        known = actuator.trntype in _JOINT_TRANSMISSIONS and (actuator.target, actuator.name) in read
        actuator.dyntype = mujoco.mjtDyn.mjDYN_NONE if known else actuator.dyntype
        if not known:
            spec.delete(actuator)
    gone = {joint.name for joint in spec.joints if joint.name not in robot.joints}
    kept = {element.get("name") for element in robot.root.iterfind("./tendon/*")}
    for tendon in [tendon for tendon in spec.tendons if tendon.name not in kept]:
        spec.delete(tendon)
    for equality in list(spec.equalities):
        ends = {equality.name1, equality.name2}
        if ends & gone or not ends & set(robot.joints):
            spec.delete(equality)
    for joint in [joint for joint in spec.joints if joint.name in gone]:
        spec.delete(joint)


def _delete_meshes(spec: mujoco.MjSpec) -> None:
    from_geom = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    for body in spec.bodies:
        for geom in [geom for geom in body.geoms if geom.type in _ASSETS or geom.meshname]:
            visual = geom.mass == 0 or (np.isnan(geom.mass) and geom.density == 0)
            if (body.explicitinertial and not from_geom) or visual or not _moves(body):
                spec.delete(geom)
    used = {geom.meshname for geom in spec.geoms}
    for asset in [*(mesh for mesh in spec.meshes if mesh.name not in used), *spec.hfields]:
        spec.delete(asset)


def _moves(body: mujoco.MjsBody | None) -> bool:
    return body is not None and (bool(body.joints) or _moves(body.parent))


def written(robot: RobotFile, makers: mujoco.MjModel) -> mujoco.MjModel:
    """Compile the bench as read, with its values and actuators, and give both models the same solver options."""
    root = ET.fromstring(ET.tostring(robot.root))
    section = ET.SubElement(root, "actuator")
    found = {element.get("name"): element for element in root.iterfind("./worldbody//joint")}
    for index, (name, actuator) in enumerate(zip(robot.joints, robot.actuators, strict=True)):
        dof = makers.jnt_dofadr[makers.joint(name).id]
        said = {key: values[index] for key, values in robot.values.items()} | {"solreffriction": makers.dof_solref[dof]}
        found[name].attrib.update({key: _numbers(value) for key, value in said.items()})
        if actuator is not None:
            bias = _numbers([actuator.bias0, actuator.bias1, actuator.bias2])
            law = {"gainprm": _numbers(actuator.gain), "biastype": "affine", "biasprm": bias}
            ranges = {"ctrlrange": actuator.ctrlrange, "forcerange": robot.forceranges[index]}
            limited = {key: ends for key, ends in ranges.items() if not np.isnan(ends).any()}
            law |= {key: _numbers(ends) for key, ends in limited.items()}
            law |= {key.replace("range", "limited"): "true" for key in limited}
            ET.SubElement(section, "general", {"name": name, "joint": name, **law})
    model = mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))
    for option in ("integrator", "solver", "iterations", "ls_iterations", "noslip_iterations", "jacobian"):
        setattr(makers.opt, option, getattr(model.opt, option))
    for each in (model, makers):
        each.opt.tolerance = each.opt.ls_tolerance = 0.0
        each.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_WARMSTART
    return model


def _numbers(values: Any) -> str:
    return " ".join(repr(float(value)) for value in np.atleast_1d(values))


def difference(makers: mujoco.MjModel, ours: mujoco.MjModel, states: int = STATES, seed: int = 0) -> float:
    """Return the largest difference of positions or velocities after one step, relative to their largest value or 1."""
    rng, largest = np.random.default_rng(seed), 0.0
    reached = {}
    for _ in range(states):
        qpos, qvel = rng.uniform(-np.pi, np.pi, ours.nq), rng.normal(0, 3, ours.nv)
        share = rng.uniform(-1, 1, ours.njnt)
        for name, model in (("makers", makers), ("ours", ours)):
            data = mujoco.MjData(model)
            data.qpos[:], data.qvel[:] = qpos, qvel
            for actuator in range(model.nu):
                low, high = model.actuator_ctrlrange[actuator] if model.actuator_ctrllimited[actuator] else (-3.0, 3.0)
                of = share[model.actuator_trnid[actuator, 0]]
                data.ctrl[actuator] = (low + high) / 2 + 0.6 * (high - low) * of  # beyond the range too
            mujoco.mj_step(model, data)
            reached[name] = data.qpos.copy(), data.qvel.copy()
        for first, second in zip(reached["makers"], reached["ours"], strict=True):
            scale = max(1.0, float(np.abs(first).max()))
            largest = max(largest, float(np.abs(first - second).max()) / scale)
    return largest


if __name__ == "__main__":
    main()
