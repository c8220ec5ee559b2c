"""Robots with a drive as if identified, for tests of what is written of it."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from conftest import make_run, trace_nothing

from frictionzoo.api.identified import Identified
from frictionzoo.bench import Bench, JointPD, Robot
from frictionzoo.core.described import describe
from frictionzoo.core.segments import Segments
from frictionzoo.core.state import Signals
from frictionzoo.models import MujocoDefault

FREE = {"init": 0.1, "low": 1e-6, "high": 10.0, "scale": "log", "identify": True}
ERROR = 0.01
"""Mean absolute error in held-out rollouts that the drives are said to have [rad or m]."""


def fit(
    path: str | Path,
    joint: Any = None,
    *,
    kind: type[Bench] = Robot,
    length: int = 30,
    substeps: int = 1,
    load: Any = None,
    **more: Any,
) -> Identified:
    """A drive as if identified, each joint another, and two rollouts of it; `more` are arguments of the bench.

    Rollouts have `length` samples of so many `substeps`, and each its payload of `load`.
    """
    options: dict[str, Any] = {"actuator": JointPD({"kp": {"init": 20.0}, "kd": {"init": 1.0}}), **more}
    bench = kind(str(path), joint, **options)
    law = MujocoDefault(bench.nv, {"frictionloss": FREE, "damping": FREE}).double()
    one_each = 1 + np.arange(bench.nv) / 7
    friction = {"frictionloss": 0.1 * one_each, "damping": 0.03 * one_each}
    law.load_state_dict({name: torch.from_numpy(value) for name, value in friction.items()})
    values = {"bench": bench.initial_values() | {"armature": 0.02 * one_each}, "friction": friction}
    sampling = bench.sampling(substeps * bench.timestep)
    times = sampling.interval * np.arange(-sampling.history, length)[:, None]
    swings = [np.sin(rate * times + np.arange(bench.nv)) for rate in (3, 5)]
    signals = Signals(np.stack(swings), {name: np.zeros((2, len(times), bench.nv)) for name in bench.inputs})
    qpos, qvel = np.random.default_rng(0).normal(scale=0.2, size=(2, 2, length + 1, bench.nv))
    loads = None if load is None else np.stack([bench.load(each) for each in load])
    segments = Segments(qpos, qvel, signals, sampling.interval, loads)
    result = make_run(0, law.name, bench.nv).result
    result.settings, result.metrics.test.position_mae, result.parameters = {"bench": describe(bench)}, ERROR, []
    return Identified(None, result, bench, law, {}, values, segments, sampling, trace_nothing(segments))
