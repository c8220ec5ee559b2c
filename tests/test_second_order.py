"""Rollouts of second order: against an integrator of another kind, and for the steps of a simulator."""

import importlib
import itertools
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import frictionzoo as fz
from frictionzoo.bench.delay import stretch, write_delay
from frictionzoo.core.described import describe, remake
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.segments import Segments
from frictionzoo.core.state import Signals
from frictionzoo.models.dahl import Dahl
from frictionzoo.result.simulator import build_simulated, compensate
from frictionzoo.simulation.drive import Drive
from frictionzoo.simulation.dry_friction import rigid_step

KP, KD, OWN, ARMATURE = 40.0, 1.5, 0.05, 0.02
STATIC, KINETIC, STRIBECK, SMOOTHING, VISCOUS = 0.4, 0.3, 0.8, 0.5, 0.2  # smooth, so that the order shows
MASS, CENTRE, INERTIA, GRAVITY = 0.3, 0.1, 0.002, 9.81
INTERVAL, SECONDS = 0.01, 1.0
START = 0.4, -1.0
STAND = f"""<mujoco><compiler angle="radian"/><option timestep="0.001" integrator="INTEGRATOR"/><worldbody><body>
  <joint name="motor" axis="0 1 0" damping="{OWN}"/>
  <inertial pos="0 0 {-CENTRE}" mass="{MASS}" diaginertia="{INERTIA} {INERTIA} 1e-5"/></body></worldbody></mujoco>"""


def bench(path: Path, integrator: str, timestep: float, second_order: bool = True) -> fz.Bench:
    (path / "stand.xml").write_text(STAND.replace("INTEGRATOR", integrator))
    return fz.Bench(
        str(path / "stand.xml"),
        actuator=fz.PositionPD(kp=KP, kd=KD),
        params={"armature": ARMATURE},
        timestep=timestep,
        second_order=second_order,
    )


def law() -> fz.FrictionModel:
    values = {
        **{"static_torque": STATIC, "kinetic_torque": KINETIC, "stribeck_velocity": STRIBECK},
        **{"smoothing_velocity": SMOOTHING, "viscous_coefficient": VISCOUS},
    }
    return fz.law("coulomb_stribeck", params={n: {"init": value, "high": 2.0} for n, value in values.items()})


def values_of(stand: fz.Bench, friction: fz.FrictionModel) -> dict[str, dict[str, np.ndarray]]:
    """Initial values of a drive."""
    own = {name: value.detach().double().numpy() for name, value in friction.state_dict().items()}
    return {"bench": stand.initial_values(), "friction": own}


def roll(
    stand: fz.Bench,
    ctrl: np.ndarray,
    friction: fz.FrictionModel | None = None,
    start: tuple[float, float] = START,
) -> np.ndarray:
    """Positions under a command."""
    friction = friction or law()
    with jax.enable_x64(True):
        drive = Drive.assemble(stand, friction, "auto", stand.sampling(INTERVAL))
        values = values_of(stand, friction)
        state = np.array([[start[0]]]), np.array([[start[1]]])
        qpos, _ = drive.rollout.compiled(values, *state, Signals(ctrl[None, :, None]))
        return np.asarray(qpos)[0, :, 0]


def solve(ctrl: np.ndarray) -> np.ndarray:
    """The same motion by Runge and Kutta, from the equation of motion alone."""
    whole = INERTIA + MASS * CENTRE**2 + ARMATURE

    def slope(_: float, state: np.ndarray, command: float) -> list[float]:
        qpos, qvel = state
        dry = KINETIC + (STATIC - KINETIC) * np.exp(-((qvel / STRIBECK) ** 2))
        friction = dry * np.tanh(qvel / SMOOTHING) + (VISCOUS + OWN) * qvel
        motor = KP * (command - qpos) - KD * qvel
        return [qvel, (motor - friction - MASS * GRAVITY * CENTRE * np.sin(qpos)) / whole]

    state, found = np.array(START), []
    for command in ctrl:
        state = solve_ivp(slope, (0, INTERVAL), state, args=(command,), rtol=1e-10, atol=1e-12).y[:, -1]
        found.append(state[0])
    return np.array(found)


