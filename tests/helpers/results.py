"""A result of one joint, made without a fit, and curves for the figures of one."""

import copy

import numpy as np
import pytest
from msgspec.structs import replace as replace_fields

from frictionzoo.bench import Bench, PositionPD
from frictionzoo.core.log import Dataset, Log
from frictionzoo.core.records import Proof
from frictionzoo.core.segments import Segments
from frictionzoo.core.state import Signals
from frictionzoo.fit.uncertainty import Uncertainty
from frictionzoo.models.coulomb_stribeck import CoulombStribeck
from frictionzoo.result.curves import Curves
from frictionzoo.result.evaluate import Evaluator, Prediction
from frictionzoo.result.record import build_result
from frictionzoo.result.section_types import FitRecord, Timing
from frictionzoo.result.types import EvaluationRollouts

TIMESTEP = 0.001
FIT = FitRecord(
    "adam", iterations=3, best_iteration=2, loss=1e-6, stopped="all iterations made", falling=0.0, moving=[]
)
SETTINGS = {"seed": 0, "dtype": "float64", "segments": {"count": 20, "length": 5}}
PROOF = Proof(step=1e-16, rollout=1e-15, cases=32, steps=8)
TIMING = Timing(setup=1.0, compile=2.0, fit=3.0, uncertainty=0.25, evaluate=0.25, total=6.5)
PARAMS = {
    "static_torque": {"init": 0.3, "low": 1e-3, "high": 1.0, "scale": "log", "identify": True},
    "kinetic_torque": {"init": 0.2, "low": 1e-3, "high": 1.0, "scale": "log", "identify": True},
    "stribeck_velocity": {"init": 0.1, "low": 0.05, "high": 1.0, "scale": "log", "identify": True},
    "viscous_coefficient": {"init": 0.05, "low": 1e-3, "high": 1.0, "scale": "log", "identify": True},
    "smoothing_velocity": {"init": 0.01, "low": 0.01, "high": 0.1, "scale": "log", "identify": False},
}
ARMATURE = {"armature": {"init": 0.04, "low": 1e-3, "high": 1.0, "scale": "log", "identify": True}}
GAINS = {
    "kp": {"init": 20.0, "low": 1.0, "high": 100.0, "scale": "log", "identify": False},
    "kd": {"init": 1.0, "low": 0.1, "high": 10.0, "scale": "log", "identify": False},
}
VALUES = {name: np.array([section["init"]]) for name, section in PARAMS.items()}


def make_log(name, samples, simulated=True):
    time = np.arange(samples) * TIMESTEP
    wave = np.sin(3 * time)[:, None]
    return Log(name, time, wave, 3 * np.cos(3 * time)[:, None], wave, sha256=64 * name[0], simulated=simulated)


@pytest.fixture
def bench():
    return Bench("knee_rod.xml", actuator=PositionPD(GAINS), params=ARMATURE)


@pytest.fixture
def model():
    return CoulombStribeck(1, PARAMS)


@pytest.fixture
def dataset():
    return Dataset("waves", (make_log("a", 400),), (make_log("b", 400),))


@pytest.fixture
def evaluation(dataset):
    return Evaluator(
        dataset,
        "hinge",
        horizons=[0.1, 0.05],
        rollouts=4,
        placement="random",
        trajectory=0.3,
        window=0.02,
        places=3,
        local=0.05,
        seed=0,
    )


def hold(values, qpos, qvel, signals, load):
    """A drive that follows its command with an offset."""
    return signals.ctrl + values["offset"]["rad"], np.zeros_like(signals.ctrl)


def judge(evaluation, offset):
    return evaluation.judge(hold, {"offset": {"rad": np.array([offset])}})


def build(bench, model, dataset, evaluation, friction, offset=0.01, **changes):
    options = {
        "values": {
            "bench": {name: np.array([param.init]) for name, param in bench.params.items()},
            "friction": friction,
        },
        "judgement": judge(evaluation, offset),
        "baseline": judge(evaluation, 0.04),
        "fit": FIT,
        "timing": TIMING,
        "settings": SETTINGS,
        "engine": "mjx",
        "proof": PROOF,
        "warnings": [],
        "device": "cpu",
        "uncertainty": Uncertainty(),
        "reference": bench.initial_values(),
        "evaluation": EvaluationRollouts(evaluation.sha256, evaluation.window),
        "recipe": [],
        **dict.fromkeys(("torque", "residual", "links")),
    }
    return build_result(model_name=model.name, bench=bench, model=model, dataset=dataset, **(options | changes))


@pytest.fixture
def result(bench, model, dataset, evaluation):
    return build(bench, model, dataset, evaluation, VALUES)


def history(**values):
    return {"iteration": np.array([1, 2, 3]), "loss": np.array([3.0, 1.0, 2.0]), "grad_norm": np.ones(3)} | values


def make_rollout(nv=1, length=200):
    time = np.arange(length + 1) * TIMESTEP
    states = np.repeat(np.sin(20 * time)[None, :, None], nv, axis=2)
    segments = Segments(states, 2 * states, Signals(states[:, :-1]), TIMESTEP)
    growth = np.linspace(0, 1, length)[None, :, None]
    model, baseline = (
        Prediction(states[:, 1:] + error * growth, 2 * states[:, 1:] + error * growth) for error in (0.02, 0.1)
    )
    return segments, model, baseline


def curves_of(rollout, **values):
    """What a run leaves for figures, without what only comparisons draw."""
    segments, model, baseline = rollout
    nothing, torque = np.empty(0), np.empty((0, segments.qpos.shape[2]))
    return Curves(
        **{"measured_qpos": segments.qpos, "measured_qvel": segments.qvel, "signals": segments.signals},
        **{"load": np.empty((len(segments.qpos), 0)), "qpos": model.qpos, "qvel": model.qvel},
        **{"baseline_qpos": baseline.qpos, "baseline_qvel": baseline.qvel, "train_mae": nothing, "test_mae": nothing},
        **dict.fromkeys(("local_mae", "local_speed", "local_load", "velocity"), nothing),
        **dict.fromkeys(("friction", "friction_low", "friction_high"), torque),
        history=history(**values),
    )


def of_joints(result, *joints):
    """The same of joints of these names, all with the values and the errors of its one."""
    several = copy.deepcopy(result)
    several.joints = list(joints)
    for parameter in (*several.parameters, *several.reference):
        (row,) = parameter.by_joint
        parameter.by_joint = [replace_fields(row, name=name, joints=[name]) for name in joints]
        parameter.value = [row.value] * len(joints) if len(joints) > 1 else row.value
    several.by_joint = [replace_fields(result.by_joint[0], joint=name) for name in joints]
    return several
