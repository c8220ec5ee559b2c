"""Laws whose constraint and damping follow direction, speed or position: by hand, against MuJoCo C, and found again."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import torch
from conftest import slow_but
from helpers.laws import friction

from frictionzoo.bench import Bench
from frictionzoo.core.log import Log
from frictionzoo.core.segments import cut_segments
from frictionzoo.core.state import DriveState, Signals
from frictionzoo.fit import LevenbergMarquardt, Objective, Space
from frictionzoo.fit.chunk import search
from frictionzoo.models import get_model
from frictionzoo.simulation import friction_of, make_engine
from frictionzoo.simulation.dry_friction import dry_friction
from frictionzoo.simulation.linear import rows_of
from frictionzoo.simulation.rollout import make_rollout

pytestmark = pytest.mark.usefixtures("in_haste", "x64")

TRUTH = {
    "asymmetric": {
        **{"frictionloss_forward": 0.4, "frictionloss_backward": 0.2, "damping_forward": 0.15},
        "damping_backward": 0.05,
    },
    "polynomial_viscous": {"frictionloss": 0.2, "damping": 0.1, "quadratic_damping": 0.05, "cubic_damping": 0.02},
    "ripple": {
        **{"frictionloss": 0.3, "damping": 0.1, "periods": 12.0},
        **{"sine_1": 0.15, "cosine_1": -0.1, "sine_2": 0.05, "cosine_2": 0.1},
    },
}
ARMATURE = 0.03


def test_asymmetric_known_values(make: Callable[..., Any]) -> None:
    values = {
        **{"frictionloss_forward": 0.5, "frictionloss_backward": 0.2, "damping_forward": 0.3},
        "damping_backward": 0.1,
    }
    terms = friction(make("model", "model=asymmetric", nv=1), [2.0, -2.0], **values)
    assert (terms.torque.item(), terms.frictionloss.item()) == pytest.approx((0.15, 0.35))
    assert terms.damping.flatten().tolist() == [0.3, 0.1]


def test_on_emps_the_constant_is_the_laws(compose: Callable[..., Any]) -> None:
    config = compose("experiment=emps", "model=asymmetric")
    assert config.bench.actuator.params.force_offset.identify is False
    assert config.bench.actuator.params.force_offset.init == 0


def test_polynomial_viscous_known_values(make: Callable[..., Any]) -> None:
    values = {"frictionloss": 0.4, "damping": 0.3, "quadratic_damping": 0.2, "cubic_damping": 0.1}
    terms = friction(make("model", "model=polynomial_viscous", nv=1), [0.0, 2.0, -2.0], **values)
    assert terms.frictionloss.item() == 0.4
    # slope at 2: 0.3 + 2 * 0.2 * 2 + 3 * 0.1 * 4; viscous torque at 2: 0.3 * 2 + 0.2 * 4 + 0.1 * 8
    assert terms.damping.flatten().tolist() == pytest.approx([0.3, 2.3, 2.3])
    viscous = (terms.torque + terms.damping * torch.tensor([[0.0], [2.0], [-2.0]])).flatten()
    assert viscous.tolist() == pytest.approx([0.0, 2.2, -2.2])


def test_ripple_known_values(make: Callable[..., Any]) -> None:
    model = make("model", "model=ripple", nv=1)
    qpos = np.array([[0.0], [np.pi / 8], [np.pi / 16]])  # phases of 4 q: 0, pi / 2, pi / 4
    shares = {"sine_1": 0.1, "cosine_1": -0.2, "sine_2": 0.05, "cosine_2": 0.15}
    values = {"frictionloss": 2.0, "damping": 0.3, "periods": 4.0, **shares}
    still = np.zeros_like(qpos)
    terms = model.terms(np, values, DriveState(qpos, still, still, still, still))
    # 2 (1 - 0.2 + 0.15), 2 (1 + 0.1 - 0.15), 2 (1 + (0.1 - 0.2) / sqrt(2) + 0.05)
    assert terms.frictionloss.flatten().tolist() == pytest.approx([1.9, 1.9, 2.1 - 0.2 / np.sqrt(2)])
    assert (terms.torque, terms.damping) == (None, 0.3)


def test_harmonic_drive_known_values(make: Callable[..., Any]) -> None:
    model = make("model", "model=harmonic_drive", nv=1)
    values = {
        **{"frictionloss": 2.0, "damping": 0.3, "cubic_damping": 0.1, "periods": 4.0},
        **{"sine_1": 0.1, "sine_2": 0.05, "cosine_2": 0.15},
        **{"stribeck_load_friction_motor": 0.2, "stribeck_load_friction_external": 0.1},
        **{"load_friction_motor": 0.3, "load_friction_external": 0.1},
        **{"stribeck_torque": 0.5, "stribeck_velocity": 0.2, "stribeck_exponent": 1.0},
    }
    # At rest at phases 0 and pi / 2; at five Stribeck velocities; with ripple alone, which would make it negative.
    qpos = np.array([[0.0], [np.pi / 8], [0.0], [0.0]])
    qvel = np.array([[0.0], [0.0], [1.0], [1.0]])
    motor, external = np.array([[1.0], [-1.0], [1.0], [0.0]]), np.array([[-2.0], [2.0], [2.0], [0.0]])
    values["cosine_1"] = np.array([[-0.2], [-0.2], [-0.2], [-1.5]])
    terms = model.terms(np, values, DriveState(qpos, qvel, qpos, motor, external))
    at_rest = 0.5 + 0.4  # under 1 N m of the motor and -2 N m from outside
    fast = 1.9 + 0.1 + 0.5 * np.exp(-5)  # both torques push, so that 0.3 - 0.2 is left of the load, and 0.2 - 0.2
    expected = [1.9 + 0.5 + at_rest, 1.9 + 0.5 + at_rest, fast, 2e-3]
    assert terms.frictionloss.flatten().tolist() == pytest.approx(expected, rel=1e-5)
    viscous = terms.torque + terms.damping * qvel
    np.testing.assert_allclose(viscous, 0.3 * qvel + 0.1 * qvel**3, rtol=1e-14)
    np.testing.assert_allclose(terms.damping, 0.3 + 3 * 0.1 * qvel**2, rtol=1e-14)  # the slope


def write_into_c(name: str, model: mujoco.MjModel, data: mujoco.MjData, values: Mapping[str, float]) -> None:
    """The law in this state in MuJoCo C's own quantities."""
    qpos, qvel = data.qpos.item(), data.qvel.item()
    if name == "asymmetric":
        forward, backward = values["frictionloss_forward"], values["frictionloss_backward"]
        model.dof_frictionloss[0], data.qfrc_applied[0] = (forward + backward) / 2, (backward - forward) / 2
        model.dof_damping[0] = values["damping_forward" if qvel > 0 else "damping_backward"]
    elif name == "polynomial_viscous":  # what `damping="d_1 d_2 d_3"` of a joint compiles to
        model.dof_frictionloss[0], model.dof_damping[0] = values["frictionloss"], values["damping"]
        model.dof_dampingpoly[0] = values["quadratic_damping"], values["cubic_damping"]
    else:
        angle = values["periods"] * qpos
        ripple = sum(
            values[f"sine_{k}"] * np.sin(k * angle) + values[f"cosine_{k}"] * np.cos(k * angle) for k in (1, 2)
        )
        model.dof_frictionloss[0], model.dof_damping[0] = values["frictionloss"] * (1 + ripple), values["damping"]


