"""A friction model as a function of plain tensors, for runtimes without frictionzoo."""

import copy
import json
from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch

from frictionzoo import __version__
from frictionzoo.core.output import write_atomically
from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.export.base import Deviation, Export, Target, measure, read_choice
from frictionzoo.export.nearest import evaluate_law
from frictionzoo.models.base import FrictionModel, sliding_torque
from frictionzoo.result.fitted_drive import FittedDrive

DTYPES = {"float64": torch.float64, "float32": torch.float32}
LIMITS = (
    "The friction law only: armature, actuator and delay stay with the simulator. Inputs qpos, qvel, ctrl, "
    "motor_torque and external_torque of shape (batch, nv) are one instant, in SI units; no history.",
    "Outputs torque, frictionloss and damping of shape (batch, nv). Subtract torque + damping * qvel from the drive's "
    "torque; dry friction is whatever stops the joint, at most frictionloss. What the law does not use is 0.",
)


class Graph(torch.nn.Module):
    """Copy of a friction model with constant parameters of one `dtype`, from state signals to `FrictionTerms`."""

    def __init__(self, model: FrictionModel, dtype: torch.dtype) -> None:
        super().__init__()
        self.law: FrictionModel = copy.deepcopy(model).to(dtype).requires_grad_(False)
        self.eval()

    def forward(
        self,
        qpos: torch.Tensor,
        qvel: torch.Tensor,
        ctrl: torch.Tensor,
        motor_torque: torch.Tensor,
        external_torque: torch.Tensor,
        temperature: torch.Tensor | None = None,
    ) -> tuple[torch.Tensor, ...]:
        """Return all terms, each of shape (batch, nv); 0 for a term that the model does not use."""
        terms = self.law(DriveState(qpos, qvel, ctrl, motor_torque, external_torque, temperature))
        shape = qvel.shape
        return tuple(torch.zeros_like(qvel) if term is None else torch.broadcast_to(term, shape) for term in terms)


def signals(model: FrictionModel) -> tuple[str, ...]:
    """Return the names of a model's input signals, in order."""
    return tuple(name for name in DriveState._fields if name in model.inputs or name not in DriveState._field_defaults)


def list_units(fitted: FittedDrive) -> tuple[dict[str, str], dict[str, str]]:
    """Return the unit of each input, and of each output, of a model's file, by name."""
    units = fitted.units
    states = {"qpos": units["position"], "qvel": units["velocity"], "ctrl": "as it was recorded"}
    states |= dict.fromkeys(("motor_torque", "external_torque"), units["torque"])
    outputs = {"torque": units["torque"], "frictionloss": units["torque"], "damping": units["damping"]}
    return {name: states.get(name, "degC") for name in signals(fitted.model)}, outputs


def list_facts(fitted: FittedDrive) -> dict[str, str]:
    """Return the metadata of a model's file as text: model, joints, units and usage."""
    inputs, outputs = map(json.dumps, list_units(fitted))
    return {
        "producer": f"frictionzoo {__version__}",
        "law": fitted.model.name,
        "joints": json.dumps(fitted.bench.joints),
        "inputs": inputs,
        "outputs": outputs,
        "sampling": "a function of one instant, to be evaluated in each step of the simulation; identified in steps "
        f"of {fitted.timestep:g} s, from samples each {fitted.segments.timestep:g} s",
        "use": LIMITS[1],
    }


def compare(fitted: FittedDrive, came: FrictionTerms, how: str) -> Deviation:
    """Compare the friction torque of terms of shape (samples, nv), computed by `how`, with the model in float64."""
    samples = fitted.samples
    expected = sliding_torque(np, evaluate_law(fitted.model, samples), samples.qvel)
    over = f"{len(expected)} recorded states in {how}"
    return measure("torque", fitted, sliding_torque(np, came, samples.qvel), expected, over)


class GraphFile(Target):
    """Friction model in one file for a runtime; `remarks` to the user follow `LIMITS`."""

    options: ClassVar[Mapping[str, str]] = {"dtype": "float64 or float32, of inputs and outputs"}
    instant: ClassVar[bool] = True
    file: ClassVar[str]
    runtime: ClassVar[str]
    remarks: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def serialise(self, graph: Graph, inputs: Mapping[str, torch.Tensor], fitted: FittedDrive) -> bytes:
        """Return the file's content, traced with these inputs by name; its metadata describes the drive."""

    @abstractmethod
    def run(self, path: Path, inputs: Mapping[str, torch.Tensor]) -> tuple[np.ndarray, ...]:
        """Evaluate the file on the CPU."""

    def write(self, fitted: FittedDrive, folder: Path, options: Mapping[str, str]) -> Export:
        """See `Target.write`."""
        model, samples, path = fitted.model, fitted.samples, folder / self.file
        dtype, input_names = DTYPES[read_choice(options, "dtype", DTYPES)], signals(model)
        # A batch of one would be traced as a constant size.
        rows = {name: torch.ones(2, model.nv, dtype=dtype) for name in input_names}
        write_atomically(path, self.serialise(Graph(model, dtype), rows, fitted))
        inputs = samples.map(lambda signal: torch.tensor(np.asarray(signal, np.float64), dtype=dtype)).given()
        terms = FrictionTerms(*(np.asarray(term, np.float64) for term in self.run(path, inputs)))
        limits = [*LIMITS, *self.remarks]
        if model.inputs:
            names = ", ".join(model.inputs)
            limits.insert(2, f"Additional inputs of the friction model, of the same shape: {names}.")
        return Export((self.file,), (compare(fitted, terms, self.runtime),), tuple(limits))
