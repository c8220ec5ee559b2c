"""Curves of runs that are compared by their errors."""

import numpy as np

from frictionzoo.core.state import Signals
from frictionzoo.result.curves import Curves

ROLLOUTS = 10
RNG = np.random.default_rng(0)
HARD = RNG.uniform(0.005, 0.02, ROLLOUTS)  # what makes a rollout hard for every drive


def make_curves(test_mae, nv=1, length=60):
    position, velocity = RNG.normal(size=(2, 3, length + 1, nv))
    drift = test_mae[0] * np.linspace(0, 1, length)[:, None]
    return Curves(
        measured_qpos=position,
        measured_qvel=velocity,
        signals=Signals(position[:, 1:]),
        load=np.zeros((3, 0)),
        qpos=position[:, 1:] + drift,
        qvel=velocity[:, 1:],
        baseline_qpos=position[:, 1:],
        baseline_qvel=velocity[:, 1:],
        train_mae=np.ones(4),
        test_mae=np.asarray(test_mae),
        local_mae=np.resize(test_mae, 40),
        local_speed=np.linspace(0, 2, 40),
        local_load=np.linspace(1, 0, 40),
        velocity=np.linspace(-1, 1, 5),
        friction=np.ones((5, nv)),
        friction_low=np.zeros((5, nv)),
        friction_high=np.full((5, nv), 2.0),
        history={"iteration": np.arange(3.0), "loss": np.array([3.0, 1.0, 2.0]), "bench.armature": np.ones((3, nv))},
    )