COMMANDS = 0.5 * np.sin(6 * INTERVAL * np.arange(round(SECONDS / INTERVAL)))


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_errors_fall_with_the_square_of_the_step(integrator: str, tmp_path: Path) -> None:
    truth = solve(COMMANDS)
    steps = (5e-3, 2.5e-3, 1.25e-3)
    errors = [np.abs(roll(bench(tmp_path, integrator, step), COMMANDS) - truth).max() for step in steps]
    plain = np.abs(roll(bench(tmp_path, integrator, steps[-1], second_order=False), COMMANDS) - truth).max()
    assert 3.3 < errors[0] / errors[1] < 4.7 and 3.3 < errors[1] / errors[2] < 4.7
    assert errors[-1] < 3e-5 and plain > 20 * errors[-1]


STIFFNESS, MICRO, BY_LOAD = 200.0, 0.5, 1e-4
SPRINGS = {
    "dahl": {"coulomb_torque": KINETIC},
    "lugre": {"static_torque": STATIC, "kinetic_torque": KINETIC, "stribeck_velocity": 0.3, "micro_damping": MICRO},
    "torque_proportional": {"coulomb_torque": KINETIC, "presliding": KINETIC / STIFFNESS}
    | {"load_friction_driving": BY_LOAD, "load_friction_braking": BY_LOAD},  # of more, the load is of first order
    "maxwell_slip": {"static_torque": KINETIC, "kinetic_torque": KINETIC, "presliding": KINETIC / STIFFNESS},
}
REST = 0.0, 0.0  # no load, so that no spring is bent


def solve_springs(name: str, ctrl: np.ndarray) -> np.ndarray:
    """Positions of a drive with presliding, from rest, by Runge and Kutta."""
    given, whole = SPRINGS[name], INERTIA + MASS * CENTRE**2 + ARMATURE

    def slope(_: float, state: np.ndarray, command: float) -> list[float]:
        qpos, qvel, bent = state
        limit, motor = KINETIC, KP * (command - qpos) - KD * qvel
        if name == "lugre":
            limit += (STATIC - KINETIC) * np.exp(-((qvel / given["stribeck_velocity"]) ** 2))
        rate = qvel - STIFFNESS * abs(qvel) * bent / limit
        spring = STIFFNESS * bent + given.get("micro_damping", 0.0) * rate
        if name == "torque_proportional":
            spring *= 1 + BY_LOAD * abs(motor) / KINETIC
        if name == "maxwell_slip":  # of one element
            rate = 0.0 if STIFFNESS * bent * np.sign(qvel) >= KINETIC else qvel
        weight = MASS * GRAVITY * CENTRE * np.sin(qpos)
        return [qvel, (motor - spring - (VISCOUS + OWN) * qvel - weight) / whole, rate]

    state, found = np.array([*REST, 0.0]), []
    for command in ctrl:
        options = {"rtol": 1e-10, "atol": 1e-13, "max_step": 2e-4}
        state = solve_ivp(slope, (0, INTERVAL), state, args=(command,), **options).y[:, -1]
        found.append(state[0])
    return np.array(found)


def spring_law(name: str) -> fz.FrictionModel:
    values = {**SPRINGS[name], "viscous_coefficient": VISCOUS}
    values |= {"stiffness": STIFFNESS} if name in ("dahl", "lugre") else {}
    options = {"elements": 1} if name == "maxwell_slip" else {}
    return fz.law(name, params={key: {"init": value, "high": 2 * value} for key, value in values.items()}, **options)


SMALL = 0.05 * np.sin(6 * INTERVAL * np.arange(100))


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
@pytest.mark.parametrize("name", SPRINGS)
def test_springs_of_a_friction_model_are_of_second_order_too(name: str, integrator: str, tmp_path: Path) -> None:
    ctrl, friction, truth = SMALL, spring_law(name), solve_springs(name, SMALL)
    steps = (2.5e-3, 1.25e-3, 6.25e-4)
    errors = [np.abs(roll(bench(tmp_path, integrator, h), ctrl, friction, REST) - truth).max() for h in steps]
    assert errors[0] / errors[1] > 3 and errors[1] / errors[2] > 2.8 and errors[-1] < 5e-6


