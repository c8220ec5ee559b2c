"""Intervals of identified parameters, and what data cannot tell apart, on segments whose truth is known."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
import scipy.stats
from conftest import slow_but, spoil
from helpers.known_drive import KNOWN, LOSS, TRUTH, Problem, compose_drive, noisy, pose, record
from helpers.servo import record as record_servo
from helpers.servo import wander

from frictionzoo.bench import Bench
from frictionzoo.core.segments import Segments, cut_segments
from frictionzoo.core.state import Signals
from frictionzoo.fit import Objective, Space, estimate_uncertainty
from frictionzoo.fit import blocks as blocks_module
from frictionzoo.fit.blocks import divide
from frictionzoo.fit.normal_equations import NormalEquations
from frictionzoo.fit.uncertainty import Uncertainty, assess
from frictionzoo.simulation import friction_of, make_engine
from frictionzoo.simulation.rollout import Rollout, make_rollout

pytestmark = pytest.mark.usefixtures("x64")

START = np.log([TRUTH["armature"], TRUTH["frictionloss"], TRUTH["damping"]])
FRICTION = ("static_torque", "kinetic_torque", "stribeck_velocity", "viscous_coefficient")


def minimise(objective: Objective, steps: int = 8) -> np.ndarray:
    """By plain steps of Gauss and Newton from the truth, near which they converge."""
    evaluate, vector = objective.compile_normal_equations(), START.copy()
    for _ in range(steps):
        equations = evaluate(vector)
        vector -= np.linalg.solve(equations.hessian, equations.gradient)
    return vector


def deviation(moved: np.ndarray) -> float:
    """Standard deviation of an estimate that the stretches have moved by so much, one after the other."""
    stretches, kept = len(moved), max(moved[1:] @ moved[:-1] / (moved @ moved), 0.0)
    new = [np.sqrt(1 - kept**2) * moved[0], *(one - kept * before for before, one in itertools.pairwise(moved))]
    return np.sqrt(stretches / (stretches - 1) * np.square(new).sum()) / (1 - kept)


def test_intervals_are_those_of_the_formula(monkeypatch: pytest.MonkeyPatch) -> None:
    """The covariance spelt out with the whole Jacobian of all residuals."""
    stretches, scale = 7, 0.02
    monkeypatch.setattr(blocks_module, "MOST_STRETCHES", stretches)
    monkeypatch.setattr(blocks_module, "ON_ACCELERATOR", 1)
    monkeypatch.setattr(blocks_module, "BLOCK_STATES", 35)  # blocks and stretches do not begin together
    data, plain = noisy(record(), 1e-3, 2e-2), pose("mujoco_default").objective
    started = jax.tree.map(jnp.asarray, (data.qpos[:, 0], data.qvel[:, 0], data.signals))

    def residuals(vector: Any) -> Any:
        states = plain._rollout(plain.space.values(vector), *started)
        errors = [after - measured[:, 1:] for after, measured in zip(states, (data.qpos, data.qvel), strict=True)]
        error = jnp.stack(errors).reshape(2, 60, -1).swapaxes(0, 1).reshape(60, -1)
        return error, error

    linearise = jax.jit(jax.jacfwd(residuals, has_aux=True))
    # With a robust loss they are steps of reweighted least squares, which are slower.
    for robust, steps in (("none", 8), ("soft_l1", 40)):
        objective = pose("mujoco_default", segments=data, robust=robust, robust_scale=scale).objective
        best = minimise(objective, steps)
        found = estimate_uncertainty(objective, best)
        slope, error = map(np.asarray, linearise(jnp.asarray(best)))
        z = (error / scale) ** 2
        # Of the loss 2 (sqrt(1 + z) - 1) scale^2: half its first and second derivative by the residual.
        force, bend = (error / np.sqrt(1 + z), (1 + z) ** -1.5) if robust == "soft_l1" else (error, np.ones_like(error))
        inverse = np.linalg.inv(np.einsum("ski,sk,skj->ij", slope, bend, slope))
        segment = np.einsum("ski,sk->si", slope, force)
        scores = np.array([segment[np.arange(60) * stretches // 60 == g].sum(axis=0) for g in range(stretches)])
        moved = (scores - scores.mean(axis=0)) @ inverse
        half = scipy.stats.t.ppf(0.975, stretches - 1) * np.array([deviation(own) for own in moved.T])
        for i, name in enumerate(objective.space.params):
            expected = np.exp(best[i] + half[i] * np.array([-1, 1]))
            # What the fit left undone stretches an interval by far less than the tolerance.
            np.testing.assert_allclose(found.intervals[name][0], expected, rtol=1e-4)
            assert found.identifiable[name] == bool(half[i] < np.log(1.5))
        assert found.indistinct == () and found.missing is None


@pytest.mark.parametrize("refine", [False, True])
def test_intervals_cover_the_truth_as_often_as_they_say(refine: bool) -> None:
    """Over repeated noise; a rollout's residuals share the noise of its initial state."""
    objective = pose("mujoco_default", refine=refine).objective
    rng, found, recording = np.random.default_rng(0), [], record()
    for _ in range(30):
        errors = [scale * rng.normal(size=recording.qpos.shape) for scale in (1e-5, 1e-3)]
        qpos, qvel = recording.qpos + errors[0], recording.qvel + errors[1]
        objective.data = objective.data._replace(qpos=jnp.asarray(qpos[None]), qvel=jnp.asarray(qvel[None]))
        best = minimise(objective)
        ends = np.concatenate(list(estimate_uncertainty(objective, best).intervals.values()))
        found.append((best, *np.log(ends).T))
    best, low, high = np.array(found).swapaxes(0, 1)
    covered = (low <= START) & (high >= START)
    # Of 30 trials at 95 %, fewer than 24 succeed in 1 of 3000 cases.
    assert (covered.sum(axis=0) >= 24).all(), covered.sum(axis=0)
    # Nor are they wide for that: half of one is Student's 2.0 standard deviations, which 30 trials know to 13 %.
    ratio = (high - low).mean(axis=0) / 2 / best.std(axis=0)
    assert (np.abs(ratio - 2) < 0.8).all(), ratio


