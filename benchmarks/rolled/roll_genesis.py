"""Rollouts of the bench's MJCF in Genesis, on the CPU in 64 bits, with delayed commands."""

from typing import Any

import genesis
import mujoco
import numpy as np
from given import Given, load_module, read_given


def main() -> None:
    """Simulate the rollouts of each payload together, one environment per rollout."""
    given, _ = read_given(__doc__)
    module: Any = load_module(given.folder / "mujoco" / "drive.py")
    genesis.init(backend=genesis.cpu, precision="64", logging_level="error")
    found = np.empty((len(given.qpos), given.steps, len(given.joints)))
    for rollouts in given.alike():
        found[rollouts] = roll(given, module, given.bench("mjcf", rollouts[0], late=False), rollouts)
    given.write(given.sampled(found), "genesis-world")


def roll(given: Given, module: Any, text: str, rollouts: np.ndarray) -> np.ndarray:
    """Return the positions after each simulation step; this function computes the torque of the file's actuators."""
    bench, law = mujoco.MjModel.from_xml_string(text), module.Actuator()
    file = given.out.with_suffix(".xml")
    file.write_text(text)
    scene = genesis.Scene(
        sim_options=genesis.options.SimOptions(dt=given.timestep, gravity=tuple(bench.opt.gravity.tolist())),
        rigid_options=genesis.options.RigidOptions(integrator=genesis.integrator.Euler, enable_collision=False),
        show_viewer=False,
    )
    robot = scene.add_entity(genesis.morphs.MJCF(file=str(file)))
    scene.build(n_envs=len(rollouts))
    joints = [robot.get_joint(name) for name in given.joints]
    at, dofs = (
        [index for joint in joints for index in getattr(joint, of)] for of in ("qs_idx_local", "dofs_idx_local")
    )
    gain, bias = bench.actuator_gainprm[:, 0], bench.actuator_biasprm.T
    qpos, qvel, found = given.qpos[rollouts], given.qvel[rollouts], []
    robot.set_qpos(qpos, at)
    robot.set_dofs_velocity(qvel, dofs)
    for number in range(given.steps):
        signals = {name: signal[rollouts, number] for name, signal in given.acting.items()}
        ctrl = law.control(np, module.ACTUATOR, qpos, qvel, signals.pop("ctrl"), signals)
        robot.control_dofs_force(gain * ctrl + bias[0] + bias[1] * qpos + bias[2] * qvel, dofs)
        scene.step()
        qpos, qvel = robot.get_qpos(at).numpy(), robot.get_dofs_velocity(dofs).numpy()
        found.append(qpos)
    return np.stack(found, axis=1)


if __name__ == "__main__":
    main()