def test_a_law_that_changes_a_step_of_its_parent_changes_those_of_second_order() -> None:
    class Twice(Dahl):
        def advance(self, xp: Any, values: Any, state: Any, memory: Any, timestep: float) -> Any:
            terms, memory = super().advance(xp, values, state, memory, timestep)
            return terms._replace(torque=2 * terms.torque), memory

    assert Twice.advance_midway is fz.FrictionModel.advance_midway is not Dahl.advance_midway


def test_a_drive_of_32_bits_is_simulated_in_64_too(tmp_path: Path) -> None:
    """As a fit in float32 and its exports do, with the arrays of one bench."""
    stand, friction = bench(tmp_path, "Euler", 1e-3), law()
    with jax.enable_x64(False):
        drive = Drive.assemble(stand, friction, "auto", stand.sampling(INTERVAL))
        values = jax.tree.map(np.float32, values_of(stand, friction))
        start = (np.full((1, 1), part, np.float32) for part in START)
        qpos, _ = drive.rollout.compiled(values, *start, Signals(np.float32(COMMANDS)[None, :, None]))
    whole = roll(stand, COMMANDS)
    assert qpos.dtype == np.float32 and whole.dtype == np.float64
    assert np.abs(whole - solve(COMMANDS)).max() < 3e-5 > np.abs(qpos[0, :, 0] - whole).max()


@pytest.mark.parametrize("name", SPRINGS)
def test_a_simulator_moves_as_a_drive_with_springs(name: str, tmp_path: Path) -> None:
    stand, friction, truth = bench(tmp_path, "Euler", 1e-3), spring_law(name), solve_springs(name, SMALL)
    values, qpos = values_of(stand, friction), np.concatenate([[0.0], truth])[None, :, None]
    segments = Segments(qpos, np.gradient(qpos, INTERVAL, axis=1), Signals(SMALL[None, :, None]), INTERVAL)
    simulated = build_simulated(stand, describe(stand), values, {"timestep": 2e-3})
    found, errors = compensate(simulated, friction, values, segments), []
    with jax.enable_x64(True):
        for midway in (True, False):
            drive = Drive.assemble(simulated, friction, "auto", simulated.sampling(INTERVAL), midway)
            history = simulated.sampling(INTERVAL).history
            acting = Signals(np.pad(SMALL, (history, 0), "edge")[None, :, None])
            qpos, _ = drive.rollout.compiled(found, np.zeros((1, 1)), np.zeros((1, 1)), acting)
            errors.append(np.abs(np.asarray(qpos)[0, :, 0] - truth).mean())
    assert errors[0] < 0.4 * errors[1] and errors[0] < 1.5e-5


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
@pytest.mark.parametrize("timestep", [2e-3, 5e-3])
def test_a_simulator_gets_the_parameters_with_which_it_moves_as_the_drive(integrator, timestep, tmp_path):
    """In MuJoCo C, which knows nothing of second order: it begins at the measured state and is read as it is."""
    stand, truth, friction = bench(tmp_path, integrator, 1e-3), solve(COMMANDS), law()
    values = values_of(stand, friction)
    simulated = build_simulated(stand, describe(stand), values, {"timestep": timestep})
    qpos = np.concatenate([[START[0]], truth])[None, :, None]
    segments = Segments(qpos, np.gradient(qpos, INTERVAL, axis=1), Signals(COMMANDS[None, :, None]), INTERVAL)
    found = compensate(simulated, friction, values, segments)
    assert found["bench"]["delay"] == pytest.approx(timestep / 2)
    kept = {**found["bench"], "armature": values["bench"]["armature"], "delay": np.zeros(1)}
    begun = round(0.3 / INTERVAL)  # what begins out of step with the half drift has decayed by then
    errors = [np.abs(play(simulated, of) - truth)[begun:].max() for of in (found["bench"], kept)]
    assert errors[0] < 0.15 * errors[1]


