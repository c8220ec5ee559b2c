"""Play between motor and load: against MuJoCo C with two joints, at its limits, and what recordings tell of it."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from frictionzoo.bench import Bench
from frictionzoo.bench.signals import pair_all
from frictionzoo.core.build import build
from frictionzoo.core.config import compose_settings
from frictionzoo.core.errors import ConfigError, LogError
from frictionzoo.core.log import Log
from frictionzoo.core.segments import Segments, cut_segments
from frictionzoo.core.state import DriveState, Signals
from frictionzoo.data.two_inertia import TwoInertia
from frictionzoo.fit import Objective, Space, estimate_uncertainty
from frictionzoo.fit.chunk import search
from frictionzoo.fit.lm import LevenbergMarquardt
from frictionzoo.fit.uncertainty import Uncertainty
from frictionzoo.identification.stages import Stages
from frictionzoo.models import Backlash
from frictionzoo.models.backlash import _dead_zone
from frictionzoo.simulation import Friction, friction_of, make_engine, without_memory
from frictionzoo.simulation.rollout import make_rollout

MAKE = Callable[..., Any]
QUIET = ("data.sensor.position_quantum=0", "data.sensor.velocity_noise=0")


@pytest.fixture(scope="module")
def law(make: MAKE) -> Backlash:
    return make("model", "model=backlash", nv=1)


@pytest.fixture(scope="module")
def twin(make: MAKE) -> Callable[..., TwoInertia]:
    return lambda *more: make("data", "data=two_inertia", "data.cache_dir=null", *more)


def truth(twin: TwoInertia, law: Backlash, **changes: float) -> dict[str, np.ndarray]:
    """What the law's parameters are in this simulated drive."""
    hidden = vars(twin.drive)
    known = {name: hidden.get(name, law.params[name].init) for name in law.params}
    return {name: np.array([value]) for name, value in (known | changes).items()}


def drive_values(bench: Bench, twin: TwoInertia, law: Backlash, **changes: float) -> dict[str, Any]:
    armature = changes.pop("armature", twin.drive.armature)
    return {
        "bench": bench.initial_values() | {"armature": np.array([armature])},
        "friction": truth(twin, law, **changes),
    }


def follow(bench: Bench, friction: Friction, values: Any, ctrl: np.ndarray, parts: int = 1) -> np.ndarray:
    """Load angle [rad] after each sample, from rest at the first command."""
    with jax.enable_x64(True):
        rollout = make_rollout(make_engine("auto", bench, friction, False)).compiled
        commands = np.repeat(ctrl, parts)[None, :, None]
        qpos, _ = rollout(values, np.full((1, 1), ctrl[0]), np.zeros((1, 1)), Signals(commands))
    return np.asarray(qpos)[0, parts - 1 :: parts, 0]


def command(twin: TwoInertia) -> np.ndarray:
    return twin.excitation.command(np.arange(twin.samples) * twin.timestep, np.random.default_rng(2))


def state_of(qvel: np.ndarray, motor_torque: np.ndarray) -> DriveState:
    zero = np.zeros_like(qvel)
    return DriveState(zero, qvel, zero, motor_torque, zero)


def test_inside_the_gap_nothing_is_passed_on(law: Backlash, twin: Callable[..., TwoInertia]) -> None:
    values = truth(twin(), law)
    ahead = values["gap"] / 2 * np.linspace(-0.85, 0.85, 18)[:, None]
    torque, rotor, qvel = np.full_like(ahead, 0.4), np.full_like(ahead, 1.3), np.full_like(ahead, 1.2)
    memory = np.stack([ahead, rotor, torque], -1)
    terms, after = law.advance(np, values, state_of(qvel, torque), memory, 1e-3)
    # All of the motor's torque is taken from the load, and goes into the rotor and its friction.
    np.testing.assert_array_equal(terms.torque, torque)
    np.testing.assert_array_equal(terms.damping, 0.0)
    kept = rotor + 1e-3 / values["rotor_inertia"] * torque
    assert (after[..., 1] < kept).all() and (after[..., 1] > kept - 1e-3 / 0.01 * (0.1 + 0.5 * 1.5)).all()
    np.testing.assert_allclose(after[..., 0], ahead + 1e-3 * (after[..., 1] - qvel), rtol=1e-12)


