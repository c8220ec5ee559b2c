"""Friction laws that remember: against closed forms, an ODE solver, and in rollouts of the EMPS carriage."""

import copy
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from conftest import slow_but
from scipy.integrate import solve_ivp

from frictionzoo.bench import Bench
from frictionzoo.core.errors import ConfigError, ModelError
from frictionzoo.core.segments import Sampling, Segments
from frictionzoo.core.state import DriveState, FrictionTerms, Signals
from frictionzoo.fit import Objective, Space, fit_reference
from frictionzoo.models import FrictionModel
from frictionzoo.models.contract import check_model
from frictionzoo.simulation import friction_of, make_engine
from frictionzoo.simulation.rollout import make_rollout

pytestmark = pytest.mark.usefixtures("in_haste")

LAWS = ("dahl", "dahl_load_dependent", "lugre", "lugre_load_dependent", "maxwell_slip", "torque_proportional")
LOADED = ("dahl_load_dependent", "lugre_load_dependent", "torque_proportional")
MASS = 95.0  # kg
TRUTH = {
    **{"stiffness": 2e5, "coulomb_torque": 20.0, "micro_damping": 300.0, "static_torque": 26.0},
    **{"kinetic_torque": 20.0, "stribeck_velocity": 0.01, "presliding": 2e-4, "lag": 2e-3, "load_friction": 0.02},
    **{"stribeck_load_friction": 0.01, "load_friction_driving": 0.1, "load_friction_braking": 0.04},
    **{"viscous_coefficient": 200.0, "rest_velocity": 1e-3},
}
"""Of the size of the EMPS carriage's: N, m, s."""


@pytest.fixture(scope="module")
def carriage(make: Callable[..., Any]) -> Callable[..., Bench]:
    """The EMPS bench, pushed by as many newtons as the command says."""
    known = ("force_gain.init=1", "force_gain.low=0.1", "force_offset.identify=false")
    options = ("bench=emps", *(f"bench.actuator.params.{option}" for option in known))
    return cache(lambda *more: make("bench", *options, *more))


@pytest.fixture(scope="module")
def build(make: Callable[..., Any]) -> Callable[[str], FrictionModel]:
    """A law from its YAML."""
    return cache(lambda name: make("model", f"model={name}", "bench=emps", nv=1))


@cache
def rollout_of(bench: Bench, law: FrictionModel) -> Callable[..., Any]:
    return make_rollout(make_engine("auto", bench, friction_of(law), law.constraint)).compiled


def truth(law: FrictionModel) -> dict[str, np.ndarray]:
    return {name: np.array([TRUTH[name]]) for name in law.params}