def in_c(bench: Bench) -> tuple[mujoco.MjModel, mujoco.MjData]:
    values = bench.initial_values() | {"armature": np.array([ARMATURE])}
    model = mujoco.MjModel.from_xml_string(bench.mjcf(values, np.ones(1)))
    return model, mujoco.MjData(model)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        *((name, "specialised") for name in TRUTH),
        # MJX's step takes several times as long to compile, and is given the same terms.
        *(pytest.param(name, "mjx", marks=pytest.mark.slow) for name in TRUTH),
    ],
)
def test_a_step_equals_mujoco_c(make: Callable[..., Any], knee: Bench, name: str, kind: str) -> None:
    engine = make_engine(kind, knee, friction_of(make("model", f"model={name}", nv=1)), get_model(name).constraint)
    values = {
        "bench": {key: jnp.asarray(value) for key, value in knee.initial_values().items()}
        | {"armature": jnp.full(1, ARMATURE)},
        "friction": {key: jnp.full(1, value) for key, value in TRUTH[name].items()},
    }
    rng = np.random.default_rng(0)
    qpos, qvel, ctrl = rng.normal(size=(3, 200, 1))
    qvel[::2] *= 1e-3  # half of them slow enough to stick
    step = jax.jit(jax.vmap(lambda *state: engine.step(values, *state, jnp.zeros(0), jnp.zeros((1, 0)))[:2]))
    ours = np.stack(step(qpos, qvel, Signals(qpos + 0.02 * ctrl)))
    model, data = in_c(knee)
    for index in range(200):
        mujoco.mj_resetData(model, data)
        data.qpos, data.qvel, data.ctrl = qpos[index], qvel[index], qpos[index] + 0.02 * ctrl[index]
        write_into_c(name, model, data, TRUTH[name])
        mujoco.mj_step(model, data)
        # Rounding only: one joint, whose constraint is solved exactly.
        np.testing.assert_allclose(ours[:, index, 0], [data.qpos.item(), data.qvel.item()], atol=1e-12)


