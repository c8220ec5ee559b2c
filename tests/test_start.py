"""Where fits begin: an arm that torque drives, simulated by MuJoCo C, and what inverse dynamics says of it first."""

import logging

import numpy as np
import pytest
from helpers.driven_arm import ARM, TRUTH, swing

import frictionzoo as fz
from frictionzoo.bench import Bench, Force
from frictionzoo.core.build import build
from frictionzoo.core.described import describe
from frictionzoo.core.errors import ConfigError, FitError
from frictionzoo.core.log import Dataset
from frictionzoo.fit import Adam, Auto, Fit, InverseDynamics, LevenbergMarquardt
from frictionzoo.fit.base import as_start
from frictionzoo.fit.start import begin_where
from frictionzoo.identification import Parts, Problem
from frictionzoo.simulation.context import computing

MASS = 1.2  # kg, of the forearm; the file says 1
SHORT = {"horizons": [0.1], "rollouts": 2, "places": 1, "trajectory": 0.1, "window": 0.02, "local": 0.1}


@pytest.fixture(scope="module")
def recorded() -> Dataset:
    """Two recordings, one to train on."""
    return Dataset("swing", (swing(4.0, mass=MASS),), (swing(1.0, seed=1, mass=MASS),))


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
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


def test_a_start_that_cannot_be_is_refused(begun, bench, recorded, make):
    with pytest.raises(ConfigError, match=r"fit\.start"):
        as_start("inverse_dynamics")
    for name in ("known", "grid", "inverse_dynamics"):
        with pytest.raises(ConfigError, match=r"takes no arguments|unknown argument start; "):
            make("fit", f"fit={name}", "start=inverse_dynamics")
    assert make("fit", "fit=lm", "start=inverse_dynamics", "fit.start.held=false").start.name == "inverse_dynamics"
    with computing("float64", "cpu", None):
        with pytest.raises(ConfigError, match=r"fit=inverse_dynamics: \d+ coordinates .*, expected at most 200"):
            pose(bench, recorded, Adam(start=InverseDynamics(links="fore")), "neural_friction")
        objective = begun.objective.starting(np.full(6, np.nan))
        with pytest.raises(FitError, match=r"fit\.start: inverse_dynamics ends without a finite value"):
            begin_where(InverseDynamics(), objective)
