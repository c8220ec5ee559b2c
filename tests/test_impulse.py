"""Velocity errors as impulses: whose torque lacks, from when on, and an arm whose torque is noisy, with known truth."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from helpers.driven_arm import ARM, TRUTH, shoot, swing

from frictionzoo.bench import Bench, Force
from frictionzoo.core.log import Log
from frictionzoo.core.segments import cut_segments
from frictionzoo.fit import LevenbergMarquardt
from frictionzoo.fit.chunk import search
from frictionzoo.fit.loss import impulses, is_moving, rigid_inertia_of

pytestmark = pytest.mark.usefixtures("x64")

IMPULSE = {"position": 0.0, "velocity": 1.0, "refine": False, "impulse": True, "by_joint": True}


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    path = tmp_path_factory.mktemp("arm") / "arm.xml"
    path.write_text(ARM)
    return Bench(str(path), ["shoulder", "elbow"], actuator=Force(), params={"armature": {"init": 0.15}})


def with_noise(log: Log, torque: float) -> Log:
    ctrl = log.ctrl + torque * np.random.default_rng(3).normal(size=log.ctrl.shape)
    return Log(log.name, log.time, log.qpos, log.qvel, ctrl, "", True)


def test_a_torque_that_lacks_shows_in_its_own_joint_in_its_own_interval(bench: Bench) -> None:
    model, armature = bench.compile(constraint=False), np.array([0.3, 0.1])
    model.dof_armature[:] = armature
    segments = cut_segments([bench.accept(swing(0.1))], None, 4)
    lacking, ends = np.array([[0.0, 0.0], [0.5, 0.0], [0.0, -0.2], [0.0, 0.0]]), []
    for torque in (lacking, np.zeros((4, 2))):
        data, velocities = mujoco.MjData(model), []
        data.qpos[:], data.qvel[:] = segments.qpos[3, 0], segments.qvel[3, 0]
        for data.qfrc_applied[:] in torque:
            mujoco.mj_step(model, data)
            velocities.append(data.qvel.copy())
        ends.append(np.array(velocities))
    inertia = rigid_inertia_of(bench, segments)
    found = impulses(jnp.asarray(ends[0] - ends[1])[None], jnp.asarray(inertia[3:4]), jnp.asarray(armature))
    np.testing.assert_allclose(found[0], lacking * model.opt.timestep, atol=2e-6)


def test_slow_intervals_are_told_joint_by_joint(bench: Bench) -> None:
    segments = cut_segments([bench.accept(swing(0.4))], None, 5)
    moving = is_moving(segments, 0.3)
    speed = np.abs(np.diff(segments.qpos, axis=1)) / segments.timestep
    assert moving.shape == (segments.count, 5, 2) and moving.any(axis=(0, 1)).all()
    assert speed[~moving].max() < 1.05 * 0.3 * np.sqrt(np.mean(np.square(segments.qvel), axis=(0, 1))).max()
    assert is_moving(segments, 0.0).mean() > 0.99


@pytest.mark.slow
def test_noise_of_the_torque_does_not_make_the_armature_heavier(bench: Bench, in_haste: None) -> None:
    logs = [with_noise(swing(2.0, seed), 1.5) for seed in (0, 1)]
    off = []
    for loss in ({**IMPULSE, "impulse": False}, {**IMPULSE, "slow": 0.05}):
        objective = shoot(bench, "mujoco_default", 3, *logs, **loss).objective.balanced()
        begun = objective.compile_normal_equations()(np.asarray(objective.space.start))
        assert begun.loss == pytest.approx(1.0)  # each joint's mean square, over what counts of it
        found = objective.space.identified(search(LevenbergMarquardt(30, 1e-6), objective)[0].best)
        off.append({name: value / np.array(TRUTH[name.split(".")[1]]) - 1 for name, value in found.items()})
    plain, impulse = off
    assert plain["bench.armature"].max() > 0.2
    assert np.abs(impulse["bench.armature"]).max() < 0.03
    # The elbow's friction is less than half of the noise: two standard errors.
    assert max(np.abs(value).max() for value in impulse.values()) < 0.15
