"""The friction law as TorchScript, which `torch.jit.load` and libtorch run without frictionzoo."""

import io
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch

from frictionzoo.core.output import write_atomically
from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.export.base import Target, register_target
from frictionzoo.export.graph import DTYPES, Graph, compare, example, inputs, limits, read_dtype
from frictionzoo.export.written import Export
from frictionzoo.models.base import FrictionModel
from frictionzoo.result.identified import Identified

FILE = "friction.pt"
_DEPRECATED = (
    "PyTorch calls TorchScript deprecated; simulators still load it. It is not Isaac Lab's actuator network, whose "
    "inputs are a history of position errors and velocities and whose output is the motor's torque."
)


@register_target("torchscript")
class TorchScript(Target):
    """The law alone, of any batch size and on any device, in one file with its weights."""

    options: ClassVar[Mapping[str, str]] = {"dtype": "float64 or float32, of inputs and outputs"}
    packages: ClassVar[tuple[str, ...]] = ("torch",)
    instant: ClassVar[bool] = True

    def write(self, fitted: Identified, folder: Path, options: Mapping[str, str]) -> Export:
        """See `Target.write`."""
        dtype = read_dtype(options)
        write_atomically(folder / FILE, export_torchscript(fitted.model, dtype))
        difference = compare(fitted, run_torchscript(folder / FILE, fitted.samples, dtype), "torch.jit.load")
        return Export((FILE,), (difference,), (*limits(fitted.model), _DEPRECATED))


def export_torchscript(model: FrictionModel, dtype: str) -> bytes:
    """The law as a serialised script module.

    Args:
        model: The law, holding its identified values.
        dtype: `float64` or `float32`.
    """
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"`torch\.jit", DeprecationWarning)
        traced = torch.jit.trace(Graph(model, DTYPES[dtype]), example(model, DTYPES[dtype]))
        torch.jit.save(traced, buffer)
    return buffer.getvalue()


def run_torchscript(path: Path, samples: DriveState, dtype: str) -> FrictionTerms:
    """What the file answers when it is loaded again.

    Args:
        path: The file.
        samples: Arrays of shape (samples, nv).
        dtype: Of the file.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"`torch\.jit", DeprecationWarning)
        loaded = torch.jit.load(path)
    return FrictionTerms(*(np.asarray(term, np.float64) for term in loaded(**inputs(samples, DTYPES[dtype]))))