def test_the_dead_zone_is_hard_but_for_its_rounding(law: Backlash, twin: Callable[..., TwoInertia]) -> None:
    values, angle = truth(twin(), law), np.linspace(-0.03, 0.03, 6001)
    bend, slope = _dead_zone(np, values, angle)
    hard = np.sign(angle) * np.maximum(np.abs(angle) - 0.01, 0)
    # Rounded over s g: at the edge a parabola and a corner are s g / 8 apart.
    assert np.abs(bend - hard).max() == pytest.approx(0.1 * 0.02 / 8)
    np.testing.assert_allclose(slope, np.gradient(bend, angle), atol=6e-3)  # of a step, by the parabola's width
    huge, _ = _dead_zone(np, values, np.array([-1e30, 1e30]))
    np.testing.assert_array_equal(huge, [-1e30, 1e30])


def test_a_rollout_begins_in_contact_where_the_motor_pushes(law: Backlash, twin: Callable[..., TwoInertia]) -> None:
    drive = twin().drive
    values = truth(twin(), law)
    torque, qvel = np.array([[1.0], [-1.0], [3e-3], [2.0]]), np.array([[0.0], [0.0], [0.0], [1.5]])
    memory = law.settle(np, values, state_of(qvel, torque))
    passed = values["stiffness"] * _dead_zone(np, values, memory[..., 0])[0]
    np.testing.assert_allclose(passed[:3], torque[:3], rtol=1e-12)
    np.testing.assert_allclose(passed[3], 2.0 - drive.friction(1.5), rtol=1e-12)
    np.testing.assert_array_equal(memory[..., 1], qvel)


def test_a_rollout_is_that_of_two_joints_in_mujoco(law: Backlash, twin: Callable[..., TwoInertia], make: MAKE) -> None:
    """The load crosses the gap some ten times; the hard corners are those of MuJoCo's simulation alone."""
    oracle = twin("data.samples=601", "data.substeps=30")
    ctrl = command(oracle)
    expected, errors = oracle.simulate(ctrl)[0][1:, 0], []
    for parts, smoothing in ((1, 0.1), (8, 0.01)):
        bench = make("bench", f"bench.timestep={1e-3 / parts}")
        values = drive_values(bench, oracle, law, smoothing=smoothing)
        errors.append(np.abs(follow(bench, friction_of(law), values, ctrl, parts)[:-1] - expected).max())
    # Without the play, the same drive is off by a good part of it.
    bench = make("bench")
    closed = follow(bench, friction_of(law), drive_values(bench, oracle, law, gap=1e-4), ctrl)[:-1] - expected
    assert np.abs(closed).max() > 0.3 * oracle.drive.gap
    assert errors[0] < 0.05 * oracle.drive.gap
    assert errors[1] < 0.2 * errors[0]  # an error of the first order, of step and rounding


@pytest.mark.parametrize("stiffness", [1e5, 1e10])  # the highest of the bounds, and no physical one
def test_a_stiff_coupling_without_play_is_one_rigid_drive(law, twin, make, stiffness):
    oracle, bench = twin("data.samples=1001"), make("bench")
    ctrl, values = command(oracle), drive_values(bench, oracle, law, gap=1e-4, stiffness=stiffness)
    found = follow(bench, friction_of(law), values, ctrl)
    rigid = drive_values(bench, oracle, law, armature=oracle.drive.armature + oracle.drive.rotor_inertia)
    one = without_memory(lambda friction, state: law.terms(jnp, friction, state))
    expected = follow(bench, one, rigid, ctrl)
    # A step of 1 ms at up to 4 rad/s, by which friction acts late, and the play of 0.1 mrad.
    assert np.abs(found - expected).max() < 2e-3


