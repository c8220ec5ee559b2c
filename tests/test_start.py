"""Where fits begin: an arm that torque drives, simulated by MuJoCo C, and what inverse dynamics says of it first."""

import logging
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest

import frictionzoo as fz
from frictionzoo.bench import Bench, Force
from frictionzoo.core.build import build
from frictionzoo.core.described import describe
from frictionzoo.core.errors import ConfigError, FitError
from frictionzoo.core.log import Dataset, Log
from frictionzoo.fit import Adam, Auto, Fit, InverseDynamics, LevenbergMarquardt
from frictionzoo.fit.base import as_start
from frictionzoo.fit.start import begin_where
from frictionzoo.identification import Parts, Problem
from frictionzoo.simulation.context import computing

STEP = 0.002  # s
TRUTH = {"armature": [0.3, 0.1], "frictionloss": [1.5, 0.6], "damping": [0.8, 0.3]}
MASS = 1.2  # kg, of the forearm; the file says 1
ARM = f"""<mujoco><option timestep="{STEP}"><flag contact="disable"/></option><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 1 0"/>
    <inertial pos="0 0 -0.15" mass="2" diaginertia="0.02 0.02 0.002"/>
    <body name="fore" pos="0 0 -0.3"><joint name="elbow" axis="0 1 0"/>
      <inertial pos="0.02 0 -0.12" mass="1" diaginertia="0.006 0.006 .001"/></body></body></worldbody></mujoco>"""
SHORT = {"horizons": [0.1], "rollouts": 2, "places": 1, "trajectory": 0.1, "window": 0.02, "local": 0.1}


def swing(seconds: float, seed: int = 0, mass: float = 1.0) -> Log:
    """A recording by MuJoCo C of torques and states without noise, under a controller that nobody knows."""
    spec = mujoco.MjSpec.from_string(ARM)
    for index, joint in enumerate(spec.joints):
        joint.armature, joint.frictionloss = TRUTH["armature"][index], TRUTH["frictionloss"][index]
        joint.damping = [TRUTH["damping"][index], 0, 0]
    fore = spec.body("fore")
    fore.mass = mass
    fore.inertia = mass * fore.inertia
    model = spec.compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    time = np.arange(0, seconds, STEP)
    rate, phase = 2 * np.pi * rng.uniform(0.2, 1.5, (5, 2)), rng.uniform(0, 6, (5, 2))
    desired = (1.5 / rate * np.sin(rate * time[:, None, None] + phase)).sum(axis=1)
    qpos, qvel, torques = (np.empty((len(time), 2)) for _ in range(3))
    data.qpos[:] = desired[0]
    for sample, wish in enumerate(desired):
        qpos[sample], qvel[sample] = data.qpos, data.qvel
        torques[sample] = data.qfrc_applied[:] = 300 * (wish - data.qpos) - 20 * data.qvel
        mujoco.mj_step(model, data)
    return Log(f"swing{seed}", time, qpos, qvel, torques, "hash", True)


@pytest.fixture(scope="module")
def recorded() -> Dataset:
    """Two recordings, one to train on."""
    return Dataset("swing", (swing(4.0, mass=MASS),), (swing(1.0, seed=1, mass=MASS),))


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """The arm as its file has it, whose forearm is too light."""
    path = tmp_path_factory.mktemp("arm") / "arm.xml"
    path.write_text(ARM)
    return Bench(str(path), ["shoulder", "elbow"], actuator=Force(), params={"armature": {"init": 0.05}})


def pose(bench: Bench, recorded: Dataset, fit: Fit, law: str = "mujoco_default") -> Problem:
    """The problem with this fit; its segments are few."""
    settings = {"segments": {"count": 20, "length": 5}, "loss": {}, "evaluation": SHORT}
    settings |= {"engine": "auto", "dtype": "float64", "bench": {}, "recipe": "given", "checkup": "strict"}
    settings |= {"device": "cpu", "compilation_cache": None}
    return Problem.pose(Parts.settle(settings, bench, recorded, fz.law(law, 2), fit))


@pytest.fixture(scope="module")
def begun(bench: Bench, recorded: Dataset) -> Problem:
    """A problem that begins at what inverse dynamics finds."""
    with computing("float64", "cpu", None):
        return pose(bench, recorded, LevenbergMarquardt(start=InverseDynamics(bandwidth=10.0, links="fore")))


def test_a_fit_begins_where_inverse_dynamics_ends(begun: Problem) -> None:
    space = begun.objective.space
    with computing("float64", "cpu", None):
        found = space.identified(space.start)
    for name, truth in TRUTH.items():
        owner = "bench" if name == "armature" else "friction"
        np.testing.assert_allclose(found[f"{owner}.{name}"], truth, rtol=0.08)
    assert begun.bench.compile(False).body("fore").mass[0] == pytest.approx(MASS, rel=0.03)
    assert begun.settings["bench"]["inertia"]["fore"][0] == pytest.approx(MASS, rel=0.03)
    again = build(describe(begun.fit))
    assert again.start.name == "inverse_dynamics" and describe(again) == describe(begun.fit)


def test_any_fit_may_be_the_start_of_another(begun: Problem, in_haste: None, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "frictionzoo")
    with computing("float64", "cpu", None):
        objective = begun.objective.starting(np.asarray(begun.objective.space.start) + 0.3)
        evaluate = objective.compile_normal_equations()
        for start in (InverseDynamics(), LevenbergMarquardt(2)):
            for fit in (Adam(start=start), Auto(start=start)):
                assert fit.choose(objective).start is start
            moved = begin_where(start, objective)
            assert moved.data is objective.data
            losses = [evaluate(np.asarray(each.space.start)).loss for each in (objective, moved)]
            assert losses[1] < losses[0]
            assert caplog.messages[-1].startswith(f"the fit starts from the result of {start.name}: bench.armature ")
        low, high = np.asarray(objective.space.low), np.asarray(objective.space.high)
        np.testing.assert_array_equal(objective.space.starting(high + 1).start, high)
        np.testing.assert_array_equal(objective.space.starting(low - 1).start, low)


def test_a_start_that_cannot_be_is_refused(
    begun: Problem, bench: Bench, recorded: Dataset, make: Callable[..., Any]
) -> None:
    with pytest.raises(ConfigError, match=r"fit\.start"):
        as_start("inverse_dynamics")
    for name in ("known", "grid", "inverse_dynamics"):
        with pytest.raises(ConfigError, match=r"takes no arguments|unexpected keyword argument 'start'"):
            make("fit", f"fit={name}", "start=inverse_dynamics")
    assert make("fit", "fit=lm", "start=inverse_dynamics", "fit.start.held=false").start.name == "inverse_dynamics"
    with computing("float64", "cpu", None):
        with pytest.raises(ConfigError, match=r"fit=inverse_dynamics: \d+ coordinates .*, expected at most 200"):
            pose(bench, recorded, Adam(start=InverseDynamics(links="fore")), "neural_friction")
        objective = begun.objective.starting(np.full(6, np.nan))
        with pytest.raises(FitError, match=r"fit\.start: inverse_dynamics ends without a finite value"):
            begin_where(InverseDynamics(), objective)
