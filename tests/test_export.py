"""The exported MJCF in MuJoCo C: exact where the law is MuJoCo's own, nearest and said so where it is not."""

from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import torch
from conftest import make_run, trace_nothing

from frictionzoo.api.identified import Identified
from frictionzoo.bench import Bench, PositionPD
from frictionzoo.core.segments import Segments
from frictionzoo.core.state import DriveState, FrictionTerms, Signals
from frictionzoo.export.mjcf import write_identified
from frictionzoo.export.nearest import nearest_frictionloss_and_damping
from frictionzoo.models.base import FrictionModel
from frictionzoo.models.baseline import Baseline
from frictionzoo.models.mujoco_default import MujocoDefault
from frictionzoo.models.neural_friction import NeuralFriction
from frictionzoo.simulation import friction_of, make_engine
from frictionzoo.simulation.bridge import to_jax
from frictionzoo.simulation.rollout import make_rollout

ANOTHER = {"frictionloss": 0.3, "damping": 0.1}
EXACT = "represented exactly"
NEAREST = "Frictionloss and damping cannot represent"


class Explicit(FrictionModel):
    """A law given by a function of the state, for these tests."""

    name = "explicit"

    def __init__(self, formula, constraint=True):
        super().__init__(1)
        self.constraint = constraint
        self.formula = formula

    def terms(self, xp, values, state):
        return self.formula(xp, state)


def known(**values):
    return {
        name: {"init": value, "low": 1e-6, "high": 10.0, "scale": "log", "identify": True}
        for name, value in values.items()
    }


@pytest.fixture
def bench():
    actuator = PositionPD(known(kp=5.0, kd=1.0))
    return Bench("knee_rod.xml", actuator=actuator, params=known(armature=1 / 30))


@pytest.fixture
def samples():
    signals = np.random.default_rng(0).normal(size=(5, 500, 1))
    return DriveState(*signals)


def fit(bench, model, values=None):
    """A drive as if identified, with two rollouts of a quarter of a second."""
    states = np.random.default_rng(0).normal(scale=0.3, size=(2, 2, 251, 1))
    ctrl = np.sin(2 * np.pi * np.arange(250) * 0.02 + [[0.3], [2.0]])[..., None]
    friction = {name: value.detach().numpy() for name, value in model.double().state_dict().items()}
    values = {"bench": bench.initial_values() if values is None else values, "friction": friction}
    segments = Segments(*states, Signals(ctrl), bench.timestep)
    sampling = bench.sampling(bench.timestep)
    result = make_run(0, model.name).result
    result.metrics.test.position_mae = 0.01
    return Identified(Path("run"), result, bench, model, {}, values, segments, sampling, trace_nothing(segments))


def export(bench, model, values=None):
    """The exported text, and the joint's frictionloss and damping as MuJoCo C compiles them."""
    (file,) = write_identified(fit(bench, model, values))
    text = file.content.decode()
    joint = mujoco.MjModel.from_xml_string(text).joint(bench.joints[0])
    return text, float(joint.frictionloss[0]), float(joint.damping[0])


def test_mujocos_friction_and_none_are_exact(bench):
    third = 1 / 3  # has no short decimal form: every digit must arrive
    own = MujocoDefault(1, known(frictionloss=third, damping=third / 7))
    for model, expected in ((own, (third, third / 7)), (Baseline(1, {}), (0, 0))):
        text, *friction = export(bench, model)
        assert tuple(friction) == expected and EXACT in text and NEAREST not in text


def test_known_coulomb_and_viscous_torque_of_all_terms_is_recovered(bench):
    def formula(xp, state):
        return FrictionTerms(0.02 * state.qvel, xp.full_like(state.qvel, 0.3), xp.full_like(state.qvel, 0.03))

    text, frictionloss, damping = export(bench, Explicit(formula))
    assert frictionloss == pytest.approx(0.3, rel=0.01)
    assert damping == pytest.approx(0.05, rel=0.01)
    assert f"{NEAREST} explicit" in text


def test_friction_that_depends_on_the_state_is_not_exact(bench):
    law = Explicit(lambda xp, state: FrictionTerms(frictionloss=0.2 + 0.1 * xp.tanh(10 * xp.abs(state.qpos))))
    text, frictionloss, _ = export(bench, law)
    assert NEAREST in text and EXACT not in text
    assert 0.1 < frictionloss < 0.3