def test_an_interval_reaches_from_where_a_fit_stopped_to_the_minimum() -> None:
    objective = pose("mujoco_default").objective
    for name, (low, high) in _intervals(estimate_uncertainty(objective, START + 0.05)).items():
        value = TRUTH[name.partition(".")[2]]
        # The minimum is extrapolated, by 5 %: to the square of that.
        assert low < value * 1.005 and high > value * np.exp(0.05) * (1 - 1e-9), name


def test_whole_recordings_are_stretches_where_there_are_enough() -> None:
    def number(segments: int, recordings: int) -> list[int]:
        none = np.zeros((segments, 2, 1))
        of = np.arange(segments) * recordings // segments
        return divide(Segments(none, none, Signals(none[:, 1:]), 0.01, recording=of)).tolist()

    assert number(30, 1) == list(range(30)) == number(30, 9)
    assert number(30, 10) == np.repeat(np.arange(10), 3).tolist()
    assert np.bincount(number(500, 100)).tolist() == [10] * 50  # two recordings each
    assert np.bincount(number(100, 1)).tolist() == [2] * 50


def test_what_lasts_from_stretch_to_stretch_widens_an_interval(arm: Space) -> None:
    """Errors of which half is left in the next stretch: their sum varies by 1 / (1 - 0.5)."""
    rng, found = np.random.default_rng(4), []
    for kept in (0.0, 0.5):
        new = 0.01 * rng.normal(size=(200, 6))
        scores = scipy.signal.lfilter([1.0], [1.0, -kept], new, axis=0)
        equations = NormalEquations(1.0, np.zeros(6), np.eye(6))
        covariance = assess(arm, np.asarray(arm.start), equations, scores).covariance
        assert covariance is not None
        found.append(np.sqrt(np.diag(covariance.matrix)).mean())
    # The mean of six deviations, each known to some 10 %.
    assert found == pytest.approx([0.01 * np.sqrt(200), 0.01 * np.sqrt(200) * 2], rel=0.12)


