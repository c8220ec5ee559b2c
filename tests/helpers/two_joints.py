"""A hip and a knee that swing at rates of their own, recorded and identified."""

from typing import Any

import jax
import numpy as np
import torch

import frictionzoo as fz
from frictionzoo.bench import Bench
from frictionzoo.core.log import Log
from frictionzoo.models import FrictionModel


def record(bench: Bench, law: FrictionModel) -> Log:
    """4 s at 1 ms, simulated."""
    time = np.arange(4000) * 0.001
    rates = np.array([[1.3, 2.1], [3.1, 2.7]])
    ctrl = sum(0.4 * np.sin(2 * np.pi * rate * time[:, None]) for rate in rates) + np.zeros((1, 2))
    start = torch.zeros((1, 2), dtype=torch.float64)
    with jax.enable_x64(True):
        qpos, qvel = fz.rollout(bench, law, start, start, torch.from_numpy(ctrl)[None, :-1])
    states = (np.concatenate([np.zeros((1, 2)), part[0].detach().numpy()]) for part in (qpos, qvel))
    return Log("two joints", time, *states, ctrl, sha256="0" * 64, simulated=True)


def identify(bench: Bench, log: Log, law: Any, method: Any = "lm") -> fz.Identified:
    """In double precision, from a hundred short segments."""
    evaluation = {"horizons": [0.2], "rollouts": 2, "places": 1, "trajectory": 0.5}
    how: Any = {"recipe": "given", "test": 0.3, "segments": {"length": 20, "count": 100}, "dtype": "float64"}
    return fz.identify(bench, law, log, method=method, discretisation=False, evaluation=evaluation, **how)
