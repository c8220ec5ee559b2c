"""Cost of torch, as a torch-only model and as a hand-written loop: `python benchmarks/torch_only.py`.

Times the loss with its gradient, the cost of one Adam iteration, on the paper's drive and its twin's recording. The
model `coulomb_stribeck` is a formula over `xp`, this formula in a loop over `frictionzoo.rollout`, or a torch module.
"""

import argparse
import copy
import time
from typing import Any

import jax
import numpy as np
import torch
from gradient import DTYPE, STEPS, Case, knee
from measure import make_parser, median_time, report

import frictionzoo as fz
from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.fit import Objective, Space
from frictionzoo.models import CoulombStribeck, FrictionModel, TorchFriction
from frictionzoo.simulation.drive import Drive

COLUMNS = {
    "engine": "engine",
    "law": "law",
    "segments": "segments",
    "compile": "compile [s]",
    "seconds": "gradient [s]",
    "calls": "calls",
    "ratio": "ratio",
    "difference": "difference",
}
ENGINES = ("specialised", "mjx")


class TorchCoulombStribeck(TorchFriction):
    """Friction model `coulomb_stribeck`, in torch alone."""

    name = "torch_coulomb_stribeck"
    dimensions = CoulombStribeck.dimensions
    static_torque: torch.Tensor
    kinetic_torque: torch.Tensor
    stribeck_velocity: torch.Tensor
    viscous_coefficient: torch.Tensor
    smoothing_velocity: torch.Tensor

    def forward(self, state: DriveState) -> FrictionTerms:
        """Return the explicit torque."""
        share = torch.exp(-((state.qvel / self.stribeck_velocity) ** 2))
        dry = torch.lerp(self.kinetic_torque, self.static_torque, share)
        sign = torch.tanh(state.qvel / self.smoothing_velocity)
        return FrictionTerms(torque=dry * sign + self.viscous_coefficient * state.qvel)


def main() -> None:
    """Measure, print and write the results."""
    options = parse()
    case = knee(options.quick)
    rows: list[dict[str, Any]] = []
    for engine in options.engines:
        measured = [measure(case, engine, law, model) for law, model in laws(case)]
        measured.insert(1, measure_loop(case, engine))
        expected = measured[0][1]
        for row, gradient in measured:
            difference = float(np.max(np.abs(gradient / expected - 1)))
            rows.append(row | {"ratio": row["seconds"] / measured[0][0]["seconds"], "difference": difference})
    report(options.out, rows, COLUMNS, quick=options.quick, dtype=DTYPE, steps=STEPS)


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser("torch_only", __doc__)
    parser.add_argument("--engines", nargs="*", choices=ENGINES, default=ENGINES, metavar="ENGINE", help="one or both")
    parser.add_argument("--quick", action="store_true", help="few segments: the ratio means nothing then")
    return parser.parse_args()


def laws(case: Case) -> list[tuple[str, FrictionModel]]:
    """Return the model as a formula and as a torch module, with the same values."""
    fields = ("init", "low", "high", "scale", "identify")
    params = {name: {key: getattr(param, key) for key in fields} for name, param in case.model.params.items()}
    return [("formula", case.model), ("torch", TorchCoulombStribeck(case.bench.nv, params))]


def measure(case: Case, engine: str, law: str, model: FrictionModel) -> tuple[dict[str, Any], np.ndarray]:
    """Measure one row without comparisons; return it with the gradient."""
    rollout = Drive.assemble(case.bench, model, engine).rollout
    objective = Objective(Space(case.bench, model, DTYPE), rollout, case.segments, **case.loss)
    function = objective.value_and_grad("reverse")
    if not objective.torch_law:
        function = objective.compile(function)
    start = objective.space.start
    began = time.perf_counter()
    jax.block_until_ready(function(start, objective.data))
    first = time.perf_counter() - began
    timed = median_time(function, start, objective.data)
    return describe(case, engine, law, first, timed), np.asarray(timed.answer[1], np.float64)


def measure_loop(case: Case, engine: str) -> tuple[dict[str, Any], np.ndarray]:
    """Measure as `measure` does, for a torch loop around `frictionzoo.rollout`."""
    law = copy.deepcopy(case.model)
    signals = case.segments.qpos, case.segments.qvel, case.segments.signals.ctrl
    qpos, qvel, ctrl = (torch.as_tensor(signal, dtype=torch.float32) for signal in signals)
    armature = torch.tensor(case.bench.initial_values()["armature"], requires_grad=True)
    moving = {"bench.armature": armature} | {f"friction.{name}": value for name, value in law.named_parameters()}
    weights = case.loss["position"], case.loss["velocity"]

    def differentiate() -> list[torch.Tensor]:
        predicted = fz.rollout(
            case.bench, law, qpos[:, 0], qvel[:, 0], ctrl, parameters={"armature": armature}, engine=engine
        )
        errors = (found - measured[:, 1:] for found, measured in zip(predicted, (qpos, qvel), strict=True))
        loss = sum(weight * error.square().mean() for weight, error in zip(weights, errors, strict=True))
        return list(torch.autograd.grad(loss, [moving[name] for name in case.space.names]))

    began = time.perf_counter()
    differentiate()
    first = time.perf_counter() - began
    timed = median_time(differentiate)
    # Optimisers of this package move logarithms.
    gradient = [
        g.numpy() * moving[name].detach().numpy() for g, name in zip(timed.answer, case.space.names, strict=True)
    ]
    return describe(case, engine, "rollout", first, timed), np.concatenate(gradient)


def describe(case: Case, engine: str, law: str, first: float, timed: Any) -> dict[str, Any]:
    """Return a row without comparisons."""
    return {
        "engine": engine,
        "law": law,
        "segments": case.segments.count,
        "compile": max(first - timed.seconds, 0.0),
        "seconds": timed.seconds,
        "calls": timed.calls,
    }


if __name__ == "__main__":
    main()