def test_a_load_between_the_two_limits_is_held_and_one_beyond_slides(make: Callable[..., Any]) -> None:
    """A carriage of 50 kg without gravity; after half a second under a constant force."""
    bench, model = make("bench", "bench=emps"), make("model", "model=asymmetric", nv=1)
    forward, backward = 30.0, 10.0
    force = np.array([-1.1 * backward, -0.95 * backward, 0.0, 0.95 * forward, 1.1 * forward])
    rollout = make_rollout(make_engine("specialised", bench, friction_of(model), model.constraint))
    known = bench.initial_values()
    values = {
        "bench": known,
        "friction": {
            **{"frictionloss_forward": np.array([forward]), "frictionloss_backward": np.array([backward])},
            **{"damping_forward": np.zeros(1), "damping_backward": np.zeros(1)},
        },
    }
    rest = np.zeros((5, 1))
    ctrl = np.broadcast_to(force[:, None, None] / known["force_gain"], (5, 500, 1))
    moved = np.asarray(rollout.compiled(values, rest, rest, Signals(ctrl))[0])[:, -1, 0]
    # (force - limit) t^2 / 2 m; held, it yields with the soft constraint's creep of less than 0.5 mm/s.
    slid = np.array([-0.1 * backward, 0.1 * forward]) * 0.5**2 / (2 * known["armature"])
    np.testing.assert_allclose(moved[[0, 4]], slid, rtol=0.1)
    assert (np.abs(moved[1:4]) < 0.5e-3 * 0.5).all()
    assert np.abs(slid).min() > 5 * np.abs(moved[1:4]).max()


def record(bench: Bench, name: str) -> Log:
    """Three seconds of the drive in MuJoCo C, with encoder steps and noise of the velocity."""
    model, data = in_c(bench)
    time = np.arange(3000) * model.opt.timestep
    ctrl = 0.8 * np.sin(4 * time) + 0.3 * np.sin(13 * time) + 0.1 * np.sin(29 * time)
    states = np.empty((len(time), 2))
    for sample, command in enumerate(ctrl):
        states[sample] = data.qpos.item(), data.qvel.item()
        data.ctrl[0] = command
        write_into_c(name, model, data, TRUTH[name])
        mujoco.mj_step(model, data)
    states[:, 0] = 1e-5 * np.round(states[:, 0] / 1e-5)
    states[:, 1] += np.random.default_rng(0).normal(scale=2e-3, size=len(time))
    return Log(name, time, states[:, :1], states[:, 1:], ctrl[:, None], "0" * 64, simulated=True)


@pytest.mark.parametrize("name", slow_but(["asymmetric"], TRUTH))
def test_a_known_drive_is_found_again(make: Callable[..., Any], knee: Bench, name: str) -> None:
    law = make("model", f"model={name}", nv=1)
    segments = cut_segments([record(knee, name)], None, 50)
    rollout = make_rollout(make_engine("specialised", knee, friction_of(law), law.constraint))
    objective = Objective(Space(knee, law, "float64"), rollout, segments, 1.0, 1.0, "none", 1.0, False)
    fit = LevenbergMarquardt(30, 1e-8)
    progress, _ = search(fit, objective)
    found = objective.space.identified(progress.best)
    wanted = {"bench.armature": ARMATURE} | {f"friction.{key}": value for key, value in TRUTH[name].items()}
    assert {key.partition(".")[2] for key in found} == {"armature", *TRUTH[name]} - {"periods"}
    for key, value in found.items():
        assert value.item() == pytest.approx(wanted[key], rel=0.05), key


@pytest.mark.parametrize("joints", [1, 3])
def test_a_joint_without_dry_friction_moves_as_if_there_were_none(joints: int) -> None:
    """With a limit of 0, at standstill without any load too, where every piece of the search holds."""
    limit = jnp.array([0.5, 0.0, 0.3])[-joints:] if joints > 1 else jnp.zeros(1)
    free = np.flatnonzero(limit == 0)
    inertia = jnp.eye(joints) + 0.2
    reference, softness = jnp.zeros(joints), jnp.full(joints, 30.0)
    pulls = [
        np.zeros(joints),
        np.array([0.1, 0.0, 0.1])[:joints] if joints > 1 else np.ones(1),
        np.arange(joints) - 5.0,
    ]
    for force in map(jnp.asarray, pulls):
        found = dry_friction(rows_of(inertia), force, softness, reference, limit)
        assert (np.asarray(found)[free] == 0).all() and (np.abs(found) <= limit).all()
        given = inertia, force, softness, reference, limit
        slope = jax.jacfwd(lambda inertia, *row: dry_friction(rows_of(inertia), *row), (0, 1, 2, 3))(*given)
        assert all((np.asarray(part)[free] == 0).all() for part in slope)
        if joints > 1:  # the others are held or slide as in the system that the free joint leaves
            kept = np.flatnonzero(limit)
            rest = np.linalg.inv(np.linalg.inv(inertia)[np.ix_(kept, kept)])
            alone = rest @ np.linalg.solve(inertia, force)[kept]
            row = softness[kept], reference[kept], limit[kept]
            expected = dry_friction(rows_of(jnp.asarray(rest)), jnp.asarray(alone), *row)
            np.testing.assert_allclose(np.asarray(found)[kept], expected, atol=1e-12)