def begin(qpos: np.ndarray, qvel: np.ndarray, ctrl: np.ndarray) -> Segments:
    """Segments of which only the first states, of shape (batch, 1, nv), are known: they stay."""
    states = (np.repeat(first, ctrl.shape[1] + 1, axis=1) for first in (qpos, qvel))
    return Segments(*states, Signals(ctrl), 0.001)


def simulate(space: Space, rollout: Rollout, started: Segments, position: float, velocity: float) -> Segments:
    """Segments as the drive's initial values make them, with noise of these sizes in all but the first state."""
    rng, states, first = np.random.default_rng(0), [], (started.qpos[:, :1], started.qvel[:, :1])
    predicted = rollout.compiled(space.values(space.start), *(at[:, 0] for at in first), started.signals, started.loads)
    for start, after, noise in zip(first, predicted, (position, velocity), strict=True):
        states.append(np.concatenate([start, after + noise * rng.normal(size=after.shape)], axis=1))
    return replace(started, qpos=states[0], qvel=states[1])


def judge(problem: Problem, started: Segments, position: float, velocity: float) -> Uncertainty:
    """Uncertainty of a drive from such segments."""
    objective, space = problem.objective, problem.objective.space
    segments = simulate(space, objective._rollout, started, position, velocity)
    return estimate_uncertainty(Objective(space, objective._rollout, segments, **LOSS), np.asarray(space.start))


def stribeck(qpos: np.ndarray, qvel: np.ndarray, push: np.ndarray) -> Uncertainty:
    """Uncertainty of a Coulomb-Stribeck drive from segments that start at these states with these commands."""
    ctrl = (qpos + push)[:, None, None] * np.ones((1, 5, 1))
    started = begin(qpos[:, None, None], qvel[:, None, None], ctrl)
    return judge(pose("coulomb_stribeck"), started, 1e-7, 1e-4)


def test_a_slow_constant_velocity_does_not_identify_a_stribeck_curve() -> None:
    count, velocity = 400, 0.1
    qpos = np.linspace(-0.5, 0.5, count)
    gravity = 0.26 * 9.81 * 0.1127 * np.sin(qpos)
    friction = (0.03 + 0.02 * np.exp(-((velocity / 0.075) ** 2))) + 0.03 * velocity
    found = stribeck(qpos, np.full(count, velocity), (gravity + friction + velocity) / 20)
    assert not any(found.identifiable[f"friction.{name}"] for name in FRICTION)
    (group,) = found.indistinct
    # One number, the friction at this speed, is all that four of them are known by.
    assert set(group) == {f"friction.{name}" for name in FRICTION}
    assert all(np.isnan(found.intervals[name]).all() for name in group)


def test_a_lively_record_identifies_all_of_it() -> None:
    rng = np.random.default_rng(1)
    speed = np.exp(rng.uniform(np.log(0.02), np.log(2), 400)) * rng.choice([-1, 1], 400)
    found = stribeck(rng.uniform(-1, 1, 400), speed, rng.normal(0, 0.05, 400))
    assert all(found.identifiable.values()), found
    assert len(found.identifiable) == 5 and found.indistinct == ()
    for low, high in _intervals(found).values():
        assert 0 < high - low < high / 2


def _intervals(found: Uncertainty) -> Mapping[str, np.ndarray]:
    return {name: ends[0] for name, ends in found.intervals.items()}


