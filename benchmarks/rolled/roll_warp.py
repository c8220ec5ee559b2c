"""Rollouts of the bench's MJCF in MuJoCo Warp on the CPU, in 32 bits, with delayed commands."""

from typing import Any

import mujoco
import mujoco_warp
import numpy as np
import warp
from given import Given, load_module, read_given


def main() -> None:
    """Simulate the rollouts of each payload together, one world per rollout."""
    given, _ = read_given(__doc__)
    module: Any = load_module(given.folder / "mujoco" / "drive.py")
    found = np.empty((len(given.qpos), given.steps, len(given.joints)))
    with warp.ScopedDevice("cpu"):
        for rollouts in given.alike():
            model = mujoco.MjModel.from_xml_string(given.bench("mjcf", rollouts[0], late=False))
            found[rollouts] = roll(given, module, model, rollouts)
    given.write(given.sampled(found), "mujoco-warp", "mujoco")


def roll(given: Given, module: Any, model: mujoco.MjModel, rollouts: np.ndarray) -> np.ndarray:
    """Return the positions after each simulation step of these rollouts."""
    data, law = mujoco.MjData(model), module.Actuator()
    mujoco.mj_forward(model, data)
    on_device = mujoco_warp.put_model(model)
    state = mujoco_warp.put_data(model, data, nworld=len(rollouts))
    state.qpos.assign(given.qpos[rollouts].astype(np.float32))
    state.qvel.assign(given.qvel[rollouts].astype(np.float32))
    found = []
    for number in range(given.steps):
        signals = {name: signal[rollouts, number] for name, signal in given.acting.items()}
        held = state.qpos.numpy(), state.qvel.numpy()
        ctrl = law.control(np, module.ACTUATOR, *held, signals.pop("ctrl"), signals)
        state.ctrl.assign(np.broadcast_to(ctrl, held[1].shape).astype(np.float32))
        mujoco_warp.step(on_device, state)
        found.append(state.qpos.numpy().astype(float))
    return np.stack(found, axis=1)


if __name__ == "__main__":
    main()
