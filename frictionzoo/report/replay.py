"""Replay of a run's long test rollouts in 3D: bodies, their shapes, and joint positions over time."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from frictionzoo.bench import Bench, Robot
from frictionzoo.bench.robot_file import look_at
from frictionzoo.core.errors import BenchError
from frictionzoo.core.units import UNITS
from frictionzoo.report.colors import BASELINE, MEASURED, MODEL, SOFT
from frictionzoo.report.run_plots import choose_rollouts
from frictionzoo.report.text import format_number
from frictionzoo.result.curves import Curves

FRAMES = 30.0  # largest frame rate [1/s]; the page interpolates linearly between frames
POSITIONS = 150_000  # largest number of joint positions in all frames, about 0.5 MB of a page
FINEST = {"hinge": 1e-4, "slide": 1e-5}  # resolution of positions [rad or m]: less than a pixel
FARTHEST = 1e4  # position from which a motion counts as diverged [rad or m]
FACES = 20_000  # largest number of triangles of all meshes together
CELLS = 256  # initial number of grid cells along the longest side of a mesh
MOTIONS = (
    {"name": "this model", "color": MODEL, "opacity": 1.0},
    {"name": "measured", "color": MEASURED, "opacity": 0.3},
    {"name": "no friction", "color": BASELINE, "opacity": 0.6},
)
_THIN, _LIGHT = 0.012, 1e-6  # line thickness relative to the model; mass below which a body is a placeholder [kg]
_HIDDEN = 3  # first geom group that MuJoCo's viewer does not show
_SHAPES = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere",
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): "ellipsoid",
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "cylinder",
    int(mujoco.mjtGeom.mjGEOM_BOX): "box",
    int(mujoco.mjtGeom.mjGEOM_PLANE): "box",
    int(mujoco.mjtGeom.mjGEOM_MESH): "mesh",
}
Shape = dict[str, Any]
"""Shape of a body: `body`, `shape`, `size` as in MuJoCo, `pos` and `quat` in the body's frame."""


def record_replay(bench: Bench, values: Mapping[str, np.ndarray], curves: Curves, timestep: float) -> dict[str, Any]:
    """Return the data from which a page shows a run's long test rollouts in 3D, without names of bodies or joints.

    Quaternions are (x, y, z, w), lengths in m, angles in rad; curves have a sample every `timestep` [s]. An encoder
    offset in the bench's `values` shifts the drawn positions.

    Returns:
        `bodies`, each with `parent`, pose in the parent's frame, and joints; `shapes` and their `meshes`; `scenery`,
        the look of fixed shapes; `rollouts`, best, median and worst first, each with the `positions` of every motion by
        joint and frame in units of `finest`; `count`, the number of long test rollouts; `step` between frames and
        `duration` [s]; `motions` with their looks; `view`, the initial direction of view; `inertia`, whether shapes are
        inertia boxes because the model has no geoms.
    """
    model = _open(bench)
    joints = [model.joint(name).id for name in bench.joints]
    moving = _find_moving(model, joints)
    shapes, meshes = list(_list_geoms(model)), list[dict[str, Any]]()
    for shape in shapes:
        shape["moves"] = bool(moving[shape["body"]])
    inertia = not any(shape["moves"] for shape in shapes)
    if not inertia:
        meshes = _list_meshes(model, shapes)
    elif bench.payload is None:
        shapes += _list_inertia(model, joints, curves)
    offset = values.get("position_offset", np.zeros(bench.nv))
    stride = _space_frames(curves, timestep)
    return {
        "bodies": _list_bodies(model, joints, offset),
        "shapes": shapes,
        "meshes": meshes,
        "inertia": inertia,
        "motions": list(MOTIONS),
        "scenery": {"color": SOFT, "opacity": 1.0},
        "rollouts": list(_list_rollouts(bench, curves, stride, inertia)),
        "count": len(curves.qpos),
        "finest": FINEST[bench.joint_type],
        "step": stride * timestep,
        "duration": timestep * curves.qpos.shape[1],
        "view": _choose_view(model, joints),
    }


