"""The engines against MuJoCo C, which is the oracle, and rollouts against repeated steps."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from conftest import slow_but
from helpers.engine_cases import BODIES, KNOWN, chain, law, random_cases, step_of

from frictionzoo.bench import Bench, PositionPD
from frictionzoo.bench.compiled import can_collide
from frictionzoo.core.errors import BenchError, ConfigError
from frictionzoo.core.state import FrictionTerms, Signals
from frictionzoo.simulation import MjxEngine, SpecialisedEngine, make_engine, without_memory
from frictionzoo.simulation.dry_friction import dry_friction
from frictionzoo.simulation.fold import CannotSpecialiseError, specialise
from frictionzoo.simulation.linear import rows_of
from frictionzoo.simulation.rollout import make_rollout

pytestmark = pytest.mark.usefixtures("in_haste", "x64")

INTEGRATORS = {
    "Euler": ('integrator="Euler"', ""),
    "Euler, explicit damping": ('integrator="Euler"', '<flag eulerdamp="disable"/>'),
    "implicitfast": ('integrator="implicitfast"', ""),
    "implicitfast, no damper": ('integrator="implicitfast"', '<flag damper="disable"/>'),
}


def make_bench(tmp_path: Path, body: str, integrator: str = "Euler", joints: int = 1, inside: str = "") -> Bench:
    option, flag = INTEGRATORS[integrator]
    path = tmp_path / "bench.xml"
    # The tolerance lets MuJoCo C converge, so that it is an oracle for several joints too.
    path.write_text(
        f'<mujoco><option timestep="0.001" tolerance="0" iterations="200" {option}>{flag}</option>'
        f"<worldbody>{body}</worldbody>{inside}</mujoco>"
    )
    actuator = PositionPD({"kp": {"init": 20.0, **KNOWN}, "kd": {"init": 1.0, **KNOWN}})
    names = [f"j{index}" for index in range(joints)]
    return Bench(str(path), names, actuator=actuator, params={"armature": {"init": 0.02, **KNOWN}})


def steps_in_c(bench: Bench, cases: dict[str, np.ndarray], constraint: bool) -> np.ndarray:
    """One step of each case; `mj_setConst` does what compiling the MJCF anew would do with other armatures."""
    model = bench.compile(constraint)
    data = mujoco.MjData(model)
    after = np.empty((len(cases["qpos"]), 2, bench.nv))
    for index in range(len(after)):
        case = {name: value[index] for name, value in cases.items()}
        model.dof_armature[:], model.dof_damping[:] = case["armature"], case["damping"]
        model.dof_frictionloss[:] = case["frictionloss"] if constraint else 0.0
        mujoco.mj_setConst(model, data)
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = case["qpos"], case["qvel"], case["ctrl"]
        data.qfrc_applied[:] = -case["torque"]
        mujoco.mj_step(model, data)
        after[index] = data.qpos, data.qvel
    return after


def change(cases: dict[str, np.ndarray], size: float) -> dict[str, np.ndarray]:
    """The cases, each moved a little in a random direction of its own."""
    rng = np.random.default_rng(5)
    return {name: value + size * rng.normal(size=value.shape) for name, value in cases.items()}


def judge_gradient(gradient: Any, weights: Any, ahead: Any, behind: Any, cases: dict[str, np.ndarray]) -> None:
    """Of the weighted states after a step, against those after steps of `change` by 1e-7 to both sides."""
    h = 1e-7
    ours = sum((gradient[name] * value).sum(axis=1) for name, value in change(cases, 1.0).items())
    ours -= sum((gradient[name] * value).sum(axis=1) for name, value in cases.items())
    slope = (weights * (ahead - behind) / (2 * h)).sum(axis=(1, 2))
    # A border between sticking and sliding inside the difference would show as a jump of 1; rounding is 1e-9.
    np.testing.assert_allclose(ours, slope, rtol=1e-5, atol=1e-6)


def compiled(step: Any, weights: Any, options: Any = None) -> Any:
    """From cases to the weighted states' gradient and the states."""

    def weighted(case: dict[str, Any]) -> tuple[jax.Array, jax.Array]:
        after = step(case)
        return jnp.sum(weights * after), after

    return jax.jit(jax.vmap(jax.grad(weighted, has_aux=True)), compiler_options=options)


