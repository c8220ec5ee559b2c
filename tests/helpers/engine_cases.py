"""Bodies, values and states for steps of the engines."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from frictionzoo.bench import Bench
from frictionzoo.core.state import FrictionTerms, Signals
from frictionzoo.simulation import without_memory

KNOWN = {"low": 1e-6, "high": 1e3, "scale": "log", "identify": False}
BODIES = {
    "hinge with gravity": '<joint name="j0" axis="0 1 0"/>'
    '<inertial pos="0 0 -0.11" mass="0.26" diaginertia="0.0011 0.0011 0.0001"/>',
    "slide without": '<joint name="j0" type="slide" axis="1 0 0"/>'
    '<inertial pos="0 0.1 0" mass="3" diaginertia="1 1 1"/>',
    "inclined axis, off-axis mass": '<joint name="j0" axis="1 2 0.5" pos="0.01 0.02 0"/>'
    '<inertial pos="0.05 -0.03 -0.1" quat="1 0.2 0.1 0" mass="0.4" diaginertia="0.002 0.003 0.004"/>',
}
AXES = ("0 1 0", "1 0 0", "0 0 1")


def chain(joints: int) -> str:
    """Hinges about changing axes, each on the body before it."""
    body = ""
    for index in reversed(range(joints)):
        body = (
            f'<body pos="0 0 -0.2"><joint name="j{index}" axis="{AXES[index % 3]}"/>'
            f'<inertial pos="0.01 0.02 -0.11" mass="0.26" diaginertia="0.0011 0.0012 0.0004"/>{body}</body>'
        )
    return body


def random_cases(count: int, nv: int, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    shape = (count, nv)
    return {
        "qpos": rng.normal(size=shape),
        # Half of them slow enough for the constraint to stick.
        "qvel": rng.normal(size=shape) * np.where(np.arange(count) % 2, 1.0, 1e-3)[:, None],
        "ctrl": rng.normal(size=shape),
        "armature": rng.uniform(0.005, 0.3, shape),
        "frictionloss": rng.uniform(0.01, 3.0, shape),
        "damping": rng.uniform(0.0, 2.0, shape),
        "torque": rng.normal(size=shape),
    }


def law(constraint: bool) -> Any:
    def friction(values: dict[str, Any], state: Any) -> FrictionTerms:
        return FrictionTerms(values["torque"], values["frictionloss"] if constraint else None, values["damping"])

    return without_memory(friction)


def step_of(engine: Any, bench: Bench) -> Any:
    known = {name: jnp.asarray(value) for name, value in bench.initial_values().items()}

    def step(case: dict[str, Any]) -> jax.Array:
        values = {"bench": known | {"armature": case["armature"]}, "friction": case}
        load, memory = case.get("load", jnp.zeros(0)), jnp.zeros((bench.nv, 0))
        return jnp.stack(engine.step(values, case["qpos"], case["qvel"], Signals(case["ctrl"]), load, memory)[:2])

    return step
