"""Rollouts in mjlab on the CPU in 32 bits: the bench's joints with the exported actuators, which delay commands."""

import xml.etree.ElementTree as ElementTree
from typing import Any

import mujoco
import numpy as np
import torch
from given import Given, load_module, read_given
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.scene import Scene, SceneCfg
from mjlab.sim import MujocoCfg, Simulation, SimulationCfg


def main() -> None:
    """Simulate the rollouts of each payload together, one world per rollout."""
    given, _ = read_given(__doc__)
    module: Any = load_module(given.folder / "mjlab" / "mjlab_actuators.py")
    found = np.empty((len(given.qpos), given.steps, len(given.joints)))
    for rollouts in given.alike():
        found[rollouts] = roll(given, module, strip(given.bench("mjcf", rollouts[0])), rollouts)
    packages = ("better-actuator-models",) if hasattr(module, "EVENTS") else ()
    given.write(given.sampled(found), "mjlab", *packages, "mujoco-warp")


def strip(text: str) -> str:
    """Return the bench without the parts that the actuators' file provides."""
    root = ElementTree.fromstring(text)
    for section in root.findall("actuator"):
        root.remove(section)
    for joint in root.iter("joint"):
        for name in ("armature", "frictionloss", "damping"):
            joint.attrib.pop(name, None)
    return ElementTree.tostring(root, encoding="unicode")


def roll(given: Given, module: Any, text: str, rollouts: np.ndarray) -> np.ndarray:
    """Return the positions after each simulation step of these rollouts."""
    option = mujoco.MjModel.from_xml_string(text).opt
    robot = EntityCfg(
        spec_fn=lambda: mujoco.MjSpec.from_string(text),
        articulation=EntityArticulationInfoCfg(actuators=module.ACTUATORS),
    )
    scene = Scene(SceneCfg(num_envs=len(rollouts), env_spacing=0.0, entities={"robot": robot}), device="cpu")
    config = MujocoCfg(
        timestep=given.timestep,
        integrator="euler",
        iterations=option.iterations,
        tolerance=option.tolerance,
        gravity=tuple(option.gravity.tolist()),
    )
    sim = Simulation(len(rollouts), SimulationCfg(mujoco=config), scene.compile(), device="cpu")
    scene.initialize(sim.mj_model, sim.model, sim.data)
    if hasattr(module, "EVENTS"):  # of BAM, which writes the friction of each world; an environment's manager does this
        sim.expand_model_fields(("dof_frictionloss", "dof_damping"))
    entity = scene["robot"]
    joints, _ = entity.find_joints(given.joints, preserve_order=True)

    def aim(targets: np.ndarray) -> None:
        entity.set_joint_position_target(as_tensor(targets), joint_ids=joints)
        scene.write_data_to_sim()

    entity.write_joint_state_to_sim(as_tensor(given.qpos[rollouts]), as_tensor(given.qvel[rollouts]), joint_ids=joints)
    for number in range(given.targets_before.shape[1]):
        aim(given.targets_before[rollouts, number])  # fills the delay buffers
    found = []
    for number in range(given.steps):
        aim(given.targets[rollouts, number])
        sim.step()
        scene.update(given.timestep)
        found.append(entity.data.joint_pos[:, joints].cpu().numpy().astype(float))
    return np.stack(found, axis=1)


def as_tensor(values: np.ndarray) -> torch.Tensor:
    """Convert to mjlab's 32 bits."""
    return torch.tensor(values, dtype=torch.float32)


if __name__ == "__main__":
    main()