WEIGHTS = np.array([[0.7], [-1.1]])


@pytest.mark.parametrize(
    ("body", "integrator", "constraint"),
    [
        *(("inclined axis, off-axis mass", name, name != "implicitfast, no damper") for name in [*INTEGRATORS][1:]),
        *(("slide without", "Euler", True), ("hinge with gravity", "Euler", False)),
    ],
)
def test_a_step_and_its_gradient_are_those_of_mujoco_c(tmp_path, body, integrator, constraint):
    bench = make_bench(tmp_path, f"<body>{BODIES[body]}</body>", integrator)
    engine = SpecialisedEngine(bench, law(constraint), constraint)
    # One sine, an armature, an actuator and a row of the constraint, however many frames MJX computes.
    assert int(engine.note.split()[-3]) <= 20
    cases = random_cases(300, 1)
    gradient, after = compiled(step_of(engine, bench), WEIGHTS)(cases)
    np.testing.assert_allclose(after, steps_in_c(bench, cases, constraint), rtol=0, atol=1e-12)
    ahead, behind = (steps_in_c(bench, change(cases, size), constraint) for size in (1e-7, -1e-7))
    judge_gradient(gradient, WEIGHTS, ahead, behind, cases)


def test_a_bench_without_friction_constraints_serves_laws_that_need_none(tmp_path: Path) -> None:
    flag = '<option><flag frictionloss="disable"/></option>'
    bench = make_bench(tmp_path, f"<body>{BODIES['hinge with gravity']}</body>", inside=flag)
    cases = random_cases(100, 1)
    after = jax.jit(jax.vmap(step_of(SpecialisedEngine(bench, law(False), False), bench)))(cases)
    np.testing.assert_allclose(after, steps_in_c(bench, cases, False), rtol=0, atol=1e-12)
    with pytest.raises(BenchError, match="disables friction constraints, which this friction model needs"):
        SpecialisedEngine(bench, law(True), True)


@pytest.mark.parametrize("joints", slow_but([2], [2, 3]))
def test_a_chain_with_dry_friction_and_its_gradient_are_those_of_mujoco_c(tmp_path: Path, joints: int) -> None:
    bench = make_bench(tmp_path, chain(joints), joints=joints)
    engine = SpecialisedEngine(bench, law(True), True)
    weights = np.random.default_rng(1).normal(size=(2, joints))
    function, cases = compiled(step_of(engine, bench), weights, engine.compiler_options), random_cases(500, joints)
    gradient, after = function(cases)
    # With friction on every joint MuJoCo C iterates to its own last digit, too few digits for a difference.
    np.testing.assert_allclose(after, steps_in_c(bench, cases, True), rtol=0, atol=1e-8)
    ahead, behind = (function(change(cases, size))[1] for size in (1e-7, -1e-7))
    judge_gradient(gradient, weights, ahead, behind, cases)


@pytest.mark.parametrize("joints", slow_but([2], [2, 7]))
def test_a_tree_with_a_branch_equals_mujoco_c(tmp_path: Path, joints: int) -> None:
    branch = (
        f'<body><joint name="j{joints}" axis="0 0 1"/>'
        '<inertial pos="0.1 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/></body>'
    )
    body = chain(joints).replace("</body>", f"</body>{branch}", 1)  # on the link before the last, beside it
    bench = make_bench(tmp_path, body, joints=joints + 1)
    cases = random_cases(1000, joints + 1)
    engine = SpecialisedEngine(bench, law(False), False)
    ours = jax.jit(jax.vmap(step_of(engine, bench)), compiler_options=engine.compiler_options)(cases)
    np.testing.assert_allclose(ours, steps_in_c(bench, cases, False), rtol=0, atol=1e-10)  # both only round