def test_a_drive_without_recordings_has_a_simulator_too(tmp_path: Path) -> None:
    stand, friction = bench(tmp_path, "Euler", 1e-3), fz.law("mujoco_default", params={"damping": {"init": 0.3}})
    values, none = values_of(stand, friction), np.zeros((0, 3, 1))
    simulated = build_simulated(stand, describe(stand), values, {"timestep": 2e-3})
    found = compensate(simulated, friction, values, Segments(none, none, Signals(none[:, :2]), INTERVAL))
    assert found["bench"]["armature"][0] == pytest.approx(ARMATURE + 1e-3 * (KD - OWN - 0.3))
    with pytest.raises(ConfigError, match=r"bench\.integrator"):
        remake(stand, integrator="RK5")


@pytest.mark.parametrize("steps", [0.1, 1.0, 1.3, 4.6])
def test_commands_are_as_late_under_rk4_as_they_should(steps: float) -> None:
    """A force that rises steadily, as it comes out of MuJoCo's actuator in RK4."""
    timestep = 2e-3
    delay = steps * timestep
    late = write_delay(float(stretch(np.array([delay]), timestep)[0]), timestep)
    written = " ".join(f'{name}="{value}"' for name, value in late.items())
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="{timestep}" gravity="0 0 0" integrator="RK4"/><worldbody><body>
        <joint name="j" type="slide"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody>
        <actuator><general joint="j" {written}/></actuator></mujoco>"""
    )
    data = mujoco.MjData(model)
    for data.ctrl[0] in timestep * np.arange(60):
        before = data.qvel[0]
        mujoco.mj_step(model, data)
    assert data.ctrl[0] - (data.qvel[0] - before) / timestep == pytest.approx(delay, rel=1e-4)


def play(simulated: fz.Bench, values: Mapping[str, np.ndarray]) -> np.ndarray:
    model = mujoco.MjModel.from_xml_string(simulated.mjcf(values))
    data, found, before = mujoco.MjData(model), [], COMMANDS[0]
    data.qpos[0], data.qvel[0] = START
    if model.na:
        data.act[0] = before
    for command in COMMANDS:
        for _ in range(round(INTERVAL / model.opt.timestep)):
            data.ctrl[0] = command
            qvel = data.qvel[0]
            dry = KINETIC + (STATIC - KINETIC) * np.exp(-((qvel / STRIBECK) ** 2))
            data.qfrc_applied[0] = -dry * np.tanh(qvel / SMOOTHING) - VISCOUS * qvel
            mujoco.mj_step(model, data)
        found.append(data.qpos[0])
    return np.array(found)


LEG = {"armature": (0.03, 0.02), "viscous": (0.2, 0.1), "forward": (1.5, 0.8)}


@pytest.fixture
def exact(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The program that simulates from event to event."""
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "benchmarks")
    return importlib.import_module("event_exact")


