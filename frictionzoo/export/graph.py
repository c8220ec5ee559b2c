"""A friction law as a function of plain tensors, which runtimes without frictionzoo can hold."""

import copy
import json
from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch

from frictionzoo import __version__
from frictionzoo.core.errors import ConfigError, closest
from frictionzoo.core.output import write_atomically
from frictionzoo.core.params import UNITS
from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.export.base import Target, measure
from frictionzoo.export.nearest import evaluate_law
from frictionzoo.export.written import Difference, Export
from frictionzoo.models.base import FrictionModel, sliding_torque
from frictionzoo.result.identified import Identified

DTYPES = {"float64": torch.float64, "float32": torch.float32}
LIMITS = (
    "The friction law only: armature, actuator and delay stay with the simulator. Inputs qpos, qvel, ctrl, "
    "motor_torque and external_torque of shape (batch, nv) are one instant, in SI units; no history.",
    "Outputs torque, frictionloss and damping of shape (batch, nv). Subtract torque + damping * qvel from the drive's "
    "torque; dry friction is whatever stops the joint, at most frictionloss. What the law does not use is 0.",
)
_OBSERVED = "Besides, the inputs {names} of the same shape: the friction law looks at them too."


class Graph(torch.nn.Module):
    """A copy of a law with its values as constants: the signals of a `DriveState` to the three of `FrictionTerms`.

    Inputs, outputs and constants are of one `dtype`.
    """

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
        """Each of the terms, of shape (batch, nv), 0 where the law does not use it."""
        terms = self.law(DriveState(qpos, qvel, ctrl, motor_torque, external_torque, temperature))
        shape = qvel.shape
        return tuple(torch.zeros_like(qvel) if term is None else torch.broadcast_to(term, shape) for term in terms)


def signals(model: FrictionModel) -> tuple[str, ...]:
    """Names of what a law looks at, in order."""
    return tuple(name for name in DriveState._fields if name in model.inputs or name not in DriveState._field_defaults)


def list_units(fitted: Identified) -> dict[str, str]:
    """Unit of each input and output of a law's file, by name."""
    units = UNITS[fitted.bench.joint_type]
    outputs = {"torque": units["torque"], "frictionloss": units["torque"], "damping": units["damping"]}
    torques = dict.fromkeys(("motor_torque", "external_torque"), units["torque"])
    states = {"qpos": units["position"], "qvel": units["velocity"], "ctrl": "as it was recorded", **torques}
    return {**{name: states.get(name, "degC") for name in signals(fitted.model)}, **outputs}


def list_facts(fitted: Identified) -> dict[str, str]:
    """What a law's file says of itself, as text: law, joints, units and how it is evaluated."""
    inputs, units = signals(fitted.model), list_units(fitted)
    return {
        "producer": f"frictionzoo {__version__}",
        "law": fitted.model.name,
        "joints": json.dumps(fitted.bench.joints),
        "inputs": json.dumps({name: units[name] for name in inputs}),
        "outputs": json.dumps({name: unit for name, unit in units.items() if name not in inputs}),
        "sampling": "a function of one instant, to be evaluated in each step of the simulation; identified in steps "
        f"of {fitted.timestep:g} s, from samples each {fitted.segments.timestep:g} s",
        "use": LIMITS[1],
    }


def compare(fitted: Identified, came: FrictionTerms, how: str) -> Difference:
    """How far the friction torque of terms of shape (samples, nv), computed by `how`, is from the law in float64."""
    samples = fitted.samples
    expected = sliding_torque(np, evaluate_law(fitted.model, samples), samples.qvel)
    over = f"{len(expected)} recorded states in {how}"
    return measure("torque", fitted, sliding_torque(np, came, samples.qvel), expected, over)


class GraphFile(Target):
    """The law alone in one file.

    Attributes:
        file: Its name.
        runtime: What runs it.
        remarks: What its user has to know besides `LIMITS`.
    """

    options: ClassVar[Mapping[str, str]] = {"dtype": "float64 or float32, of inputs and outputs"}
    instant: ClassVar[bool] = True
    file: ClassVar[str]
    runtime: ClassVar[str]
    remarks: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def serialise(self, graph: Graph, inputs: Mapping[str, torch.Tensor], fitted: Identified) -> bytes:
        """The file's content, recorded with these inputs by name; what it says of the drive is in its metadata."""

    @abstractmethod
    def run(self, path: Path, inputs: Mapping[str, torch.Tensor]) -> tuple[np.ndarray, ...]:
        """What the file answers on the CPU."""

    def write(self, fitted: Identified, folder: Path, options: Mapping[str, str]) -> Export:
        """See `Target.write`."""
        name, model, samples, path = options.get("dtype", "float64"), fitted.model, fitted.samples, folder / self.file
        if name not in DTYPES:
            raise ConfigError(f"dtype={name}: unknown; {closest(name, DTYPES)}")
        dtype, seen = DTYPES[name], signals(model)
        # Two rows, since one would be taken for a constant.
        rows = {name: torch.ones(2, model.nv, dtype=dtype) for name in seen}
        write_atomically(path, self.serialise(Graph(model, dtype), rows, fitted))
        inputs = samples.map(lambda signal: torch.tensor(np.asarray(signal, np.float64), dtype=dtype)).given()
        came = FrictionTerms(*(np.asarray(term, np.float64) for term in self.run(path, inputs)))
        observed = (_OBSERVED.format(names=", ".join(model.inputs)),) if model.inputs else ()
        return Export((self.file,), (compare(fitted, came, self.runtime),), (*LIMITS, *observed, *self.remarks))