def test_dry_friction_on_several_joints_keeps_to_each_limit() -> None:
    """The force is that of the constraint at the acceleration that it leads to, also where Newton's steps go astray."""
    rng = np.random.default_rng(0)
    mixing, wide = rng.normal(size=(1000, 5, 5)), 10 ** rng.uniform(-3, 3, size=(3, 1000, 5))
    inertia = mixing @ mixing.transpose(0, 2, 1) + 0.01 * np.eye(5)  # some nearly singular
    softness = 9 / np.diagonal(np.linalg.inv(inertia), axis1=1, axis2=2)  # as of MuJoCo's default solimp
    force, reference = wide[:2] * rng.normal(size=(2, 1000, 5))
    function = jax.jit(jax.vmap(lambda inertia, *row: dry_friction(rows_of(inertia), *row)))
    found = function(inertia, force, softness, reference, wide[2])
    acceleration = np.linalg.solve(inertia, (force + found)[..., None])[..., 0]
    expected = np.clip(softness * (reference - acceleration), -wide[2], wide[2])
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8)


def test_an_engine_without_reverse_mode_says_so(tmp_path: Path) -> None:
    bench = make_bench(tmp_path, chain(2), joints=2)  # as above, so that it is known already
    assert not MjxEngine(bench, law(True), True).reverse
    assert MjxEngine(bench, law(False), False).reverse and SpecialisedEngine(bench, law(True), True).reverse


BALL = '<geom size="0.1"/>'
ROD = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><joint name="j0" {}/>'
TIED = '<tendon><fixed><joint joint="j0" coef="1"/></fixed></tendon>'


@pytest.mark.parametrize(
    ("joint", "geom", "inside", "reason"),
    [
        ('range="-1 1" limited="true"', "", "", "joint limits"),
        ("", BALL, "", "geoms that can touch"),
        ("", "", '<equality><joint joint1="j0"/></equality>', "equality constraints"),
        ("", "", TIED, "tendons"),
    ],
)
def test_a_bench_with_other_constraints_goes_to_mjx(tmp_path, joint, geom, inside, reason):
    body = f"<body>{ROD.format(joint)}{geom}</body><body>{geom}</body>"
    bench = make_bench(tmp_path, body, inside=inside)
    engine = make_engine("auto", bench, law(False), False)
    assert engine.name == "mjx" and reason in engine.note
    with pytest.raises(ConfigError, match=f"engine=specialised: .* has {reason}"):
        make_engine("specialised", bench, law(False), False)


JOINT = '<joint type="hinge"/>'
# Geoms o of bodies in brackets, with a joint where j is.
LINKS = ("[joo]", "o[jo]", "[o][jo]", "[jo[o]]", "[o[jo]]", "[jo[jo]]", "[jo[jo[jo]]]", "[jo][jo]")