def _open(bench: Bench) -> mujoco.MjModel:
    """Return the model to draw: the robot's file with all its geoms, otherwise the simulated model."""
    simulated = bench.compile(constraint=False)
    if not isinstance(bench, Robot):
        return simulated
    try:
        model = look_at(bench.source)
        joints = [model.joint(name).id for name in bench.joints]
    except (BenchError, KeyError):  # the file was changed or removed after the run began
        return simulated
    moving = _find_moving(model, joints)
    return model if any(moving[shape["body"]] for shape in _list_geoms(model)) else simulated


def _find_moving(model: mujoco.MjModel, joints: Sequence[int]) -> Bool[np.ndarray, "nbody"]:
    moving = np.zeros(model.nbody, bool)
    moving[model.jnt_bodyid[list(joints)]] = True
    for body in range(1, model.nbody):
        moving[body] |= moving[model.body_parentid[body]]
    return moving


def _list_bodies(model: mujoco.MjModel, joints: Sequence[int], offset: Float[np.ndarray, "nv"]) -> list[dict[str, Any]]:
    """Return the kinematic tree, world first; all other joints stay at their reference position."""
    bodies = []
    for body in range(model.nbody):
        pose = {"pos": model.body_pos[body].tolist(), "quat": _turn(model.body_quat[body])}
        bodies.append({"parent": int(model.body_parentid[body]), **pose, "joints": []})
    for index, joint in enumerate(joints):
        # MuJoCo's reference position is `qpos0`; the encoder's offset is subtracted from it.
        reference = float(model.qpos0[model.jnt_qposadr[joint]] - offset[index])
        pose = {"pos": model.jnt_pos[joint].tolist(), "axis": model.jnt_axis[joint].tolist()}
        slide = bool(model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE)
        bodies[model.jnt_bodyid[joint]]["joints"].append({"at": index, "slide": slide, "reference": reference, **pose})
    return bodies


def _list_geoms(model: mujoco.MjModel) -> Iterator[Shape]:
    """Yield the geoms that MuJoCo's viewer shows; for a body without visible geoms, all of its geoms."""
    kinds, bodies, clear = model.geom_type, model.geom_bodyid, model.geom_rgba[:, 3] > 0
    drawn = np.isin(kinds, list(_SHAPES)) & clear
    for body in np.unique(bodies[drawn]):
        geoms = np.flatnonzero(drawn & (bodies == body))
        visible = geoms[model.geom_group[geoms] < _HIDDEN]
        for geom in visible if len(visible) else geoms:
            size = model.geom_size[geom].copy()
            if kinds[geom] == mujoco.mjtGeom.mjGEOM_PLANE:  # size 0 means infinite
                size[:2] = np.where(size[:2] > 0, size[:2], 2 * model.stat.extent)
                size[2] = _THIN * model.stat.extent / 4
            shape = _shape(int(body), _SHAPES[int(kinds[geom])], size, model.geom_pos[geom], model.geom_quat[geom])
            shape["backdrop"] = bool(kinds[geom] == mujoco.mjtGeom.mjGEOM_PLANE)
            yield shape | ({"mesh": int(model.geom_dataid[geom])} if shape["shape"] == "mesh" else {})


def _list_inertia(model: mujoco.MjModel, joints: Sequence[int], curves: Curves) -> list[Shape]:
    """Return an inertia box for each moving body, and lines that connect them."""
    moving = _find_moving(model, joints)
    boxes = [box for body in np.flatnonzero(moving) for box in _box_inertia(model, int(body))]
    largest = max((max(box["size"]) for box in boxes), default=float(model.stat.meansize))
    shapes = [*boxes, *_list_links(model, joints, curves, largest)]
    return [shape | {"moves": bool(moving[shape["body"]])} for shape in shapes]


def _box_inertia(model: mujoco.MjModel, body: int) -> list[Shape]:
    """Return the box of uniform density with a body's mass and inertia, as MuJoCo's viewer draws it.

    Source: MuJoCo, `src/engine/engine_vis_visualize.c`, mjVIS_INERTIA.
    """
    mass, inertia = float(model.body_mass[body]), model.body_inertia[body]
    if mass <= _LIGHT:
        return []
    size = np.sqrt(np.maximum(0.0, inertia.sum() - 2 * inertia) * 6 / mass) / 2
    return [_shape(body, "box", size, model.body_ipos[body], model.body_iquat[body])]