def leg(exact: Any, path: Path, integrator: str, timestep: float) -> tuple[Drive, Any, Any]:
    """A leg that sticks and slides: the simulated drive, its values, and links and drives of the other program."""
    links = [exact.Link(-1, (0, 1, 0), (0, 0, 0), MASS, (0, 0, -CENTRE), (INERTIA, INERTIA, 1e-5))]
    links.append(exact.Link(0, (0, 1, 0), (0, 0, -0.2), MASS, (0, 0, -CENTRE), (INERTIA, INERTIA, 1e-5)))
    rows = zip(*LEG.values(), strict=True)
    drives = [exact.Drive(*row, kp=KP, kd=KD) for row in rows]
    text = exact.write_mjcf(links, ["hip", "knee"]).replace("<option ", f'<option integrator="{integrator}" ')
    (path / "leg.xml").write_text(text)
    stand = fz.Bench(
        str(path / "leg.xml"),
        ["hip", "knee"],
        actuator=fz.PositionPD(kp=KP, kd=KD),
        params={"armature": list(LEG["armature"])},
        timestep=timestep,
        solreffriction=[2 * timestep, 1.0],
        second_order=True,
    )
    drive = Drive.assemble(stand, fz.law("mujoco_default", nv=2), "auto", stand.sampling(INTERVAL))
    friction = {"frictionloss": np.array(LEG["forward"]), "damping": np.array(LEG["viscous"])}
    return drive, {"bench": stand.initial_values(), "friction": friction}, (links, drives)


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_dry_friction_does_not_creep_and_turns_round_in_time(integrator: str, tmp_path: Path, exact: Any) -> None:
    """Errors and slopes of a leg against one that is simulated from event to event, by a program without a step."""
    times = INTERVAL * np.arange(200)
    ctrl = np.stack([0.3 * np.sin(5 * times) + 0.1 * np.sin(11 * times + 1), 0.4 * np.sin(6 * times)], axis=1)
    found, slopes = {}, {}
    with jax.enable_x64(True):
        for timestep in (2e-3, 1e-3, 5e-4):
            drive, values, program = leg(exact, tmp_path, integrator, timestep)
            begun, acting = (jnp.asarray(ctrl[:1]), jnp.zeros((1, 2))), Signals(jnp.asarray(ctrl[None]))

            def roll(
                dry: Any, drive: Drive = drive, values: Any = values, begun: Any = begun, acting: Any = acting
            ) -> Any:
                given = {**values, "friction": {**values["friction"], "frictionloss": dry}}
                return drive.rollout(given, *begun, acting)[0][0]

            dry = np.array(LEG["forward"])
            both = jax.jit(lambda dry, roll=roll: jax.jvp(roll, (dry,), (dry,)))(dry)
            found[timestep], slopes[timestep] = map(np.asarray, both)
    motion = exact.simulate(*program, np.concatenate([ctrl, ctrl[-1:]]), INTERVAL)
    assert motion.sticking > 0.1
    errors = [np.abs(qpos - motion.qpos[1:]).max() for qpos in found.values()]
    assert 3 < errors[0] / errors[1] < 5 and 3 < errors[1] / errors[2] < 5 and errors[1] < 5e-6
    links, drives = program
    more, less = (
        exact.simulate(links, [replace(of, forward=of.forward * (1 + by)) for of in drives], ctrl, INTERVAL).qpos[1:]
        for by in (1e-3, -1e-3)
    )
    wide = (more - less) / 2e-3
    off = [np.linalg.norm(slope[:-1] - wide) / np.linalg.norm(wide) for slope in slopes.values()]
    assert off[1] < 5e-3 and off[2] < 2e-3


def test_both_engines_have_the_same_dry_friction(tmp_path: Path, exact: Any) -> None:
    times = INTERVAL * np.arange(20)
    ctrl = 0.5 * np.sin(20 * times)[None, :, None] * np.ones((1, 1, 2))
    begun = np.array([[0.1, -0.1]]), np.array([[0.4, 0.0]])
    with jax.enable_x64(True):
        drive, values, _ = leg(exact, tmp_path, "Euler", 2e-3)
        other = Drive.assemble(drive.engine.bench, drive.model, "mjx", drive.engine.bench.sampling(INTERVAL))
        one, two = (of.rollout.compiled(values, *begun, Signals(ctrl)) for of in (drive, other))
    assert other.engine.name == "mjx" and drive.engine.name == "specialised"
    np.testing.assert_allclose(one, two, rtol=1e-9, atol=1e-11)


