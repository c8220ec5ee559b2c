"""Segments of a drive whose truth is known, and problems posed on them."""

import copy
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from conftest import compose_once
from omegaconf import OmegaConf

from frictionzoo.bench import Bench
from frictionzoo.core.build import build
from frictionzoo.core.segments import Segments
from frictionzoo.core.state import DriveState, Signals
from frictionzoo.fit import Objective, Space, run_fit
from frictionzoo.fit.loggers import TensorBoard
from frictionzoo.fit.loop import FitFiles
from frictionzoo.models import FrictionModel
from frictionzoo.simulation import friction_of, make_engine
from frictionzoo.simulation.rollout import Rollout, make_rollout

LOSS = {"position": 1.0, "velocity": 1.0, "robust": "none", "robust_scale": 1.0, "refine": False}
TRUTH = {"armature": 0.03, "frictionloss": 0.2, "damping": 0.1}
PARAMETERS = ("bench.params.armature", "model.params.frictionloss", "model.params.damping")
KNOWN = [f"{name}.identify=false" for name in PARAMETERS]


@dataclass
class Problem:
    model: FrictionModel
    objective: Objective


@cache
def record() -> Segments:
    """Segments of a drive with MuJoCo's own friction, made by MuJoCo C, without noise."""
    bench = build(OmegaConf.to_container(compose_once(), resolve=True)["bench"])
    values = bench.initial_values() | {"armature": np.array([TRUTH["armature"]])}
    text = bench.mjcf(values, np.array([TRUTH["frictionloss"]]), np.array([TRUTH["damping"]]))
    model = mujoco.MjModel.from_xml_string(text)
    rng = np.random.default_rng(0)
    batch, time = 60, 5
    states = np.empty((batch, time + 1, 2))
    ctrl = np.empty((batch, time, 1))
    data = mujoco.MjData(model)
    for row in range(batch):
        mujoco.mj_resetData(model, data)
        data.qpos, data.qvel = rng.normal(), rng.normal()
        ctrl[row] = data.qpos + rng.normal(scale=0.1)
        states[row, 0] = data.qpos[0], data.qvel[0]
        for i in range(time):
            data.ctrl = ctrl[row, i]
            mujoco.mj_step(model, data)
            states[row, i + 1] = data.qpos[0], data.qvel[0]
    return Segments(states[..., :1], states[..., 1:], Signals(ctrl), 0.001)


@cache
def compose_drive(choices: tuple[str, ...]) -> tuple[Bench, FrictionModel]:
    """The bench and the law of these choices."""
    config = OmegaConf.to_container(compose_once(*choices), resolve=True)
    bench, law = build(config["bench"]), build(config["model"], nv=1)
    law.prepare(DriveState(*np.random.default_rng(0).normal(size=(5, 100, 1))))
    return bench, law


@cache
def roll_out(model: str, bench: str, engine: str) -> Rollout:
    """Rollouts of a law on a bench; they know neither bounds nor what is identified."""
    bench, law = compose_drive((f"model={model}", f"bench={bench}"))
    return make_rollout(make_engine(engine, bench, friction_of(law), law.constraint))


PROGRAMS: dict[Any, Any] = defaultdict(dict)  # compiled equations of objectives that differ by their numbers only


def pose(
    model: str,
    *overrides: str,
    segments: Segments | None = None,
    bench: str = "knee",
    engine: str = "specialised",
    **loss: Any,
) -> Problem:
    """The identification problem of one model on these segments; `overrides` say what is identified, and from where."""
    drive = copy.deepcopy(compose_drive((f"model={model}", f"bench={bench}", *overrides)))
    rollout, segments = roll_out(model, bench, engine), record() if segments is None else segments
    objective = Objective(Space(*drive, "float64"), rollout, segments, **(LOSS | loss))
    shapes = tuple(part.shape for part in jax.tree.leaves(objective.data))
    objective._programs = PROGRAMS[model, bench, engine, overrides, str(loss), objective.stretches, shapes]
    return Problem(drive[1], objective)


def bowl(problem: Problem, centre: float = 0.0) -> Problem:
    """The same problem with another loss, which compiles at once: a vector's distance from this one."""
    problem.objective.value_and_grad = lambda _: jax.value_and_grad(lambda vector, _: jnp.sum((vector - centre) ** 4))
    return problem


def identified(values: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    return {name: np.ravel(value)[0] for owner in values.values() for name, value in owner.items()}


def run(problem: Problem, fit: Any, folder: Path, **options: Any) -> Any:
    loop = {"chunk": 100, "patience": None, "progress": False} | options
    return run_fit(fit, problem.objective, problem.model, FitFiles(folder, TensorBoard()), **loop)


def noisy(segments: Segments, position: float, velocity: float) -> Segments:
    rng = np.random.default_rng(3)
    qpos = segments.qpos + position * rng.normal(size=segments.qpos.shape)
    qvel = segments.qvel + velocity * rng.normal(size=segments.qvel.shape)
    return Segments(qpos, qvel, segments.signals, segments.timestep)