@pytest.mark.parametrize("name", slow_but(["lugre"], ["lugre", "harmonic_drive", "maxwell_slip"]))
def test_one_speed_in_one_direction_identifies_no_law(name: str) -> None:
    """Whatever friction is made of, such a record holds one number of it."""
    problem, alike = pose(name), np.ones((100, 1, 1))
    started = begin(0.0 * alike, 0.5 * alike, 0.1 * np.ones((100, 5, 1)))
    found = judge(problem, started, 1e-6, 1e-4)
    assert set(found.identifiable) == set(problem.objective.space.params) > {"bench.armature"}
    assert not any(found.identifiable.values())


def test_back_emf_and_damping_of_a_servo_are_one() -> None:
    options = ("bench=sts3215", "bench.params.delay.init=0", "bench.params.delay.identify=false")
    bench, law = compose_drive(("model=mujoco_default", *options))
    kept, _ = compose_drive((*options, "bench.actuator.params.kt2_over_r.identify=false"))
    spaces = [Space(each, law, "float64") for each in (bench, kept)]
    engine = make_engine("specialised", bench, friction_of(law), law.constraint)
    rollout, still = make_rollout(engine, bench.sampling(0.01)), record_servo(wander(801, 0), gain=32.0)
    moved = simulate(spaces[0], rollout, cut_segments([bench.accept(still)], count=None, length=800), 0.0, 0.0)
    log = replace(still, qpos=moved.qpos[0], qvel=moved.qvel[0])
    segments = cut_segments([bench.accept(log)], count=None, length=10)
    for signal, noise in ((segments.qpos, 1e-5), (segments.qvel, 1e-3)):
        signal[:, 1:] += noise * np.random.default_rng(0).normal(size=signal[:, 1:].shape)
    best = np.asarray(spaces[0].start)
    equations, scores = Objective(spaces[0], rollout, segments, **LOSS).compile_scores()(best)
    one = ("bench.kt2_over_r", "friction.damping")
    for space, told in zip(spaces, ((one,), ()), strict=True):
        at = [spaces[0].names.index(name) for name in space.names]
        loss, gradient, hessian = equations[:3]
        found = assess(space, best[at], NormalEquations(loss, gradient[at], hessian[np.ix_(at, at)]), scores[:, at])
        assert found.indistinct == told
        assert {name for name, fine in found.identifiable.items() if not fine} == {name for one in told for name in one}


def test_a_constant_force_and_a_law_that_differs_by_direction_are_one() -> None:
    rng = np.random.default_rng(2)
    start = rng.uniform(-0.1, 0.1, (200, 1, 1)), rng.normal(0, 0.1, (200, 1, 1))
    started = begin(*start, rng.normal(0, 1, (200, 5, 1)))
    found = judge(pose("asymmetric", bench="emps", segments=started), started, 1e-8, 1e-6)
    group = ("bench.force_offset", "friction.frictionloss_forward", "friction.frictionloss_backward")
    assert found.indistinct == (group,)
    assert {name for name, fine in found.identifiable.items() if not fine} == set(group)


@pytest.fixture
def arm(make: Callable[..., Any], two_joints: Bench) -> Space:
    """The coordinates of two joints: armature, frictionloss and damping of each, all logarithms."""
    return Space(two_joints, make("model", "model=mujoco_default", nv=2), "float64")