def test_one_joint_turns_at_the_instant_at_which_it_stops() -> None:
    """Whatever acts on it: velocity and place after a step are those of the motion's two pieces."""
    rng, step = np.random.default_rng(0), 1e-3
    size, (force, limit, inertia) = 500, np.abs(rng.normal(size=(3, 500)))
    force, qvel = force * rng.choice([-1, 1], size), 2e-3 * rng.normal(size=size)
    inertia, limit[:20] = inertia + 0.1, 0.0
    with jax.enable_x64(True):
        step_one = jax.vmap(lambda m, f, v, most: rigid_step(((m,),), f[None], v[None], step, most[None]))
        acceleration, shift = (np.asarray(part)[:, 0] for part in step_one(inertia, force, qvel, limit))
    place, speed = np.zeros(size), qvel.copy()
    for at in range(size):
        left = step
        for _ in range(2):
            side = np.sign(speed[at]) or np.sign(force[at])
            holds = speed[at] == 0 and abs(force[at]) <= limit[at]
            slope = 0.0 if holds else (force[at] - side * limit[at]) / inertia[at]
            stops = -speed[at] / slope if slope * speed[at] < 0 else np.inf
            part = min(stops, left)
            place[at] += speed[at] * part + slope * part**2 / 2
            speed[at], left = (0.0 if stops <= left else speed[at] + slope * part), left - part
    turned, stopped = (speed * qvel < 0).mean(), (speed == 0).mean()
    assert turned > 0.1 and stopped > 0.1
    np.testing.assert_allclose(qvel + step * acceleration, speed, atol=2e-8)
    np.testing.assert_allclose(step * (qvel + step * acceleration / 2) + shift, place, atol=1e-11)


@pytest.mark.parametrize("limits", [[[0.0]], [[0.0, 0.3], [0.3, 0.0]]])
def test_a_joint_without_friction_or_force_has_slopes(limits: list[list[float]]) -> None:
    def step(inertia: Any, force: Any, qvel: Any, limit: Any) -> Any:
        return rigid_step(inertia, force, qvel, 1e-3, limit)

    joints = len(limits[0])
    with jax.enable_x64(True):
        inertia = tuple(tuple(jnp.asarray(float(i == j)) for j in range(i + 1)) for i in range(joints))
        slopes = jax.jit(jax.jacfwd(step, (0, 1, 2, 3)))
        for limit, qvel in itertools.product(limits, (-0.1, 0.0, 0.1)):
            found = slopes(inertia, jnp.zeros(joints), jnp.full(joints, qvel), jnp.asarray(limit))
            assert all(np.isfinite(part).all() for part in jax.tree.leaves(found)), (limit, qvel)


@pytest.mark.slow
def test_exact_coulomb_friction_is_found(tmp_path: Path, exact: Any) -> None:
    """Of a drive that sticks and slides from event to event, simulated by a program that knows nothing of MuJoCo."""
    truth, interval = exact.Drive(armature=0.03, viscous=0.2, forward=0.3, kp=KP, kd=KD), 0.002
    links = [exact.Link(-1, (0, 1, 0), (0, 0, 0), MASS, (0, 0, -CENTRE), (INERTIA, INERTIA, 1e-5))]
    (tmp_path / "stand.xml").write_text(exact.write_mjcf(links, ["motor"]))
    times = interval * np.arange(8000)
    ctrl = (0.3 * np.sin(5 * times) + 0.2 * np.sin(8.7 * times + 1))[:, None]
    motion = exact.simulate(links, [truth], ctrl, interval)
    assert motion.sticking > 0.01
    log = fz.Log("log", times, exact.round_to(motion.qpos, 14), motion.qvel, ctrl, sha256=64 * "0", simulated=True)
    stand = fz.Bench(str(tmp_path / "stand.xml"), actuator=fz.PositionPD(kp=KP, kd=KD))
    found = fz.identify(stand, fz.law("mujoco_default"), [log])
    values = {name: float(parameter.value[0]) for name, parameter in found.parameters.items()}
    assert values["bench.armature"] == pytest.approx(0.03, rel=3e-3)
    assert values["friction.frictionloss"] == pytest.approx(0.3, rel=3e-3)
    assert values["friction.damping"] == pytest.approx(0.2, rel=1e-2)
    chosen = {row["option"]: row["value"] for row in found.result["recipe"]}
    assert chosen["bench.second_order"] is True and chosen["bench.solreffriction"] == [2e-3, 1.0]
    own = np.abs(found.find_residual()).mean()
    for integrator in ("Euler", "implicitfast", "RK4"):
        for timestep in (2e-3, 5e-3):
            folder = tmp_path / f"{integrator}{1e3 * timestep:g}"
            export = found.export("mjcf", folder, timestep=timestep, integrator=integrator).export
            assert export is not None and export.differences[0].error is not None
            assert export.differences[0].error < 2 * own