@pytest.mark.parametrize("stiffness", [1.0, 1e2, 1e4, 1e5, 1e8])
def test_without_a_motor_energy_is_never_gained(law, twin, stiffness):
    """Rotor and a free load that meet in the gap, again and again, at 1 ms; neither friction nor damper helps."""
    values = truth(twin(), law, stiffness=stiffness, coupling_damping=1e-9, frictionloss=1e-9, damping=1e-9)
    inertia, timestep, nothing = 0.03, 1e-3, np.zeros(7)
    qvel = np.linspace(-2.0, 2.0, 7)
    memory = np.stack([np.linspace(-0.009, 0.006, 7), np.full(7, 0.7), nothing], -1)
    energy = []
    for _ in range(1000):
        terms, memory = law.advance(np, values, state_of(qvel, nothing), memory, timestep)
        bend, _ = _dead_zone(np, values, memory[..., 0])
        spring = stiffness * np.where(np.abs(bend) > 1e-3, np.square(bend), 0.0) / 2  # less than what is in it
        energy.append(inertia * np.square(qvel) / 2 + 0.01 * np.square(memory[..., 1]) / 2 + spring)
        qvel = qvel - timestep * (terms.torque + terms.damping * qvel) / (inertia + timestep * terms.damping)
    start = 0.03 * np.linspace(-2.0, 2.0, 7) ** 2 / 2 + 0.01 * 0.7**2 / 2
    assert (np.max(energy, axis=0) <= start * (1 + 1e-6)).all()


def test_torch_equals_jax_across_the_gap(law: Backlash, twin: Callable[..., TwoInertia]) -> None:
    values, time = truth(twin(), law), np.arange(60)
    states = [
        state_of(np.array([v]), np.array([t])) for v, t in zip(np.cos(time / 9), 2 * np.sin(time / 5), strict=True)
    ]

    def along(xp: Any, convert: Callable[[Any], Any], advance: Callable[..., Any]) -> np.ndarray:
        own = {name: convert(value) for name, value in values.items()}
        drive = [state.map(convert) for state in states]
        memory, found = law.settle(xp, own, drive[0]), []
        for state in drive:
            terms, memory = advance(own, state, memory)
            found.append([float(part[0]) for part in (terms.torque, terms.damping, memory[..., 0], memory[..., 1])])
        return np.array(found)

    with jax.enable_x64(True):
        ours = along(torch, torch.tensor, partial(law.advance, torch, timestep=1e-3))
        theirs = along(jnp, jnp.asarray, jax.jit(partial(law.advance, jnp, timestep=1e-3)))
    np.testing.assert_allclose(ours, theirs, rtol=1e-10, atol=1e-12)  # rounding, carried over 60 steps
    assert (ours[:, 1] == 0).any() and (ours[:, 1] > 0).any()  # free and in contact


def test_gradient_of_a_rollout_equals_central_differences(law, twin, knee):
    oracle = twin("data.samples=150")
    ctrl = np.stack([0.1 * np.sin(40e-3 * np.arange(150)), -0.2 * np.sin(25e-3 * np.arange(150) + 1)])
    names = [name for name, param in law.params.items() if param.identify]
    with jax.enable_x64(True):
        rollout = make_rollout(make_engine("auto", knee, friction_of(law), False))
        values = drive_values(knee, oracle, law)

        def end(scale: Any) -> Any:
            friction = {name: jnp.asarray(value) for name, value in values["friction"].items()}
            friction |= {name: friction[name] * scale[i] for i, name in enumerate(names)}
            start = jnp.zeros((2, 1)), jnp.array([[0.0], [0.3]])
            qpos, _ = rollout({**values, "friction": friction}, *start, Signals(jnp.asarray(ctrl)[..., None]))
            return (qpos * 1e3).sum()

        steps = 1e-7 * np.eye(len(names))  # small: the second derivative has corners
        scales = 1 + np.concatenate([0 * steps, steps, -steps])
        ends, slopes = jax.jit(jax.vmap(jax.value_and_grad(end)))(scales)
    _, after, before = np.asarray(ends).reshape(3, -1)
    slope = dict(zip(names, np.asarray(slopes)[0], strict=True))
    expected = dict(zip(names, (after - before) / 2e-7, strict=True))
    assert slope == pytest.approx(expected, rel=1e-4, abs=1e-4)
    assert min(map(abs, slope.values())) > 1e-3


