"""Segments that hold together: their equations against dense ones, and an arm that torque drives, with known truth."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from helpers.driven_arm import ARM, TRUTH, Shot, shoot, swing

from frictionzoo.bench import Bench, Force
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.log import Log
from frictionzoo.core.segments import cut_segments
from frictionzoo.fit import LevenbergMarquardt, lm, shooting
from frictionzoo.fit import blocks as blocks_module
from frictionzoo.fit.blocks import each_part, measured_states
from frictionzoo.fit.chunk import search
from frictionzoo.fit.loss import Loss
from frictionzoo.fit.normal_equations import NormalEquations
from frictionzoo.fit.shooting import Mixed, follow, solve_chain

pytestmark = pytest.mark.usefixtures("x64")

CONTINUITY = 30.0


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    path = tmp_path_factory.mktemp("arm") / "arm.xml"
    path.write_text(ARM)
    return Bench(str(path), ["shoulder", "elbow"], actuator=Force(), params={"armature": {"init": 0.15}})


def noisy(log: Log, position: float, velocity: float) -> Log:
    rng = np.random.default_rng(3)
    qpos = log.qpos + position * rng.normal(size=log.qpos.shape)
    qvel = log.qvel + velocity * rng.normal(size=log.qvel.shape)
    return Log(log.name, log.time, qpos, qvel, log.ctrl, "hash", True)


def test_neighbours_are_told_within_a_recording_alone() -> None:
    logs = [swing(0.1), swing(0.1)]
    assert cut_segments(logs, None, 10).follows.tolist() == [False, True, True, True] * 2
    assert cut_segments(logs, 4, 10).follows.tolist() == [False] * 4
    assert cut_segments(logs, None, 10).first.follows is None


def test_a_chain_is_solved_as_a_dense_matrix_would_be() -> None:
    rng, count, size = np.random.default_rng(0), 5, 3
    root = rng.normal(size=(count * size, 2 * count * size))
    dense = root @ root.T
    for row in range(count):
        dense[row * size : (row + 1) * size, (row + 2) * size :] = 0
        dense[(row + 2) * size :, row * size : (row + 1) * size] = 0
    dense += 40 * np.eye(len(dense))
    blocks = dense.reshape(count, size, count, size).swapaxes(1, 2)
    diagonal = np.stack([blocks[row, row] for row in range(count)])
    beside = np.stack([blocks[row, (row + 1) % count] for row in range(count)])
    beside[-1] = rng.normal(size=(size, size))  # does not count
    right = rng.normal(size=(count, size, 2))
    found = solve_chain(*map(jnp.asarray, (diagonal, beside, right)))
    expected = np.linalg.solve(dense, right.reshape(-1, 2)).reshape(right.shape)
    np.testing.assert_allclose(found, expected, rtol=1e-10)


def test_a_forgotten_velocity_takes_nothing_but_what_its_position_takes(bench: Bench) -> None:
    """The derivatives by both are then the same but for their size, and the states' equations singular."""
    objective = shoot(bench, "coulomb_smooth", 10, swing(0.1)).objective
    rng = np.random.default_rng(0)
    slopes, by_state = rng.normal(size=(2, 1, 5, 60)), rng.normal(size=(4, 1, 5, 60))
    by_state[2:] = by_state[:2] * np.array([1e-3, -3e-9])[:, None, None, None] * (1 + 1e-15 * rng.normal(size=60))
    local = objective._residuals.shooting.local(jnp.zeros((1, 5, 60)), jnp.asarray(by_state))
    mixed = Mixed(jnp.einsum("ibsk,jbsk->bsij", by_state, slopes), jnp.zeros(()))
    blocks = jax.tree.map(lambda part: part[:1], objective.data)._replace(weight=jnp.ones((1, 5)))
    taken = objective._residuals.shooting.eliminate(local, mixed, blocks)[1][0]
    expected = np.zeros((2, 2))
    for own, by_own in zip(slopes[:, 0].swapaxes(0, 1), by_state[:2, 0].swapaxes(0, 1), strict=True):
        expected += own @ by_own.T @ np.linalg.solve(by_own @ by_own.T, by_own @ own.T)
    np.testing.assert_allclose(taken, expected, rtol=0, atol=1e-4 * np.abs(expected).max())


