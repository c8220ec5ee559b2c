"""The long test rollouts of a run as motion in space: bodies, what is drawn of them, and joint positions over time."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from frictionzoo.bench import Bench, Robot
from frictionzoo.bench.robot_file import look_at
from frictionzoo.core.errors import BenchError
from frictionzoo.core.params import UNITS
from frictionzoo.result.curves import Curves
from frictionzoo.show.colors import BASELINE, MEASURED, MODEL, SOFT
from frictionzoo.show.run_plots import choose_rollouts
from frictionzoo.show.text import format_number

FRAMES = 30.0  # at most so many a second; the page draws straight lines between them
POSITIONS = 150_000  # of joints in all frames, about 0.5 MB of a page
FINEST = {"hinge": 1e-4, "slide": 1e-5}  # rad or m to which positions are rounded: less than a pixel
FARTHEST = 1e4  # rad or m from where a motion counts as diverged
FACES = 20_000  # triangles of all meshes together
CELLS = 256  # of a mesh along its longest side, at first
MOTIONS = (
    {"name": "this model", "color": MODEL, "opacity": 1.0},
    {"name": "measured", "color": MEASURED, "opacity": 0.3},
    {"name": "no friction", "color": BASELINE, "opacity": 0.6},
)
_THIN, _LIGHT = 0.012, 1e-6  # share of the size of all; kg, below which a body only fills MuJoCo's want of a mass
_HIDDEN = 3  # the first of the groups of geoms that MuJoCo's viewer does not show
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
"""What is drawn of a body: `body`, `shape`, `size` as MuJoCo has it, `pos` and `quat` in the body's frame."""


def record_replay(bench: Bench, values: Mapping[str, np.ndarray], curves: Curves, timestep: float) -> dict[str, Any]:
    """All that a page needs to show a run's long test rollouts in space; without names.

    Quaternions are (x, y, z, w), lengths in m, angles in rad.

    Args:
        bench: As it was simulated.
        values: Its identified parameters: an encoder's offset moves what is drawn.
        curves: Of the run.
        timestep: Between the samples of the curves [s].

    Returns:
        `bodies`, each with its `parent`, its place in it and its joints; `shapes`, and `meshes` of them; `rollouts`,
        those that the page speaks of first, each with `positions` of every motion, by joint and frame in units of
        `finest`; `step` between frames and `duration` [s]; `motions` with their looks; `view`, from where one looks at
        first; and `inertia`, whether shapes are boxes of inertia because the model has no others.
    """
    model = _open(bench)
    joints = [model.joint(name).id for name in bench.joints]
    moving = _find_moving(model, joints)
    shapes, meshes = list(_list_geoms(model)), list[dict[str, Any]]()
    inertia = not any(moving[shape["body"]] for shape in shapes)
    if not inertia:
        meshes = _list_meshes(model, shapes)
    elif bench.payload is None:
        shapes += _list_inertia(model, joints, curves)
    for shape in shapes:
        shape["moves"] = bool(moving[shape["body"]])
    offset = values.get("position_offset", np.zeros(bench.nv))
    every = _space_frames(curves, timestep)
    return {
        "bodies": _list_bodies(model, joints, offset),
        "shapes": shapes,
        "meshes": meshes,
        "inertia": inertia,
        "motions": list(MOTIONS),
        "scenery": {"color": SOFT, "opacity": 1.0},
        "rollouts": list(_list_rollouts(bench, curves, every, inertia)),
        "count": len(curves.qpos),
        "finest": FINEST[bench.joint_type],
        "step": every * timestep,
        "duration": timestep * curves.qpos.shape[1],
        "view": _choose_view(model, joints),
    }