def pose(bench: Bench, law: Backlash, segments: Segments) -> Objective:
    rollout = make_rollout(make_engine("auto", bench, friction_of(law), False), bench.sampling(segments.timestep))
    return Objective(Space(bench, law, "float64"), rollout, segments, 1.0, 1.0, "none", 1.0, False)


def coordinates(space: Space, values: Any) -> np.ndarray:
    """All identified parameters are on a logarithmic scale."""
    owners = (name.split(".") for name in space.names)
    return np.log([float(values[owner][name][0]) for owner, name in owners])


def assess(bench: Bench, law: Backlash, log: Log, values: Any, length: int) -> Uncertainty:
    objective = pose(bench, law, cut_segments([bench.accept(log)], 20, length))
    return estimate_uncertainty(objective, coordinates(objective.space, values))


@pytest.mark.slow
@pytest.mark.parametrize(("sensor", "spoilt"), [(QUIET, ()), ((), ("friction.stiffness",))], ids=["exact", "noisy"])
def test_parameters_are_recovered_from_the_simulated_recording(law, twin, knee, sensor, spoilt):
    """From MuJoCo's hard corners at 0.05 ms, by a law rounded at 1 ms; the start is off by up to a factor of two."""
    oracle = twin("data.samples=8001", *sensor)
    (log,) = oracle.load().train
    factors = {"friction.gap": 0.5, "friction.stiffness": 1.3, "friction.damping": 0.7, "friction.frictionloss": 1.5}
    with jax.enable_x64(True):
        objective = pose(knee, law, cut_segments([knee.accept(log)], 40, 1500))
        names, expected = objective.space.names, coordinates(objective.space, drive_values(knee, oracle, law))
        objective.space.start = jnp.asarray(expected + np.log([factors.get(name, 1.0) for name in names]))
        method = LevenbergMarquardt(60, 1e-8)
        progress, _ = search(method, objective)
        best = np.asarray(progress.best)
        found = dict(zip(names, np.exp(best - expected), strict=True))
        uncertainty = estimate_uncertainty(objective, best)
    assert uncertainty.identifiable["friction.gap"]
    low, high = uncertainty.intervals["friction.gap"][0] / oracle.drive.gap
    assert 0.9 < low < high < 1.1  # the interval is of the best gap, which the rounding moves
    for name in ("bench.armature", "friction.rotor_inertia", "friction.gap", "friction.stiffness"):
        if name not in spoilt:
            assert found[name] == pytest.approx(1.0, abs=0.05), found


def test_a_load_on_one_side_hides_the_gap(law: Backlash, twin: Callable[..., TwoInertia], knee: Bench) -> None:
    """Held up against gravity and moved so slowly that the coupling stays in contact; swung, it is told above."""
    oracle = twin("data.samples=1701", "data.substeps=5", *QUIET)
    time = 1e-3 * np.arange(oracle.samples)
    ctrl = 1.2 + 0.1 * np.sin(4 * time)
    qpos, qvel = (part[500:] for part in oracle.simulate(ctrl))  # from when it hangs in the coupling on
    log = Log("raised", time[:-500], qpos, qvel, ctrl[500:, None], "", simulated=True)
    with jax.enable_x64(True):
        found = assess(knee, law, log, drive_values(knee, oracle, law), 300)
    assert not found.identifiable["friction.gap"] and found.identifiable["friction.damping"]
    assert np.isnan(found.intervals["friction.gap"]).all()  # no effect at all, not a small one


