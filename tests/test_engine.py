"""The MJX engine against MuJoCo C, which is the oracle, and rollouts against repeated steps."""

from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from conftest import slow_but
from test_specialised import BODIES, change, law, make_bench, random_cases, step_of, steps_in_c

from frictionzoo.core.state import FrictionTerms, Signals
from frictionzoo.simulation import MjxEngine, SpecialisedEngine, without_memory
from frictionzoo.simulation.rollout import make_rollout

ROD = "hinge with gravity"


@pytest.fixture(autouse=True)
def x64(in_haste: None) -> Iterator[None]:
    with jax.enable_x64(True):
        yield


@pytest.mark.parametrize(
    ("body", "integrator", "constraint"),
    slow_but(
        [("inclined axis, off-axis mass", "implicitfast", False)],  # with dry friction a servo's in test_servo
        [
            *(("inclined axis, off-axis mass", "implicitfast", dry) for dry in (False, True)),
            *((ROD, "Euler, explicit damping", False), ("slide without", "Euler", True)),
        ],
    ),
)
def test_a_step_and_its_slope_are_those_of_mujoco_c(
    tmp_path: Path, body: str, integrator: str, constraint: bool
) -> None:
    bench = make_bench(tmp_path, f"<body>{BODIES[body]}</body>", integrator)
    step = step_of(MjxEngine(bench, law(constraint), constraint), bench)
    cases = random_cases(100, 1)
    ahead, behind = (change(cases, size) for size in (1e-7, -1e-7))
    direction = {name: (ahead[name] - behind[name]) / 2e-7 for name in cases}
    moved = jax.jit(
        lambda case, direction: jax.jvp(step, (case,), (direction,))
    )  # of one case: a batch compiles longer
    found = [
        moved(*({name: value[index] for name, value in given.items()} for given in (cases, direction)))
        for index in range(100)
    ]
    after, slope = (np.array(part) for part in zip(*found, strict=True))
    np.testing.assert_allclose(after, steps_in_c(bench, cases, constraint), rtol=0, atol=1e-12)
    difference = steps_in_c(bench, ahead, constraint) - steps_in_c(bench, behind, constraint)
    np.testing.assert_allclose(slope, difference / 2e-7, rtol=1e-5, atol=1e-6)


def test_law_sees_what_mujoco_c_computes(tmp_path: Path) -> None:
    bench = make_bench(tmp_path, f"<body>{BODIES['inclined axis, off-axis mass']}</body>")
    case = {name: value[0] for name, value in random_cases(1, 1).items()}
    values = {"bench": bench.initial_values()}
    model = bench.compile(constraint=False)
    data = mujoco.MjData(model)
    data.qpos, data.qvel, data.ctrl = case["qpos"], case["qvel"], case["ctrl"]
    mujoco.mj_forward(model, data)
    for kind in (MjxEngine, SpecialisedEngine):
        engine = kind(bench, law(False), False)
        state = jax.jit(engine.drive_state)(values, case["qpos"], case["qvel"], Signals(case["ctrl"]), jnp.zeros(0))
        np.testing.assert_allclose(state.motor_torque, data.qfrc_actuator, rtol=1e-12)
        np.testing.assert_allclose(state.external_torque, data.qfrc_passive - data.qfrc_bias, rtol=1e-12)
        np.testing.assert_array_equal([state.qpos, state.qvel, state.ctrl], [data.qpos, data.qvel, data.ctrl])


def test_rollout_is_the_step_repeated(tmp_path: Path) -> None:
    bench = make_bench(tmp_path, f"<body>{BODIES[ROD]}</body>")
    friction = without_memory(lambda values, state: FrictionTerms(torque=0.1 * jnp.tanh(state.qvel)))
    engine = SpecialisedEngine(bench, friction, False)
    values = {"bench": {name: jnp.asarray(value) for name, value in bench.initial_values().items()}, "friction": {}}
    rng = np.random.default_rng(1)
    qpos, qvel, ctrl = rng.normal(size=(2, 1)), rng.normal(size=(2, 1)), rng.normal(size=(2, 4, 1))
    positions, velocities = make_rollout(engine).compiled(
        values, *jax.tree.map(jnp.asarray, (qpos, qvel, Signals(ctrl)))
    )
    assert positions.shape == velocities.shape == (2, 4, 1)
    step = jax.jit(engine.step)
    for row in range(2):
        q, v = jnp.asarray(qpos[row]), jnp.asarray(qvel[row])
        for i in range(4):
            q, v, _ = step(values, q, v, Signals(jnp.asarray(ctrl[row, i])), jnp.zeros(0), jnp.zeros((1, 0)))
            np.testing.assert_allclose(positions[row, i], q, rtol=1e-13)
            np.testing.assert_allclose(velocities[row, i], v, rtol=1e-13)
