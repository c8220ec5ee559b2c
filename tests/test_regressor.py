"""Inverse dynamics, its regressor, and coordinates of link inertia, against MuJoCo C."""

import mujoco
import numpy as np
import pytest
from helpers.robots import arm

from frictionzoo.bench.base_parameters import BaseParameters, find_base_parameters
from frictionzoo.bench.inertia import (
    SYMBOLS,
    LogCholesky,
    from_pseudo_inertia,
    inertial_parameters,
    is_consistent,
    put_parameters,
    to_parameters,
    to_pseudo_inertia,
)
from frictionzoo.bench.regressor import inertial_regressor, inverse_torque
from frictionzoo.core.errors import BenchError

CRANE = """<mujoco><option gravity="0.3 -0.2 -9.81"/><worldbody><body pos="0 1 2" euler="10 20 30">
  <joint type="slide" axis="1 1 0" stiffness="30" springref="0.2"/>
  <joint axis="0 1 0" pos="0.1 0 0.2" armature="0.3" frictionloss="1"/>
  <inertial pos="0.1 0.2 0.3" mass="2" fullinertia="0.3 0.2 0.25 0.01 0.02 -0.03"/>
  <body pos="0.3 0 0" quat="1 0.2 0 0.4"><inertial pos="0 0.1 0" mass="0.5" diaginertia="0.01 0.02 0.02"/>
    <body pos="0 0.4 0"><joint axis="1 0 1" damping="0.7"/><inertial pos="0 0 0.3" mass="1" diaginertia="0.1 0.1 0.02"/>
  </body></body>
  <body pos="0 0 -0.3"><joint type="slide" axis="0 0 1"/>
    <inertial pos="0.1 0 0" mass="0.7" diaginertia="0.03 0.04 0.05"/></body>
</body></worldbody></mujoco>"""
"""Slides and hinges, two on one body, a body without a joint, two branches, a spring and a damper."""


def moving(model: mujoco.MjModel, samples: int = 50) -> np.ndarray:
    """Random positions, velocities and accelerations."""
    return np.random.default_rng(0).normal(size=(3, samples, model.nv))


def names(model: mujoco.MjModel, bodies: list[int]) -> list[str]:
    return [f"{symbol} {body}" for body in bodies for symbol in SYMBOLS]


@pytest.mark.parametrize("mjcf", [arm(), CRANE], ids=["arm", "crane"])
def test_regressor_times_parameters_is_inverse_dynamics(mjcf: str) -> None:
    model = mujoco.MjModel.from_xml_string(mjcf)
    bodies, motion = list(range(1, model.nbody)), moving(model)
    regressor = inertial_regressor(model, bodies, *motion)
    torque = np.einsum("tvbk,bk->tv", regressor, inertial_parameters(model, bodies))
    springs = model.jnt_stiffness * (motion[0] - model.qpos_spring) + model.dof_damping * motion[1]
    np.testing.assert_allclose(torque + springs, inverse_torque(model, *motion), atol=1e-10)


def test_inverse_torque_has_no_armature_and_no_dry_friction() -> None:
    model = mujoco.MjModel.from_xml_string(CRANE)
    data, motion = mujoco.MjData(model), moving(model)
    torque = inverse_torque(model, *motion)
    for index in range(len(torque)):
        data.qpos[:], data.qvel[:] = motion[0, index], motion[1, index]
        mujoco.mj_forward(model, data)
        data.qacc[:] = motion[2, index]
        mujoco.mj_inverse(model, data)
        friction = data.qfrc_constraint
        expected = data.qfrc_inverse + friction - model.dof_armature * motion[2, index]
        np.testing.assert_allclose(torque[index], expected, atol=1e-10)


def test_some_bodies_of_a_model_change_the_torque_by_their_columns() -> None:
    model = mujoco.MjModel.from_xml_string(arm())
    bodies, motion = [2, 4], moving(model)
    before, parameters = inverse_torque(model, *motion), inertial_parameters(model, bodies)
    changed = LogCholesky.around(parameters, ["2", "4"]).parameters(np.random.default_rng(1).normal(size=(2, 10)) / 5)
    for body, own in zip(bodies, changed, strict=True):
        put_parameters(model, body, own)
    regressor = inertial_regressor(model, bodies, *motion)
    difference = np.einsum("tvbk,bk->tv", regressor, changed - parameters)
    np.testing.assert_allclose(inverse_torque(model, *motion), before + difference, atol=1e-10)
    np.testing.assert_allclose(inertial_parameters(model, bodies), changed, atol=1e-12)


def test_a_free_joint_and_compensated_gravity_are_refused() -> None:
    free = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><freejoint/><geom size="1"/></body></worldbody></mujoco>'
    )
    with pytest.raises(BenchError, match="a free or a ball joint, expected hinges and slides"):
        inverse_torque(free, *np.zeros((3, 1, 6)))
    floating = mujoco.MjModel.from_xml_string(arm().replace("<body pos", '<body gravcomp="1" pos', 1))
    with pytest.raises(BenchError, match="gravcomp=1, expected 0"):
        inertial_regressor(floating, [1], *np.zeros((3, 1, floating.nv)))