def test_without_play_rotor_and_load_are_one(law: Backlash, twin: Callable[..., TwoInertia], knee: Bench) -> None:
    """A stiff coupling that is never let go; the recording is the law's own, so that nothing but this counts."""
    oracle, time = twin("data.samples=2", *QUIET), 1e-3 * np.arange(1400)
    ctrl = 1.2 + 0.1 * np.sin(4 * time)
    values = drive_values(knee, oracle, law, gap=2e-4, stiffness=5e4)
    with jax.enable_x64(True):
        rollout = make_rollout(make_engine("auto", knee, friction_of(law), False)).compiled
        after = rollout(values, np.full((1, 1), ctrl[0]), np.zeros((1, 1)), Signals(ctrl[None, :, None]))
        qpos, qvel = (np.asarray(part)[0, 499:-1] for part in after)  # from when it hangs in the coupling on
        log = Log("stiff", time[:-500], qpos, qvel, ctrl[500:, None], "", simulated=True)
        found = assess(knee, law, log, values, 300)
    assert not found.identifiable["bench.armature"] and not found.identifiable["friction.rotor_inertia"]
    assert ("bench.armature", "friction.rotor_inertia") in [tuple(sorted(group)) for group in found.indistinct]


def test_a_recording_carries_its_truth(twin: Callable[..., TwoInertia]) -> None:
    made = twin("data.samples=801", "data.split.gap=0.1", *QUIET)
    (log,) = made.load().train
    assert log.simulated and log.metadata["drive"] == vars(made.drive)
    wide = twin("data.samples=801", "data.split.gap=0.1", "data.drive.gap=0.04", *QUIET).load().train[0]
    assert np.abs(wide.qpos - log.qpos).max() > 5e-3  # the gap is in the motion


def test_the_simulated_coupling_pushes_in_contact_only(twin: Callable[..., TwoInertia]) -> None:
    drive = twin().drive
    assert [drive.coupling(ahead, 1.0) for ahead in (-0.0099, 0.0, 0.0099)] == [0.0, 0.0, 0.0]
    assert drive.coupling(0.015, 0.2) == pytest.approx(100 * 0.005 + 0.2)
    assert drive.coupling(-0.015, -0.2) == pytest.approx(-drive.coupling(0.015, 0.2))


def test_a_drive_that_cannot_be_is_refused(twin: Callable[..., TwoInertia]) -> None:
    with pytest.raises(ConfigError, match=r"data\.drive\.gap=-0\.1: expected 0 or more"):
        twin("data.drive.gap=-0.1")
    with pytest.raises(ConfigError, match=r"data\.drive\.stiffness=0: expected a positive number"):
        twin("data.drive.stiffness=0")
    with pytest.raises(LogError, match=r"two_inertia: the simulation diverged at sample \d+"):
        twin("data.samples=200", "data.drive.stiffness=1e9").load()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "seconds"), [("backlash", 1.6), ("coulomb_smooth", 1.0)])
def test_segments_are_long_where_a_rollout_begins_with_a_guess(twin, knee, name, seconds):
    """A tenth of 16 s to train on, which is less than the law asks for; of other laws a second."""
    samples = "data.samples=20001"
    settings = compose_settings({}, "data=two_inertia", samples, f"model={name}", "recipe=auto")
    law, fit = build(settings["model"], nv=1), build(settings["fit"])
    law.bind(knee.joints)
    recorded = pair_all(twin(samples).load(), knee.joints)
    with jax.enable_x64(True):
        stages = Stages(settings, knee, recorded, law, fit)
        stages.prepare()
        length = stages.settings["segments"]["length"]
    assert length * 1e-3 == pytest.approx(seconds, rel=0.1)
