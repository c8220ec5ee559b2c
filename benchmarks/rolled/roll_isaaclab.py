"""Rollouts with Isaac Lab's actuators on the CPU in 32 bits; MuJoCo C replaces PhysX, which is not run.

Isaac Lab's actuator classes, configured by the exported file, compute the torque in each step. MuJoCo simulates the
bench's links with the file's armature, `dynamic_friction` and `viscous_friction`. It has no counterpart of `friction`,
which holds a joint at rest in PhysX; a file for Newton has this alone, and MuJoCo takes it.

In Isaac Lab 2, `isaaclab.utils.assets` requests a file server from Isaac Sim on import. An empty module replaces it;
only network actuators would call it, and nothing here does.
"""

import sys
from importlib.metadata import distribution, version
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
import torch
from given import Given, load_module, read_given


def main() -> None:
    """Simulate the rollouts of each payload together, one actuator environment per rollout."""
    given, options = read_given(__doc__, lambda parser: parser.add_argument("--target", default="isaaclab"))
    if version("isaaclab").startswith("2."):
        find_isaaclab()
    configs = load_module(given.folder / options.target / "isaaclab_actuators.py").ACTUATORS
    found = np.empty((len(given.qpos), given.steps, len(given.joints)))
    for rollouts in given.alike():
        found[rollouts] = roll(given, configs, rollouts)
    given.write(given.sampled(found), isaaclab=version("isaaclab") + " actuators", mujoco=version("mujoco"))


def find_isaaclab() -> None:
    """Make `isaaclab` the inner package of the installed one; the outer one would start Isaac Sim."""
    sys.path.insert(0, str(distribution("isaaclab").locate_file("isaaclab/source/isaaclab")))
    assets: Any = ModuleType("isaaclab.utils.assets")
    assets.read_file = None
    sys.modules[assets.__name__] = assets


def roll(given: Given, configs: dict[str, Any], rollouts: np.ndarray) -> np.ndarray:
    """Return the positions after each simulation step of these rollouts."""
    actuators = [make_actuator(config.copy(), given.joints, len(rollouts)) for config in configs.values()]
    model = compile_joints(given, actuators, rollouts[0])
    worlds = [mujoco.MjData(model) for _ in rollouts]
    for data, rollout in zip(worlds, rollouts, strict=True):
        data.qpos[:], data.qvel[:] = given.qpos[rollout], given.qvel[rollout]
    targets = np.concatenate([given.targets_before, given.targets], axis=1)[rollouts]
    begin, found = given.targets_before.shape[1], []
    for number in range(targets.shape[1]):
        qpos, qvel = np.stack([data.qpos for data in worlds]), np.stack([data.qvel for data in worlds])
        efforts = np.full(qpos.shape, np.nan)
        for actuator in actuators:
            joints = actuator.joint_indices.numpy()
            late = np.maximum(number - find_lags(given, actuator), 0)
            efforts[:, joints] = compute(actuator, targets[:, late, joints], qpos[:, joints], qvel[:, joints])
        if number < begin:  # these steps only fill the delay buffers
            continue
        for data, effort in zip(worlds, efforts, strict=True):
            data.qfrc_applied[:] = effort
            mujoco.mj_step(model, data)
        found.append([data.qpos.copy() for data in worlds])
    return np.stack(found, axis=1)


def make_actuator(config: Any, joints: list[str], count: int) -> Any:
    """Return the actuator that Isaac Lab's articulation makes from a configuration for a robot without limits."""
    from isaaclab.utils.string import resolve_matching_names

    numbers, names = resolve_matching_names(config.joint_names_expr, joints)
    actuator = config.class_type(config, names, torch.tensor(numbers), count, "cpu")
    assert not actuator.is_implicit_model, "PhysX would compute its torque"
    actuator.reset(range(count))
    return actuator


def compile_joints(given: Given, actuators: list[Any], rollout: int) -> mujoco.MjModel:
    """Compile the bench with the actuators' joint parameters and without its motors."""
    model = mujoco.MjModel.from_xml_string(given.bench("mjcf", rollout, late=False))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    for values in (model.dof_armature, model.dof_frictionloss, model.dof_damping):
        values[:] = np.nan  # each joint gets its actuator's values below
    for actuator in actuators:
        joints = actuator.joint_indices.numpy()
        config = actuator.cfg
        model.dof_armature[joints] = config.armature
        model.dof_frictionloss[joints] = config.friction if config.dynamic_friction is None else config.dynamic_friction
        model.dof_damping[joints] = config.viscous_friction
    return model


def find_lags(given: Given, actuator: Any) -> np.ndarray:
    """Return the steps by which the caller delays commands; 0 if the actuator delays them itself."""
    lags = np.array(given.lags)[actuator.joint_indices.numpy()]
    return 0 * lags if hasattr(actuator, "positions_delay_buffer") else lags


def compute(actuator: Any, targets: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """Return an actuator's torque, clipped to the simulated joint's limit, which Isaac Lab 2 has not by default."""
    from isaaclab.utils.types import ArticulationActions

    none = torch.zeros(targets.shape)
    wanted = ArticulationActions(as_tensor(targets), none, none, actuator.joint_indices)
    efforts = actuator.compute(wanted, as_tensor(qpos), as_tensor(qvel)).joint_efforts
    limit = getattr(actuator.cfg, "joint_effort_limit", None) or np.inf
    return np.clip(efforts.numpy(), -limit, limit)


def as_tensor(values: np.ndarray) -> torch.Tensor:
    """Convert to Isaac Lab's 32 bits."""
    return torch.tensor(values, dtype=torch.float32)


if __name__ == "__main__":
    main()