def _open(bench: Bench) -> mujoco.MjModel:
    """The model to be drawn: a robot's own file with all that it shows, or else what was simulated."""
    simulated = bench.compile(constraint=False)
    if not isinstance(bench, Robot):
        return simulated
    try:
        model = look_at(bench.source)
        joints = [model.joint(name).id for name in bench.joints]
    except (BenchError, KeyError):  # it has changed, or gone, since the run began
        return simulated
    moving = _find_moving(model, joints)
    return model if any(moving[shape["body"]] for shape in _list_geoms(model)) else simulated


def _find_moving(model: mujoco.MjModel, joints: Sequence[int]) -> Bool[np.ndarray, "nbody"]:
    """Which bodies these joints move."""
    moving = np.zeros(model.nbody, bool)
    moving[model.jnt_bodyid[list(joints)]] = True
    for body in range(1, model.nbody):
        moving[body] |= moving[model.body_parentid[body]]
    return moving


def _list_bodies(model: mujoco.MjModel, joints: Sequence[int], offset: Float[np.ndarray, "nv"]) -> list[dict[str, Any]]:
    """The kinematic tree, the world first; joints that are not among these stand at their reference position."""
    bodies = []
    for body in range(model.nbody):
        place = {"pos": model.body_pos[body].tolist(), "quat": _turn(model.body_quat[body])}
        bodies.append({"parent": int(model.body_parentid[body]), **place, "joints": []})
    for at, joint in enumerate(joints):
        # MuJoCo's joint is at its reference where `qpos` is `qpos0`; what the encoder lacks comes on top.
        reference = float(model.qpos0[model.jnt_qposadr[joint]] - offset[at])
        place = {"pos": model.jnt_pos[joint].tolist(), "axis": model.jnt_axis[joint].tolist()}
        slide = bool(model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE)
        bodies[model.jnt_bodyid[joint]]["joints"].append({"at": at, "slide": slide, "reference": reference, **place})
    return bodies


def _list_geoms(model: mujoco.MjModel) -> Iterator[Shape]:
    """What MuJoCo's viewer would show of each body; of one that it hides all of, all."""
    kinds, bodies, clear = model.geom_type, model.geom_bodyid, model.geom_rgba[:, 3] > 0
    drawn = np.isin(kinds, list(_SHAPES)) & clear
    for body in np.unique(bodies[drawn]):
        own = np.flatnonzero(drawn & (bodies == body))
        visible = own[model.geom_group[own] < _HIDDEN]
        for geom in visible if len(visible) else own:
            size = model.geom_size[geom].copy()
            if kinds[geom] == mujoco.mjtGeom.mjGEOM_PLANE:  # 0 is without an end
                size[:2] = np.where(size[:2] > 0, size[:2], 2 * model.stat.extent)
                size[2] = _THIN * model.stat.extent / 4
            shape = _shape(int(body), _SHAPES[int(kinds[geom])], size, model.geom_pos[geom], model.geom_quat[geom])
            shape["backdrop"] = bool(kinds[geom] == mujoco.mjtGeom.mjGEOM_PLANE)
            yield shape | ({"mesh": int(model.geom_dataid[geom])} if shape["shape"] == "mesh" else {})


def _list_inertia(model: mujoco.MjModel, joints: Sequence[int], curves: Curves) -> list[Shape]:
    """A box of each moving body's inertia, and lines by which they hang together."""
    moving = _find_moving(model, joints)
    boxes = [box for body in np.flatnonzero(moving) for box in _box_inertia(model, int(body))]
    largest = max((max(box["size"]) for box in boxes), default=float(model.stat.meansize))
    shapes = [*boxes, *_list_links(model, joints, curves, largest)]
    return [shape | {"moves": bool(moving[shape["body"]])} for shape in shapes]


def _box_inertia(model: mujoco.MjModel, body: int) -> list[Shape]:
    """The box of uniform density with a body's mass and inertia, as MuJoCo's viewer draws it.

    Source: MuJoCo, `src/engine/engine_vis_visualize.c`, mjVIS_INERTIA.
    """
    mass, inertia = float(model.body_mass[body]), model.body_inertia[body]
    if mass <= _LIGHT:
        return []
    size = np.sqrt(np.maximum(0.0, inertia.sum() - 2 * inertia) * 6 / mass) / 2
    return [_shape(body, "box", size, model.body_ipos[body], model.body_iquat[body])]