@pytest.mark.parametrize(
    ("links", "geom", "flag"),
    [
        *((links, "", "") for links in LINKS),
        ("[jo[jo]]", "", '<flag filterparent="disable"/>'),
        ("[jo][jo]", 'contype="0"', ""),
        ("[jo][jo]", 'contype="2" conaffinity="4"', ""),
    ],
)
def test_geoms_can_touch_where_mujoco_c_finds_contacts(links: str, geom: str, flag: str) -> None:
    """All of them lie in the same place, so that those which may touch do."""
    parts = {"[": "<body>", "]": "</body>", "j": JOINT, "o": f'<geom size="0.1" {geom}/>'}
    body = "".join(parts[part] for part in links)
    model = mujoco.MjModel.from_xml_string(f"<mujoco><option>{flag}</option><worldbody>{body}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert can_collide(model) == (data.ncon > 0)


def test_auto_says_what_it_chose(tmp_path: Path) -> None:
    bench = make_bench(tmp_path, f"<body>{BODIES['hinge with gravity']}</body>")
    engine = make_engine("auto", bench, law(False), False)
    assert engine.name == "specialised" and " 12 " in engine.note
    many = make_bench(tmp_path, chain(18), joints=18)
    engine = make_engine("auto", many, law(False), False)
    assert engine.name == "mjx" and "18 joints" in engine.note
    with pytest.raises(ConfigError, match=r"engine=special: no such engine; did you mean specialised\?"):
        make_engine("special", bench, law(False), False)


def test_every_rule_gives_what_jax_gives() -> None:
    rng = np.random.default_rng(0)
    x, y, matrix = rng.normal(size=4), rng.uniform(0.5, 1.0, 4), rng.normal(size=(3, 4))

    def function(x: Any, y: Any, matrix: Any) -> Any:
        table = jnp.arange(12.0).reshape(3, 4)
        padded = jnp.pad(x, (1, 2))
        return {
            "elementwise": jnp.sin(x) * jnp.exp(y) / jnp.sqrt(y) - jnp.arctan2(x, y) + jnp.tanh(x) ** 3 + x**-2,
            "select": jnp.where((x > 0) & ~(y < 0.7) | (x == y), jnp.maximum(x, 0.1), jnp.clip(y, 0.6, 0.8)),
            "rounding": jnp.floor(x) + jnp.sign(x) + jnp.abs(x) + jnp.fmod(x, 0.3),
            "gather": matrix[jnp.array([2, 0]), 1:3] + table[jnp.array([2, 0]), 1:3],
            "scatter": jnp.zeros(5).at[jnp.array([1, 3])].set(x[:2]).at[jnp.array([3, 3])].add(y[:2]),
            "dropped": jnp.zeros(3).at[jnp.array([1, 7])].add(x[:2], mode="drop"),
            "slices": jax.lax.dynamic_slice(matrix, (1, 2), (2, 2)) @ padded[1:3],
            "update": jax.lax.dynamic_update_slice(padded, y[:2], (2,)),
            "contract": jnp.einsum("ij,j->i", matrix, x) + jnp.linalg.norm(matrix, axis=1),
            "batched": jax.vmap(jnp.dot)(matrix, table),
            "reduce": jnp.array([x.sum(), y.max(), y.min(), x.cumsum()[2], jnp.all(y > 0), jnp.any(x > 9)]),
            "shape": jnp.concatenate([matrix.T[::-1].ravel(), jnp.repeat(x, 2), jnp.stack([x, y]).reshape(-1)]),
            "constant": jnp.linalg.inv(jnp.eye(3) * 2.0) + jnp.sort(jnp.array([3.0, 1.0, 2.0])),
            "powers": jnp.cos(x[0]) ** 4 + 2 * jnp.cos(x[0]) ** 2 * jnp.sin(x[0]) ** 2 + jnp.sin(x[0]) ** 4,
        }

    specialised = specialise(function, x, y, matrix)
    found, expected = jax.jit(lambda *given: (specialised(*given), function(*given)))(x, y, matrix)
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, rtol=1e-12, atol=1e-14, err_msg=name)


def test_what_cancels_is_multiplied_out() -> None:
    assert specialise(lambda x: jnp.cos(x) ** 2 + jnp.sin(x) ** 2, np.zeros(())).operations == 0
    assert specialise(lambda x, y: (x + y) ** 2 - x**2 - 2 * x * y - y * y, np.zeros(()), np.zeros(())).operations == 0


@pytest.mark.parametrize(
    ("function", "operation"),
    [
        (lambda x: jnp.sort(x), "sort"),
        (lambda x: jax.lax.fori_loop(0, 3, lambda _, y: y * x, x), "scan|while"),
        (lambda x: jnp.arange(3.0)[x[0].astype(int)], "an index that depends on the state"),
    ],
)
def test_what_has_no_rule_is_named(function: Any, operation: str) -> None:
    with pytest.raises(CannotSpecialiseError, match=operation):
        specialise(function, np.ones(2))


@pytest.mark.parametrize(
    ("body", "integrator", "constraint"),
    slow_but(
        [("inclined axis, off-axis mass", "implicitfast", False)],  # with dry friction a servo's in test_servo
        [
            *(("inclined axis, off-axis mass", "implicitfast", dry) for dry in (False, True)),
            *(("hinge with gravity", "Euler, explicit damping", False), ("slide without", "Euler", True)),
        ],
    ),
)
def test_a_step_of_mjx_and_its_slope_are_those_of_mujoco_c(tmp_path, body, integrator, constraint):
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
    bench = make_bench(tmp_path, f"<body>{BODIES['hinge with gravity']}</body>")
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
