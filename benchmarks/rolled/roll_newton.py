"""Rollouts of the bench's MJCF in Newton's MuJoCo solver on the CPU, with delayed commands."""

from typing import Any

import newton
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
            found[rollouts] = roll(given, module, rollouts)
    given.write(given.sampled(found), "newton", "mujoco-warp")


def roll(given: Given, module: Any, rollouts: np.ndarray) -> np.ndarray:
    """Return the positions after each simulation step of these rollouts."""
    bench, builder, law = newton.ModelBuilder(), newton.ModelBuilder(), module.Actuator()
    newton.solvers.SolverMuJoCo.register_custom_attributes(bench)
    bench.add_mjcf(given.bench("mjcf", rollouts[0], late=False), ctrl_direct=True)
    builder.replicate(bench, len(rollouts))
    model = builder.finalize()
    model.joint_q.assign(given.qpos[rollouts].reshape(-1).astype(np.float32))
    model.joint_qd.assign(given.qvel[rollouts].reshape(-1).astype(np.float32))
    solver = newton.solvers.SolverMuJoCo(model)
    state, after, control = model.state(), model.state(), model.control()
    newton.eval_fk(model, state.joint_q, state.joint_qd, state)
    shape, found = given.qpos[rollouts].shape, []
    for number in range(given.steps):
        signals = {name: signal[rollouts, number] for name, signal in given.acting.items()}
        held = state.joint_q.numpy().reshape(shape), state.joint_qd.numpy().reshape(shape)
        ctrl = law.control(np, module.ACTUATOR, *held, signals.pop("ctrl"), signals)
        control.mujoco.ctrl.assign(np.broadcast_to(ctrl, shape).reshape(-1).astype(np.float32))
        solver.step(state, after, control, None, given.timestep)
        state, after = after, state
        found.append(state.joint_q.numpy().reshape(shape).astype(float))
    return np.stack(found, axis=1)


if __name__ == "__main__":
    main()