def _list_links(model: mujoco.MjModel, joints: Sequence[int], curves: Curves, largest: float) -> Iterator[Shape]:
    """Lines from a joint's anchor to those of the next joints, from the last to its link's centre, and a rail."""
    # Places at the reference position; between joints of one body and the next they stay as they are.
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    owner = {int(model.jnt_bodyid[joint]): joint for joint in joints}
    lines = list[tuple[int, np.ndarray, np.ndarray]]()
    for at, joint in enumerate(joints):
        body, anchor = int(model.jnt_bodyid[joint]), data.xanchor[joint]
        above = int(model.body_parentid[body])
        before = above
        while before and before not in owner:
            before = int(model.body_parentid[before])
        if before:
            lines.append((before, data.xanchor[owner[before]], anchor))
        if model.body_mass[body] > _LIGHT:
            lines.append((body, anchor, data.xipos[body]))
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
            moved = curves.measured_qpos[:, :, at] - model.qpos0[model.jnt_qposadr[joint]]
            ends = (anchor + end * data.xaxis[joint] for end in (moved.min(), moved.max()))
            lines.append((above, *ends))
    reach = [float(np.linalg.norm(end - start)) for _, start, end in lines]
    thickness = _THIN / 2 * max([largest, *reach])
    for body, start, end in lines:
        yield from _line(data, body, start, end, thickness)
    for joint in joints:  # the shaft of a hinge, on the side that holds it
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
            above, shaft = int(model.body_parentid[model.jnt_bodyid[joint]]), 12 * thickness * data.xaxis[joint]
            anchor = data.xanchor[joint]
            yield from _line(data, above, anchor - shaft, anchor + shaft, 3 * thickness)


def _line(data: mujoco.MjData, body: int, start: np.ndarray, end: np.ndarray, thickness: float) -> Iterator[Shape]:
    """A thin capsule between two places in the world, which a body carries."""
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
    """The meshes of shapes, which are numbered anew; coarser, until all together are small enough."""
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
        cells = max(2, int(cells / max(1.1, excess**0.5)))  # triangles fall at most by the square of it


def _read_mesh(model: mujoco.MjModel, mesh: int) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    vertices, faces = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
    return (
        model.mesh_vert[vertices : vertices + model.mesh_vertnum[mesh]].astype(np.float64),
        model.mesh_face[faces : faces + model.mesh_facenum[mesh]].astype(np.int64),
    )


def _coarsen(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"], cells: int
) -> dict[str, Any]:
    """A mesh whose vertices lie on a grid of so many cells along its longest side; those of one cell become one.

    Source: J. Rossignac, P. Borrel, "Multi-resolution 3D approximations for rendering complex scenes", 1993.
    """
    low = vertices.min(axis=0)
    cell = float(np.ptp(vertices, axis=0).max()) / cells or 1.0
    grid, kept = _unite(np.rint((vertices - low) / cell).astype(np.int64))
    merged = kept[faces]
    flat = (merged == np.roll(merged, 1, axis=1)).any(axis=1)
    # One of several triangles that fell together, whichever corner each begins with.
    first = np.argmin(merged, axis=1)[:, None]
    turned, _ = _unite(np.take_along_axis(merged, (first + np.arange(3)) % 3, axis=1)[~flat])
    return {"low": _round(low), "cell": cell, "vertices": grid.ravel().tolist(), "faces": turned.ravel().tolist()}