def _list_links(model: mujoco.MjModel, joints: Sequence[int], curves: Curves, largest: float) -> Iterator[Shape]:
    """Yield lines between anchors of successive joints and to the links' centres, rails of slides, shafts of hinges."""
    # Computed at the reference position; each line is fixed to one body.
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    owner = {int(model.jnt_bodyid[joint]): joint for joint in joints}
    lines = list[tuple[int, np.ndarray, np.ndarray]]()
    for index, joint in enumerate(joints):
        body, anchor = int(model.jnt_bodyid[joint]), data.xanchor[joint]
        parent = int(model.body_parentid[body])
        previous = parent
        while previous and previous not in owner:
            previous = int(model.body_parentid[previous])
        if previous:
            lines.append((previous, data.xanchor[owner[previous]], anchor))
        if model.body_mass[body] > _LIGHT:
            lines.append((body, anchor, data.xipos[body]))
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
            travel = curves.measured_qpos[:, :, index] - model.qpos0[model.jnt_qposadr[joint]]
            ends = (anchor + end * data.xaxis[joint] for end in (travel.min(), travel.max()))
            lines.append((parent, *ends))
    reach = [float(np.linalg.norm(end - start)) for _, start, end in lines]
    thickness = _THIN / 2 * max([largest, *reach])
    for body, start, end in lines:
        yield from _line(data, body, start, end, thickness)
    for joint in joints:  # shaft of a hinge, fixed to the parent body
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
            parent, shaft = int(model.body_parentid[model.jnt_bodyid[joint]]), 12 * thickness * data.xaxis[joint]
            anchor = data.xanchor[joint]
            yield from _line(data, parent, anchor - shaft, anchor + shaft, 3 * thickness)


def _line(data: mujoco.MjData, body: int, start: np.ndarray, end: np.ndarray, thickness: float) -> Iterator[Shape]:
    axes, quaternion = data.xmat[body].reshape(3, 3), np.zeros(4)
    first, last = ((place - data.xpos[body]) @ axes for place in (start, end))
    length = float(np.linalg.norm(last - first))
    if length > thickness:
        mujoco.mju_quatZ2Vec(quaternion, last - first)
        yield _shape(body, "capsule", np.array([thickness, length / 2, 0.0]), (first + last) / 2, quaternion)


def _shape(body: int, shape: str, size: np.ndarray, pos: np.ndarray, quat: np.ndarray) -> Shape:
    numbers = {"size": _round(size), "pos": _round(pos), "quat": _turn(quat)}
    return {"body": body, "shape": shape, **numbers}


def _list_meshes(model: mujoco.MjModel, shapes: Sequence[Shape]) -> list[dict[str, Any]]:
    """Return the meshes of the shapes, coarse enough for the size limit; renumber them in the shapes."""
    used = sorted({shape["mesh"] for shape in shapes if "mesh" in shape})
    for shape in shapes:
        if "mesh" in shape:
            shape["mesh"] = used.index(shape["mesh"])
    cells = CELLS
    while True:
        meshes = [_coarsen(*_read_mesh(model, mesh), cells) for mesh in used]
        excess = sum(len(mesh["faces"]) for mesh in meshes) / (3 * FACES)
        if excess <= 1 or cells <= 2:
            return meshes
        cells = max(2, int(cells / max(1.1, excess**0.5)))  # the number of triangles falls at most with the square


def _read_mesh(model: mujoco.MjModel, mesh: int) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    vertices, faces = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
    return (
        model.mesh_vert[vertices : vertices + model.mesh_vertnum[mesh]].astype(np.float64),
        model.mesh_face[faces : faces + model.mesh_facenum[mesh]].astype(np.int64),
    )


def _coarsen(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"], cells: int
) -> dict[str, Any]:
    """Coarsen a mesh: merge vertices on a grid with this number of cells along the longest side.

    Source: J. Rossignac, P. Borrel, "Multi-resolution 3D approximations for rendering complex scenes", 1993.
    """
    low = vertices.min(axis=0)
    cell = float(np.ptp(vertices, axis=0).max()) / cells or 1.0
    grid, kept = _unite(np.rint((vertices - low) / cell).astype(np.int64))
    merged = kept[faces]
    flat = (merged == np.roll(merged, 1, axis=1)).any(axis=1)
    # Keep one of several coinciding triangles; they may begin with different corners.
    first = np.argmin(merged, axis=1)[:, None]
    turned, _ = _unite(np.take_along_axis(merged, (first + np.arange(3)) % 3, axis=1)[~flat])
    return {"low": _round(low), "cell": cell, "vertices": grid.ravel().tolist(), "faces": turned.ravel().tolist()}


