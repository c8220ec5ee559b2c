"""Time of gradient fits against the paper's grid search: `python benchmarks/grid.py`.

As in the paper, the grid search simulates 1000 steps for each combination of armature, frictionloss and damping, one
combination after another. It is measured twice: with a compiled `mjx.step` called from Python, as in MJX's tutorials (a
few combinations, scaled to all), and with all steps in one compiled function. The table adds this package's `fit=grid`,
which simulates many combinations at once in the specialised engine, and gradient fits by the paper's recipe.
"""

import argparse
import itertools
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from measure import compile_time, make_parser, report
from mujoco import mjx
from omegaconf import OmegaConf

from frictionzoo.core.build import build
from frictionzoo.core.config import compose_config
from frictionzoo.fit import run_fit
from frictionzoo.fit.loop import FitFiles
from frictionzoo.identification import Problem

COLUMNS = {
    "way": "way",
    "model": "model",
    "simulations": "simulations or iterations",
    "compile": "compile [s]",
    "search": "search [s]",
    "whole": "both [s]",
    "stepwise": "mjx.step by step / this",
    "compiled": "MJX, compiled / this",
}
GRID = "mujoco_grid_search"
MODELS = ("mujoco_default", "coulomb_smooth", "coulomb_stribeck", "neural_friction")


def pose(*overrides: str) -> Problem:
    """Return the problem of `experiment=kovalev2026` with these overrides, without the compilation cache.

    Args:
        overrides: Options as on the command line.
    """
    config = compose_config("experiment=kovalev2026", "compilation_cache=null", "loop.progress=false", *overrides)
    settings = cast(dict[str, Any], OmegaConf.to_container(config, resolve=True))
    return Problem.from_settings(settings)


def search_one_by_one(points: int, sample: int, *overrides: str) -> Iterator[dict[str, Any]]:
    """Yield the rows of the paper's grid search, one simulation per combination: stepped from Python, and compiled.

    Args:
        points: Values of each parameter.
        sample: Combinations simulated step by step; their time is scaled to all.
        overrides: Overrides of the configuration.
    """
    problem = pose(f"model={GRID}", "engine=mjx", f"fit.points={points}", *overrides)
    objective, space = problem.objective, problem.objective.space
    loss, compiling = compile_time(objective.compile, objective.loss, space.start, objective.data)
    axes = [np.linspace(low, high, points) for low, high in zip(space.low, space.high, strict=True)]
    vectors = np.array(list(itertools.product(*axes)), dtype=space.start.dtype)
    losses, seconds = timed(lambda vector: loss(vector, objective.data), vectors)

    step = jax.jit(mjx.step)
    _, warm = timed(lambda vector: simulate(step, problem, vector), vectors[:1])
    few = np.arange(sample) * len(vectors) // sample
    checked, lasted = timed(lambda vector: simulate(step, problem, vector), vectors[few])
    np.testing.assert_allclose(checked, losses[few], rtol=1e-3)  # the same simulations; float32
    lasted *= len(vectors) / sample
    yield row("mjx.step from Python", GRID, len(vectors), max(0.0, warm - lasted / len(vectors)), lasted)
    yield row("MJX, compiled", GRID, len(vectors), compiling, seconds)


def timed(function: Callable[[np.ndarray], Any], vectors: np.ndarray) -> tuple[np.ndarray, float]:
    """Return a function's values and their total time [s].

    Args:
        function: Function of a vector.
        vectors: One vector per row.
    """
    began = time.perf_counter()
    values = np.array([float(function(vector)) for vector in vectors])
    return values, time.perf_counter() - began


def simulate(step: Callable[..., Any], problem: Problem, vector: np.ndarray) -> float:
    """Return the objective of one combination, simulated step by step with stock MJX.

    Args:
        step: Compiled `mjx.step`.
        problem: Problem with one segment.
        vector: The combination.
    """
    values, segment = problem.objective.space.values(vector), problem.segments
    friction = (np.asarray(values["friction"][name]) for name in ("frictionloss", "damping"))
    text = problem.bench.mjcf({name: np.asarray(value) for name, value in values["bench"].items()}, *friction)
    stock = mujoco.MjModel.from_xml_string(text)
    model, data = mjx.put_model(stock), mjx.make_data(stock)
    data = data.replace(qpos=jnp.asarray(segment.qpos[0, 0]), qvel=jnp.asarray(segment.qvel[0, 0]))
    predicted = []
    for command in segment.signals.ctrl[0]:
        data = step(model, data.replace(ctrl=jnp.asarray(command)))
        predicted.append((data.qpos, data.qvel))
    qpos, qvel = np.swapaxes(np.asarray(predicted), 0, 1)
    return float(np.mean((qpos - segment.qpos[0, 1:]) ** 2 + (qvel - segment.qvel[0, 1:]) ** 2))


def search_with_package(model: str, *overrides: str) -> dict[str, Any]:
    """Run a fit of this package and return its row.

    Args:
        model: Friction model.
        overrides: Overrides of the configuration.
    """
    problem = pose(f"model={model}", *overrides)
    settings = problem.settings
    with tempfile.TemporaryDirectory() as folder:
        record = FitFiles(Path(folder), build(settings["logger"]))
        outcome = run_fit(problem.fit, problem.objective, problem.drive.model, record, **settings["loop"])
    way = "fit=grid" if model == GRID else "gradient"
    return row(way, model, outcome.iterations, outcome.compile_seconds, outcome.fit_seconds)


def row(way: str, model: str, simulations: int, compiling: float, search: float) -> dict[str, Any]:
    """Return one row of the table.

    Args:
        way: Search method.
        model: Friction model.
        simulations: Number of simulated combinations, or of iterations.
        compiling: Compile time [s].
        search: Search time [s].
    """
    times = {"compile": compiling, "search": search, "whole": compiling + search}
    return {"way": way, "model": model, "simulations": simulations, **times}


def measure(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yield all rows, each with its ratios to both grid searches of the paper.

    Args:
        options: Command-line options.
    """
    stepwise, compiled = search_one_by_one(options.points, options.sample, *options.overrides)
    ours = search_with_package(GRID, f"fit.points={options.points}", *options.overrides)
    gradient = (search_with_package(model, *options.overrides) for model in options.models)
    for found in itertools.chain([stepwise, compiled, ours], gradient):
        ratios = {"stepwise": stepwise, "compiled": compiled}
        yield found | {name: grid["whole"] / found["whole"] for name, grid in ratios.items()}


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser("grid", __doc__)
    parser.add_argument("--points", type=int, default=11, help="values of each parameter in the grid of the paper")
    parser.add_argument("--sample", type=int, default=10, help="combinations that are simulated step by step")
    parser.add_argument("--models", nargs="*", default=MODELS, help="gradient models to fit")
    parser.add_argument("overrides", nargs="*", help="overrides of the configuration, after --")
    return parser.parse_args()


def main() -> None:
    """Measure, print and write the results."""
    options = parse()
    report(options.out, list(measure(options)), COLUMNS, points=options.points)


if __name__ == "__main__":
    main()
