"""Rollouts in MJX with the exported module's `step`, in 64 bits."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from given import Given, load_module, read_given
from mujoco import mjx


def main() -> None:
    """Simulate each rollout from its initial state."""
    jax.config.update("jax_enable_x64", True)
    given, _ = read_given(__doc__)
    module: Any = load_module(given.folder / "mjx" / "drive.py")
    roll, found = jax.jit(make_rollout(module, given)), []
    for rollout in range(len(given.qpos)):
        on_device = mjx.put_model(mujoco.MjModel.from_xml_string(given.bench("mjx", rollout)))
        data = mjx.make_data(on_device).replace(
            qpos=jnp.asarray(given.qpos[rollout]), qvel=jnp.asarray(given.qvel[rollout])
        )
        acting = {name: jnp.asarray(signal[rollout]) for name, signal in given.acting.items()}
        found.append(np.asarray(roll(on_device, data, acting)))
    given.write(given.sampled(np.array(found)), "mujoco-mjx")


def make_rollout(module: Any, given: Given) -> Any:
    """Return a rollout as one JAX function; its commands are already delayed."""
    remembers = hasattr(module, "reset")

    def rollout(model: mjx.Model, data: mjx.Data, acting: dict[str, jax.Array]) -> jax.Array:
        def step(state: tuple[Any, ...], signals: dict[str, jax.Array]) -> tuple[Any, Any]:
            inputs = dict(signals)
            state = module.step(model, *state, inputs.pop("ctrl"), inputs)
            state = state if remembers else (state,)
            return state, state[0].qpos

        first = {name: signal[0] for name, signal in acting.items()}
        memory = [module.reset(model, data, first.pop("ctrl"), first)] if remembers else []
        return jax.lax.scan(step, (data, *memory), acting)[1]

    return rollout


if __name__ == "__main__":
    main()
