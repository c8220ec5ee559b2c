"""The MJX engine against MuJoCo C, which is the oracle."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from conftest import slow_but
from test_specialised import KNOWN, random_cases

from frictionzoo.bench import Bench, PositionPD
from frictionzoo.engine import MjxEngine, without_memory
from frictionzoo.rollout import make_rollout
from frictionzoo.types import FrictionTerms

ARMATURE = {"armature": {"init": 0.02, **KNOWN}}
HINGE = '<joint name="a" axis="0 1 0"/><inertial pos="0 0 -0.11" mass="0.26" diaginertia="0.0011 0.0011 0.0001"/>'
BODIES = {
    "hinge": HINGE,
    "slide": '<joint name="a" type="slide" axis="1 0 0"/><inertial pos="0 0 0" mass="3" diaginertia="1 1 1"/>',
    "offset slide": '<joint name="a" type="slide"/><inertial pos="0 0.1 0" mass="3" diaginertia="1 1 1"/>',
    "inclined": '<joint name="a" axis="1 2 0.5" pos="0.01 0.02 0"/>'
    '<inertial pos="0.05 -0.03 -0.1" quat="1 0.2 0.1 0" mass="0.4" diaginertia="0.002 0.003 0.004"/>',
    "two": HINGE + f'<body pos="0 0 -0.2">{HINGE.replace(chr(34) + "a" + chr(34), chr(34) + "b" + chr(34))}</body>',
}
INTEGRATORS = {
    "euler": ('integrator="Euler"', ""),
    "explicit": ('integrator="Euler"', '<flag eulerdamp="disable"/>'),
    "implicitfast": ('integrator="implicitfast"', ""),
}
STATES = 500


@pytest.fixture(autouse=True)
def x64() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


def make_bench(tmp_path: Path, body: str, integrator: str) -> Bench:
    option, flag = INTEGRATORS[integrator]
    path = tmp_path / "bench.xml"
    # The tolerance lets MuJoCo C converge, so that it is an oracle for the two joints too.
    path.write_text(
        f'<mujoco><option timestep="0.001" tolerance="0" iterations="50" {option}>{flag}</option>'
        f"<worldbody><body>{BODIES[body]}</body></worldbody></mujoco>"
    )
    joints = ["a", "b"] if body == "two" else ["a"]
    actuator = PositionPD({"kp": {"init": 20.0, **KNOWN}, "kd": {"init": 1.0, **KNOWN}})
    return Bench(str(path), joints, actuator, ARMATURE, [0.02, 1.0], None, None)


def step_in_c(bench: Bench, case: dict[str, np.ndarray], constraint: bool) -> tuple[np.ndarray, np.ndarray]:
    """One step of the bench written as MJCF with these values and compiled anew."""
    values = bench.initial_values() | {"armature": case["armature"]}
    frictionloss = case["frictionloss"] if constraint else None
    model = mujoco.MjModel.from_xml_string(bench.mjcf(values, frictionloss, case["damping"]))
    data = mujoco.MjData(model)
    data.qpos, data.qvel, data.ctrl = case["qpos"], case["qvel"], case["ctrl"]
    data.qfrc_applied = -case["torque"]
    mujoco.mj_step(model, data)
    return data.qpos.copy(), data.qvel.copy()


@pytest.mark.parametrize("constraint", [False, True], ids=["smooth", "frictionloss"])
@pytest.mark.parametrize(
    ("body", "integrator"),
    slow_but(
        [("hinge", "implicitfast"), ("offset slide", "euler"), ("inclined", "euler")],
        [*(("hinge", name) for name in INTEGRATORS), *((body, "euler") for body in BODIES if body != "hinge")],
    ),
)
def test_step_equals_mujoco_c(tmp_path: Path, body: str, integrator: str, constraint: bool) -> None:
    bench = make_bench(tmp_path, body, integrator)

    def friction(values: dict[str, Any], state: Any) -> FrictionTerms:
        loss = values["frictionloss"] if constraint else None
        return FrictionTerms(values["torque"], loss, values["damping"])

    engine = MjxEngine(bench, without_memory(friction), constraint)
    known = {name: jnp.asarray(value) for name, value in bench.initial_values().items()}

    def step(case: dict[str, Any]) -> tuple:
        values = {"bench": known | {"armature": case["armature"]}, "friction": case}
        return engine.step(values, case["qpos"], case["qvel"], case["ctrl"], jnp.zeros(0), jnp.zeros((bench.nv, 0)))[:2]

    cases = random_cases(STATES, bench.nv)
    qpos, qvel = jax.jit(jax.vmap(step))(cases)
    # One joint: rounding only. Two joints with friction: both solvers iterate, to their own tolerance.
    tolerance = 1e-8 if constraint and bench.nv > 1 else 1e-12
    for index in range(0, STATES, 5):
        expected = step_in_c(bench, {name: value[index] for name, value in cases.items()}, constraint)
        np.testing.assert_allclose(qpos[index], expected[0], atol=tolerance)
        np.testing.assert_allclose(qvel[index], expected[1], atol=tolerance)


def test_law_sees_what_mujoco_c_computes(tmp_path: Path) -> None:
    bench = make_bench(tmp_path, "inclined", "euler")
    engine = MjxEngine(bench, without_memory(lambda values, state: FrictionTerms()), False)
    case = {name: value[0] for name, value in random_cases(STATES, 1).items()}
    values = {"bench": bench.initial_values()}
    signals = (jnp.asarray(case[name]) for name in ("qpos", "qvel", "ctrl"))
    state = jax.jit(engine.drive_state)(values, *signals, jnp.zeros(0))
    model = bench.compile(constraint=False)
    data = mujoco.MjData(model)
    data.qpos, data.qvel, data.ctrl = case["qpos"], case["qvel"], case["ctrl"]
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(state.motor_torque, data.qfrc_actuator, rtol=1e-12)
    np.testing.assert_allclose(state.external_torque, data.qfrc_passive - data.qfrc_bias, rtol=1e-12)
    np.testing.assert_array_equal(state.ctrl, case["ctrl"])


def test_rollout_is_the_step_repeated(tmp_path: Path) -> None:
    bench = make_bench(tmp_path, "hinge", "euler")
    friction = without_memory(lambda values, state: FrictionTerms(torque=0.1 * jnp.tanh(state.qvel)))
    engine = MjxEngine(bench, friction, False)
    values = {"bench": {name: jnp.asarray(value) for name, value in bench.initial_values().items()}, "friction": {}}
    rng = np.random.default_rng(1)
    qpos, qvel, ctrl = rng.normal(size=(2, 1)), rng.normal(size=(2, 1)), rng.normal(size=(2, 4, 1))
    positions, velocities = make_rollout(engine).compiled(values, *map(jnp.asarray, (qpos, qvel, ctrl)))
    assert positions.shape == velocities.shape == (2, 4, 1)
    step = jax.jit(engine.step)
    for row in range(2):
        q, v = jnp.asarray(qpos[row]), jnp.asarray(qvel[row])
        for i in range(4):
            q, v, _ = step(values, q, v, jnp.asarray(ctrl[row, i]), jnp.zeros(0), jnp.zeros((1, 0)))
            np.testing.assert_allclose(positions[row, i], q, rtol=1e-13)
            np.testing.assert_allclose(velocities[row, i], v, rtol=1e-13)
