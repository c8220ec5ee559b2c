"""The friction law as TorchScript, which `torch.jit.load` and libtorch run without frictionzoo."""

import io
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch

from frictionzoo.export.base import register_target
from frictionzoo.export.graph import Graph, GraphFile


@register_target("torchscript")
class TorchScript(GraphFile):
    """The law alone, of any batch size and on any device, in one file with its weights."""

    packages: ClassVar[tuple[str, ...]] = ("torch",)
    file, runtime = "friction.pt", "torch.jit.load"
    remarks = (
        "PyTorch calls TorchScript deprecated; simulators still load it. It is not Isaac Lab's actuator network, whose "
        "inputs are a history of position errors and velocities and whose output is the motor's torque.",
    )

    def serialise(self, graph: Graph, inputs: tuple[torch.Tensor, ...], names: tuple[str, ...]) -> bytes:
        """See `GraphFile.serialise`."""
        buffer = io.BytesIO()
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", r"`torch\.jit", DeprecationWarning)
            torch.jit.save(torch.jit.trace(graph, inputs), buffer)
        return buffer.getvalue()

    def run(self, path: Path, inputs: Mapping[str, torch.Tensor]) -> tuple[np.ndarray, ...]:
        """See `GraphFile.run`."""
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", r"`torch\.jit", DeprecationWarning)
            return tuple(map(np.asarray, torch.jit.load(path)(**inputs)))