def _unite(rows: Int[np.ndarray, "rows 3"]) -> tuple[Int[np.ndarray, "different 3"], Int[np.ndarray, "rows"]]:
    """Return the distinct rows of non-negative integers, and the index of each row among them."""
    base = int(rows.max(initial=0)) + 1
    keys, kept = np.unique(rows @ [base * base, base, 1], return_inverse=True)  # one number per row: ten times as fast
    return np.stack([keys // base**2, keys // base % base, keys % base], axis=1), kept


def _space_frames(curves: Curves, timestep: float) -> int:
    """Return the number of samples per frame, from the frame rate and the size limit of the page."""
    samples, joints = curves.measured_qpos.shape[1:]
    room = max(2, POSITIONS // (len(MOTIONS) * joints * len(choose_rollouts(curves))))
    return max(1, int(np.ceil(1 / (FRAMES * timestep) - 1e-9)), -(-samples // room))


def _list_rollouts(bench: Bench, curves: Curves, every: int, inertia: bool) -> Iterator[dict[str, Any]]:
    """Yield best, median and worst rollout, then as many others as the size limit allows."""
    ranks = choose_rollouts(curves)
    names = {rollout: f"{rank}, " if len(curves.qpos) > 1 else "" for rank, rollout in ranks.items()}
    order = [*names, *(rollout for rollout in range(len(curves.qpos)) if rollout not in names)]
    numbers = len(MOTIONS) * curves.qpos.shape[2] * (curves.qpos.shape[1] // every + 1)
    for rollout in order[: max(len(ranks), POSITIONS // numbers)]:
        measured = curves.measured_qpos[rollout]
        simulated = (np.concatenate([measured[:1], motion[rollout]]) for motion in (curves.qpos, curves.baseline_qpos))
        model, baseline = simulated
        positions = [_round_positions(motion[::every], bench) for motion in (model, measured, baseline)]
        error = float(np.abs(model - measured)[1:].mean())  # the first state is measured
        error_text = (
            f"{format_number(error)} {UNITS[bench.joint_type]['position']}" if np.isfinite(error) else "diverged"
        )
        label = f"{names.get(rollout, '')}{rollout + 1} of {len(curves.qpos)}: {error_text}"
        shapes = list[Shape]()
        if inertia and bench.payload is not None:
            loaded = bench.compile(constraint=False)
            bench.put_load(loaded, curves.load[rollout])
            shapes = _list_inertia(loaded, [loaded.joint(name).id for name in bench.joints], curves)
        yield {"rollout": rollout, "label": label, "positions": positions, "shapes": shapes}


def _round_positions(qpos: Float[np.ndarray, "frames nv"], bench: Bench) -> list[list[int]]:
    """Return rounded positions by joint, up to where the motion diverges."""
    bounded = np.logical_and.accumulate((np.abs(qpos) < FARTHEST).all(axis=1))
    return np.rint(qpos[bounded] / FINEST[bench.joint_type]).astype(np.int64).T.tolist()


def _choose_view(model: mujoco.MjModel, joints: Sequence[int]) -> list[float]:
    """Return azimuth and elevation of the camera [rad]: along hinges, across slides, and oblique to show depth."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    axes = np.abs(data.xaxis[list(joints)])
    slides = model.jnt_type[list(joints)] == mujoco.mjtJoint.mjJNT_SLIDE
    along = np.where(slides[:, None], 1 - axes, axes).mean(axis=0)
    azimuth = np.arctan2(-along[1], along[0]) if along[:2].max() > 0.1 else -np.pi / 2
    return _round([azimuth + np.radians(30), np.radians(15 + 40 * along[2] / np.linalg.norm(along))])


def _turn(quaternion: np.ndarray) -> list[float]:
    """Convert a quaternion from MuJoCo's order to the order of three.js."""
    return [float(quaternion[index]) for index in (1, 2, 3, 0)]


def _round(numbers: Sequence[float] | np.ndarray) -> list[float]:
    return [float(f"{number:.6g}") for number in numbers]
