"""What a friction law costs that exists only in torch: `python benchmarks/torch_only.py`.

One law, `coulomb_stribeck`, as a formula over `xp` and as a module in torch alone, in one objective on the paper's
drive and its twin's recording: seconds of the loss with its gradient, which is what an iteration of Adam costs.
"""

import argparse
import time
from typing import Any

import jax
import numpy as np
import torch
from gradient import DTYPE, STEPS, Case, knee
from measure import make_parser, median_time, report

from frictionzoo.fit import Objective, Space
from frictionzoo.models import CoulombStribeck, FrictionModel, TorchFriction
from frictionzoo.simulate.drive import Drive
from frictionzoo.types import DriveState, FrictionTerms

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
    """The law of `coulomb_stribeck`, in torch alone."""

    name = "torch_coulomb_stribeck"
    dimensions = CoulombStribeck.dimensions
    static_torque: torch.Tensor
    kinetic_torque: torch.Tensor
    stribeck_velocity: torch.Tensor
    viscous_coefficient: torch.Tensor
    smoothing_velocity: torch.Tensor

    def forward(self, state: DriveState) -> FrictionTerms:
        """The explicit torque."""
        share = torch.exp(-((state.qvel / self.stribeck_velocity) ** 2))
        dry = torch.lerp(self.kinetic_torque, self.static_torque, share)
        sign = torch.tanh(state.qvel / self.smoothing_velocity)
        return FrictionTerms(torque=dry * sign + self.viscous_coefficient * state.qvel)


def main() -> None:
    """Measure, print, write."""
    options = parse()
    case = knee(options.quick)
    rows: list[dict[str, Any]] = []
    for engine in options.engines:
        pair = [measure(case, engine, law, model) for law, model in laws(case)]
        expected = pair[0][1]
        for row, gradient in pair:
            difference = float(np.max(np.abs(gradient / expected - 1)))
            rows.append(row | {"ratio": row["seconds"] / pair[0][0]["seconds"], "difference": difference})
    report(options.out, rows, COLUMNS, quick=options.quick, dtype=DTYPE, steps=STEPS)


def parse() -> argparse.Namespace:
    """The command line."""
    parser = make_parser("torch_only", __doc__)
    parser.add_argument("--engines", nargs="*", choices=ENGINES, default=ENGINES, metavar="ENGINE", help="one or both")
    parser.add_argument("--quick", action="store_true", help="few segments: the ratio means nothing then")
    return parser.parse_args()


def laws(case: Case) -> list[tuple[str, FrictionModel]]:
    """The law with a formula and the one without, with the same values."""
    fields = ("init", "low", "high", "scale", "identify")
    params = {name: {key: getattr(param, key) for key in fields} for name, param in case.model.params.items()}
    return [("formula", case.model), ("torch", TorchCoulombStribeck(case.bench.nv, params))]


def measure(case: Case, engine: str, law: str, model: FrictionModel) -> tuple[dict[str, Any], np.ndarray]:
    """One row without comparisons, and the gradient."""
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
    row = {
        "engine": engine,
        "law": law,
        "segments": case.segments.count,
        "compile": max(first - timed.seconds, 0.0),
        "seconds": timed.seconds,
        "calls": timed.calls,
    }
    return row, np.asarray(timed.answer[1], np.float64)


if __name__ == "__main__":
    main()