def _unite(rows: Int[np.ndarray, "rows 3"]) -> tuple[Int[np.ndarray, "different 3"], Int[np.ndarray, "rows"]]:
    """The rows that differ, of numbers from 0, and which of them each row is."""
    base = int(rows.max(initial=0)) + 1
    keys, kept = np.unique(rows @ [base * base, base, 1], return_inverse=True)  # as one number a row, ten times as fast
    return np.stack([keys // base**2, keys // base % base, keys % base], axis=1), kept


def _space_frames(curves: Curves, timestep: float) -> int:
    """Samples from frame to frame: no more frames than are seen, and than a page has room for."""
    samples, joints = curves.measured_qpos.shape[1:]
    room = max(2, POSITIONS // (len(MOTIONS) * joints * len(choose_rollouts(curves))))
    return max(1, int(np.ceil(1 / (FRAMES * timestep) - 1e-9)), -(-samples // room))


def _list_rollouts(bench: Bench, curves: Curves, every: int, inertia: bool) -> Iterator[dict[str, Any]]:
    """The rollouts that the page speaks of, and of the others as many as there is room for."""
    ranks = choose_rollouts(curves)
    names = {rollout: f"{rank}, " if len(curves.qpos) > 1 else "" for rank, rollout in ranks.items()}
    order = [*names, *(rollout for rollout in range(len(curves.qpos)) if rollout not in names)]
    numbers = len(MOTIONS) * curves.qpos.shape[2] * (curves.qpos.shape[1] // every + 1)
    for rollout in order[: max(len(ranks), POSITIONS // numbers)]:
        measured = curves.measured_qpos[rollout]
        simulated = (np.concatenate([measured[:1], each[rollout]]) for each in (curves.qpos, curves.baseline_qpos))
        model, baseline = simulated
        positions = [_round_positions(each[::every], bench) for each in (model, measured, baseline)]
        error = float(np.abs(model - measured)[1:].mean())  # the first state is measured
        said = f"{format_number(error)} {UNITS[bench.joint_type]['position']}" if np.isfinite(error) else "diverged"
        label = f"{names.get(rollout, '')}{rollout + 1} of {len(curves.qpos)}: {said}"
        shapes = _list_carried(bench, curves, rollout) if inertia else []
        yield {"rollout": rollout, "label": label, "positions": positions, "shapes": shapes}


def _list_carried(bench: Bench, curves: Curves, rollout: int) -> list[Shape]:
    """Inertia with the payload of a rollout, of a bench that carries any."""
    if bench.payload is None:
        return []
    model = bench.compile(constraint=False)
    bench.put_load(model, curves.load[rollout])
    return _list_inertia(model, [model.joint(name).id for name in bench.joints], curves)


def _round_positions(qpos: Float[np.ndarray, "frames nv"], bench: Bench) -> list[list[int]]:
    """By joint, as far as the motion has not diverged."""
    near = np.logical_and.accumulate((np.abs(qpos) < FARTHEST).all(axis=1))
    return np.rint(qpos[near] / FINEST[bench.joint_type]).astype(np.int64).T.tolist()


def _choose_view(model: mujoco.MjModel, joints: Sequence[int]) -> list[float]:
    """Azimuth and elevation of the eye [rad]: along hinges and across slides, and askew so that depth is seen."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    axes = np.abs(data.xaxis[list(joints)])
    slides = model.jnt_type[list(joints)] == mujoco.mjtJoint.mjJNT_SLIDE
    along = np.where(slides[:, None], 1 - axes, axes).mean(axis=0)
    azimuth = np.arctan2(-along[1], along[0]) if along[:2].max() > 0.1 else -np.pi / 2
    return _round([azimuth + np.radians(30), np.radians(15 + 40 * along[2] / np.linalg.norm(along))])


def _turn(quaternion: np.ndarray) -> list[float]:
    """From MuJoCo's order to that of three.js."""
    return [float(quaternion[at]) for at in (1, 2, 3, 0)]


def _round(numbers: Sequence[float] | np.ndarray) -> list[float]:
    return [float(f"{number:.6g}") for number in numbers]