def root_mean_squares(shot: Shot) -> np.ndarray:
    """Of each joint's errors of position and velocity from measured states, where the objective begins."""
    objective, segments = shot.objective, shot.segments
    values = objective.space.values(objective.space.start)
    predicted = objective._rollout.compiled(values, segments.qpos[:, 0], segments.qvel[:, 0], segments.signals)
    errors = predicted[0] - segments.qpos[:, 1:], predicted[1] - segments.qvel[:, 1:]
    return np.sqrt([np.mean(np.square(error), axis=(0, 1)) for error in errors])


def dense_equations(shot: Shot, vector: np.ndarray, roots: np.ndarray) -> NormalEquations:
    """The same of states and coordinates in one dense matrix, the states found by scipy."""
    objective, segments = shot.objective, shot.segments
    follows, count = np.asarray(segments.follows), segments.count
    driven = segments.signals.map(jnp.asarray), jnp.zeros((count, 0))

    def residuals(both: Any) -> Any:
        states, vector = both[: 4 * count], both[4 * count :]
        qpos, qvel = jnp.moveaxis(states.reshape(count, 2, 2), 1, 0)
        predicted = objective._rollout(objective.space.values(vector), qpos, qvel, *driven)
        parts = []
        for root, own, after, measured in zip(
            roots, (qpos, qvel), predicted, (segments.qpos, segments.qvel), strict=True
        ):
            errors = (
                own - measured[:, 0],
                after - measured[:, 1:],
                CONTINUITY**0.5 * (after[:-1, -1] - own[1:])[follows[1:]],
            )
            parts += [(root * error).ravel() for error in errors]
        return jnp.concatenate(parts)

    errors, slopes = jax.jit(residuals), jax.jit(jax.jacfwd(residuals))
    start = np.stack([segments.qpos[:, 0], segments.qvel[:, 0]], axis=1).ravel()
    found = scipy.optimize.least_squares(
        lambda states: np.asarray(errors(np.append(states, vector))),
        start,
        jac=lambda states: np.asarray(slopes(np.append(states, vector)))[:, : len(start)],
        **dict.fromkeys(("xtol", "ftol", "gtol"), 1e-15),
    )
    rest, both = (np.asarray(part(np.append(found.x, vector))) for part in (errors, slopes))
    own, by_vector = np.split(both, [len(start)], axis=1)
    left = by_vector - own @ np.linalg.lstsq(own, by_vector, rcond=None)[0]
    terms = count * (segments.length + 1) * 2
    return NormalEquations(rest @ rest / terms, left.T @ rest / terms, left.T @ left / terms)


def test_equations_are_the_dense_ones(bench: Bench, monkeypatch: pytest.MonkeyPatch, in_haste: None) -> None:
    monkeypatch.setattr(blocks_module, "KEPT_STATES", 60)  # 3 of the 8 segments: the last block is not full
    monkeypatch.setattr(blocks_module, "ON_ACCELERATOR", 1)
    monkeypatch.setattr(blocks_module, "KEPT_BLOCKS", 1)
    monkeypatch.setattr(shooting, "_SHORTEST", 0.0)  # the dense equations have no curvature added
    logs = [noisy(swing(0.1, seed), 1e-3, 0.03) for seed in (0, 1)]
    shot = shoot(bench, "coulomb_smooth", 10, *logs, position=2.0, velocity=0.5, continuity=CONTINUITY, by_joint=True)
    roots = np.sqrt([[2.0], [0.5]]) / root_mean_squares(shot)
    objective, vector = shot.objective.balanced(), np.asarray(shot.objective.space.start) + 0.1
    assert objective.data.weight.shape == (3, 3) and objective.data.linked.sum() == 6
    ours, dense = objective.compile_normal_equations()(vector), dense_equations(shot, vector, roots)
    assert ours.loss == pytest.approx(dense.loss, rel=1e-9)
    scale = np.sqrt(np.diag(dense.hessian))
    np.testing.assert_allclose(ours.gradient / scale, dense.gradient / scale, atol=1e-6 * np.sqrt(dense.loss))
    np.testing.assert_allclose(ours.hessian, dense.hessian, atol=1e-7 * np.outer(scale, scale).max())


