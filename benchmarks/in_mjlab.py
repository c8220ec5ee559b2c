"""Effect of `target=randomisation` events in mjlab: `python benchmarks/in_mjlab.py EXPORT`, with mjlab's Python.

Creates an mjlab environment with the exported drive, `nominal.xml`, in many worlds on the CPU, once with DRAWS and once
with RANGES of `mjlab_events.py`. Lists the model fields that differ between worlds, with their ranges. Then simulates
all worlds under one command, and some of them (`--compared`) in MuJoCo C with the values of the world.
"""

import argparse
import importlib.util
import json
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
from measure import make_parser, print_table

FIELDS = {  # field of mjlab's model, entry, sign
    "joint.armature": ("dof_armature", None, 1.0),
    "joint.frictionloss": ("dof_frictionloss", None, 1.0),
    "joint.damping": ("dof_damping", None, 1.0),
    "actuator.stiffness": ("actuator_gainprm", 0, 1.0),
    "actuator.damping": ("actuator_biasprm", 2, -1.0),
}
SET = ("dof_armature", "dof_frictionloss", "dof_damping", "actuator_gainprm", "actuator_biasprm")


def main() -> None:
    """Apply both kinds of events, print and write their changes."""
    arguments = parse()
    folder = arguments.export.resolve()
    events, rows, motions = load_events(folder / "mjlab_events.py"), [], []
    with np.load(folder / "samples.npz") as samples:
        known = dict(samples)
    for kind in ("DRAWS", "RANGES"):
        env = make_environment(folder / "nominal.xml", getattr(events, kind), arguments.worlds)
        fields = {name: np.asarray(getattr(env.sim.model, name)[:].cpu()) for name in SET}
        worlds = {name: read_field(env.sim.mj_model, fields, name, known["joints"].tolist()) for name in FIELDS}
        rows += list_rows(kind, known, worlds)
        motions.append({"events": kind, **compare_motion(env, fields, arguments.steps, arguments.compared)})
    columns = ("events", "field", "joint", "unit", "nominal", "low", "high", "least", "most", "apart")
    print_table(rows, dict(zip(columns, columns, strict=True)))
    print_table(motions)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps({"rows": rows, "motions": motions}, indent=2) + "\n")


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser("in_mjlab", __doc__)
    parser.add_argument("export", type=Path, metavar="EXPORT", help="folder that target=randomisation wrote")
    parser.add_argument("--worlds", type=int, default=1024, help="of the environment")
    parser.add_argument("--steps", type=int, default=500, help="of the simulation, in which worlds are compared")
    parser.add_argument("--compared", type=int, default=8, help="worlds that MuJoCo C simulates too")
    return parser.parse_args()


def load_events(path: Path) -> ModuleType:
    """Load the file as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def make_environment(model: Path, events: dict[str, Any], worlds: int) -> Any:
    """Return an mjlab environment without actions and rewards, with its events applied."""
    # mjlab has a separate Python environment: it needs another version of MuJoCo.
    from mjlab.actuator import XmlActuatorCfg  # pyright: ignore[reportMissingImports]
    from mjlab.entity import EntityArticulationInfoCfg, EntityCfg  # pyright: ignore[reportMissingImports]
    from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg  # pyright: ignore[reportMissingImports]
    from mjlab.scene import SceneCfg  # pyright: ignore[reportMissingImports]
    from mjlab.sim import MujocoCfg, SimulationCfg  # pyright: ignore[reportMissingImports]

    spec = mujoco.MjSpec.from_file(str(model))
    one_each = tuple(
        XmlActuatorCfg(target_names_expr=(f"^{actuator.target}$",), command_field="position")
        for actuator in spec.actuators
    )
    robot = EntityCfg(
        spec_fn=lambda: mujoco.MjSpec.from_file(str(model)),
        articulation=EntityArticulationInfoCfg(actuators=one_each),
    )
    step = MujocoCfg(timestep=spec.option.timestep, integrator="euler")
    config = ManagerBasedRlEnvCfg(
        decimation=1,
        scene=SceneCfg(num_envs=worlds, entities={"robot": robot}),
        events=dict(events),
        sim=SimulationCfg(mujoco=step),
        seed=0,
    )
    return ManagerBasedRlEnv(config, device="cpu")


def list_rows(kind: str, known: dict[str, np.ndarray], worlds: dict[str, np.ndarray]) -> Iterator[dict[str, Any]]:
    """Yield a row for each quantity that differs between worlds and each joint: exported values and values in mjlab.

    For DRAWS, `apart` is the largest distance between a world and its nearest drive in samples.npz: the largest
    difference over all quantities, as a share of their ranges.
    """
    names = known["names"].tolist()
    varied = [name for name in FIELDS if name in names]
    wide = {name: known["high"][names.index(name)] - known["low"][names.index(name)] for name in varied}
    varied = [name for name in varied if (wide[name] > 0).any()]
    apart = None
    if kind == "DRAWS":
        found, drawn = (
            np.concatenate([of[name][:, wide[name] > 0] / wide[name][wide[name] > 0] for name in varied], axis=1)
            for of in (worlds, known)
        )
        apart = max(float(np.abs(drawn - one).max(axis=1).min()) for one in found)
    for name in varied:
        at = names.index(name)
        for joint, own in enumerate(known["joints"].tolist()):
            values = worlds[name][:, joint]
            yield {
                **{"events": kind, "field": FIELDS[name][0], "joint": own, "unit": str(known["units"][at])},
                **{end: float(known[end][at, joint]) for end in ("nominal", "low", "high")},
                **{"least": float(values.min()), "most": float(values.max()), "apart": apart},
            }


def read_field(model: Any, fields: dict[str, np.ndarray], name: str, joints: list[str]) -> np.ndarray:
    """Return a quantity of these joints in all worlds, of shape (worlds, nv)."""
    field, entry, sign = FIELDS[name]
    ids = [model.joint(f"robot/{joint}").id for joint in joints]
    if entry is None:
        return fields[field][:, model.jnt_dofadr[ids]]
    actuators = [model.actuator_trnid[:, 0].tolist().index(joint) for joint in ids]
    return sign * fields[field][:, actuators, entry]


def compare_motion(env: Any, fields: dict[str, np.ndarray], steps: int, compared: int) -> dict[str, Any]:
    """Return the distance of worlds (float32) from MuJoCo C with their values, and from each other [rad or m]."""
    import torch

    model, found = env.sim.mj_model, []
    ctrl = 0.5 * np.sin(6 * model.opt.timestep * np.arange(steps))
    for command in ctrl:
        env.sim.data.ctrl[:] = torch.full_like(env.sim.data.ctrl[:], command)
        env.sim.step()
        found.append(np.asarray(env.sim.data.qpos[:].cpu()).copy())
    qpos, largest = np.array(found), 0.0
    for world in range(compared):
        for name, field in fields.items():
            getattr(model, name)[:] = field[min(world, len(field) - 1)]  # worlds share fields that no event changes
        data = mujoco.MjData(model)
        mujoco.mj_setConst(model, data)
        mujoco.mj_resetData(model, data)
        for at, command in enumerate(ctrl):
            data.ctrl[:] = command
            mujoco.mj_step(model, data)
            largest = max(largest, float(np.abs(data.qpos - qpos[at, world]).max()))
    return {"steps": steps, "from MuJoCo C": largest, "between worlds": float(np.ptp(qpos, axis=1).max())}


if __name__ == "__main__":
    main()