def simulate(
    bench: Bench, law: FrictionModel, force: np.ndarray, qvel: float = 0.0, **friction: float
) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity after each step under these forces [N], of shape (time,)."""
    values = {
        "bench": bench.initial_values() | {"armature": np.array([MASS])},
        "friction": truth(law) | {name: np.array([value]) for name, value in friction.items()},
    }
    with jax.enable_x64(True):
        states = rollout_of(bench, law)(values, np.zeros((1, 1)), np.full((1, 1), qvel), Signals(force[None, :, None]))
    return tuple(np.asarray(part)[0, :, 0] for part in states)


def drag(
    law: FrictionModel, qvel: np.ndarray, timestep: float, memory: np.ndarray, motor: float = 0.0, **more: float
) -> np.ndarray:
    """Friction at the end of each step in which the joint is drawn at these velocities, under this torque [N]."""
    values = {name: torch.tensor(value) for name, value in (truth(law) | more).items()}
    found, held = [], torch.tensor(memory)
    for velocity in qvel:
        zero, moving = torch.zeros(1), torch.full((1,), velocity, dtype=torch.float64)
        state = DriveState(zero, moving, zero, zero + motor, zero)
        terms, held = law.advance(torch, values, state, held, timestep)
        found.append(float(terms.torque + terms.damping * velocity))
    return np.array(found)


def test_dahls_spring_yields_along_its_curve(build: Callable[[str], FrictionModel]) -> None:
    """From rest, force over displacement is f_c (1 - exp(-s x / f_c)), whatever the step."""
    law, timestep, speed = build("dahl"), 1e-3, 0.02
    force = drag(law, np.full(20, speed), timestep, np.zeros((1, 1)))
    # The memory is that of the state at the step's beginning, the force that at its end: two steps after the first.
    moved = speed * timestep * (2 + np.arange(20))
    expected = 20 * (1 - np.exp(-2e5 * moved / 20)) + 200 * speed
    np.testing.assert_allclose(force, expected, rtol=1e-12)


def test_maxwells_elements_slip_one_after_the_other(build: Callable[[str], FrictionModel]) -> None:
    """The first loading is piecewise linear, with corners where an element slips; a loop closes in its corner."""
    law, timestep = build("maxwell_slip"), 1e-3
    fine = TRUTH["presliding"] / 40  # m a step: ten until the first of four elements slips
    speed = fine / timestep
    forth, back = np.full(60, speed), np.full(30, -speed)
    force = drag(law, np.concatenate([forth, back, forth]), timestep, np.zeros((1, 4)), static_torque=20.0)
    dry = force - TRUTH["viscous_coefficient"] * np.concatenate([forth, back, forth])
    moved = (2 + np.arange(60)) / 40  # shares of the presliding
    expected = sum(5 * np.minimum(moved * 4 / element, 1) for element in range(1, 5))
    np.testing.assert_allclose(dry[:60], expected, rtol=1e-9)
    # Thirty steps back and thirty forth end on the first loading's curve again, at its limit.
    np.testing.assert_allclose(dry[119:], 20.0, rtol=1e-9)
    assert dry[89] < 0 and np.abs(np.diff(dry[90:119])).max() > 0.5


@pytest.mark.parametrize("name", LAWS)
def test_what_has_settled_in_motion_is_the_law_at_constant_velocity(build, name):
    law = build(name)
    values = {name: torch.tensor(value) for name, value in truth(law).items()}
    zero, speeds = torch.zeros(4, 1), torch.tensor([[0.1], [-0.1], [0.03], [-0.02]], dtype=torch.float64)
    motor = torch.tensor([[30.0], [20.0], [-10.0], [-15.0]], dtype=torch.float64)
    state = DriveState(zero, speeds, zero, motor, zero + 5)

    def sliding(terms: FrictionTerms) -> torch.Tensor:
        return terms.torque + terms.damping * speeds

    terms, _ = law.advance(torch, values, state, law.settle(torch, values, state), 1e-3)
    torch.testing.assert_close(sliding(terms), sliding(law.terms(torch, values, state)))


@pytest.mark.parametrize("motor", [40.0, -40.0])
@pytest.mark.parametrize("timestep", [1e-4, 1e-2])
def test_a_share_of_the_torque_builds_up_along_its_curve(build, motor, timestep):
    """From rest, the memory over displacement is 1 - exp(-x / h), whatever the step, and at last the sign."""
    law, moved = build("torque_proportional"), 4e-6 * np.arange(2, 22)  # m
    for speed in (moved[0] / 2 / timestep, -moved[0] / 2 / timestep):
        force = drag(law, np.full(20, speed), timestep, np.zeros((1, 1)), motor)
        z = np.sign(speed) * (1 - np.exp(-moved / 2e-4))
        expected = (20 + 0.07 * 40) * z + 0.03 * motor * z**2 + 200 * speed
        np.testing.assert_allclose(force, expected, rtol=1e-9)
        slid = drag(law, np.full(3, 1e6 * speed), timestep, np.zeros((1, 1)), motor, viscous_coefficient=0.0)[-1]
        share = 0.1 if speed * motor > 0 else 0.04
        assert slid == pytest.approx(np.sign(speed) * (20 + share * 40), rel=1e-9)


@pytest.mark.parametrize("asked", [-18.0, 3.0, 25.0])
def test_what_has_settled_at_rest_holds_the_load(build: Callable[[str], FrictionModel], asked: float) -> None:
    """A share of the torque is no straight line over its memory, which is found nevertheless; 25 N are too many."""
    law, motor = build("torque_proportional"), np.sign(asked) * 30.0
    values = {name: torch.tensor(value) for name, value in (truth(law) | {"load_friction_braking": [0.0]}).items()}
    zero = torch.zeros(1, dtype=torch.float64)
    state = DriveState(zero, zero, zero, zero + motor, zero + asked - motor)
    z = law.settle(torch, values, state).item()
    limit = 20 + 0.1 * 30
    assert (20 + 0.05 * 30) * z + 0.05 * motor * z**2 == pytest.approx(np.clip(asked, -limit, limit), rel=1e-12)


def test_a_share_of_the_torque_may_be_all_of_the_friction(build, carriage):
    """As its source has it: without a Coulomb torque nothing is divided by 0, and a force drives but for its share."""
    law, force = build("torque_proportional"), np.repeat([0.0, 30.0], [2, 500])
    qpos, qvel = simulate(carriage(), law, force, coulomb_torque=0.0)
    assert (qpos[:2] == 0).all()
    time = 1e-3 * np.arange(1, 501)
    expected = (1 - 0.1) * 30 / 200 * (1 - np.exp(-200 / MASS * time))
    assert np.abs(qvel[2:] - expected).max() < 0.03 * expected[-1]  # until the sign is complete, it is faster


def formula(law: FrictionModel) -> Callable[[float, float, float], tuple[float, float]]:
    """Friction [N] and the slope of the memory, of velocity, memory and motor torque, as their sources print them."""
    has = defaultdict(float, {name: TRUTH[name] for name in law.params})

    def share_of_torque(v: float, z: float, push: float) -> tuple[float, float]:
        mean, difference = (has["load_friction_driving"] + np.array([1, -1]) * has["load_friction_braking"]) / 2
        dry = (has["coulomb_torque"] + mean * abs(push)) * z + difference * push * z**2
        return dry + has["viscous_coefficient"] * v, (v - abs(v) * z) / has["presliding"]

    def bristles(v: float, z: float, push: float) -> tuple[float, float]:
        slow = np.exp(-((v / TRUTH["stribeck_velocity"]) ** 2)) if "stribeck_velocity" in law.params else 0.0
        kinetic = has["kinetic_torque"] + has["coulomb_torque"]
        load = (has["load_friction"] + slow * has["stribeck_load_friction"]) * abs(push)
        limit = kinetic + slow * (has["static_torque"] - kinetic) + load
        bend = v - has["stiffness"] * abs(v) / limit * z
        return has["stiffness"] * z + has["micro_damping"] * bend + has["viscous_coefficient"] * v, bend

    return share_of_torque if law.name == "torque_proportional" else bristles


@pytest.mark.parametrize(
    "name", slow_but(["dahl", "lugre", "torque_proportional"], [name for name in LAWS if name != "maxwell_slip"])
)
def test_a_rollout_follows_an_ode_solver(build, carriage, name):
    """Presliding, breakaway and reversal: the error is small at 1 ms and halves with the step.

    Maxwell's elements switch; their curve has a closed form above.
    """
    law = build(name)
    force = 45 * np.sin(2 * np.pi * 2 * np.arange(300) * 1e-3)
    friction_and_bend = formula(law)

    def slope(time: float, state: np.ndarray) -> list[float]:
        _, v, z = state
        push = force[min(int(time / 1e-3 + 1e-9), len(force) - 1)]
        friction, bend = friction_and_bend(v, z, push)
        return [v, (push - friction) / MASS, bend]

    state, expected = np.zeros(3), []
    for i in range(len(force)):  # a step at a time: the force jumps in between
        state = solve_ivp(slope, (i * 1e-3, (i + 1) * 1e-3 - 1e-12), state, method="LSODA", rtol=1e-9, atol=1e-14).y[
            :, -1
        ]
        expected.append(state[0])
    errors = []
    for parts in (1, 2, 4):
        bench = carriage(f"bench.timestep={1e-3 / parts}")
        qpos, _ = simulate(bench, law, np.repeat(force, parts))
        errors.append(np.abs(qpos[parts - 1 :: parts] - expected).max())
    travel = np.ptp(expected)
    assert errors[0] < 0.02 * travel
    assert errors[1] < 0.65 * errors[0] and errors[2] < 0.65 * errors[1]


@pytest.mark.parametrize("name", LAWS)
def test_no_stiffness_makes_a_step_unstable(build, carriage, name):
    law, force = build(name), 40 * np.sin(2 * np.pi * 4 * np.arange(1000) * 1e-3)
    stiff = {"presliding": 1e-8} if "presliding" in law.params else {"stiffness": 1e10}
    soft, (qpos, qvel) = simulate(carriage(), law, force), simulate(carriage(), law, force, **stiff)
    assert np.isfinite(qpos).all()
    # As the springs stiffen, the law comes down to friction without presliding: of the same size, and no faster.
    assert 0.2 * np.abs(soft[1]).max() < np.abs(qvel).max() < 1.2 * np.abs(soft[1]).max()


@pytest.mark.parametrize("name", LAWS)
def test_a_loaded_joint_holds_until_it_breaks_away(build, carriage, name):
    """A rollout that begins at rest begins with the bend that holds the load; a smooth sign would creep."""
    law, bench = build(name), carriage()
    below, above = (simulate(bench, law, np.full(1000, force))[0] for force in (15.0, 30.0))
    assert np.abs(below).max() < 1e-9
    assert above[-1] > 0.02


def test_the_bristles_break_away_above_the_sliding_friction(build, carriage):
    """Between kinetic and static friction a force does not start the carriage, yet keeps a moving one going."""
    law, bench, force = build("lugre"), carriage(), np.full(1000, 24.0)
    at_rest, moving = simulate(bench, law, force), simulate(bench, law, force, qvel=0.05)
    assert np.abs(at_rest[0]).max() < 1e-3 * moving[0][-1]
    assert moving[1][-1] > 0.01


@pytest.mark.parametrize("name", slow_but(["lugre"], LAWS))
def test_gradient_of_a_rollout_equals_central_differences(build, carriage, name):
    law, bench = build(name), carriage()
    force = 45 * np.sin(2 * np.pi * 5 * np.arange(60) * 1e-3)
    names = [key for key, param in law.params.items() if param.identify]
    with jax.enable_x64(True):
        rollout = make_rollout(make_engine("auto", bench, friction_of(law), law.constraint))

        def end(scale: Any) -> Any:
            friction = {key: jnp.asarray(value) for key, value in truth(law).items()}
            friction |= {key: friction[key] * scale[i] for i, key in enumerate(names)}
            values = {"bench": bench.initial_values() | {"armature": np.array([MASS])}, "friction": friction}
            qvel, forces = jnp.array([[0.0], [0.03]]), jnp.stack([force, -force])[..., None]
            qpos, _ = rollout(values, jnp.zeros((2, 1)), qvel, Signals(forces))
            return (qpos * 1e3).sum()

        steps = 1e-6 * np.eye(len(names))
        scales = 1 + np.concatenate([0 * steps, steps, -steps])
        ends, slopes = jax.jit(jax.vmap(jax.value_and_grad(end)))(scales)
    _, after, before = np.asarray(ends).reshape(3, -1)
    slope = dict(zip(names, np.asarray(slopes)[0], strict=True))
    assert slope == pytest.approx(dict(zip(names, (after - before) / 2e-6, strict=True)), rel=1e-4, abs=1e-6)
    assert min(map(abs, slope.values())) > 1e-6


def test_a_law_whose_memory_does_not_settle_is_refused(build, make):
    with pytest.raises(ConfigError, match="elements=0"):
        make("model", "model=maxwell_slip", "bench=emps", "model.elements=0", nv=1)
    law = copy.copy(build("dahl"))
    law.settle = lambda xp, values, state: (0.1 * xp.tanh(state.qvel))[..., None]  # pyright: ignore
    with pytest.raises(ModelError, match="dahl: memory: in steady motion it still changes"):
        check_model(law)


def recover(bench: Bench, law: FrictionModel, hidden: Mapping[str, float], ctrl: np.ndarray) -> dict[str, float]:
    """What a fit finds from noiseless rollouts under these commands, as a share of what was hidden in them."""
    friction = {name: np.array([hidden[name]]) for name in law.params}
    values = {"bench": bench.initial_values() | {"armature": np.array([hidden["armature"]])}, "friction": friction}
    with jax.enable_x64(True):
        rollout = make_rollout(make_engine("auto", bench, friction_of(law), law.constraint), Sampling(1e-3, 1, 0))
        start = np.zeros((len(ctrl), 1))
        states = rollout.compiled(values, start, start, Signals(ctrl[..., None]))
        qpos, qvel = (np.concatenate([start[:, None], np.asarray(part)], axis=1) for part in states)
        segments = Segments(qpos, qvel, Signals(ctrl[..., None]), 1e-3)
        objective = Objective(Space(bench, law, "float64"), rollout, segments, 1.0, 0.01, "none", 1.0, False)
        found = fit_reference(objective)
    assert found["friction"]["rest_velocity"] == pytest.approx(hidden["rest_velocity"])
    identified = {**found["friction"], "armature": found["bench"]["armature"]}
    identified.pop("rest_velocity")
    return {name: float(np.ravel(value)[0]) / hidden[name] for name, value in identified.items()}


def swing(sizes: Sequence[float], rates: Sequence[float]) -> np.ndarray:
    """Commands of each size at each rate [Hz]: they preslide, break away and slide."""
    time = 1e-3 * np.arange(400)
    return np.array([size * np.sin(2 * np.pi * rate * time + size) for size in sizes for rate in rates])


@pytest.mark.parametrize("name", slow_but(["dahl"], LAWS))
def test_known_parameters_are_recovered(build, carriage, name):
    force = swing([12, 18, 24, 30, 40, 60], [2.0, 5.0, 9.0])
    shares = recover(carriage(), build(name), TRUTH | {"armature": MASS}, force)
    assert shares == {parameter: pytest.approx(1.0, abs=0.05) for parameter in shares}


@pytest.mark.parametrize("name", slow_but(["torque_proportional"], LOADED))
def test_what_load_does_is_recovered_from_a_rod_that_swings(make: Callable[..., Any], name: str) -> None:
    """Gravity loads the gear besides the motor, as a controller holds it: the rod's torque is not the motor's."""
    hidden = {
        **{"stiffness": 200.0, "presliding": 1e-3, "rest_velocity": 0.01, "armature": 0.03},
        **{"coulomb_torque": 0.15, "static_torque": 0.2, "kinetic_torque": 0.15, "stribeck_velocity": 0.1},
        **{"micro_damping": 0.05, "viscous_coefficient": 0.05, "load_friction": 0.1, "stribeck_load_friction": 0.05},
        **{"load_friction_driving": 0.2, "load_friction_braking": 0.1},
    }
    shares = recover(make("bench"), make("model", f"model={name}", nv=1), hidden, swing([0.05, 0.2, 0.8], [1.0, 4.0]))
    assert shares == {parameter: pytest.approx(1.0, abs=1e-3) for parameter in shares}