def test_trials_of_states_alone_have_the_same_derivatives(bench: Bench) -> None:
    objective = shoot(bench, "mujoco_default", 10, noisy(swing(0.1), 1e-3, 0.03), continuity=CONTINUITY).objective
    residuals, vector = objective._residuals, objective.space.start
    assert residuals.rollout.keeps_slopes  # else the first program has the derivatives already
    states = measured_states(objective.data.qpos, objective.data.qvel)
    block, own, following = next(each_part(objective.data, (states, follow(states))))
    linearised = residuals.linearise(vector, block, own, following)
    alone, whole = residuals.local(linearised), residuals.equations(linearised, exact=False).local
    jax.tree.map(lambda one, other: np.testing.assert_allclose(one, other, rtol=1e-12), alone, whole)


def test_a_fit_ends_when_three_tries_bring_nothing(bench: Bench) -> None:
    objective = shoot(bench, "mujoco_default", 10, swing(0.1)).objective
    fit = LevenbergMarquardt(9)
    vector, begun = fit.init(objective)
    equations = objective.compile_normal_equations()(vector)
    tried = begun._replace(tried=np.asarray(4), gradient=np.tile(equations.gradient, (9, 1)))
    tried = tried._replace(hessian=np.tile(equations.hessian, (9, 1, 1)))
    for change, ends in ((0.1 * objective.negligible, True), (10 * objective.negligible, False)):
        loss = equations.loss * (1 - change * np.arange(9))
        assert bool(lm._ask(objective, tried._replace(loss=loss), 1e-8).ended) == ends


@pytest.mark.slow
def test_an_arm_is_found_again_by_short_segments_that_hold_together(bench: Bench, in_haste: None) -> None:
    logs = [noisy(swing(1.0, seed), 1e-4, 0.02) for seed in (0, 1)]
    weights = {"position": 1e8, "velocity": 2500.0}  # of the noise's variances
    errors = []
    # Held together, one corner, where a joint sticks, ends the search for all states before their own gradient is 0.
    for continuity, near in ((0.0, 1e-6), (10.0, 1e-3)):
        objective = shoot(bench, "mujoco_default", 10, *logs, continuity=continuity, **weights).objective
        vector = objective.space.start
        loss, gradient = objective.compile(objective.value_and_grad("forward"))(vector, objective.data)
        equations = objective.compile_normal_equations()(np.asarray(vector))
        assert loss == pytest.approx(equations.loss, rel=1e-9)
        np.testing.assert_allclose(gradient, 2 * equations.gradient, rtol=0, atol=near * np.abs(gradient).max())
        found = objective.space.identified(search(LevenbergMarquardt(20, 1e-6), objective)[0].best)
        off = [np.abs(np.log(value / np.array(TRUTH[name.split(".")[1]]))) for name, value in found.items()]
        errors.append(np.stack(off))
    assert errors[1].max() < 0.03 and errors[1].mean() < 0.3 * errors[0].mean()


def test_a_joint_that_stands_still_is_not_all_that_counts() -> None:
    loss = Loss(4.0, 1.0, by_joint=True)
    np.testing.assert_allclose(loss.roots, [[2.0, 1.0]])
    weighed = loss.over(np.array([[0.25, 1.0], [0.0, 0.0]]))
    np.testing.assert_allclose(weighed.roots, [[4.0, 1.0], [4e4, 1e4]])
    assert np.isfinite(loss.over(np.zeros((2, 2))).roots).all()
    with pytest.raises(ConfigError, match=r"loss\.by_joint=true: rollouts of the segments are not finite"):
        loss.over(np.array([[np.nan, 1.0]]))
