# pyright: strict
"""Every name of `frictionzoo`, as a program that is type-checked strictly uses it: `make lint` looks at it."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

import frictionzoo as fz


@fz.register_model("own")
class Own(fz.FrictionModel):
    """A law of one's own."""

    dimensions = {"damping": "damping"}

    def terms(self, xp: Any, values: Mapping[str, Any], state: fz.DriveState) -> fz.FrictionTerms:
        """See `FrictionModel.terms`."""
        return fz.FrictionTerms(torque=values["damping"] * state.qvel)


def identify(folder: str) -> list[str]:
    """Recordings to results."""
    logs: fz.Logs = fz.read("a.csv", {"time": np.arange(3.0)}, clean=fz.Cleaning(step=0.002), units={"time": "ms"})
    first: fz.Log = next(iter(logs))
    doubts = [finding.text for finding in fz.inspect(logs).findings if finding.doubtful]
    bench = fz.Bench("stand.xml", joint="shaft", actuator=fz.PositionPD(kp=15, kd=0.5))
    others = [fz.Force(force_gain=1.2, force_offset=0.0), fz.DcMotorPD, fz.VoltageServo]
    fit: fz.Identified = fz.identify(
        bench,
        Own(bench.nv, {"damping": {"init": 0.1, "low": 1e-3, "high": 10.0, "scale": "log", "identify": True}}),
        [first],
        test=fz.Split(by="file", test=["a.csv"]),
        segments={"length": 20},
        loss={"robust": "huber"},
        evaluation={"horizons": [1.0]},
        loop={"progress": False},
    )
    fit.plot()
    logs.plot(0, bench)
    fit.save(folder)
    written = fit.export("mjcf", "drive.xml", timestep=0.001)
    armature = fit.parameters["bench.armature"]
    error: float | None = fit.metrics["test"].position_mae
    known: dict[str, fz.Param] = bench.params
    compared: fz.Compared = fz.compare(
        bench, ["baseline", Own(1, {"damping": 0.1})], logs, test=0.2, method="lm", seed=1
    )
    best = compared.recommended or fz.load(folder)
    told = [str(best), armature.unit, f"{armature.value} {armature.interval} {error} {written.target} {known} {others}"]
    return told + compared.ranking + doubts


def roll_out(bench: fz.Bench, measured: torch.Tensor, ctrl: torch.Tensor) -> torch.nn.Module:
    """Torch in, torch out."""
    law = fz.law("neural_friction", nv=1, hidden=[4])
    qpos, qvel = fz.rollout(bench, law, measured[:, 0], 0 * measured[:, 0], ctrl)
    loss = (qpos - measured).square().mean() + 0 * qvel.sum()
    loss.backward()  # pyright: ignore[reportUnknownMemberType] - torch's own
    fz.check_model(fz.law("own"))
    return law
