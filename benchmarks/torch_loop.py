"""Hand-written torch loops against compiled fits: `python benchmarks/torch_loop.py`.

Compares hand-written loops over `fz.rollout`, with torch's Adam and LBFGS, with `fit=adam` and `fit=lm`. All start from
the same values on the segments of `data=twin`. The table gives the loss reached and the time per iteration; for LBFGS,
per evaluation of its closure. Models with a network omit `fit=lm` and LBFGS.
"""

import argparse
import copy
import time
from collections.abc import Callable, Iterator
from typing import Any

import torch
from measure import make_parser, report
from omegaconf import OmegaConf

import frictionzoo as fz
from frictionzoo.core.config import compose_config
from frictionzoo.fit import run_fit
from frictionzoo.identification import Problem
from frictionzoo.models import FrictionModel
from frictionzoo.simulation.context import computing

COLUMNS = {
    "law": "law",
    "way": "way",
    "iterations": "iterations",
    "loss": "loss",
    "ratio": "loss / first",
    "seconds": "seconds",
    "each": "seconds an iteration",
}
LAWS = ("coulomb_stribeck", "lugre", "neural_friction")
RATE = {"coulomb_stribeck": 2e-3, "lugre": 2e-3, "neural_friction": 1e-2}  # learning rate of Adam, in SI units


def main() -> None:
    """Measure, print and write the results."""
    options = parse()
    rows: list[dict[str, Any]] = []
    for law in options.laws:
        measured = list(measure(law, options))
        rows += [row | {"ratio": row["loss"] / measured[0]["loss"]} for row in measured]
    report(options.out, rows, COLUMNS)


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser("torch_loop", __doc__)
    parser.add_argument("--laws", nargs="*", choices=LAWS, default=LAWS, metavar="LAW", help="some of the laws")
    parser.add_argument("--iterations", type=int, default=700, help="of fit=adam")
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="options of a run, after --")
    return parser.parse_args()


def measure(law: str, options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yield the rows of a friction model, without the ratio."""
    network = law == "neural_friction"
    for fit in ("adam",) if network else ("adam", "lm"):
        problem, device = pose(law, fit, options)
        with device:
            start = copy.deepcopy(problem.drive.model)
            if fit == "adam":
                by_hand = problem, start
            outcome = run_fit(problem.fit, problem.objective, problem.drive.model, progress=False)
        yield row(law, f"fit={fit}", outcome.iterations, outcome.loss, outcome.fit_seconds)
    problem, start = by_hand
    yield descend(law, problem, copy.deepcopy(start), options.iterations)
    if not network:
        yield search_line(law, problem, copy.deepcopy(start))


def pose(law: str, fit: str, options: argparse.Namespace) -> tuple[Problem, Any]:
    """Return the problem of a run and its computing context."""
    iterations = [f"fit.iterations={options.iterations}"] if fit == "adam" else []
    config = compose_config(f"model={law}", f"fit={fit}", *iterations, *options.overrides)
    settings: Any = OmegaConf.to_container(config, resolve=True)
    device = computing(settings["dtype"], settings["device"], settings["compilation_cache"])
    with device:
        return Problem.from_settings(settings), computing(settings["dtype"], settings["device"], None)


def closure(problem: Problem, law: FrictionModel) -> tuple[Callable[[], torch.Tensor], list[torch.Tensor]]:
    """Return the loss of a run as a torch closure, and its trainable tensors."""
    bench, segments = problem.bench, problem.segments
    signals = segments.qpos, segments.qvel, segments.signals.ctrl
    qpos, qvel, ctrl = (torch.as_tensor(signal, dtype=torch.float32) for signal in signals)
    armature = torch.tensor(bench.initial_values()["armature"], dtype=torch.float32, requires_grad=True)

    def loss() -> torch.Tensor:
        found = fz.rollout(bench, law, qpos[:, 0], qvel[:, 0], ctrl, parameters={"armature": armature})
        errors = (one - measured[:, 1:] for one, measured in zip(found, (qpos, qvel), strict=True))
        return sum((error.square().mean() for error in errors), torch.zeros(()))

    return loss, [*(p for p in law.parameters() if p.requires_grad), armature]


def descend(law: str, problem: Problem, model: FrictionModel, iterations: int) -> dict[str, Any]:
    """Run a hand-written Adam loop; physical values stay within their bounds."""
    loss, moving = closure(problem, model)
    optimiser = torch.optim.Adam(moving, lr=RATE[law], betas=(0.9, 0.9))
    loss().backward()  # compiles it
    best, began = float("inf"), time.perf_counter()
    for _ in range(iterations):
        optimiser.zero_grad()
        error = loss()
        error.backward()
        best = min(best, error.item())
        optimiser.step()
        clamp(model, moving[-1])
    return row(law, "torch Adam", iterations, best, time.perf_counter() - began)


def search_line(law: str, problem: Problem, model: FrictionModel) -> dict[str, Any]:
    """Run a hand-written LBFGS loop."""
    loss, moving = closure(problem, model)
    optimiser = torch.optim.LBFGS(moving, max_iter=200, line_search_fn="strong_wolfe")
    losses: list[float] = []

    def step() -> torch.Tensor:
        optimiser.zero_grad()
        error = loss()
        error.backward()
        losses.append(error.item())
        return error

    step()  # compiles it
    began = time.perf_counter()
    optimiser.step(step)
    finite = [error for error in losses if error == error]
    return row(law, "torch LBFGS", len(losses), min(finite), time.perf_counter() - began)


def clamp(model: FrictionModel, armature: torch.Tensor) -> None:
    """Clip values to their bounds, as `fit=adam` does."""
    with torch.no_grad():
        armature.clamp_(min=1e-5)
        for name, param in model.params.items():
            model.get_parameter(name).clamp_(param.low, param.high)


def row(law: str, way: str, iterations: int, loss: float, seconds: float) -> dict[str, Any]:
    """Return one row of the table."""
    return {
        "law": law,
        "way": way,
        "iterations": iterations,
        "loss": loss,
        "seconds": seconds,
        "each": seconds / iterations,
    }


if __name__ == "__main__":
    main()