def test_ten_parameters_pseudo_inertia_and_log_cholesky_are_one_body() -> None:
    model = mujoco.MjModel.from_xml_string(CRANE)
    bodies = list(range(1, model.nbody))
    maker = inertial_parameters(model, bodies)
    np.testing.assert_allclose(from_pseudo_inertia(to_pseudo_inertia(maker)), maker, atol=1e-15)
    around = LogCholesky.around(maker, ["a", "b", "c", "d"])
    np.testing.assert_allclose(around.parameters(np.zeros((len(bodies), 10))), maker, atol=1e-15)
    moved = np.random.default_rng(2).normal(size=(len(bodies), 10))
    parameters = around.parameters(moved)
    assert is_consistent(parameters).all()
    np.testing.assert_allclose(around.coordinates(parameters), moved, atol=1e-10)
    np.testing.assert_allclose(parameters[:, 0], maker[:, 0] * np.exp(moved[:, 0]), rtol=1e-12)
    shift = parameters[:, 1:4] / parameters[:, :1] - maker[:, 1:4] / maker[:, :1]
    np.testing.assert_allclose(shift, moved[:, 1:4], atol=1e-12)


def test_slopes_of_log_cholesky_are_its_derivative() -> None:
    maker = to_parameters(2.0, np.array([0.1, 0.0, -0.2]), np.diag([0.02, 0.03, 0.04]))[None]
    around, at = LogCholesky.around(maker, ["a"]), np.random.default_rng(3).normal(size=(1, 10)) / 2
    steps = 1e-6 * np.eye(10)
    numeric = [(around.parameters(at + step) - around.parameters(at - step)) / 2e-6 for step in steps]
    np.testing.assert_allclose(around.slopes(at), np.stack(numeric, axis=-1), atol=1e-8)


def test_a_point_mass_is_taken_as_a_small_ball_and_an_impossible_body_is_refused() -> None:
    point = to_parameters(1.0, np.zeros(3), np.zeros((3, 3)))
    around = LogCholesky.around(point[None], ["tip"])
    assert is_consistent(around.parameters(np.zeros((1, 10)))).all()
    with pytest.raises(BenchError, match=r"body tip: principal inertias .* exceeds the sum of the others"):
        LogCholesky.around(to_parameters(1.0, np.zeros(3), np.diag([1.0, 1.0, 3.0]))[None], ["tip"])
    with pytest.raises(BenchError, match="body tip: a mass of 0 kg"):
        LogCholesky.around(np.zeros((1, 10)), ["tip"])
    model = mujoco.MjModel.from_xml_string(arm())
    with pytest.raises(BenchError, match="no mass distribution has"):
        put_parameters(model, 1, to_parameters(1.0, np.zeros(3), np.diag([1.0, 1.0, 3.0])))


def without_effect(base: BaseParameters) -> set[str]:
    """Names of the parameters without an effect."""
    return {name for name, column in zip(base.names, base.matrix.T, strict=True) if not column.any()}


def test_base_parameters_say_all_and_no_more_than_the_regressor() -> None:
    model = mujoco.MjModel.from_xml_string(arm())
    bodies, motion = list(range(1, model.nbody)), moving(model)
    regressor = inertial_regressor(model, bodies, *motion).reshape(50 * model.nv, -1)
    base = find_base_parameters(regressor, names(model, bodies))
    parameters = inertial_parameters(model, bodies).ravel()
    reduced = regressor[:, base.leading]
    np.testing.assert_allclose(reduced @ (base.matrix @ parameters), regressor @ parameters, atol=1e-9)
    assert np.linalg.matrix_rank(regressor, tol=1e-8) == len(base.leading)
    # A vertical first axis: gravity does not act on it, and its inertia alone counts.
    assert {"m 1", "mx 1", "my 1", "mz 1", "Ixx 1"} <= without_effect(base)
    assert "Izz 1" not in without_effect(base)


def test_base_parameters_of_a_double_pendulum_are_the_textbooks() -> None:
    body = '<body pos="{}"><joint axis="0 1 0"/><inertial pos="0.1 0 0" mass="1" diaginertia="0.1 0.1 0.1"/>{}</body>'
    mjcf = f"<mujoco><worldbody>{body.format('0 0 0', body.format('0.5 0 0', ''))}</worldbody></mujoco>"
    model = mujoco.MjModel.from_xml_string(mjcf)
    regressor = inertial_regressor(model, [1, 2], *moving(model)).reshape(100, -1)
    base = find_base_parameters(regressor, names(model, [1, 2]))
    assert base.describe() == ["mx 1 + 0.5 m 2", "mz 1", "Iyy 1 + 0.25 m 2", "mx 2", "mz 2", "Iyy 2"]
    assert set(base.combined) == {"mx 1", "m 2", "Iyy 1"}
    assert without_effect(base) == {f"{s} {b}" for b in "12" for s in ("my", "Ixx", "Izz", "Ixy", "Ixz", "Iyz")} | {
        "m 1"
    }
