"""A tree's dynamics in its links' frames, against MuJoCo C, and the slopes of what is folded, against JAX's."""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from frictionzoo.simulation import tree
from frictionzoo.simulation.fold import CannotSpecialiseError, specialise

INERTIAL = '<inertial pos="0.01 -0.02 -0.1" quat="1 0.2 -0.1 0.3" mass="0.4" diaginertia="0.002 0.003 0.004"/>'
TREES = {
    "anchors beside the body's origin": f"""<body pos="0.1 0 0.3" quat="1 0.1 0.2 -0.3">
      <joint axis="1 2 0.5" pos="0.02 -0.01 0.03" ref="0.4"/>{INERTIAL}
      <body pos="0 0.1 -0.2" quat="1 0 0.3 0"><joint axis="0 1 0" pos="0 0.05 0"/>{INERTIAL}</body></body>""",
    "several joints a body": f"""<body><joint type="slide" axis="1 0.2 0"/><joint axis="0 0 1" pos="0.1 0 0"/>
      <joint axis="0 1 0"/>{INERTIAL}
      <body pos="0.2 0 0"><joint type="slide" axis="0 0.6 0.8"/>{INERTIAL}</body></body>""",
    "branches, and links that are welded on": f"""<body pos="0 0 1"><inertial pos="0 0 0" mass="5" diaginertia="1 1 1"/>
      <body quat="1 0 0 0.4"><joint axis="1 0 0"/>{INERTIAL}
        <body pos="0 0.1 0" quat="1 0.5 0 0">{INERTIAL}
          <body pos="0 0 -0.1"><joint axis="0 0 1"/>{INERTIAL}</body></body>
        <body pos="0 -0.1 0"><joint axis="0 1 1"/>{INERTIAL}</body></body></body>""",
}


def compile_tree(bodies: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option gravity="1 -2 -9.81"/><worldbody>{bodies}</worldbody></mujoco>'
    )


@pytest.mark.parametrize("bodies", TREES.values(), ids=TREES)
@pytest.mark.parametrize("regrouped", [False, True])
def test_inertia_and_bias_are_those_of_mujoco_c(bodies: str, regrouped: bool) -> None:
    model = compile_tree(bodies)
    links, data, rng = tree.links_of(np, model), mujoco.MjData(model), np.random.default_rng(0)
    if regrouped:
        links = tree.without_rounding(tree.regroup(np, links))
        assert all(link.mass == 0 for link in links if not link.slides)
    with jax.enable_x64(True):
        for qpos, qvel in rng.normal(size=(5, 2, model.nv)):
            data.qpos[:], data.qvel[:] = qpos, qvel
            mujoco.mj_forward(model, data)
            expected = np.zeros((model.nv, model.nv))
            mujoco.mj_fullM(model, data, expected)
            at = tree.poses(links, jnp.asarray(qpos - model.qpos0))
            rows = tree.joint_inertia(links, at)
            for i, j in itertools.product(range(model.nv), repeat=2):
                assert abs(float(rows[max(i, j)][min(i, j)]) - expected[i, j]) < 1e-13
            bias = tree.bias_torque(links, at, jnp.asarray(qvel), model.opt.gravity)
            np.testing.assert_allclose(bias, data.qfrc_bias, rtol=0, atol=1e-12)


def test_links_are_put_together_again_from_their_numbers() -> None:
    model = compile_tree(TREES["several joints a body"])
    links = tree.links_of(np, model)
    numbers = tree.flatten(links)
    changed = {place: 2 * numbers[place] for place in (0, 12, 40)}
    again = tree.flatten(tree.unflatten(links, changed))
    np.testing.assert_array_equal(again, np.where(np.isin(np.arange(len(numbers)), [*changed]), 2 * numbers, numbers))
    for one, other in zip(tree.unflatten(links, {}), links, strict=True):
        assert one[:2] == other[:2]
        for number, expected in zip(one[2:], other[2:], strict=True):
            np.testing.assert_allclose(number, expected, rtol=1e-15, atol=1e-18)


def curve(fixed: Any, x: Any, y: Any) -> Any:
    return {"a": fixed * jnp.sin(x) * y[0] - y[1], "b": -jnp.cos(x + y[1]) * fixed, "c": jnp.stack([fixed, 2.0])}


def test_slopes_are_those_of_jax() -> None:
    with jax.enable_x64(True):
        arguments = jnp.asarray(1.3), jnp.asarray(0.4), jnp.asarray([0.7, -0.2])
        specialised = specialise(curve, *arguments, moving=(1, 2))
        rng = np.random.default_rng(0)
        for _ in range(3):
            along = (0.0, *map(jnp.asarray, (rng.normal(), rng.normal(size=2))))
            found, expected = (jax.jvp(function, arguments, along) for function in (specialised, curve))
            assert jax.tree.structure(found) == jax.tree.structure(expected)
            for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
                np.testing.assert_allclose(one, other, rtol=1e-13, atol=1e-15)
        backwards = [jax.grad(lambda x, f=f: f(1.3, x, arguments[2])["a"])(0.4) for f in (specialised, curve)]
        assert abs(backwards[0] - backwards[1]) < 1e-14


def test_a_slope_without_a_rule_is_named() -> None:
    with pytest.raises(CannotSpecialiseError, match="a derivative of exp"):
        specialise(lambda x: jnp.exp(x), np.zeros(()), moving=(0,))
    assert specialise(lambda y, x: jnp.exp(y) * x, np.zeros(()), np.zeros(()), moving=(1,)).operations == 2