def test_each_joint_is_judged_by_itself(arm: Space) -> None:
    """Armature 0 is at its bound, frictionloss 1 has no effect, damping 0 and armature 1 are one; the rest is fine."""
    rng = np.random.default_rng(3)
    jacobian = rng.normal(size=(1000, 6))
    jacobian[:, 3] = 0.0
    jacobian[:, 4] = 2 * jacobian[:, 1]
    residuals = 0.1 * rng.normal(size=1000)
    residuals -= jacobian[:, 1:] @ np.linalg.pinv(jacobian[:, 1:]) @ residuals
    vector = np.asarray(arm.start).copy()
    vector[0] = np.asarray(arm.low)[0]
    scores = (jacobian * residuals[:, None]).reshape(50, 20, 6).sum(axis=1)
    equations = NormalEquations(residuals @ residuals, jacobian.T @ residuals, jacobian.T @ jacobian)
    found = assess(arm, vector, equations, scores)
    missing = {name: np.isnan(ends[:, 0]).tolist() for name, ends in found.intervals.items()}
    assert missing == {
        "bench.armature": [True, True],
        "friction.frictionloss": [False, True],
        "friction.damping": [True, False],
    }
    assert not any(found.identifiable.values())
    fine = {name: joints.tolist() for name, joints in found.determined.items()}
    assert fine["bench.armature"] == [False, False]
    assert fine["friction.frictionloss"] == [True, False] and fine["friction.damping"] == [False, True]
    assert found.indistinct == (("bench.armature/knee", "friction.damping/hip"),)
    # 0.1 of noise over 1000 rows of size 1, times Student's 2.01; from 50 stretches the spread is known to 10 %.
    low, high = np.log(found.intervals["friction.damping"][1])
    assert (high - low) / 2 == pytest.approx(2.01 * 0.1 / np.sqrt(1000), rel=0.3)


def test_an_interval_ends_at_the_bounds(arm: Space) -> None:
    vector, unit = np.asarray(arm.start), np.eye(6)
    scores = np.concatenate([unit, -unit])  # as uncertain as the coordinates are long
    found = assess(arm, vector, NormalEquations(1.0, np.zeros(6), 0.1 * unit), scores)
    assert not any(found.identifiable.values())
    for name, ends in found.intervals.items():
        param = arm.params[name]
        np.testing.assert_allclose(ends, [[param.low, param.high]] * 2, rtol=1e-12)


@pytest.mark.parametrize("precise", [False, True])
def test_estimates_that_follow_each_other_are_told_apart_where_they_are_precise(arm: Space, precise: bool) -> None:
    hessian = np.eye(6)
    hessian[2, 5] = hessian[5, 2] = 0.995
    scores = (1e-4 if precise else 1e-2) * np.concatenate([np.eye(6), -np.eye(6)])
    found = assess(arm, np.asarray(arm.start), NormalEquations(1.0, np.zeros(6), hessian), scores)
    one = ("friction.frictionloss/hip", "friction.damping/knee")
    assert found.indistinct == (() if precise else (one,))
    assert [name for name, fine in found.identifiable.items() if fine] == [
        name for name in arm.params if precise or name == "bench.armature"
    ]


def test_what_a_long_log_says_of_a_combination_can_be_had(arm: Space) -> None:
    """Of an eigenvalue of 7e-5, which counts as none: the recipe takes it, so that a long delay is not left out."""
    hessian = np.eye(6)
    hessian[2, 5] = hessian[5, 2] = 1 - 7e-5
    pushed = 1e-4 * np.outer([1, -1, 1, -1], [0, 0, 1, 0, 0, -1])  # along it
    equations, start = NormalEquations(1.0, np.zeros(6), hessian), np.asarray(arm.start)
    widths = [
        np.log(np.divide(*assess(arm, start, equations, pushed, *collinear).intervals["friction.damping"][1][::-1]))
        for collinear in ((), (1e-8,))
    ]
    assert np.isnan(widths[0]) and 1 < widths[1] < 20


@pytest.mark.parametrize(
    ("model", "options", "reason"),
    [
        ("residual_network", (), "a network's weights"),
        ("mujoco_default", KNOWN, "nothing was identified"),
        ("mujoco_default", (), "the derivative of the objective is not finite"),
    ],
)
def test_where_there_are_no_intervals_a_reason_is_given(model: str, options: Sequence[str], reason: str) -> None:
    objective = pose(model, *options).objective
    if "finite" in reason:
        spoil(objective)
    found = estimate_uncertainty(objective, np.asarray(objective.space.start))
    assert found.missing is not None and reason in found.missing
    assert found == Uncertainty(missing=found.missing)