def test_nearest_never_drives_the_joint(samples):
    for loss, viscous in ((0.3, -0.05), (-0.3, 0.5), (-0.3, -0.05)):
        torque = loss * np.sign(samples.qvel) + viscous * samples.qvel
        (frictionloss,), (damping,) = nearest_frictionloss_and_damping(torque, samples.qvel)
        assert frictionloss >= 0 and damping >= 0
        assert (frictionloss > 0, damping > 0) == (loss > 0, viscous > 0)


def test_no_pair_nearby_is_nearer_and_joints_are_apart(samples):
    v = np.concatenate([samples.qvel, samples.qvel], axis=1)
    torque = (0.2 + 0.2 * np.exp(-((v / 0.1) ** 2))) * np.tanh(v / 0.01) + 0.05 * v
    torque[:, 1] = 0.4 * np.sign(v[:, 1]) + 0.03 * v[:, 1]
    loss, damping = nearest_frictionloss_and_damping(torque, v)
    np.testing.assert_allclose((loss[1], damping[1]), (0.4, 0.03), rtol=1e-9)
    lowest = np.sqrt(np.mean((torque - loss * np.sign(v) - damping * v) ** 2, axis=0))[0]
    for change in ((1e-3, 0), (-1e-3, 0), (0, 1e-3), (0, -1e-3)):
        other = torque - (loss + change[0]) * np.sign(v) - (damping + change[1]) * v
        assert np.sqrt(np.mean(other**2, axis=0))[0] > lowest


def test_a_drive_that_diverges_has_the_friction_nearest_to_its_law(bench):
    text, frictionloss, damping = export(bench, Explicit(lambda xp, state: FrictionTerms(-1e4 * state.qvel**3), False))
    assert "diverges in its own 2 rollouts of 0.25 s" in text
    assert (frictionloss, damping) == (0, 0)  # a law that drives the joint


def test_network_is_exported_without_being_changed(bench):
    model = NeuralFriction(1, hidden=[8], seed=0).double()
    before = {name: weights.clone() for name, weights in model.state_dict().items()}
    text, frictionloss, damping = export(bench, model)
    assert f"{NEAREST} neural_friction" in text
    assert frictionloss >= 0 and damping >= 0
    assert all(torch.equal(before[name], weights) for name, weights in model.state_dict().items())


@pytest.mark.parametrize("name", ["knee", "emps"])
def test_identified_model_moves_in_mujoco_c_as_it_was_fitted(make, name):
    """3 s from a measured-like state, in MuJoCo C from the exported text and in the engine that fits."""
    bench = make("bench", f"bench={name}")
    scale = {"knee": (1.0, 0.05), "emps": (100.0, 93.0)}[name]  # of torque, and the armature
    model = MujocoDefault(1, {key: known(x=0.1)["x"] for key in ("frictionloss", "damping")})
    model.load_state_dict({key: torch.tensor([share * scale[0]]) for key, share in ANOTHER.items()})
    values = {"bench": bench.initial_values() | {"armature": np.array([scale[1]])}, "friction": {}}
    compiled = mujoco.MjModel.from_xml_string(export(bench, model, values["bench"])[0])
    data = mujoco.MjData(compiled)
    data.qpos, data.qvel = 0.1, 0.2
    # Slow enough for the drive to stick and come loose again.
    ctrl = 0.1 + 0.3 * np.sin(2 * np.pi * np.arange(3000) * 0.001)[None, :, None]

    with jax.enable_x64(True):
        values["friction"] = to_jax(model, "float64")
        rollout = make_rollout(make_engine("auto", bench, friction_of(model), model.constraint)).compiled
        start = jnp.asarray([[0.1]]), jnp.asarray([[0.2]])
        fitted, _ = rollout(jax.tree.map(jnp.asarray, values), *start, Signals(jnp.asarray(ctrl)))
    exported = np.empty(3000)
    for i in range(3000):
        data.ctrl = ctrl[0, i]
        mujoco.mj_step(compiled, data)
        exported[i] = data.qpos[0]
    assert np.ptp(exported) > 0.01
    # The promise is 1e-6; rounding of 3000 steps stays far below.
    np.testing.assert_allclose(fitted[0, :, 0], exported, atol=1e-9)
